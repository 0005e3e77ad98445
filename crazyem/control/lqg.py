"""The controller of Zhao's paper: LQR gains on the filtered state, thrust and torque from the estimated parameters."""

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.control.flatness import reference_angles, reference_rate
from crazyem.vehicle import GRAVITY

# least cos(pitch) cos(roll) that thrust is divided by (eq. 83 has none: it grows without bound)
SMALLEST_TILT_COSINE = 0.2


def position_gains(*, dt: float, position_weight: float, velocity_weight: float) -> NDArray[np.float64]:
    """Gains [1/s^2, 1/s] of u = -K (x - x_ref) for one axis of position, acceleration held over dt (eq. 79, 82).

    Args:
        dt: s.
        position_weight, velocity_weight: cost of 1 m and of 1 m/s, over that of 1 m/s^2 (the paper gives none).
    """
    a = np.array([[1.0, dt], [0.0, 1.0]])
    b = np.array([[0.5 * dt * dt], [dt]])
    from control import dlqr  # slow to import, and no flight designs gains

    gain, _, _ = dlqr(a, b, np.diag([position_weight, velocity_weight]), np.eye(1))
    return np.array([float(gain[0, 0]), float(gain[0, 1])])


@compiled
def control(state, reference, yaw, gains, limit, mass, inertia, wrench):
    """Thrust and torque for a state (eq. 8-22, 82-84).

    Args:
        state: (12,) position m, velocity m/s (world), roll pitch yaw rad, body rate rad/s.
        reference: (9,) position m, velocity m/s, acceleration m/s^2, world.
        yaw: wanted [rad].
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
