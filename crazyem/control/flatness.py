"""Differential flatness of a quadrotor: the attitude that an acceleration asks for (Zhao, eq. 8-21; Faessler et al.).

Euler angles are roll, pitch, yaw of R = Rz(yaw) Ry(pitch) Rx(roll), body (FLU) to world; see the errata for eq. 46.
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.vehicle import GRAVITY


@compiled
def reference_angles(acceleration, yaw, angles):
    """Roll, pitch and yaw [rad] at which thrust along body z gives `acceleration` (eq. 8-10, 12-17).

    Args:
        acceleration: (3,) m/s^2, world, gravity excluded.
        yaw: heading wanted [rad].
        angles: (3,) receives the angles.

    Returns:
        Specific thrust |t| [m/s^2] (eq. 11 without the mass).
    """
    t = np.empty(3)
    t[0], t[1], t[2] = acceleration[0], acceleration[1], acceleration[2] + GRAVITY
    norm = np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    if norm < 1e-9:  # free fall asks for no attitude
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
