"""Derivatives of the innovations by the parameters, and from these score and Fisher information."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import angular_acceleration, apply
from crazyem.estimation.kernels.layout import DELAY, LAG, OFFSET, PARAMETERS


@compiled
def _push(k, dt, h, w, thrust, torque, thrust_tau, torque_tau, thrust_delay, torque_delay, theta, unit, inertia,
          inverse, middle, rest, model, alpha, d):  # fmt: skip
    """Add to d (12, at least 9) the direct effect of the parameters in step k.

    model (3,) receives the derivatives of F/m by mass, lag and delay. `rest` is the weight of F/m in the specific force
    of the step: 1, or less where the specific force is measured. alpha (3,) is scratch.
    """
    angular_acceleration(w, torque[k], inertia, inverse, alpha)
    model[0] = -thrust[k] / theta[0]
    model[1] = theta[4] * thrust_tau[k] / theta[0]
    model[2] = unit[5] * thrust_delay[k] / theta[0]
    for i in range(3):
        v = rest * dt * middle[k, i, 2]
        for a in range(3):
            column = 0 if a == 0 else LAG if a == 1 else DELAY
            d[3 + i, column] += v * model[a]
            d[i, column] += h * v * model[a]
        for a in range(4, 6):
            f = theta[4] if a == 4 else unit[a]
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


@compiled
def _correct(d, i, gain, row):
    """Update the sensitivities d (12, columns) by the measurement of component i: d - gain d_i; `row` is scratch."""
    for a in range(d.shape[1]):
        row[a] = d[i, a]
    for j in range(12):
        for a in range(d.shape[1]):
            d[j, a] -= gain[j] * row[a]


@compiled
def sensitivities(first, last, time, kind, usable, force, thrust, torque, thrust_tau, torque_tau, thrust_delay,
                  torque_delay, theta, unit, inertia, inverse, q, r_force, lead, xf, gain, s, e, blocks, middle,
                  score):  # fmt: skip
    """Information and score of the nine parameters (logarithms, units) by derivatives of the innovations.

    The noise intensities are free nuisances in units of acceleration. So the gains do not depend on the nine parameters
    (except through the state in the Jacobian), and each sensitivity is a 12-vector carried along the filter.

    Returns:
        Fisher information (9, 9); `score` (n, 9) receives each sample's contribution to the score.
    """
    d = np.zeros((12, PARAMETERS))
    d2 = np.zeros((12, PARAMETERS))
    info = np.zeros((PARAMETERS, PARAMETERS))
    alpha = np.empty(3)
    model = np.empty(3)
    column = (0, LAG, DELAY)
    for k in range(first, last):
        for a in range(PARAMETERS):
            score[k, a] = 0.0
        if kind[k] == 1 or k == first:
            for i in range(12):
                for a in range(PARAMETERS):
                    d[i, a] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = lead * dt
        apply(blocks[k], dt, h, d, d2)
        for i in range(12):
            for a in range(PARAMETERS):
                d[i, a] = d2[i, a]
        if usable[k]:
            rest = 1.0
            measured = not np.isnan(force[k, 2])
            if measured:
                var = q[2] / dt + r_force
                rest = r_force / var
            _push(k, dt, h, xf[k - 1, 10:13], thrust, torque, thrust_tau, torque_tau, thrust_delay, torque_delay, theta,
                  unit, inertia, inverse, middle, rest, model, alpha, d)  # fmt: skip
            if measured:
                err = force[k, 2] - thrust[k] / theta[0]
                for a in range(3):
                    score[k, column[a]] += model[a] * err / var
                    for b in range(3):
                        info[column[a], column[b]] += model[a] * model[b] / var
        for i in range(12):
            if s[k, i] == 0.0:
                continue
            inv = 1.0 / s[k, i]
            for a in range(PARAMETERS):
                da = d[i, a]
                score[k, a] += da * e[k, i] * inv
                for b in range(PARAMETERS):
                    info[a, b] += da * d[i, b] * inv
            _correct(d, i, gain[k, i], d2[0])
    return info


@compiled
def torque_sensitivities(first, last, time, kind, usable, force, thrust, torque, thrust_tau, torque_tau, thrust_delay,
                         torque_delay, theta, unit, inertia, inverse, q, r_force, lead, xf, gain, s, e, blocks, middle,
                         shapes):  # fmt: skip
    """Information and score of the sizes of K torques with known shapes (n, 3, K) [N m for a size of one].

    Returns:
        Information between the parameters and the sizes (9, K), among the sizes (K, K), score of the sizes (K,).
    """
    sizes = shapes.shape[2]
    columns = PARAMETERS + sizes
    d = np.zeros((12, columns))
    d2 = np.zeros((12, columns))
    cross = np.zeros((PARAMETERS, sizes))
    among = np.zeros((sizes, sizes))
    score = np.zeros(sizes)
    alpha = np.empty(3)
    model = np.empty(3)
    for k in range(first, last):
        if kind[k] == 1 or k == first:
            d[:, :] = 0.0
            continue
        dt = time[k] - time[k - 1]
        h = lead * dt
        apply(blocks[k], dt, h, d, d2)
        d, d2 = d2, d
        if usable[k]:
            rest = 1.0 if np.isnan(force[k, 2]) else r_force / (q[2] / dt + r_force)
            _push(k, dt, h, xf[k - 1, 10:13], thrust, torque, thrust_tau, torque_tau, thrust_delay, torque_delay, theta,
                  unit, inertia, inverse, middle, rest, model, alpha, d)  # fmt: skip
            for i in range(3):
                for j in range(3):
                    v = dt * inverse[i, j]
                    if v == 0.0:
                        continue
                    for a in range(sizes):
                        t = v * shapes[k, j, a]
                        d[9 + i, PARAMETERS + a] += t
                        d[6 + i, PARAMETERS + a] += h * t
        for i in range(12):
            if s[k, i] == 0.0:
                continue
            inv = 1.0 / s[k, i]
            for a in range(sizes):
                da = d[i, PARAMETERS + a] * inv
                score[a] += da * e[k, i]
                for b in range(PARAMETERS):
                    cross[b, a] += d[i, b] * da
                for b in range(sizes):
                    among[b, a] += d[i, PARAMETERS + b] * da
            _correct(d, i, gain[k, i], d2[0])
    return cross, among, score
