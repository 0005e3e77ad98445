"""The smoother (modified Bryson-Frazier) and the statistics that the M-step needs."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import angular_acceleration, apply_transposed, right_jacobian, specific_force
from crazyem.estimation.kernels.layout import (
    AXIS,
    AXIS_SIZE,
    BRIDGE,
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
def backward(first, last, time, kind, usable, force, thrust, torque, thrust_tau, torque_tau, thrust_delay,
             torque_delay, tau, delay, offset, mass, inertia, inverse, q, r, r_force, lead, xf, pf, gain, s, e, blocks,
             middle, stats, moments):  # fmt: skip
    """Smoother over samples last-1 down to first, without information from `last` on; fills statistics rows.

    Row k holds the step that ends at k (k > first, not a break, usable) and the measurements at k. `moments` (n, 12)
    receives the smoothed means: specific force (3) m/s^2, angular acceleration (3) rad/s^2, body rate (3) rad/s at the
    start of the step, and angular disturbances (3) rad/s^2 (for diagnostics).
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
    model = np.zeros(3)
    known = np.empty(3)
    left = np.empty(3)
    within = np.empty(6)
    var = np.empty(6)
    phi = np.empty(3)
    jr = np.empty((3, 3))
    l3 = np.empty((3, 3))
    for k in range(last - 1, first - 1, -1):
        row = stats[k]
        for i in range(SIZE):
            row[i] = 0.0
        # measurement update, channels in reverse
        for i in range(11, -1, -1):
            if s[k, i] == 0.0:
                continue
            column = gain[k, i]
            inv = 1.0 / s[k, i]
            kl = 0.0
            klk = 0.0
            for j in range(12):
                kl += column[j] * lam[j, 0]
                acc = 0.0
                for m in range(12):
                    acc += big[j, m] * column[m]
                lk[j] = acc
                klk += column[j] * acc
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
        # lam and big are now before the measurement at k
        if kind[k] == 1 or k == first:
            for i in range(12):
                lam[i, 0] = 0.0
                for j in range(12):
                    big[i, j] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = lead * dt
        b = blocks[k]
        # smoothed impulse, Q its variance given the accelerometer: mean given the accelerometer less Q G' lam,
        # variance Q - Q G' big G Q
        model[2] = thrust[k] / mass
        specific_force(model, force[k], q, dt, r_force, known, left)
        w = xf[k - 1, 10:13]
        angular_acceleration(w, torque[k], inertia, inverse, alpha)
        for i in range(3):
            phi[i] = dt * w[i] + h * dt * alpha[i]
        right_jacobian(phi, jr)
        bridge = dt * dt / 12.0 if lead == 0.5 else 0.0
        for i in range(3):
            for j in range(3):
                l3[i, j] = big[3 + i, 3 + j] + h * (big[i, 3 + j] + big[3 + i, j]) + h * h * big[i, j]
        for i in range(3):
            # impulse i changes velocity by m and position by h m; impulse 3 + i changes rate i by 1 and attitude by h t
            slow, both, slow2, both2 = 0.0, 0.0, 0.0, 0.0
            turned, cross, turned2 = 0.0, 0.0, 0.0
            for j in range(3):
                m = middle[k, j, i]
                t = jr[j, i]
                slow += m * lam[j, 0]
                both += m * (lam[3 + j, 0] + h * lam[j, 0])
                turned += t * lam[6 + j, 0]
                cross += t * big[6 + j, 9 + i]
                x, z3, y3 = 0.0, 0.0, 0.0
                for c in range(3):
                    x += big[j, c] * middle[k, c, i]
                    z3 += l3[j, c] * middle[k, c, i]
                    y3 += big[6 + j, 6 + c] * jr[c, i]
                slow2 += m * x
                both2 += m * z3
                turned2 += t * y3
            u[i] = dt * (known[i] - model[i] - left[i] * both)
            var[i] = left[i] * dt - (left[i] * dt) ** 2 * both2
            within[i] = q[i] * q[i] * bridge * dt * (slow * slow - slow2)
            qd = q[3 + i] * dt
            u[3 + i] = -qd * (lam[9 + i, 0] + h * turned)
            var[3 + i] = qd - qd * qd * (big[9 + i, 9 + i] + 2 * h * cross + h * h * turned2)
            within[3 + i] = q[3 + i] * qd * bridge * (turned * turned - turned2)
        for i in range(6):
            var[i] = max(var[i], 0.0)
        # back through the dynamics
        apply_transposed(b, dt, h, lam, lam2)
        for i in range(12):
            lam[i, 0] = lam2[i, 0]
        apply_transposed(b, dt, h, big, tmp)
        for i in range(12):
            for j in range(12):
                tra[i, j] = tmp[j, i]
        apply_transposed(b, dt, h, tra, big)
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
            mom[i] = model[i] + u[i] / dt
            mom[3 + i] = alpha[i] + u[3 + i] / dt
            mom[6 + i] = rate[i]
            mom[9 + i] = u[3 + i] / dt
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
            # torque of the (fixed) products of inertia: a known part, counted with the input
            taken = inertia[i, j] * mom[3 + j] + inertia[i, m] * mom[3 + m]
            taken += rate[j] * (inertia[m, i] * rate[i] + inertia[m, j] * rate[j])
            taken -= rate[m] * (inertia[j, i] * rate[i] + inertia[j, m] * rate[m])
            z[2] = torque[k, i] - torque_tau[k, i] * tau - torque_delay[k, i] * delay - offset[i] - taken
            z[3] = torque_tau[k, i]
            z[4] = torque_delay[k, i]
            z[5] = 1.0
            outer(row, AXIS + AXIS_SIZE * i, z, 6, dt)
            row[AXIS + AXIS_SIZE * i] += var[3 + i] / dt
        for i in range(6):
            row[IMPULSE + i] = (u[i] * u[i] + var[i]) / dt
            row[BRIDGE + i] = within[i]
            row[IMPULSE_SEEN + i] = (1.0 - var[i] / (q[i] * dt)) ** 2
        for i in range(3):
            if not np.isnan(force[k, i]):
                res = force[k, i] - mom[i]
                resvar = var[i] / (dt * dt)
                row[RESIDUAL + 4] += res * res + resvar
                row[MEASURED + 4] += 1.0
                row[RESIDUAL_SEEN + 4] += (1.0 - resvar / r_force) ** 2
        row[COUNT] = 1.0


@compiled
def total(first, last, stats, out):
    """Sum statistics rows first..last-1 into out (SIZE,)."""
    for i in range(SIZE):
        out[i] = 0.0
    for k in range(first, last):
        for i in range(SIZE):
            out[i] += stats[k, i]
