"""Compiled inner loops of the monitor: signatures along the filter, their scores and information, test statistics.

A change at the onset t0 gives the filter's state an error d: d <- Phi d + B in each step, and d <- d - gain (d_i + m_i)
after each scalar measurement, where m is an error of the sensor. The innovation changes by g = d_i + m_i, the signature
(Willsky and Jones 1976). The unit of innovations is their standard deviation. The predicted slow error (slow_error.py)
is subtracted from innovations, and likewise from signatures.
"""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import apply
from crazyem.physics.effects.onboard_estimate import path_step


@compiled
def _step(d, scratch, blocks, dt, h, middle, acting, act, once, new):
    """Carry d (12, C) over one step; act: whether changes act in it; new: whether it is the first step of a window."""
    apply(blocks, dt, h, d, scratch)
    size = d.shape[1]
    for i in range(12):
        for a in range(size):
            d[i, a] = scratch[i, a]
    if not act:
        return
    for a in range(size):
        t = dt
        if once[a]:
            if not new:
                continue
            t = 1.0
        for i in range(3):
            v = t * (middle[i, 0] * acting[a, 0] + middle[i, 1] * acting[a, 1] + middle[i, 2] * acting[a, 2])
            d[3 + i, a] += v
            d[i, a] += h * v
            v = t * acting[a, 3 + i]
            d[9 + i, a] += v
            d[6 + i, a] += h * v


@compiled
def _relaxation(dt, seconds, turn_seconds, left):
    """Into left (U + 1, 3): decay, cosine and sine of the onboard filter's errors in a step; last that of attitudes."""
    for c in range(len(seconds)):
        part = dt / seconds[c]
        left[c, 0], left[c, 1], left[c, 2] = np.exp(-part), np.cos(part), np.sin(part)
    left[-1, 0] = np.exp(-dt / turn_seconds)


@compiled
def _filter_errors(path, turned, left, middle, acting, onboard, seconds, later, before, now, new, error):
    """Errors (9, C) of the onboard filter's position, velocity and attitude after one step, by changes of size one.

    A change is a force that the filter does not know (`path_error` in physics/effects/onboard_estimate.py), or a delay
    of the fixes of the pose: then position and attitude tend to values that are ahead by the motion in this time.

    Args:
        path: (6, U) errors of position and velocity by the columns `onboard` (U,), for delays less the motion ahead.
            turned: (3,) likewise of the attitude. Both are updated.
        left: (U + 1, 3) of `_relaxation`. seconds, later: (U,) time constants of the path; whether it is a delay.
        before, now: (6,) velocity [m/s] and body rate [rad/s] at both ends of the step. new: whether the change is at
            the start of the step.
    """
    for i in range(3):
        turned[i] = left[-1, 0] * (-before[3 + i] if new else turned[i]) - (now[3 + i] - before[3 + i])
    for c in range(len(onboard)):
        a, time = onboard[c], seconds[c]
        decay, cosine, sine = left[c, 0], left[c, 1], left[c, 2]
        for i in range(3):
            drive = 0.0
            if later[c]:
                if new:
                    path[i, c] = -before[i]
            else:
                drive = -(middle[i, 0] * acting[a, 0] + middle[i, 1] * acting[a, 1])
            path[i, c], path[3 + i, c] = path_step(path[i, c], path[3 + i, c], drive, time, decay, cosine, sine)
            error[i, a], error[3 + i, a] = path[i, c], path[3 + i, c]
            if later[c]:
                path[i, c] -= now[i] - before[i]
                error[i, a] = path[i, c] + now[i]
                error[6 + i, a] = turned[i] + now[3 + i]


@compiled
def absorb(first, last, lead, time, usable, gain, s, e, blocks, middle, acting, sensed, acting_n, sensed_n, drifting,
           late, drift, once, block, onboard, seconds, later, turn_seconds, motion, slots, rows, slow, d, path, turned,
           d_slow, n, n_slow, n_now, e_slow, e_now, score, score_n, among, cross, among_n):  # fmt: skip
    """Add rows first..last-1 of the tape to the sums of every open window.

    Args:
        acting (k, C, 6), sensed (k, C, 12), acting_n (k, M, 6), sensed_n (k, M, 12): see `RowMaker`; once, block: see
            `Columns`.
        drifting (k, 1, 6): changes of the model's accelerations since its reference. drift: (12, 1) their effect on the
            filter's state; with it, innovations are corrected to those of the reference.
        motion: (k + 1, 6) velocity and body rate at both ends of the steps; onboard, seconds, later, turn_seconds: see
            `_filter_errors` and `_relaxation`, with path (W, 6, U) and turned (W, 3).
        late: (k, 12) known errors of measurements that are older than usual; innovations are corrected likewise.
        slots: (w,) indices of the open windows. rows: (W,) number of rows in each, updated.
        slow: (3, 12) of the slow errors: decay, gain, 1 over the standard deviation of the rest.
        d, d_slow: (W, 12, C) state errors by changes, and predicted signatures; n, n_slow: (12, M) those of nuisances.
        e_slow: (12,) prediction of the innovations. n_now, e_now: scratch for the rest.
        score (W, C), among (W, C, C) within hypotheses, cross (W, C, M), score_n (M,), among_n (M, M): sums.
    """
    size, nuisances = d.shape[2], n.shape[1]
    phi, learnt, weight = slow[0], slow[1], slow[2]
    scratch = np.empty((12, size))
    scratch_n = np.empty((12, nuisances))
    now = np.empty(size)
    whole = np.empty(size)
    part = np.empty(nuisances)
    never = np.zeros(nuisances, np.bool_)
    scratch_1 = np.empty((12, 1))
    error = np.zeros((9, size))
    decays = np.zeros((len(onboard) + 1, 3))
    for k in range(first, last):
        dt = time[k] - time[k - 1]
        h = lead * dt
        _step(n, scratch_n, blocks[k], dt, h, middle[k], acting_n[k - first], usable[k], never, False)
        _step(drift, scratch_1, blocks[k], dt, h, middle[k], drifting[k - first], usable[k], never, False)
        for i in range(12):
            e_now[i] = np.nan
            if s[k, i] == 0.0:
                continue
            root = 1.0 / np.sqrt(s[k, i])
            moved = drift[i, 0] - late[k - first, i]
            f, q, r = phi[i], learnt[i], weight[i]
            v = (e[k, i] + moved) * root - e_slow[i]
            e_now[i] = r * v
            e_slow[i] = f * (e_slow[i] + q * v)
            for a in range(nuisances):
                part[a] = n[i, a] + sensed_n[k - first, a, i]
                v = part[a] * root - n_slow[i, a]
                n_now[i, a] = r * v
                n_slow[i, a] = f * (n_slow[i, a] + q * v)
            for j in range(12):
                g = gain[k, i, j]
                drift[j, 0] -= g * moved
                for a in range(nuisances):
                    n[j, a] -= g * part[a]
            for a in range(nuisances):
                v = n_now[i, a]
                score_n[a] += v * e_now[i]
                for b in range(a + 1):
                    among_n[a, b] += v * n_now[i, b]
        _relaxation(dt, seconds, turn_seconds, decays)
        for at in range(len(slots)):
            w = slots[at]
            dw = d[w]
            _step(dw, scratch, blocks[k], dt, h, middle[k], acting[k - first], True, once, rows[w] == 0)
            rows[w] += 1
            _filter_errors(
                path[w], turned[w], decays, middle[k], acting[k - first], onboard, seconds, later, motion[k - first],
                motion[k - first + 1], rows[w] == 1, error,
            )  # fmt: skip
            for i in range(12):
                if s[k, i] == 0.0:
                    continue
                root = 1.0 / np.sqrt(s[k, i])
                f, q, r = phi[i], learnt[i], weight[i]
                for a in range(size):
                    now[a] = dw[i, a] + sensed[k - first, a, i]
                if i < 9:
                    for a in range(size):
                        now[a] += error[i, a]
                for j in range(12):
                    g = gain[k, i, j]
                    dj = dw[j]
                    for a in range(size):
                        dj[a] -= g * now[a]
                past = d_slow[w, i]
                for a in range(size):
                    v = now[a] * root - past[a]
                    whole[a] = r * v
                    past[a] = f * (past[a] + q * v)
                left = e_now[i]
                for a in range(size):
                    x = whole[a]
                    if x == 0.0:
                        continue
                    score[w, a] += x * left
                    for b in range(block[a], a + 1):
                        among[w, a, b] += x * whole[b]
                    row = cross[w, a]
                    for b in range(nuisances):
                        row[b] += x * n_now[i, b]


@compiled
def correlate(first, last, time, s, e, memory, most, lags, past, seen, moments):
    """Running covariances of the normalised innovations: moments (1 + L, 12), at lag 0 and at `lags` (L,) samples.

    `memory` [s] is their time constant. Values are limited to `most` standard deviations. past (R, 12) and seen (12,)
    hold the newest samples of each signal and their number.
    """
    room = past.shape[0]
    for k in range(first, last):
        for i in range(12):
            if s[k, i] == 0.0:
                continue
            share = max((time[k] - time[k - 1]) / memory, 1.0 / (2.0 + seen[i]))
            bound = most * np.sqrt(moments[0, i])
            v = min(max(e[k, i] / np.sqrt(s[k, i]), -bound), bound)
            moments[0, i] += share * (v * v - moments[0, i])
            for j in range(len(lags)):
                if seen[i] >= lags[j]:
                    moments[1 + j, i] += share * (v * past[(seen[i] - lags[j]) % room, i] - moments[1 + j, i])
            past[seen[i] % room, i] = v
            seen[i] += 1


@compiled
def _factor(m, size):
    """Cholesky factor of the lower triangle of m (size, size), in place; False if m is not positive definite."""
    for j in range(size):
        v = m[j, j]
        for k in range(j):
            v -= m[j, k] * m[j, k]
        if not v > 0.0:
            return False
        m[j, j] = np.sqrt(v)
        for i in range(j + 1, size):
            v = m[i, j]
            for k in range(j):
                v -= m[i, k] * m[j, k]
            m[i, j] = v / m[j, j]
    return True


@compiled
def judge(slots, first, prior, normal, prior_n, score, score_n, among, cross, among_n, excess, statistic, determinant,
          size, variance):  # fmt: skip
    """Test statistics of every hypothesis in every open window, with the nuisances integrated out.

    Nuisances act before and after a change: score_n (M,) and among_n (M, M) are those of the oldest window and the
    flight before it.

    Args:
        first (H + 1,): columns of each hypothesis. prior (C,): precisions of the sizes after a change. normal (C,): of
            those without one. prior_n (M,): of the nuisances.
        statistic (W, H): S' (J + prior)^-1 S, twice the logarithm of the likelihood ratio to sizes of zero. excess
            (W, H): the same less S' (J + normal)^-1 S, of the ratio to normal sizes. determinant (W, H): log det
            (1 + J / prior). size (W, C): most probable sizes, variance (W, C): their variances. Filled for open
            windows.
    """
    nuisances = prior_n.shape[0]
    columns = prior.shape[0]
    m = np.empty((nuisances, nuisances))
    x = np.empty((nuisances, columns + 1))
    hyp, null = np.empty((8, 8)), np.empty((8, 8))
    y, z = np.empty(8), np.empty(8)
    for a in range(nuisances):
        for b in range(a + 1):
            m[a, b] = among_n[a, b]
        m[a, a] += prior_n[a]
    _factor(m, nuisances)
    for at in range(len(slots)):
        w = slots[at]
        for a in range(nuisances):  # x = L^-1 (cross', score_n)
            for c in range(columns):
                x[a, c] = cross[w, c, a]
            x[a, columns] = score_n[a]
            for k in range(a):
                f = m[a, k]
                for c in range(columns + 1):
                    x[a, c] -= f * x[k, c]
            f = 1.0 / m[a, a]
            for c in range(columns + 1):
                x[a, c] *= f
        for k in range(len(first) - 1):
            lo, n = first[k], first[k + 1] - first[k]
            log_prior = 0.0
            for a in range(n):
                v = score[w, lo + a]
                for c in range(nuisances):
                    v -= x[c, lo + a] * x[c, columns]
                y[a] = z[a] = v
                for b in range(a + 1):
                    u = among[w, lo + a, lo + b]
                    for c in range(nuisances):
                        u -= x[c, lo + a] * x[c, lo + b]
                    hyp[a, b] = null[a, b] = u
                hyp[a, a] += prior[lo + a]
                null[a, a] += normal[lo + a]
                log_prior += np.log(prior[lo + a])
            statistic[w, k] = excess[w, k] = 0.0
            determinant[w, k] = 0.0
            if not (_factor(hyp, n) and _factor(null, n)):
                for a in range(n):
                    size[w, lo + a], variance[w, lo + a] = 0.0, 1.0 / prior[lo + a]
                continue
            for a in range(n):
                for c in range(a):
                    y[a] -= hyp[a, c] * y[c]
                y[a] /= hyp[a, a]
                for c in range(a):
                    z[a] -= null[a, c] * z[c]
                z[a] /= null[a, a]
                statistic[w, k] += y[a] * y[a]
                excess[w, k] += y[a] * y[a] - z[a] * z[a]
                determinant[w, k] += 2.0 * np.log(hyp[a, a])
            determinant[w, k] -= log_prior
            for a in range(n - 1, -1, -1):
                v = y[a]
                for c in range(a + 1, n):
                    v -= hyp[c, a] * size[w, lo + c]
                size[w, lo + a] = v / hyp[a, a]
            for a in range(n):  # variance: |L^-1 e_a|^2
                total = 0.0
                for c in range(a, n):
                    v = 1.0 if c == a else 0.0
                    for b in range(a, c):
                        v -= hyp[c, b] * y[b]
                    y[c] = v / hyp[c, c]
                    total += y[c] * y[c]
                variance[w, lo + a] = total
