"""Compiled inner loops of the estimator: extended Kalman filter, smoother, statistics, innovation sensitivities.

All matrices are 12 x 12 or smaller, so everything is explicit loops over contiguous rows. Every measured
quantity is one component of the error state (position, velocity, attitude error, body rate), so measurements
enter one scalar at a time and no matrix is ever inverted. The smoother is the modified Bryson-Frazier
recursion: it gives the smoothed moments of Rauch-Tung-Striebel (reference.py is that, in textbook form; the
tests compare them), and yields the smoothed process noise, all that the M-step needs, without inverting the
prediction covariance.

State arrays hold 13 numbers: position (3) m world, velocity (3) m/s world, quaternion x y z w (4) body to
world, body rate (3) rad/s FLU. Noise intensities `q` (6,) are in units of acceleration: variance per second of
specific-impulse x y z [(m/s)^2/s] and angular-velocity impulse x y z [(rad/s)^2/s], body frame. `r` (12,) are
measurement variances."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.vehicle import GRAVITY

# Layout of a statistics row.
MASS = 0  # 10: upper triangle of z z', z = (a, F0, dF/dtau, dF/ddelay)
AXIS = 10  # 3 x 21: upper triangle of z z', z = (alpha_i, gyroscopic product, M0_i, dM_i/dtau, dM_i/ddelay, 1)
AXIS_SIZE = 21
COUNT = 73  # 1: steps
IMPULSE = 74  # 6: squared impulses over dt, by body axis: specific force, angular acceleration
RESIDUAL = 80  # 4: squared measurement residuals of position, velocity, attitude, body rate
MEASURED = 84  # 4: how many scalars went into each
IMPULSE_SEEN = 88  # 6: squared share of each impulse's variance that the data resolve
RESIDUAL_SEEN = 94  # 4: the same for the measurement noise
SIZE = 98

# Parameters: mass, Ixx, Iyy, Izz, time constant (by their logarithms); delay, torque offset x y z (linear, in units).
PARAMETERS = 9
LAG = 4
DELAY = 5
OFFSET = 6


@compiled
def _half_turn(w, h, q):
    """Quaternion of the rotation vector w * h into q."""
    x, y, z = w[0] * h, w[1] * h, w[2] * h
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        s = 0.5 - angle2 / 48.0
        c = 1.0 - angle2 / 8.0
    else:
        angle = np.sqrt(angle2)
        s = np.sin(0.5 * angle) / angle
        c = np.cos(0.5 * angle)
    q[0], q[1], q[2], q[3] = s * x, s * y, s * z, c


@compiled
def _product(p, q, out):
    """Hamilton product p * q, scalar last, normalised."""
    x = p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1]
    y = p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0]
    z = p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3]
    w = p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2]
    n = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    out[0], out[1], out[2], out[3] = x * n, y * n, z * n, w * n


@compiled
def _matrix(q, m):
    """Rotation matrix of a quaternion into m (3, 3)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    m[0, 0], m[0, 1], m[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    m[1, 0], m[1, 1], m[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    m[2, 0], m[2, 1], m[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@compiled
def _log(q, out):
    """Rotation vector of a quaternion, the shorter way round."""
    sign = 1.0 if q[3] >= 0 else -1.0
    s = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    f = 2.0 * sign if s < 1e-9 else 2.0 * sign * np.arctan2(s, sign * q[3]) / s
    out[0], out[1], out[2] = f * q[0], f * q[1], f * q[2]


@compiled
def _angular_acceleration(w, torque, inertia, inverse, out):
    """Euler's equation: out = I^-1 (torque - w x I w)."""
    l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
    l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
    l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
    t0 = torque[0] - (w[1] * l2 - w[2] * l1)
    t1 = torque[1] - (w[2] * l0 - w[0] * l2)
    t2 = torque[2] - (w[0] * l1 - w[1] * l0)
    for i in range(3):
        out[i] = inverse[i, 0] * t0 + inverse[i, 1] * t1 + inverse[i, 2] * t2


@compiled
def _rate_jacobian(w, inertia, inverse, dt, out):
    """out = I + dt d(angular acceleration)/dw."""
    l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
    l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
    l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
    s = np.empty((3, 3))
    for j in range(3):  # skew(I w) - skew(w) I
        s[0, j] = w[2] * inertia[1, j] - w[1] * inertia[2, j]
        s[1, j] = w[0] * inertia[2, j] - w[2] * inertia[0, j]
        s[2, j] = w[1] * inertia[0, j] - w[0] * inertia[1, j]
    s[0, 1] -= l2
    s[0, 2] += l1
    s[1, 0] += l2
    s[1, 2] -= l0
    s[2, 0] -= l1
    s[2, 1] += l0
    for i in range(3):
        for j in range(3):
            out[i, j] = dt * (inverse[i, 0] * s[0, j] + inverse[i, 1] * s[1, j] + inverse[i, 2] * s[2, j])
        out[i, i] += 1.0


@compiled
def _apply(blocks, dt, x, out):
    """out = Phi x for x (12, n); blocks are dv/dtheta, dv/dw, dtheta/dtheta, dtheta/dw, dw/dw of the transition."""
    n = x.shape[1]
    h = 0.5 * dt
    for i in range(3):
        a0, a1, a2 = blocks[0, i, 0], blocks[0, i, 1], blocks[0, i, 2]
        b0, b1, b2 = blocks[1, i, 0], blocks[1, i, 1], blocks[1, i, 2]
        c0, c1, c2 = blocks[2, i, 0], blocks[2, i, 1], blocks[2, i, 2]
        d0, d1, d2 = blocks[3, i, 0], blocks[3, i, 1], blocks[3, i, 2]
        e0, e1, e2 = blocks[4, i, 0], blocks[4, i, 1], blocks[4, i, 2]
        for j in range(n):
            t0, t1, t2 = x[6, j], x[7, j], x[8, j]
            w0, w1, w2 = x[9, j], x[10, j], x[11, j]
            v = x[3 + i, j] + a0 * t0 + a1 * t1 + a2 * t2 + b0 * w0 + b1 * w1 + b2 * w2
            out[i, j] = x[i, j] + h * (x[3 + i, j] + v)
            out[3 + i, j] = v
            out[6 + i, j] = c0 * t0 + c1 * t1 + c2 * t2 + d0 * w0 + d1 * w1 + d2 * w2
            out[9 + i, j] = e0 * w0 + e1 * w1 + e2 * w2


@compiled
def _apply_transposed(blocks, dt, x, out):
    """out = Phi' x for x (12, n)."""
    n = x.shape[1]
    h = 0.5 * dt
    for i in range(3):
        a0, a1, a2 = blocks[0, 0, i], blocks[0, 1, i], blocks[0, 2, i]
        b0, b1, b2 = blocks[1, 0, i], blocks[1, 1, i], blocks[1, 2, i]
        c0, c1, c2 = blocks[2, 0, i], blocks[2, 1, i], blocks[2, 2, i]
        d0, d1, d2 = blocks[3, 0, i], blocks[3, 1, i], blocks[3, 2, i]
        e0, e1, e2 = blocks[4, 0, i], blocks[4, 1, i], blocks[4, 2, i]
        for j in range(n):
            v0, v1, v2 = x[3, j] + h * x[0, j], x[4, j] + h * x[1, j], x[5, j] + h * x[2, j]
            t0, t1, t2 = x[6, j], x[7, j], x[8, j]
            out[i, j] = x[i, j]
            out[3 + i, j] = x[3 + i, j] + dt * x[i, j]
            out[6 + i, j] = a0 * v0 + a1 * v1 + a2 * v2 + c0 * t0 + c1 * t1 + c2 * t2
            out[9 + i, j] = (
                b0 * v0 + b1 * v1 + b2 * v2 + d0 * t0 + d1 * t1 + d2 * t2
                + e0 * x[9, j] + e1 * x[10, j] + e2 * x[11, j]
            )  # fmt: skip


@compiled
def forward(first, last, restart, time, kind, y, thrust, torque, mass, inertia, inverse, q, r, p0,
            xp, pp, xf, pf, gain, s, e, blocks, middle, loglik):  # fmt: skip
    """Extended Kalman filter over samples first..last-1, written into the tape arrays; returns the log-likelihood.

    A sample k is predicted from k - 1 with thrust[k], torque[k] (means over the step that ends at k), except where
    kind[k] == 1 (a break: the state starts anew at the measurement with variances p0) and at k == first with restart
    (the prior xp[first], pp[first] stands as it is). Missing measurements are NaN in y.
    """
    cov = np.empty((12, 12))
    tmp = np.empty((12, 12))
    tra = np.empty((12, 12))
    quat = np.empty(4)
    turn = np.empty((3, 3))
    start = np.empty((3, 3))
    alpha = np.empty(3)
    phi = np.empty(3)
    correction = np.empty(12)
    innov = np.empty(12)
    jr = np.empty((3, 3))
    total = 0.0
    for k in range(first, last):
        x = xp[k]
        if kind[k] == 1:
            for i in range(13):
                x[i] = y[k, i] if not np.isnan(y[k, i]) else (xf[k - 1, i] if k > 0 else 0.0)
            norm = np.sqrt(x[6] ** 2 + x[7] ** 2 + x[8] ** 2 + x[9] ** 2)
            if norm < 1e-6 or np.isnan(norm):
                x[6], x[7], x[8], x[9] = 0.0, 0.0, 0.0, 1.0
                norm = 1.0
            for i in range(6, 10):
                x[i] /= norm
            for i in range(12):
                for j in range(12):
                    cov[i, j] = 0.0
                cov[i, i] = p0[i]
        elif k == first and restart:
            for i in range(12):
                for j in range(12):
                    cov[i, j] = pp[k, i, j]
        else:
            dt = time[k] - time[k - 1]
            h = 0.5 * dt
            bridge = dt * dt / 12.0  # what white noise does to position and attitude between its values at both ends
            w = xf[k - 1, 10:13]
            b = blocks[k]
            # mean
            _half_turn(w, h, quat)
            _matrix(quat, turn)
            _matrix(xf[k - 1, 6:10], start)
            for i in range(3):
                for j in range(3):
                    middle[k, i, j] = start[i, 0] * turn[0, j] + start[i, 1] * turn[1, j] + start[i, 2] * turn[2, j]
            acc = thrust[k] / mass
            _angular_acceleration(w, torque[k], inertia, inverse, alpha)
            for i in range(3):
                a = middle[k, i, 2] * acc
                if i == 2:
                    a -= GRAVITY
                v = xf[k - 1, 3 + i]
                x[3 + i] = v + dt * a
                x[i] = xf[k - 1, i] + h * (v + x[3 + i])
                x[10 + i] = w[i] + dt * alpha[i]
                phi[i] = h * (w[i] + x[10 + i])
            _half_turn(phi, 1.0, quat)
            _product(xf[k - 1, 6:10], quat, x[6:10])
            # Jacobian blocks
            u0, u1, u2 = turn[0, 2], turn[1, 2], turn[2, 2]
            f = -dt * acc
            for i in range(3):
                b[0, i, 0] = f * (start[i, 1] * u2 - start[i, 2] * u1)
                b[0, i, 1] = f * (start[i, 2] * u0 - start[i, 0] * u2)
                b[0, i, 2] = f * (start[i, 0] * u1 - start[i, 1] * u0)
                b[1, i, 0] = f * h * middle[k, i, 1]
                b[1, i, 1] = -f * h * middle[k, i, 0]
                b[1, i, 2] = 0.0
            _rate_jacobian(w, inertia, inverse, dt, b[4])
            _matrix(quat, turn)
            x0, x1, x2 = phi[0], phi[1], phi[2]
            n2 = x0 * x0 + x1 * x1 + x2 * x2
            for i in range(3):
                for j in range(3):
                    b[2, i, j] = turn[j, i]
                    jr[i, j] = phi[i] * phi[j] / 6.0
                jr[i, i] += 1.0 - n2 / 6.0
            jr[0, 1] += 0.5 * x2
            jr[0, 2] -= 0.5 * x1
            jr[1, 0] -= 0.5 * x2
            jr[1, 2] += 0.5 * x0
            jr[2, 0] += 0.5 * x1
            jr[2, 1] -= 0.5 * x0
            for i in range(3):
                for j in range(3):
                    b[3, i, j] = h * (jr[i, j] + jr[i, 0] * b[4, 0, j] + jr[i, 1] * b[4, 1, j] + jr[i, 2] * b[4, 2, j])
            # covariance: Phi P Phi' + G Q G'
            _apply(b, dt, pf[k - 1], tmp)
            for i in range(12):
                for j in range(12):
                    tra[i, j] = tmp[j, i]
            _apply(b, dt, tra, cov)
            for i in range(3):
                for j in range(3):
                    v = dt * (
                        middle[k, i, 0] * middle[k, j, 0] * q[0]
                        + middle[k, i, 1] * middle[k, j, 1] * q[1]
                        + middle[k, i, 2] * middle[k, j, 2] * q[2]
                    )
                    cov[3 + i, 3 + j] += v
                    cov[i, 3 + j] += h * v
                    cov[3 + i, j] += h * v
                    cov[i, j] += (h * h + bridge) * v
                    cov[6 + i, 6 + j] += (
                        (h * h + bridge)
                        * dt
                        * (jr[i, 0] * jr[j, 0] * q[3] + jr[i, 1] * jr[j, 1] * q[4] + jr[i, 2] * jr[j, 2] * q[5])
                    )
                    v = h * dt * jr[i, j] * q[3 + j]
                    cov[6 + i, 9 + j] += v
                    cov[9 + j, 6 + i] += v
                cov[9 + i, 9 + i] += dt * q[3 + i]
        for i in range(12):
            for j in range(12):
                pp[k, i, j] = cov[i, j]
        # measurements, one scalar after the other
        for i in range(6):
            innov[i] = y[k, i] - x[i]
            innov[6 + i] = np.nan
        if not np.isnan(y[k, 6]):
            quat[0], quat[1], quat[2], quat[3] = -x[6], -x[7], -x[8], x[9]
            _product(quat, y[k, 6:10], quat)
            _log(quat, innov[6:9])
        for i in range(3):
            innov[9 + i] = y[k, 10 + i] - x[10 + i]
        for i in range(12):
            correction[i] = 0.0
        ll = 0.0
        for i in range(12):
            if np.isnan(innov[i]):
                s[k, i] = 0.0
                e[k, i] = 0.0
                continue
            var = cov[i, i] + r[i]
            err = innov[i] - correction[i]
            inv = 1.0 / var
            s[k, i] = var
            e[k, i] = err
            g = gain[k, i]
            for j in range(12):
                g[j] = cov[i, j] * inv
            for j in range(12):
                correction[j] += g[j] * err
                f = g[j] * var
                row = cov[j]
                for m in range(12):
                    row[m] -= f * g[m]
            ll -= 0.5 * (np.log(2 * np.pi * var) + err * err * inv)
        if kind[k] == 1:
            ll = 0.0
        loglik[k] = ll
        total += ll
        for i in range(6):
            xf[k, i] = x[i] + correction[i]
        for i in range(3):
            xf[k, 10 + i] = x[10 + i] + correction[9 + i]
        _half_turn(correction[6:9], 1.0, quat)
        _product(x[6:10], quat, xf[k, 6:10])
        for i in range(12):
            for j in range(12):
                pf[k, i, j] = 0.5 * (cov[i, j] + cov[j, i])
    return total


@compiled
def _outer(out, base, z, n, weight):
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
        _apply_transposed(b, dt, lam, lam2)
        for i in range(12):
            lam[i, 0] = lam2[i, 0]
        _apply_transposed(b, dt, big, tmp)
        for i in range(12):
            for j in range(12):
                tra[i, j] = tmp[j, i]
        _apply_transposed(b, dt, tra, big)
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
        _angular_acceleration(rate, torque[k], inertia, inverse, alpha)
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
        _outer(row, MASS, z, 4, dt)
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
            _outer(row, AXIS + AXIS_SIZE * i, z, 6, dt)
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


@compiled
def sensitivities(first, last, time, kind, usable, thrust, torque, thrust_tau, torque_tau, thrust_delay,
                  torque_delay, theta, unit, inertia, inverse, xf, gain, s, e, blocks, middle, score):  # fmt: skip
    """Derivatives of the innovations with respect to the nine parameters (logarithms, units).

    With the noise intensities in units of acceleration as free nuisance parameters the gains do not depend on these
    (up to the state-dependence of the Jacobian), so each sensitivity is a 12-vector carried along the filter.

    Returns:
        Fisher information (9, 9); `score` (n, 9) receives each sample's contribution to the score.
    """
    d = np.zeros((12, PARAMETERS))
    d2 = np.zeros((12, PARAMETERS))
    info = np.zeros((PARAMETERS, PARAMETERS))
    alpha = np.empty(3)
    for k in range(first, last):
        for a in range(PARAMETERS):
            score[k, a] = 0.0
        if kind[k] == 1 or k == first:
            for i in range(12):
                for a in range(PARAMETERS):
                    d[i, a] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = 0.5 * dt
        w = xf[k - 1, 10:13]
        _apply(blocks[k], dt, d, d2)
        for i in range(12):
            for a in range(PARAMETERS):
                d[i, a] = d2[i, a]
        if usable[k]:
            _angular_acceleration(w, torque[k], inertia, inverse, alpha)
            for i in range(3):
                v = -dt * middle[k, i, 2] * thrust[k] / theta[0]
                d[3 + i, 0] += v
                d[i, 0] += h * v
                for a in range(4, 6):
                    f = theta[4] if a == 4 else unit[a]
                    t = f * dt * middle[k, i, 2] * (thrust_tau[k] if a == 4 else thrust_delay[k]) / theta[0]
                    d[3 + i, a] += t
                    d[i, a] += h * t
                    t = 0.0
                    for j in range(3):
                        t += inverse[i, j] * (torque_tau[k, j] if a == 4 else torque_delay[k, j])
                    t *= dt * f
                    d[9 + i, a] += t
                    d[6 + i, a] += h * t
                for a in range(3):
                    t = dt * inverse[i, a] * unit[OFFSET + a]
                    d[9 + i, OFFSET + a] += t
                    d[6 + i, OFFSET + a] += h * t
            for a in range(3):  # d(I^-1 (M - w x I w)) / d log I_aa = -I^-1 (e_a I_a alpha_a + w x e_a I_a w_a)
                b = (a + 1) % 3
                c = (a + 2) % 3
                for i in range(3):
                    t = inverse[i, a] * alpha[a] + w[a] * (inverse[i, b] * w[c] - inverse[i, c] * w[b])
                    t *= -dt * theta[1 + a]
                    d[9 + i, 1 + a] += t
                    d[6 + i, 1 + a] += h * t
        for i in range(12):
            if s[k, i] == 0.0:
                continue
            inv = 1.0 / s[k, i]
            g = gain[k, i]
            for a in range(PARAMETERS):
                da = d[i, a]
                score[k, a] += da * e[k, i] * inv
                for b in range(PARAMETERS):
                    info[a, b] += da * d[i, b] * inv
            for a in range(PARAMETERS):
                da = d[i, a]
                for j in range(12):
                    d2[j, a] = g[j] * da
            for j in range(12):
                for a in range(PARAMETERS):
                    d[j, a] -= d2[j, a]
    return info
