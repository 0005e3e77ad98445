"""The exact score of the noise variances: one backward pass over the arrays that the filter stored.

For a scalar innovation e of variance s and gain K, let u = e/s - K'r and D = 1/s + K'NK. Backwards over a measurement,
r becomes r + H'u and N becomes (I - KH)'N(I - KH) + H'H/s. Over a step they become Phi'r and Phi'N Phi. The derivative
of the log-likelihood by a measurement variance is the sum of (u^2 - D)/2; by a process variance, the sum of
tr((rr' - N) dQ)/2 (Koopman and Shephard, Biometrika 79, 1992). For any number of variances, the cost is that of two
passes of the filter.
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.diagnosis.fitting.kernel import DISTURBED, layout


@compiled
def noise_score(time, starts, measured, thrust_only, disturbance, memory, xf, e, s, gains, steps, known, out):
    """Add the derivatives of the log-likelihood by q (6,), r (12,), disturbance (18,) and the logarithms of memory
    (18,) of `kernel.sweep` to out (54,).

    A memory m is in the transition phi = exp(-dt/m) of its own state and in the noise (1 - phi^2) of the step. The
    derivative by phi is r x' - N Phi P. There x is the smoothed state before the step, and P its filtered covariance.

    measured: (n, 12) bool, whether a scalar was measured at a row; thrust_only: as for `sweep`; xf, e, s, gains, steps,
    known: outputs of `sweep`.
    """
    which, own = layout(disturbance)
    size = gains.shape[2]
    r = np.zeros(size)
    total = np.zeros((size, size))  # N
    product = np.zeros(size)
    for k in range(len(time) - 1, -1, -1):
        for i in range(11, -1, -1):
            if not s[k, i] > 0.0:
                continue
            gain = gains[k, i]
            u, d = e[k, i] / s[k, i], 1.0 / s[k, i]
            for j in range(size):
                u -= gain[j] * r[j]
                v = 0.0
                for m in range(size):
                    v += total[j, m] * gain[m]
                product[j] = v
            for j in range(size):
                d += gain[j] * product[j]
            out[6 + i] += 0.5 * (u * u - d)
            o = own[i]
            r[i] += u
            for j in range(size):
                total[i, j] -= product[j]
                total[j, i] -= product[j]
            total[i, i] += d
            if o:  # the measurement is the state plus this error
                r[o] += u
                for j in range(size):
                    total[o, j] -= product[j]
                    total[j, o] -= product[j]
                total[o, o] += d
                total[i, o] += d
                total[o, i] += d
        if starts[k] or k == 0:
            for i in range(12):
                if measured[k, i]:
                    out[6 + i] += 0.5 * (r[i] * r[i] - total[i, i])
            for i in range(size - 12):
                a = which[i] - DISTURBED
                if a < 0:
                    out[18 + which[i]] += 0.5 * (r[12 + i] * r[12 + i] - total[12 + i, 12 + i])
                elif measured[k, a]:
                    both = r[12 + i] - r[a]
                    seen = total[12 + i, 12 + i] + total[a, a] - 2.0 * total[a, 12 + i]
                    out[18 + which[i]] += 0.5 * (both * both - seen)
                else:
                    out[18 + which[i]] += 0.5 * (r[12 + i] * r[12 + i] - total[12 + i, 12 + i])
            r[:] = 0.0
            total[:] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = 0.5 * dt
        bridge = h * h + dt * dt / 12.0
        middle, jr = steps[k, size : size + 3], steps[k, size + 3 : size + 6]
        moved, joint = r[:6].copy(), total[:6, :6].copy()  # along position and velocity
        for a in range(2, -1, -1):
            if a == 1 and thrust_only and own[0] and own[3]:  # along body x and y, their errors move the other way
                e0, e1 = own[0], own[0] + 6
                moved -= r[e0:e1]
                joint += total[e0:e1, e0:e1] - total[:6, e0:e1] - total[e0:e1, :6]
            position = velocity = cross = angle = both = 0.0  # r'g r - g'N g along the axis
            for i in range(3):
                mi, ji = middle[i, a], jr[i, a]
                both += ji * (r[6 + i] * r[9 + a] - total[6 + i, 9 + a])
                for j in range(3):
                    mj, jj = middle[j, a], jr[j, a]
                    position += mi * mj * (moved[i] * moved[j] - joint[i, j])
                    velocity += mi * mj * (moved[3 + i] * moved[3 + j] - joint[3 + i, 3 + j])
                    cross += mi * mj * (moved[i] * moved[3 + j] - joint[i, 3 + j])
                    angle += ji * jj * (r[6 + i] * r[6 + j] - total[6 + i, 6 + j])
            rate = r[9 + a] * r[9 + a] - total[9 + a, 9 + a]
            out[a] += 0.5 * dt * (velocity + 2.0 * h * cross + bridge * position)
            out[3 + a] += 0.5 * dt * (rate + 2.0 * h * both + bridge * angle)
        for i in range(size - 12):
            decay = np.exp(-dt / memory[which[i]])
            out[18 + which[i]] += 0.5 * (1.0 - decay * decay) * (r[12 + i] * r[12 + i] - total[12 + i, 12 + i])
        phi = steps[k, :size]
        back, turned = np.dot(phi.T, r), np.dot(total, phi)
        for i in range(size - 12):
            a = 12 + i
            decay = np.exp(-dt / memory[which[i]])
            before, spread = xf[k - 1, 13 + which[i]], 0.0  # smoothed state before the step; N Phi P
            for j in range(size):
                before += known[k - 1, i, j] * back[j]
                spread += turned[a, j] * known[k - 1, i, j]
            by_phi = r[a] * before - spread
            by_phi -= decay * disturbance[which[i]] * (r[a] * r[a] - total[a, a])
            out[36 + which[i]] += by_phi * decay * dt / memory[which[i]]
        r[:] = back
        total[:] = np.dot(phi.T, turned)
