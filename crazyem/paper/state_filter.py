"""The extended Kalman filter that the paper flies with (VII): position and body rate correct, acceleration is an input.

Its attitude is dead reckoning from a known start, since eq. 59 has no derivative of velocity by attitude; that is kept,
Table I shows it.
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.paper.plant import angle_rates


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
    # six scalars one after the other: the same as eq. 73-76 with a diagonal R
    for c in range(6):
        i = c if c < 3 else c + 6
        y = position[c] if c < 3 else rate[c - 3]
        gain = p[:, i] / (p[i, i] + r)
        x += gain * (y - x[i])
        row = p[i].copy()
        for a in range(12):
            for b in range(12):
                p[a, b] -= gain[a] * row[b]
