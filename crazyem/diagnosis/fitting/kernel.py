"""Innovations of a flight under given accelerations, with score and information of any number of columns.

The states of the extended Kalman filter are position, velocity, attitude and body rate. Optional states are two
disturbances (specific force and angular acceleration, body axes) and errors of measurements (Bryson and Henrikson
1968), all with memory (Ornstein-Uhlenbeck). Position and velocity of one estimate err together: the error of the
position also integrates that of the velocity. Inputs are the specific force and angular acceleration of each step.
`physics.motion` computes them beforehand at the states of the filter, so the kernel contains no parameter.

A column is a change of the accelerations or of the measurements. The kernel propagates the derivative of the state by
each column. So it knows the derivatives of the innovations; score and information are sums over innovations. Commands
depend on earlier motion only. So the control loop causes no bias (Ljung, System Identification, ch. 7 and 13).
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.diagnosis.fitting.transition import transition, unknown_force
from crazyem.estimation.kernels.algebra import half_turn, log, matrix, product, right_jacobian
from crazyem.vehicle import GRAVITY

# Most states of the filter: position, velocity, attitude, body rate; then optional ones: disturbing angular
# acceleration, disturbing specific force, errors of measurements with memory. Torques come before forces, because most
# flights need torques with memory alone.
STATES = 30
MEASURED = 12  # measured scalars
DISTURBED = 6  # disturbances; they and the errors are the states with memory
# Rows of inner loops have a length that is a multiple of LANES, and at least SHORTEST_ROW. A rest that does not fill a
# vector register would take three times as long.
LANES, SHORTEST_ROW = 4, 16
# Limits of the number of measurements whose products are added by one product of matrices; with more, BLAS would use
# several threads.
PRODUCT, MOST_ROWS = 200_000, 600


@compiled
def layout(disturbance):
    """The disturbance or error (0 to 17) of each state after the first 12, in the order of the filter; and the index of
    the error state of each measured scalar (12,), 0 for none."""
    which, own = np.zeros(18, np.int64), np.zeros(MEASURED, np.int64)
    count = 0
    force, torque = False, False
    for i in range(3):
        force = force or disturbance[i] > 0.0
        torque = torque or disturbance[3 + i] > 0.0
    if force or torque:
        for i in range(3):
            which[count + i] = 3 + i
        count += 3
    if force:
        for i in range(3):
            which[count + i] = i
        count += 3
    for first in range(0, MEASURED, 3):
        shown = False
        for i in range(first, first + 3):
            shown = shown or disturbance[DISTURBED + i] > 0.0
        if shown:
            for i in range(first, first + 3):
                which[count] = DISTURBED + i
                own[i] = 12 + count
                count += 1
    return which[:count], own


@compiled
def _take_away(x, scale, left, right):
    """x (n, m) -= scale left right'; left (n or more,), right (m,)."""
    for i in range(x.shape[0]):
        g = scale * left[i]
        row = x[i]
        for j in range(x.shape[1]):
            row[j] -= g * right[j]


@compiled
def _padded(size):
    """Length of a row for `size` numbers (see `LANES`)."""
    return max(SHORTEST_ROW, (size + LANES - 1) // LANES * LANES)


@compiled
def _add_products(shown, total):
    """total (m, m) += z' z for z, the first m columns of shown (rows, m or more)."""
    product = np.dot(shown.T, shown)
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            total[i, j] += product[i, j]


@compiled
def sweep(time, starts, y, specific, angular, offset, acting, showing, q, r, disturbance, memory, p0, block,
          thrust_only, xp, xf, e, s, loglik, score, information, gains, steps, known):  # fmt: skip
    """One pass of the filter; returns the log-likelihood.

    Args:
        time: (n,) s.
        starts: (n,) bool, rows at which the state starts again from the measurements.
        y: (n, 13) position, velocity, attitude (x y z w), body rate; NaN where not measured.
        specific, angular: (n, 3) m/s^2, rad/s^2, body: means over the step that ends at each row.
        offset: (n, 12) difference of measurements from the state (attitude: rotation vector on the right).
        acting: (n, 6, c) derivatives of the accelerations by the first c columns.
        showing: (n, 12, d) derivatives of the offset by the other d columns.
        q: (6,) variances per second of specific-force and angular-acceleration impulses, body.
        r: (12,) variances of the measurements.
        disturbance: (18,) stationary variances of the states with memory: specific force and angular acceleration (6),
            errors of measurements (12); 0 leaves a state out.
        memory: (18,) s, their correlation times.
        p0: (12,) variances at a start of states that are not measured there.
        block: (n,) int, the block of `score` and `information` of each row.
        thrust_only: 1 if the measured position and velocity are of an estimate by attitude and thrust alone: at first
            they lack what impulses and disturbances along body x and y change, and an error of the attitude turns the
            thrust; else 0.
        xp, xf: (n, 31) receive predicted and filtered state (13), disturbances (6) and errors with memory (12).
        e, s: (n, 12) receive innovations and their variances, sequential scalars; s is 0 where nothing was measured.
        loglik: (n,) receives log-likelihoods.
        score: (b, c + d) receives by block the sums of derivative times innovation over variance.
        information: (b, c + d, c + d) receives by block the sums of products of derivatives over variance.
        gains: (n, 12, size) receives the gain of each scalar, for `noise_score`; with 0 rows, nothing.
        steps: (n, size + 6, size) likewise the transition of each step; its last six rows receive `middle` and `jr`.
        known: (n, size - 12, size) likewise the covariances of the states with memory.
    """
    n = len(time)
    c, d = acting.shape[2], showing.shape[2]
    m = c + d
    which, own = layout(disturbance)
    size, pushed = 12 + len(which), 12
    while pushed < size and which[pushed - 12] < DISTURBED:
        pushed += 1
    coupled = own[0] > 0 and own[3] > 0
    tilt = own[6] if coupled and thrust_only else 0
    decay = np.empty(size - 12)
    wide, broad = _padded(size), _padded(m)
    rows = max(MEASURED, min(MOST_ROWS, PRODUCT // (broad * broad)))
    cov = np.zeros((size, wide))
    tmp = np.empty((size, wide))
    tra = np.zeros((size, wide))
    sens = np.zeros((size, broad))
    new = np.empty((size, broad))
    z = np.zeros(broad)
    shown = np.empty((rows, broad))
    seen, filled = 0, 0  # number of rows of `shown` in use, and their block
    quat = np.empty(4)
    turn = np.empty((3, 3))
    start = np.empty((3, 3))
    middle = np.empty((3, 3))
    turned = np.empty((3, 3))
    by_rate = np.empty((3, 3))
    rate_turn = np.empty((3, 3))
    unknown = np.zeros((3, 12))
    u = np.empty(3)
    jr = np.empty((3, 3))
    phi = np.empty(3)
    unit = np.eye(size)
    gain = np.zeros(wide)
    correction = np.zeros(STATES)
    innov = np.empty(12)
    f = np.empty(3)
    total = 0.0
    for k in range(n):
        x = xp[k]
        if starts[k] or k == 0:
            for i in range(13):
                x[i] = 0.0 if np.isnan(y[k, i]) else y[k, i]
            for i in range(13, 31):
                x[i] = 0.0
            if np.isnan(y[k, 6]):
                x[6], x[7], x[8], x[9] = 0.0, 0.0, 0.0, 1.0
            else:
                for i in range(3):
                    phi[i] = -offset[k, 6 + i]
                half_turn(phi, 1.0, quat)
                product(y[k, 6:10], quat, x[6:10])
            cov[:] = 0.0
            sens[:] = 0.0
            for i in range(12):
                column = i if i < 6 else i + 1
                if i >= 6 and i < 9:
                    measured = not np.isnan(y[k, 6])
                else:
                    measured = not np.isnan(y[k, column])
                    if measured:
                        x[column] -= offset[k, i]
                cov[i, i] = r[i] if measured else p0[i]
                if measured and own[i]:  # the state is the measurement less an error with memory
                    cov[i, i] += disturbance[DISTURBED + i]
                    cov[i, own[i]] = -disturbance[DISTURBED + i]
                    cov[own[i], i] = -disturbance[DISTURBED + i]
                if measured:
                    for j in range(d):
                        sens[i, c + j] = -showing[k, i, j]
            for i in range(size - 12):
                cov[12 + i, 12 + i] = disturbance[which[i]]
            if len(known):
                known[k] = cov[12:, :size]
            for i in range(31):
                xf[k, i] = x[i]
            for i in range(12):
                e[k, i] = 0.0
                s[k, i] = 0.0
            loglik[k] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = 0.5 * dt
        for i in range(size - 12):
            decay[i] = np.exp(-dt / memory[which[i]])
        w = xf[k - 1, 10:13]
        half_turn(w, h, quat)
        matrix(quat, turn)
        matrix(xf[k - 1, 6:10], start)
        for i in range(3):
            f[i] = specific[k, i] + xf[k - 1, 13 + i]
            for j in range(3):
                middle[i, j] = start[i, 0] * turn[0, j] + start[i, 1] * turn[1, j] + start[i, 2] * turn[2, j]
        for i in range(3):
            a = middle[i, 0] * f[0] + middle[i, 1] * f[1] + middle[i, 2] * f[2]
            if i == 2:
                a -= GRAVITY
            v = xf[k - 1, 3 + i]
            x[3 + i] = v + dt * a
            x[i] = xf[k - 1, i] + h * (v + x[3 + i])
            x[10 + i] = w[i] + dt * (angular[k, i] + xf[k - 1, 16 + i])
            phi[i] = h * (w[i] + x[10 + i])
        half_turn(phi, 1.0, quat)
        product(xf[k - 1, 6:10], quat, x[6:10])
        for i in range(13, 31):
            x[i] = 0.0
        for i in range(size - 12):
            x[13 + which[i]] = decay[i] * xf[k - 1, 13 + which[i]]
        if coupled:
            for i in range(3):
                x[19 + i] += dt * xf[k - 1, 22 + i]
        # derivative of velocity by attitude (at the start) and by body rate (through the middle)
        for i in range(3):
            m0, m1, m2 = middle[i, 0], middle[i, 1], middle[i, 2]
            by_rate[i, 0] = -dt * (m1 * f[2] - m2 * f[1])
            by_rate[i, 1] = -dt * (m2 * f[0] - m0 * f[2])
            by_rate[i, 2] = -dt * (m0 * f[1] - m1 * f[0])
        for i in range(3):  # a rotation at the start, seen in the middle: -dt middle skew(f) turn'
            for j in range(3):
                turned[i, j] = by_rate[i, 0] * turn[j, 0] + by_rate[i, 1] * turn[j, 1] + by_rate[i, 2] * turn[j, 2]
        if coupled and thrust_only:
            unknown_force(dt, tilt, xf[k - 1], f, middle, turn, by_rate, unknown, u)
            for i in range(3):
                v = dt * (middle[i, 0] * u[0] + middle[i, 1] * u[1] + middle[i, 2] * u[2])
                x[19 + i] += h * v
                x[22 + i] += v
        matrix(quat, turn)
        for i in range(3):
            for j in range(3):
                rate_turn[i, j] = turn[j, i]
        right_jacobian(phi, jr)
        transition(dt, pushed, coupled, tilt, decay, turned, rate_turn, middle, by_rate, unknown, jr, cov, tmp)
        for i in range(size):
            for j in range(size):
                tra[i, j] = tmp[j, i]
        transition(dt, pushed, coupled, tilt, decay, turned, rate_turn, middle, by_rate, unknown, jr, tra, cov)
        if len(steps):
            transition(
                dt, pushed, coupled, tilt, decay, turned, rate_turn, middle, by_rate, unknown, jr, unit, steps[k]
            )
            for i in range(3):
                for j in range(3):
                    steps[k, size + i, j] = middle[i, j]
                    steps[k, size + 3 + i, j] = jr[i, j]
        bridge = h * h + dt * dt / 12.0
        for i in range(3):
            for j in range(3):
                v = dt * (
                    middle[i, 0] * middle[j, 0] * q[0]
                    + middle[i, 1] * middle[j, 1] * q[1]
                    + middle[i, 2] * middle[j, 2] * q[2]
                )
                cov[3 + i, 3 + j] += v
                cov[i, 3 + j] += h * v
                cov[3 + i, j] += h * v
                cov[i, j] += bridge * v
                cov[6 + i, 6 + j] += (
                    bridge * dt * (jr[i, 0] * jr[j, 0] * q[3] + jr[i, 1] * jr[j, 1] * q[4] + jr[i, 2] * jr[j, 2] * q[5])
                )
                v = h * dt * jr[i, j] * q[3 + j]
                cov[6 + i, 9 + j] += v
                cov[9 + j, 6 + i] += v
            cov[9 + i, 9 + i] += dt * q[3 + i]
        if coupled and thrust_only:
            for i in range(3):
                for j in range(3):
                    v = dt * (middle[i, 0] * middle[j, 0] * q[0] + middle[i, 1] * middle[j, 1] * q[1])
                    pi, pj = pushed + i, pushed + j
                    cov[3 + i, pj + 3] -= v
                    cov[pj + 3, 3 + i] -= v
                    cov[pi + 3, pj + 3] += v
                    cov[3 + i, pj] -= h * v
                    cov[pj, 3 + i] -= h * v
                    cov[i, pj + 3] -= h * v
                    cov[pj + 3, i] -= h * v
                    cov[pi, pj + 3] += h * v
                    cov[pj + 3, pi] += h * v
                    cov[i, pj] -= bridge * v
                    cov[pj, i] -= bridge * v
                    cov[pi, pj] += bridge * v
        for i in range(size - 12):
            cov[12 + i, 12 + i] += (1.0 - decay[i] * decay[i]) * disturbance[which[i]]
        if m:
            transition(dt, pushed, coupled, tilt, decay, turned, rate_turn, middle, by_rate, unknown, jr, sens, new)
            for j in range(c):
                f0, f1, f2 = acting[k, 0, j], acting[k, 1, j], acting[k, 2, j]
                a0, a1, a2 = acting[k, 3, j], acting[k, 4, j], acting[k, 5, j]
                for i in range(3):
                    v = dt * (middle[i, 0] * f0 + middle[i, 1] * f1 + middle[i, 2] * f2)
                    new[3 + i, j] += v
                    new[i, j] += h * v
                    new[6 + i, j] += h * dt * (jr[i, 0] * a0 + jr[i, 1] * a1 + jr[i, 2] * a2)
                new[9, j] += dt * a0
                new[10, j] += dt * a1
                new[11, j] += dt * a2
            sens[:] = new
        # measurements, one scalar after the other
        for i in range(6):
            innov[i] = y[k, i] - x[i] - offset[k, i] - x[19 + i]
            innov[6 + i] = np.nan
        if not np.isnan(y[k, 6]):
            quat[0], quat[1], quat[2], quat[3] = -x[6], -x[7], -x[8], x[9]
            product(quat, y[k, 6:10], quat)
            log(quat, innov[6:9])
            for i in range(3):
                innov[6 + i] -= offset[k, 6 + i] + x[25 + i]
        for i in range(3):
            innov[9 + i] = y[k, 10 + i] - x[10 + i] - offset[k, 9 + i] - x[28 + i]
        correction[:] = 0.0
        ll = 0.0
        bl = block[k]
        if seen and (bl != filled or seen + MEASURED > rows):
            _add_products(shown[:seen], information[filled])
            seen = 0
        filled = bl
        for i in range(12):
            if np.isnan(innov[i]):
                s[k, i] = 0.0
                e[k, i] = 0.0
                continue
            o = own[i]
            for j in range(wide):
                gain[j] = cov[i, j]
            if o:
                for j in range(wide):
                    gain[j] += cov[o, j]
            var = gain[i] + gain[o] + r[i] if o else gain[i] + r[i]
            err = innov[i] - correction[i] - correction[o] if o else innov[i] - correction[i]
            inv = 1.0 / var
            s[k, i] = var
            e[k, i] = err
            for j in range(wide):
                gain[j] *= inv
            for j in range(size):
                correction[j] += gain[j] * err
                if len(gains):
                    gains[k, i, j] = gain[j]
            _take_away(cov, var, gain, gain)
            if m:
                for j in range(broad):
                    z[j] = sens[i, j]
                if o:
                    for j in range(broad):
                        z[j] += sens[o, j]
                for j in range(d):
                    z[c + j] += showing[k, i, j]
                _take_away(sens, 1.0, gain, z)
                weight, root = err * inv, np.sqrt(inv)
                for j in range(m):
                    score[bl, j] += weight * z[j]
                for j in range(broad):
                    shown[seen, j] = root * z[j]
                seen += 1
            ll -= 0.5 * (np.log(2 * np.pi * var) + err * err * inv)
        loglik[k] = ll
        total += ll
        for i in range(6):
            xf[k, i] = x[i] + correction[i]
        for i in range(size - 12):
            xf[k, 13 + which[i]] = x[13 + which[i]] + correction[12 + i]
        for i in range(3):
            xf[k, 10 + i] = x[10 + i] + correction[9 + i]
        half_turn(correction[6:9], 1.0, quat)
        product(x[6:10], quat, xf[k, 6:10])
        for i in range(size):
            for j in range(i):
                v = 0.5 * (cov[i, j] + cov[j, i])
                cov[i, j] = v
                cov[j, i] = v
        if len(known):
            known[k] = cov[12:, :size]
    if seen:
        _add_products(shown[:seen], information[filled])
    return total
