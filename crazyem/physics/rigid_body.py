"""The rigid body: one step of its motion under thrust along body z and torque, and the step's analytic Jacobian.

State: position p [m, world], velocity v [m/s, world], attitude q (x, y, z, w; body to world), body rate w [rad/s, FLU].
Errors are 12-vectors (dp, dv, dtheta, dw) with q_true = q * exp(dtheta): the attitude error is in the body frame.

One step of length dt with mean thrust F and mean torque M over the step, and random impulses u of specific force and
angular acceleration (body frame), by the midpoint rule, second order in dt:

    a  = R(q exp(w dt/2)) (e3 F/m + u_v/dt) - g e3          v' = v + dt a
    al = I^-1 (M - w x I w) + u_w/dt                        w' = w + dt al
    p' = p + dt (v + v')/2                                  q' = q exp(dt (w + w')/2)

Noise enters through force and torque only (Zhao eq. 55), so its covariance has rank 6, not 12; in units of
acceleration it does not depend on mass and inertia.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.rotations import quaternion_from_rotation_vector, quaternion_product, rotation_matrix, skew
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
    """
    p, v, q, w = state
    impulse = np.zeros(6) if impulse is None else impulse
    middle = rotation_matrix(quaternion_product(q, quaternion_from_rotation_vector(0.5 * dt * w)))
    specific = np.array([0.0, 0.0, thrust / mass]) + impulse[:3] / dt
    v_next = v + dt * (middle @ specific - np.array([0.0, 0.0, GRAVITY]))
    w_next = w + dt * angular_acceleration(w, torque, inertia=inertia) + impulse[3:]
    q_next = quaternion_product(q, quaternion_from_rotation_vector(0.5 * dt * (w + w_next)))
    return State(p + 0.5 * dt * (v + v_next), v_next, q_next / np.linalg.norm(q_next), w_next)


def bridge_covariance(noise: NDArray, q: NDArray, *, dt: float) -> NDArray:
    """Covariance (12, 12) that white noise adds within a step beyond its impulse.

    The integral of a Brownian motion given both its ends is uncertain by dt^3/12 times its intensity: position and
    attitude do not follow exactly from the velocities at the ends. Leaving this out makes rates look noisier than they
    are, and with them inertia too large (8 % on hover data at 100 Hz).

    Args:
        noise: (12, 6) from `step_jacobians`.
        q: (6,) impulse variances per second.
        dt: length of the step [s].
    """
    within = np.zeros((12, 6))
    within[0:3, 0:3] = noise[3:6, 0:3]
    within[6:9, 3:6] = noise[6:9, 3:6] / (0.5 * dt)
    return within @ np.diag(q) @ within.T * dt**3 / 12


def right_jacobian(phi: NDArray) -> NDArray:
    """d log(exp(phi)^-1 exp(phi + d)) / dd to second order in phi: fine for the turns of one step. (3,) -> (3, 3)."""
    s = skew(phi)
    return np.eye(3) - 0.5 * s + s @ s / 6.0


def step_jacobians(
    state: State, thrust: float, torque: NDArray, *, dt: float, mass: float, inertia: NDArray
) -> tuple[NDArray, NDArray]:
    """Derivatives of `step`'s error-state: with respect to the error (12, 12) and to the impulse (12, 6).

    Exact but for terms of third order in the turn of half a step.
    """
    _, _, q, w = state
    half_turn = rotation_matrix(quaternion_from_rotation_vector(0.5 * dt * w))
    start = rotation_matrix(q)
    middle = start @ half_turn
    acceleration = thrust / mass
    e3 = np.array([0.0, 0.0, 1.0])
    v_theta = -dt * acceleration * start @ skew(half_turn @ e3)
    v_rate = -0.5 * dt * dt * acceleration * middle @ skew(e3)
    w_rate = np.eye(3) + dt * np.linalg.solve(inertia, skew(inertia @ w) - skew(w) @ inertia)
    w_next = w + dt * angular_acceleration(w, torque, inertia=inertia)
    phi = 0.5 * dt * (w + w_next)
    turn = rotation_matrix(quaternion_from_rotation_vector(phi))
    jr = right_jacobian(phi)

    transition = np.eye(12)
    transition[0:3, 3:6] = dt * np.eye(3)
    transition[3:6, 6:9] = v_theta
    transition[3:6, 9:12] = v_rate
    transition[0:3, 6:9] = 0.5 * dt * v_theta
    transition[0:3, 9:12] = 0.5 * dt * v_rate
    transition[6:9, 6:9] = turn.T
    transition[6:9, 9:12] = 0.5 * dt * jr @ (np.eye(3) + w_rate)
    transition[9:12, 9:12] = w_rate

    noise = np.zeros((12, 6))
    noise[0:3, 0:3] = 0.5 * dt * middle
    noise[3:6, 0:3] = middle
    noise[6:9, 3:6] = 0.5 * dt * jr
    noise[9:12, 3:6] = np.eye(3)
    return transition, noise
