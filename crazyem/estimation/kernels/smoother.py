"""The smoother (modified Bryson-Frazier) and the statistics that the M-step needs."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import angular_acceleration, apply_transposed
from crazyem.estimation.kernels.layout import (
    AXIS,
    AXIS_SIZE,
    COUNT,
    IMPULSE,
    IMPULSE_SEEN,
    MASS,
    MEASURED,
    RESIDUAL,
    RESIDUAL_SEEN,
    SIZE,
)


@compiled
def outer(out, base, z, n, weight):
    """Adds weight z z' (upper triangle, row by row) to out[base:]."""
    at = base
    for i in range(n):
        for j in range(i, n):
            out[at] += weight * z[i] * z[j]
            at += 1


@compiled
def backward(first, last, time, kind, usable, thrust, torque, thrust_tau, torque_tau, thrust_delay, torque_delay,
             tau, delay, offset, mass, inertia, inverse, q, r, xf, pf, gain, s, e, blocks, middle, stats,
             moments):  # fmt: skip
    """Smoother over samples last-1 down to first, information beyond `last` being none; fills statistics rows.

    Row k holds the step that ends at k (k > first, not a break, usable) and the measurements at k. `moments` (n, 12)
    keeps the smoothed means it was made from: specific force (3) m/s^2, angular acceleration (3) rad/s^2, body rate
    (3) rad/s at the start of the step, and thrust-axis and angular disturbances in acceleration (for diagnostics).
    """
    lam = np.zeros((12, 1))
    lam2 = np.zeros((12, 1))
    big = np.zeros((12, 12))
    tmp = np.empty((12, 12))
    tra = np.empty((12, 12))
    lk = np.empty(12)
    z = np.empty(6)
    alpha = np.empty(3)
    rate = np.empty(3)
    u = np.empty(6)
    var = np.empty(6)
    l3 = np.empty((3, 3))
    for k in range(last - 1, first - 1, -1):
        row = stats[k]
        for i in range(SIZE):
            row[i] = 0.0
        # measurement update, channels in reverse
        for i in range(11, -1, -1):
            if s[k, i] == 0.0:
                continue
            g = gain[k, i]
            inv = 1.0 / s[k, i]
            kl = 0.0
            klk = 0.0
            for j in range(12):
                kl += g[j] * lam[j, 0]
                acc = 0.0
                for m in range(12):
                    acc += big[j, m] * g[m]
                lk[j] = acc
                klk += g[j] * acc
            adj = e[k, i] * inv + kl
            if kind[k] != 1:
                res = r[i] * adj
                resvar = r[i] - r[i] * r[i] * (inv + klk)
                row[RESIDUAL + i // 3] += res * res + max(resvar, 0.0)
                row[MEASURED + i // 3] += 1.0
                row[RESIDUAL_SEEN + i // 3] += (r[i] * (inv + klk)) ** 2
            lam[i, 0] -= adj
            for j in range(12):
                big[i, j] -= lk[j]
                big[j, i] -= lk[j]
            big[i, i] += klk + inv
        # now lam, big are those before the measurement at k
        if kind[k] == 1 or k == first:
            for i in range(12):
                lam[i, 0] = 0.0
                for j in range(12):
                    big[i, j] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = 0.5 * dt
        b = blocks[k]
        # smoothed impulse: mean -Q G' lam, variance Q - Q G' big G Q
        for i in range(3):
            acc = 0.0
            for j in range(3):
                acc += middle[k, j, i] * (lam[3 + j, 0] + h * lam[j, 0])
            u[i] = -q[i] * dt * acc
            u[3 + i] = -q[3 + i] * dt * (lam[9 + i, 0] + h * lam[6 + i, 0])  # right Jacobian of one step taken as 1
            var[3 + i] = q[3 + i] * dt - (q[3 + i] * dt) ** 2 * (
                big[9 + i, 9 + i] + 2 * h * big[6 + i, 9 + i] + h * h * big[6 + i, 6 + i]
            )
            for j in range(3):
                l3[i, j] = big[3 + i, 3 + j] + h * (big[i, 3 + j] + big[3 + i, j]) + h * h * big[i, j]
        for i in range(3):
            acc = 0.0
            for j in range(3):
                for m in range(3):
                    acc += middle[k, j, i] * l3[j, m] * middle[k, m, i]
            var[i] = q[i] * dt - (q[i] * dt) ** 2 * acc
        for i in range(6):
            var[i] = max(var[i], 0.0)
        # back through the dynamics
        apply_transposed(b, dt, lam, lam2)
        for i in range(12):
            lam[i, 0] = lam2[i, 0]
        apply_transposed(b, dt, big, tmp)
        for i in range(12):
            for j in range(12):
                tra[i, j] = tmp[j, i]
        apply_transposed(b, dt, tra, big)
        for i in range(12):
            for j in range(i):
                v = 0.5 * (big[i, j] + big[j, i])
                big[i, j] = v
                big[j, i] = v
        # smoothed body rate at the start of the step
        for i in range(3):
            acc = 0.0
            for j in range(12):
                acc += pf[k - 1, 9 + i, j] * lam[j, 0]
            rate[i] = xf[k - 1, 10 + i] - acc
        angular_acceleration(rate, torque[k], inertia, inverse, alpha)
        mom = moments[k]
        for i in range(3):
            mom[i] = u[i] / dt
            mom[3 + i] = alpha[i] + u[3 + i] / dt
            mom[6 + i] = rate[i]
            mom[9 + i] = u[3 + i] / dt
        mom[2] += thrust[k] / mass
        if not usable[k]:
            continue
        # statistics of the step
        z[0] = mom[2]
        z[1] = thrust[k] - thrust_tau[k] * tau - thrust_delay[k] * delay
        z[2] = thrust_tau[k]
        z[3] = thrust_delay[k]
        outer(row, MASS, z, 4, dt)
        row[MASS] += var[2] / dt
        for i in range(3):
            j = (i + 1) % 3
            m = (i + 2) % 3
            z[0] = mom[3 + i]
            z[1] = rate[j] * rate[m]
            # torque that the (fixed) products of inertia take: known part, counted with the input
            known = inertia[i, j] * mom[3 + j] + inertia[i, m] * mom[3 + m]
            known += rate[j] * (inertia[m, i] * rate[i] + inertia[m, j] * rate[j])
            known -= rate[m] * (inertia[j, i] * rate[i] + inertia[j, m] * rate[m])
            z[2] = torque[k, i] - torque_tau[k, i] * tau - torque_delay[k, i] * delay - offset[i] - known
            z[3] = torque_tau[k, i]
            z[4] = torque_delay[k, i]
            z[5] = 1.0
            outer(row, AXIS + AXIS_SIZE * i, z, 6, dt)
            row[AXIS + AXIS_SIZE * i] += var[3 + i] / dt
        for i in range(6):
            row[IMPULSE + i] = (u[i] * u[i] + var[i]) / dt
            row[IMPULSE_SEEN + i] = (1.0 - var[i] / (q[i] * dt)) ** 2
        row[COUNT] = 1.0


@compiled
def total(first, last, stats, out):
    """Sum of statistics rows first..last-1 into out (SIZE,)."""
    for i in range(SIZE):
        out[i] = 0.0
    for k in range(first, last):
        for i in range(SIZE):
            out[i] += stats[k, i]
