"""The rigid body in plain numpy: a step of the model of crazyem.estimation.kernels, and the step's analytic Jacobian.

Notation as there. reference.py and tests use this module; crazyem itself runs the compiled functions of
crazyem.estimation.kernels.algebra.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.kernels.algebra import UPRIGHT
from crazyem.physics.rotations import (
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_product,
    rotation_matrix,
    skew,
)
from crazyem.vehicle import GRAVITY


class State(NamedTuple):
    """Rigid-body state. position (3,) m, velocity (3,) m/s, attitude (4,) x y z w, body_rate (3,) rad/s."""

    position: NDArray
    velocity: NDArray
    attitude: NDArray
    body_rate: NDArray

    def plus(self, error: NDArray) -> "State":
        """The state displaced by an error (12,)."""
        attitude = quaternion_product(self.attitude, quaternion_from_rotation_vector(error[6:9]))
        return State(
            self.position + error[0:3],
            self.velocity + error[3:6],
            attitude / np.linalg.norm(attitude),
            self.body_rate + error[9:12],
        )


def angular_acceleration(body_rate: NDArray, torque: NDArray, *, inertia: NDArray) -> NDArray:
    """Euler's equation. body_rate (3,) rad/s, torque (3,) N m, inertia (3, 3) kg m^2 -> (3,) rad/s^2, body FLU."""
    return np.linalg.solve(inertia, torque - np.cross(body_rate, inertia @ body_rate))


def step(
    state: State,
    thrust: float,
    torque: NDArray,
    *,
    dt: float,
    mass: float,
    inertia: NDArray,
    impulse: NDArray | None = None,
    lead: float = 0.5,
) -> State:
    """One step of the rigid body.

    Args:
        state: at the start of the step.
        thrust: mean over the step, along body z [N].
        torque: (3,) mean over the step, body FLU [N m].
        dt: length of the step [s].
        mass: [kg].
        inertia: (3, 3) [kg m^2], body FLU.
        impulse: (6,) random specific impulse [m/s] and angular-velocity impulse [rad/s], body FLU; none if absent.
        lead: rule of integration, 0.5 midpoint, 0 explicit, 1 semi-implicit Euler.
    """
    h = lead * dt
    p, v, q, w = state
    impulse = np.zeros(6) if impulse is None else impulse
    middle = rotation_matrix(quaternion_product(q, quaternion_from_rotation_vector(h * w)))
    specific = np.array([0.0, 0.0, thrust / mass]) + impulse[:3] / dt
    v_next = v + dt * (middle @ specific - np.array([0.0, 0.0, GRAVITY]))
    w_next = w + dt * angular_acceleration(w, torque, inertia=inertia) + impulse[3:]
    q_next = quaternion_product(q, quaternion_from_rotation_vector((dt - h) * w + h * w_next))
    if lead == 0.0 and np.cos((angles := euler_angles(q))[1]) > UPRIGHT:
        q_next = quaternion_from_euler(*(angles + dt * angle_rates(angles) @ w))
    return State(p + (dt - h) * v + h * v_next, v_next, q_next / np.linalg.norm(q_next), w_next)


def euler_angles(q: NDArray) -> NDArray:
    """Roll, pitch, yaw (3,) rad with R(q) = Rz(yaw) Ry(pitch) Rx(roll), pitch within a right angle."""
    r = rotation_matrix(q)
    roll, yaw = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    return np.array([roll, np.arcsin(np.clip(-r[2, 0], -1.0, 1.0)), yaw])


def angle_rates(angles: NDArray) -> NDArray:
    """Matrix (3, 3) from body rates to the derivatives of roll, pitch, yaw (3,) rad: Zhao eq. 47."""
    sr, cr, cp, tp = np.sin(angles[0]), np.cos(angles[0]), np.cos(angles[1]), np.tan(angles[1])
    return np.array([[1.0, sr * tp, cr * tp], [0.0, cr, -sr], [0.0, sr / cp, cr / cp]])


def _explicit_turn_jacobians(q: NDArray, w: NDArray, dt: float) -> tuple[NDArray, NDArray]:
    """Derivatives (3, 3) of the attitude error after an explicit step by the one before and by the body rate."""
    angles = euler_angles(q)
    rates = angle_rates(angles)
    after = angles + dt * rates @ w
    sr, cr, sp, cp = np.sin(angles[0]), np.cos(angles[0]), np.sin(angles[1]), np.cos(angles[1])
    along, across = sr * w[1] + cr * w[2], cr * w[1] - sr * w[2]  # derivatives of yaw, times cp, and of pitch
    bent = np.eye(3)
    bent[:, 0] += dt * np.array([across * sp / cp, -along, across / cp])
    bent[:, 1] += dt * np.array([along / cp**2, 0.0, along * sp / cp**2])
    back = np.linalg.inv(angle_rates(after))
    return back @ bent @ rates, dt * back @ rates


def bridge_covariance(noise: NDArray, q: NDArray, *, dt: float, lead: float = 0.5) -> NDArray:
    """Covariance (12, 12) that white noise adds within a step beyond its impulse.

    The integral of a Brownian motion given both its ends is uncertain by dt^3/12 times its intensity: position and
    attitude do not follow exactly from the velocities at the ends. Without this term the estimated noise of rates and
    the inertia are too large (inertia by 8 % on hover data at 100 Hz).

    Args:
        noise: (12, 6) from `step_jacobians`.
        q: (6,) impulse variances per second.
        dt: length of the step [s].
        lead: rule of integration; the covariance is zero except for the midpoint rule.
    """
    if lead != 0.5:
        return np.zeros((12, 12))
    within = np.zeros((12, 6))
    within[0:3, 0:3] = noise[3:6, 0:3]
    within[6:9, 3:6] = noise[6:9, 3:6] / (0.5 * dt)
    return within @ np.diag(q) @ within.T * dt**3 / 12


def right_jacobian(phi: NDArray) -> NDArray:
    """d log(exp(phi)^-1 exp(phi + d)) / dd to second order in phi: fine for the turns of one step. (3,) -> (3, 3)."""
    s = skew(phi)
    return np.eye(3) - 0.5 * s + s @ s / 6.0


def step_jacobians(
    state: State,
    thrust: float,
    torque: NDArray,
    *,
    dt: float,
    mass: float,
    inertia: NDArray,
    impulse: NDArray | None = None,
    lead: float = 0.5,
) -> tuple[NDArray, NDArray]:
    """Derivatives of `step`'s error-state: with respect to the error (12, 12) and to the impulse (12, 6).

    Arguments as of `step`; taken at `impulse`. Exact but for terms of third order in the turn of a step.
    """
    h = lead * dt
    impulse = np.zeros(6) if impulse is None else impulse
    _, _, q, w = state
    part_turn = rotation_matrix(quaternion_from_rotation_vector(h * w))
    start = rotation_matrix(q)
    middle = start @ part_turn
    specific = np.array([0.0, 0.0, thrust / mass]) + impulse[:3] / dt
    v_theta = -dt * start @ skew(part_turn @ specific)
    v_rate = -h * dt * middle @ skew(specific)
    w_rate = np.eye(3) + dt * np.linalg.solve(inertia, skew(inertia @ w) - skew(w) @ inertia)
    w_next = w + dt * angular_acceleration(w, torque, inertia=inertia) + impulse[3:]
    phi = (dt - h) * w + h * w_next
    turn = rotation_matrix(quaternion_from_rotation_vector(phi))
    jr = right_jacobian(phi)

    transition = np.eye(12)
    transition[0:3, 3:6] = dt * np.eye(3)
    transition[3:6, 6:9] = v_theta
    transition[3:6, 9:12] = v_rate
    transition[0:3, 6:9] = h * v_theta
    transition[0:3, 9:12] = h * v_rate
    transition[6:9, 6:9] = turn.T
    transition[6:9, 9:12] = jr @ ((dt - h) * np.eye(3) + h * w_rate)
    transition[9:12, 9:12] = w_rate

    if lead == 0.0 and np.cos(euler_angles(q)[1]) > UPRIGHT:
        transition[6:9, 6:9], transition[6:9, 9:12] = _explicit_turn_jacobians(q, w, dt)

    noise = np.zeros((12, 6))
    noise[0:3, 0:3] = h * middle
    noise[3:6, 0:3] = middle
    noise[6:9, 3:6] = h * jr
    noise[9:12, 3:6] = np.eye(3)
    return transition, noise
