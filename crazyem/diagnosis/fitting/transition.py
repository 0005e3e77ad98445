"""One step of the filter's error states: the transition, and the force that an onboard estimate does not know.

An onboard filter predicts its velocity by thrust and its own attitude. It does not know forces along body x and y, and
an error of its attitude turns the thrust. So a disturbing force and the attitude's error drive the velocity's error.
"""

import numpy as np

from crazyem.compiled import compiled


@compiled
def transition(dt, pushed, coupled, tilt, decay, turned, rate_turn, middle, specific, unknown, jr, x, out):
    """out = Phi x for x (size, m): error states of one step by the midpoint rule.

    pushed: 12 plus the number of disturbance states; coupled: whether errors of position and velocity follow these,
    the first the integral of the second; tilt: the first state of the error of an attitude that turns the thrust in
    that of the velocity, 0 for none; decay: factors of all states after the first 12; turned (3, 3): -dt middle
    skew(specific), by the attitude at the start; rate_turn (3, 3): transposed rotation of the step; unknown (3, 12):
    derivatives of the velocity's error by attitude, body rate, disturbing force and error of the attitude.
    """
    h = 0.5 * dt
    size = x.shape[0]
    f0 = f1 = f2 = a0 = a1 = a2 = 0.0
    for j in range(x.shape[1]):
        t0, t1, t2 = x[6, j], x[7, j], x[8, j]
        w0, w1, w2 = x[9, j], x[10, j], x[11, j]
        if pushed > 12:
            a0, a1, a2 = x[12, j], x[13, j], x[14, j]
        if pushed > 15:
            f0, f1, f2 = x[15, j], x[16, j], x[17, j]
        # attitude in the middle of the step, by the half turn
        for i in range(3):
            v = (
                x[3 + i, j]
                + turned[i, 0] * t0
                + turned[i, 1] * t1
                + turned[i, 2] * t2
                + h * (specific[i, 0] * w0 + specific[i, 1] * w1 + specific[i, 2] * w2)
                + dt * (middle[i, 0] * f0 + middle[i, 1] * f1 + middle[i, 2] * f2)
            )
            out[i, j] = x[i, j] + h * (x[3 + i, j] + v)
            out[3 + i, j] = v
        b0, b1, b2 = dt * w0 + h * dt * a0, dt * w1 + h * dt * a1, dt * w2 + h * dt * a2
        for i in range(3):
            out[6 + i, j] = (
                rate_turn[i, 0] * t0
                + rate_turn[i, 1] * t1
                + rate_turn[i, 2] * t2
                + jr[i, 0] * b0
                + jr[i, 1] * b1
                + jr[i, 2] * b2
            )
        out[9, j] = w0 + dt * a0
        out[10, j] = w1 + dt * a1
        out[11, j] = w2 + dt * a2
        for i in range(12, size):
            out[i, j] = decay[i - 12] * x[i, j]
        if coupled:
            for i in range(3):
                v = unknown[i, 6] * f0 + unknown[i, 7] * f1 + unknown[i, 8] * f2
                for a in range(3):
                    v += unknown[i, a] * x[6 + a, j] + unknown[i, 3 + a] * x[9 + a, j]
                    v += unknown[i, 9 + a] * x[tilt + a, j]
                out[pushed + i, j] += dt * x[pushed + 3 + i, j] + h * v
                out[pushed + 3 + i, j] += v


@compiled
def unknown_force(dt, tilt, x, f, middle, turn, by_rate, out, u):
    """Specific force u (3,), body, that is missing in an onboard velocity, and derivatives (3, 12) of this velocity.

    u is e x f - (d_x, d_y, 0), with the error e of the attitude, if `tilt`, and the disturbing force d; x (31,): state
    before the step; f: specific force of the model and d. Other arguments as in `kernel.sweep`, columns as in
    `transition`.
    """
    e = x[25:28] if tilt else np.zeros(3)
    u[0] = e[1] * f[2] - e[2] * f[1] - x[13]
    u[1] = e[2] * f[0] - e[0] * f[2] - x[14]
    u[2] = e[0] * f[1] - e[1] * f[0]
    for i in range(3):
        m0, m1, m2 = middle[i, 0], middle[i, 1], middle[i, 2]
        b0, b1, b2 = -dt * (m1 * u[2] - m2 * u[1]), -dt * (m2 * u[0] - m0 * u[2]), -dt * (m0 * u[1] - m1 * u[0])
        for j in range(3):  # by the attitude at the start, as `turned` in `kernel.sweep`
            out[i, j] = b0 * turn[j, 0] + b1 * turn[j, 1] + b2 * turn[j, 2]
            out[i, 9 + j] = by_rate[i, j] if tilt else 0.0
        out[i, 3], out[i, 4], out[i, 5] = 0.5 * dt * b0, 0.5 * dt * b1, 0.5 * dt * b2
        out[i, 6] = dt * (m1 * e[2] - m2 * e[1] - m0)
        out[i, 7] = dt * (m2 * e[0] - m0 * e[2] - m1)
        out[i, 8] = dt * (m0 * e[1] - m1 * e[0])
