"""The quadcopter of the paper as a stochastic differential equation, and the filter of its controller (VII).

State (12,): position m, velocity m/s (world), roll pitch yaw rad, body rate rad/s, integrated by eq. 56
(Euler-Maruyama). The equations are 47, 54 and 55 (with the errata of 46 and 48). No estimator uses this code, so an
error here cannot be in both. In the extended Kalman filter, position and body rate are measurements and acceleration
is an input. The filter's attitude is dead reckoning from a known start, because eq. 59 has no derivative of velocity
with respect to attitude; this is kept as printed, Table I shows the effect.
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
        ground: whether z = 0 is a floor; a drone on the floor stands level and does not slip.
        scratch: (12,) receives the derivative; [3:6] is the acceleration of the step.
    """
    torque = wrench[1:] + noise[1:]
    derivative(x, wrench[0] + noise[0], torque, mass, inertia, scratch)
    if ground and x[2] <= 0.0 and x[5] + dt * scratch[5] <= 0.0:
        x[2:9] = 0.0  # also the heading: it is zero in all flights
        x[9:12] = 0.0
        scratch[:] = 0.0
        return True
    for i in range(12):
        x[i] += dt * scratch[i]
    return False


@compiled
def transition(x, dt, phi):
    """Jacobian (eq. 59-70) of the prediction at x (12,), into phi (12, 12)."""
    for i in range(12):
        for j in range(12):
            phi[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        phi[i, 3 + i] = dt
    s, c = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    t = sp / cp
    wy, wz = x[10], x[11]
    phi[6, 6] = 1.0 + dt * (c * t * wy - s * t * wz)
    phi[6, 7] = dt * (s * wy + c * wz) / cp**2
    phi[6, 9] = dt
    phi[6, 10] = dt * s * t
    phi[6, 11] = dt * c * t
    phi[7, 6] = dt * (-s * wy - c * wz)
    phi[7, 10] = dt * c
    phi[7, 11] = -dt * s
    phi[8, 6] = dt * (c * wy - s * wz) / cp
    phi[8, 7] = dt * (s * wy + c * wz) * sp / cp**2
    phi[8, 10] = dt * s / cp
    phi[8, 11] = dt * c / cp


@compiled
def filter_step(x, p, acceleration, position, rate, dt, q, r):
    """Prediction and correction (eq. 58, 71-76), in place.

    Args:
        x: (12,) estimate. p: (12, 12) its covariance.
        acceleration: (3,) m/s^2, world, of the step (eq. 25).
        position, rate: (3,) m, (3,) rad/s measured at its end.
        dt: s.
        q, r: one number each for all states and channels, as printed (eq. 119, 120).
    """
    phi = np.empty((12, 12))
    transition(x, dt, phi)
    angles = np.empty(3)
    angle_rates(x[6:9], x[9:12], angles)
    for i in range(3):
        x[i] += dt * x[3 + i]
    for i in range(3):
        x[3 + i] += dt * acceleration[i]
        x[6 + i] += dt * angles[i]
    p[:, :] = phi @ p @ phi.T
    for i in range(12):
        p[i, i] += q
    # six scalar updates: same result as eq. 73-76 with a diagonal R
    for c in range(6):
        i = c if c < 3 else c + 6
        y = position[c] if c < 3 else rate[c - 3]
        gain = p[:, i] / (p[i, i] + r)
        x += gain * (y - x[i])
        row = p[i].copy()
        for a in range(12):
            for b in range(12):
                p[a, b] -= gain[a] * row[b]
