"""The controller of Zhao's paper: LQR gains on the filtered state, thrust and torque from the estimated parameters.

By differential flatness, an acceleration determines an attitude (eq. 8-21; Faessler et al.). Euler angles are roll,
pitch, yaw of R = Rz(yaw) Ry(pitch) Rx(roll), body (FLU) to world; see the errata for eq. 46.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.vehicle import GRAVITY


@compiled
def reference_angles(acceleration, yaw, angles):
    """Roll, pitch and yaw [rad] at which thrust along body z gives `acceleration` (eq. 8-10, 12-17).

    Args:
        acceleration: (3,) m/s^2, world, gravity excluded.
        yaw: desired heading [rad].
        angles: (3,) receives the angles.

    Returns:
        Specific thrust |t| [m/s^2] (eq. 11 without the mass).
    """
    t = np.empty(3)
    t[0], t[1], t[2] = acceleration[0], acceleration[1], acceleration[2] + GRAVITY
    norm = np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    if norm < 1e-9:  # free fall determines no attitude
        angles[0], angles[1], angles[2] = 0.0, 0.0, yaw
        return norm
    z = t / norm
    # x_B = y_C x z_B with y_C = (-sin yaw, cos yaw, 0), y_B = z_B x x_B
    x = np.empty(3)
    x[0] = np.cos(yaw) * z[2]
    x[1] = np.sin(yaw) * z[2]
    x[2] = -np.sin(yaw) * z[1] - np.cos(yaw) * z[0]
    x /= np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2) + 1e-300
    y2 = z[0] * x[1] - z[1] * x[0]
    pitch = np.arcsin(min(1.0, max(-1.0, -x[2])))
    angles[0] = np.arctan2(y2, z[2])
    angles[1] = pitch
    angles[2] = np.arctan2(x[1], x[0])
    return norm


@compiled
def reference_rate(angles, wanted, gain, rate):
    """Body rate [rad/s] that turns `angles` towards `wanted` with the angular gain [1/s] (eq. 18, 20, 21).

    Args:
        angles, wanted: (3,) roll, pitch, yaw [rad].
        gain: K_theta [1/s].
        rate: (3,) receives the rate, body frame.
    """
    error = np.empty(3)
    for i in range(3):
        error[i] = -gain * (angles[i] - wanted[i])
    error[2] = -gain * ((angles[2] - wanted[2] + np.pi) % (2 * np.pi) - np.pi)
    sr, cr, sp, cp = np.sin(angles[0]), np.cos(angles[0]), np.sin(angles[1]), np.cos(angles[1])
    rate[0] = error[0] - sp * error[2]
    rate[1] = cr * error[1] + cp * sr * error[2]
    rate[2] = -sr * error[1] + cp * cr * error[2]


# Lower bound of cos(pitch) cos(roll), the divisor of the thrust; without it (eq. 83) the thrust would be unlimited.
SMALLEST_TILT_COSINE = 0.2


def position_gains(*, dt: float, position_weight: float, velocity_weight: float) -> NDArray[np.float64]:
    """Gains [1/s^2, 1/s] of u = -K (x - x_ref) for one axis of position, acceleration held over dt (eq. 79, 82).

    Args:
        dt: s.
        position_weight, velocity_weight: cost of 1 m and of 1 m/s, over that of 1 m/s^2 (not given in the paper).
    """
    a = np.array([[1.0, dt], [0.0, 1.0]])
    b = np.array([[0.5 * dt * dt], [dt]])
    from control import dlqr  # a slow import, and not needed in flight

    gain, _, _ = dlqr(a, b, np.diag([position_weight, velocity_weight]), np.eye(1))
    return np.array([float(gain[0, 0]), float(gain[0, 1])])


@compiled
def control(state, reference, yaw, gains, limit, mass, inertia, wrench):
    """Thrust and torque for a state (eq. 8-22, 82-84).

    Args:
        state: (12,) position m, velocity m/s (world), roll pitch yaw rad, body rate rad/s.
        reference: (9,) position m, velocity m/s, acceleration m/s^2, world.
        yaw: desired [rad].
        gains: (4,) position 1/s^2, velocity 1/s, angle K_theta 1/s, rate K_omega 1/s.
        limit: largest commanded acceleration [m/s^2].
        mass: kg, as the controller believes it.
        inertia: (3,) kg m^2, as the controller believes it.
        wrench: (4,) receives thrust N and torque N m (body).
    """
    a = np.empty(3)
    size = 0.0
    for i in range(3):
        a[i] = reference[6 + i] - gains[0] * (state[i] - reference[i]) - gains[1] * (state[3 + i] - reference[3 + i])
        size += a[i] ** 2
    size = np.sqrt(size)
    if size > limit:
        a *= limit / size
    wanted = np.empty(3)
    rate = np.empty(3)
    reference_angles(a, yaw, wanted)
    reference_rate(state[6:9], wanted, gains[2], rate)
    upright = max(np.cos(state[6]) * np.cos(state[7]), SMALLEST_TILT_COSINE)
    wrench[0] = max(0.0, (a[2] + GRAVITY) * mass / upright)
    w = state[9:12]
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        wrench[1 + i] = -inertia[i] * gains[3] * (w[i] - rate[i]) + (inertia[k] - inertia[j]) * w[j] * w[k]
