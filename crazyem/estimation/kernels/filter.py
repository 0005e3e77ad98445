"""The extended Kalman filter."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import (
    angular_acceleration,
    apply,
    explicit_turn,
    half_turn,
    log,
    matrix,
    product,
    rate_jacobian,
    right_jacobian,
    specific_force,
)
from crazyem.vehicle import GRAVITY


@compiled
def forward(first, last, restart, time, kind, y, force, thrust, torque, mass, inertia, inverse, q, r, r_force, lead,
            p0, xp, pp, xf, pf, gain, s, e, blocks, middle, loglik):  # fmt: skip
    """Extended Kalman filter over samples first..last-1, written into the tape arrays; returns the log-likelihood.

    Sample k is predicted from k - 1 with thrust[k], torque[k] (means over the step that ends at k). There are two
    exceptions: at a break, kind[k] == 1, the state restarts at the measurement with variances p0; at k == first with
    restart, the prior is xp[first], pp[first]. Missing measurements are NaN in y and force. `lead` is the rule of
    integration (estimation/kernels).
    """
    cov = np.empty((12, 12))
    tmp = np.empty((12, 12))
    tra = np.empty((12, 12))
    quat = np.empty(4)
    turn = np.empty((3, 3))
    start = np.empty((3, 3))
    alpha = np.empty(3)
    model = np.zeros(3)
    f = np.empty(3)
    left = np.empty(3)
    phi = np.empty(3)
    correction = np.empty(12)
    innov = np.empty(12)
    jr = np.empty((3, 3))
    total = 0.0
    for k in range(first, last):
        x = xp[k]
        ll = 0.0
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
            h = lead * dt
            rest = dt - h
            # variance of position and attitude by white noise within a step, given its impulse over the step
            bridge = dt * dt / 12.0 if lead == 0.5 else 0.0
            w = xf[k - 1, 10:13]
            b = blocks[k]
            # mean
            half_turn(w, h, quat)
            matrix(quat, turn)
            matrix(xf[k - 1, 6:10], start)
            for i in range(3):
                for j in range(3):
                    middle[k, i, j] = start[i, 0] * turn[0, j] + start[i, 1] * turn[1, j] + start[i, 2] * turn[2, j]
            model[2] = thrust[k] / mass
            ll = specific_force(model, force[k], q, dt, r_force, f, left)
            angular_acceleration(w, torque[k], inertia, inverse, alpha)
            for i in range(3):
                a = middle[k, i, 0] * f[0] + middle[k, i, 1] * f[1] + middle[k, i, 2] * f[2]
                if i == 2:
                    a -= GRAVITY
                v = xf[k - 1, 3 + i]
                x[3 + i] = v + dt * a
                x[i] = xf[k - 1, i] + rest * v + h * x[3 + i]
                x[10 + i] = w[i] + dt * alpha[i]
                phi[i] = rest * w[i] + h * x[10 + i]
            half_turn(phi, 1.0, quat)
            product(xf[k - 1, 6:10], quat, x[6:10])
            # Jacobian blocks
            f0, f1, f2 = -dt * f[0], -dt * f[1], -dt * f[2]
            u0 = turn[0, 0] * f0 + turn[0, 1] * f1 + turn[0, 2] * f2
            u1 = turn[1, 0] * f0 + turn[1, 1] * f1 + turn[1, 2] * f2
            u2 = turn[2, 0] * f0 + turn[2, 1] * f1 + turn[2, 2] * f2
            for i in range(3):
                b[0, i, 0] = start[i, 1] * u2 - start[i, 2] * u1
                b[0, i, 1] = start[i, 2] * u0 - start[i, 0] * u2
                b[0, i, 2] = start[i, 0] * u1 - start[i, 1] * u0
                b[1, i, 0] = h * (middle[k, i, 1] * f2 - middle[k, i, 2] * f1)
                b[1, i, 1] = h * (middle[k, i, 2] * f0 - middle[k, i, 0] * f2)
                b[1, i, 2] = h * (middle[k, i, 0] * f1 - middle[k, i, 1] * f0)
            rate_jacobian(w, inertia, inverse, dt, b[4])
            matrix(quat, turn)
            right_jacobian(phi, jr)
            for i in range(3):
                for j in range(3):
                    b[2, i, j] = turn[j, i]
                    b[3, i, j] = rest * jr[i, j] + h * (
                        jr[i, 0] * b[4, 0, j] + jr[i, 1] * b[4, 1, j] + jr[i, 2] * b[4, 2, j]
                    )
            if lead == 0.0:
                explicit_turn(xf[k - 1, 6:10], start, w, dt, x[6:10], b[2], b[3])
            # covariance: Phi P Phi' + G Q G'
            apply(b, dt, h, pf[k - 1], tmp)
            for i in range(12):
                for j in range(12):
                    tra[i, j] = tmp[j, i]
            apply(b, dt, h, tra, cov)
            for i in range(3):
                for j in range(3):
                    v = dt * (
                        middle[k, i, 0] * middle[k, j, 0] * left[0]
                        + middle[k, i, 1] * middle[k, j, 1] * left[1]
                        + middle[k, i, 2] * middle[k, j, 2] * left[2]
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
            for c in range(3):
                if left[c] != q[c]:  # the accelerometer shows the mean over the step, not the noise within it
                    for i in range(3):
                        for j in range(3):
                            cov[i, j] += bridge * dt * middle[k, i, c] * middle[k, j, c] * (q[c] - left[c])
        for i in range(12):
            for j in range(12):
                pp[k, i, j] = cov[i, j]
        # measurements, one scalar after the other
        for i in range(6):
            innov[i] = y[k, i] - x[i]
            innov[6 + i] = np.nan
        if not np.isnan(y[k, 6]):
            quat[0], quat[1], quat[2], quat[3] = -x[6], -x[7], -x[8], x[9]
            product(quat, y[k, 6:10], quat)
            log(quat, innov[6:9])
        for i in range(3):
            innov[9 + i] = y[k, 10 + i] - x[10 + i]
        for i in range(12):
            correction[i] = 0.0
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
                c = g[j] * var
                row = cov[j]
                for m in range(12):
                    row[m] -= c * g[m]
            ll -= 0.5 * (np.log(2 * np.pi * var) + err * err * inv)
        if kind[k] == 1:
            ll = 0.0
        loglik[k] = ll
        total += ll
        for i in range(6):
            xf[k, i] = x[i] + correction[i]
        for i in range(3):
            xf[k, 10 + i] = x[10 + i] + correction[9 + i]
        half_turn(correction[6:9], 1.0, quat)
        product(x[6:10], quat, xf[k, 6:10])
        for i in range(12):
            for j in range(12):
                pf[k, i, j] = 0.5 * (cov[i, j] + cov[j, i])
    return total
