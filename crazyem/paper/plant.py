"""The quadcopter of the paper as a stochastic differential equation, stepped as eq. 56 says (Euler-Maruyama).

State (12,): position m, velocity m/s (world), roll pitch yaw rad, body rate rad/s. Written down from eq. 47, 54 and 55
(with the errata of 46 and 48) and shared with no estimator, so that none can inherit its mistakes.
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.vehicle import GRAVITY


@compiled
def thrust_axis(angles, axis):
    """Third column of R = Rz(yaw) Ry(pitch) Rx(roll): body z in the world. angles (3,) rad, axis (3,) is filled."""
    sr, cr = np.sin(angles[0]), np.cos(angles[0])
    sp, cp = np.sin(angles[1]), np.cos(angles[1])
    sy, cy = np.sin(angles[2]), np.cos(angles[2])
    axis[0] = cr * sp * cy + sr * sy
    axis[1] = cr * sp * sy - sr * cy
    axis[2] = cr * cp


@compiled
def angle_rates(angles, rate, out):
    """E^-1(angles) rate (eq. 47): derivatives of roll, pitch and yaw [rad/s] from the body rate [rad/s]."""
    sr, cr = np.sin(angles[0]), np.cos(angles[0])
    tp, cp = np.tan(angles[1]), np.cos(angles[1])
    out[0] = rate[0] + sr * tp * rate[1] + cr * tp * rate[2]
    out[1] = cr * rate[1] - sr * rate[2]
    out[2] = (sr * rate[1] + cr * rate[2]) / cp


@compiled
def derivative(x, thrust, torque, mass, inertia, out):
    """f(x, u) of eq. 54; thrust N and torque (3,) N m with their noise already added; out (12,) is filled."""
    axis = np.empty(3)
    thrust_axis(x[6:9], axis)
    angle_rates(x[6:9], x[9:12], out[6:9])
    w = x[9:12]
    for i in range(3):
        out[i] = x[3 + i]
        out[3 + i] = axis[i] * thrust / mass
        j = (i + 1) % 3
        k = (i + 2) % 3
        out[9 + i] = (torque[i] - (inertia[k] - inertia[j]) * w[j] * w[k]) / inertia[i]
    out[5] -= GRAVITY


@compiled
def step(x, wrench, noise, dt, mass, inertia, ground, scratch):
    """One Euler step of length dt [s] in place; returns whether the drone touches the ground.

    Args:
        x: (12,) state, replaced.
        wrench: (4,) thrust N, torque N m.
        noise: (4,) noise of thrust and torque, same units, held over the step.
        mass, inertia: kg, (3,) kg m^2.
        ground: whether z = 0 is a floor that the drone cannot fall through; it stands there level and does not slip.
        scratch: (12,) receives the derivative; [3:6] is the acceleration of the step.
    """
    torque = wrench[1:] + noise[1:]
    derivative(x, wrench[0] + noise[0], torque, mass, inertia, scratch)
    if ground and x[2] <= 0.0 and x[5] + dt * scratch[5] <= 0.0:
        x[2:9] = 0.0  # the heading is lost, too: it is zero throughout
        x[9:12] = 0.0
        scratch[:] = 0.0
        return True
    for i in range(12):
        x[i] += dt * scratch[i]
    return False
