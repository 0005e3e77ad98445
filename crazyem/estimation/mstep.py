"""M-step: mass, inertia and rotor time constant that maximise the expected complete-data log-likelihood.

For N steps, with the noise intensities profiled out (paper's eq. 107 and appendix in their correct, joint form), it is

    Q = N log m - N/2 log S_F + N sum_i log I_i - N/2 sum_i log S_i + log prior,
    S_F = sum E[(m a - F)^2] dt,   S_i = sum E[(I_i alpha_i + (I_k - I_j) w_j w_k - M_i)^2] dt,

Where the intensity s of a noise is known in newtons or newton metres, - S / (2 s^2) replaces - N/2 log S of its axis.
Then the size of the residuals carries information on mass and inertia, too.

M contains the torque offset. F and M are linearised in tau and in the delay. Every S is a quadratic form c' A c, where
the vector c is linear in the parameters and A holds the sums of kernels/smoother.py. So Newton's method in the
logarithms of the parameters costs microseconds. Logarithms also keep the parameters positive."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels import AXIS, AXIS_SIZE, COUNT, DELAY, IMPULSE, LAG, MASS, OFFSET, PARAMETERS

MAX_STEP = 1.0  # largest change of a logarithm, or of a linear parameter in its unit, in one Newton step


@compiled
def _unpack(sums, base, n, out):
    at = base
    for i in range(n):
        for j in range(i, n):
            out[i, j] = sums[at]
            out[j, i] = sums[at]
            at += 1


@compiled
def _residual(term, theta, sums, a, c, dc):
    """Fill a, c and dc = dc/dtheta of c' A c for F (term 0) or M about an axis (1..3); returns the size of c."""
    dc[:, :] = 0.0
    if term == 0:
        _unpack(sums, MASS, 4, a)
        c[0], c[1], c[2], c[3] = theta[0], -1.0, -theta[4], -theta[5]
        dc[0, 0] = 1.0
        dc[2, 4] = -1.0
        dc[3, 5] = -1.0
        return 4
    i = term - 1
    j = (i + 1) % 3
    k = (i + 2) % 3
    _unpack(sums, AXIS + AXIS_SIZE * i, 6, a)
    c[0], c[1], c[2] = theta[1 + i], theta[1 + k] - theta[1 + j], -1.0
    c[3], c[4], c[5] = -theta[LAG], -theta[DELAY], -theta[OFFSET + i]
    dc[0, 1 + i] = 1.0
    dc[1, 1 + k] = 1.0
    dc[1, 1 + j] = -1.0
    dc[3, 4] = -1.0
    dc[4, DELAY] = -1.0
    dc[5, OFFSET + i] = -1.0
    return 6


@compiled
def _prior(theta, unit, free, centre, precision, gradient, hessian):
    """Add the prior of the free parameters and hold the others fixed; returns minus the log prior."""
    value = 0.0
    for u in range(PARAMETERS):
        if free[u]:
            d = np.log(theta[u] / centre[u]) if u <= LAG else (theta[u] - centre[u]) / unit[u]
            value += 0.5 * precision[u] * d * d
            gradient[u] += precision[u] * d
            hessian[u, u] += precision[u]
        else:
            gradient[u] = 0.0
            for v in range(PARAMETERS):
                hessian[u, v] = 0.0
                hessian[v, u] = 0.0
            hessian[u, u] = 1.0
    return value


@compiled
def objective(theta, unit, sums, free, centre, precision, known, gradient, hessian, squares):
    """-Q at theta (9,), its gradient and Hessian (logarithms, units); squares (4,) receives S_F, S_x, S_y, S_z.

    `known` (5,) holds the known squared intensities of thrust [N^2 s], torque [(N m)^2 s] and lateral force [N^2 s],
    and 0 for the unknown ones.
    """
    count = sums[COUNT]
    a = np.zeros((6, 6))
    c = np.zeros(6)
    dc = np.zeros((6, PARAMETERS))
    ac = np.zeros(6)
    adc = np.zeros((6, PARAMETERS))
    gradient[:] = 0.0
    hessian[:, :] = 0.0
    value = 0.0
    grad = np.zeros(PARAMETERS)
    scale = unit.copy()
    scale[: LAG + 1] = theta[: LAG + 1]
    for term in range(4):
        n = _residual(term, theta, sums, a, c, dc)
        value -= count * np.log(theta[term])
        gradient[term] -= count
        s = 0.0
        for p in range(n):
            ac[p] = 0.0
            for q in range(n):
                ac[p] += a[p, q] * c[q]
            s += c[p] * ac[p]
        s = max(s, 1e-150)  # squared below
        squares[term] = s
        # the profiled term is count/2 log s, the term with known noise is s / (2 variance)
        profiled = known[term] == 0.0
        weight = count / s if profiled else 1.0 / known[term]
        bend = 1.0 / s if profiled else 0.0
        value += 0.5 * (count * np.log(s) if profiled else s * weight)
        for u in range(PARAMETERS):
            grad[u] = 0.0
            for p in range(n):
                grad[u] += dc[p, u] * ac[p]
            grad[u] *= 2.0 * scale[u]
            gradient[u] += 0.5 * weight * grad[u]
        for p in range(n):
            for v in range(PARAMETERS):
                adc[p, v] = 0.0
                for q in range(n):
                    adc[p, v] += a[p, q] * dc[q, v]
        for u in range(PARAMETERS):
            if u <= LAG:
                hessian[u, u] += 0.5 * weight * grad[u]
            for v in range(PARAMETERS):
                h = 0.0
                for p in range(n):
                    h += dc[p, u] * adc[p, v]
                hessian[u, v] += 0.5 * weight * (2.0 * h * scale[u] * scale[v] - grad[u] * grad[v] * bend)
    if known[4] > 0.0:  # lateral accelerations are pure noise: with a noise known in newtons they determine the mass
        s = theta[0] ** 2 * (sums[IMPULSE] + sums[IMPULSE + 1]) / known[4]
        value += 0.5 * s - 2.0 * count * np.log(theta[0])
        gradient[0] += s - 2.0 * count
        hessian[0, 0] += 2.0 * s
    return value + _prior(theta, unit, free, centre, precision, gradient, hessian)


@compiled
def maximise(theta, unit, sums, free, centre, precision, known, iterations, squares):
    """Newton's method with Levenberg damping from theta (9,: kernels.py), in place.

    Args:
        unit: (9,) units of the linear parameters. sums: statistics summed over the window.
        free: (9,) which parameters may move.
        centre, precision: (9,) prior: centre, and 1/sd^2 of the logarithm, or of the linear parameter in its unit.
        known: (5,) squares of the intensities of thrust, torque and lateral force that are known, 0 where profiled.
        iterations: at most so many Newton steps.
        squares: (4,) receives the residual sums S_F, S_x, S_y, S_z at the result.
    """
    gradient = np.empty(PARAMETERS)
    hessian = np.empty((PARAMETERS, PARAMETERS))
    trial = np.empty(PARAMETERS)
    g2 = np.empty(PARAMETERS)
    h2 = np.empty((PARAMETERS, PARAMETERS))
    value = objective(theta, unit, sums, free, centre, precision, known, gradient, hessian, squares)
    if not (np.isfinite(value) and np.isfinite(gradient).all() and np.isfinite(hessian).all()):
        return  # the states diverged: no step is possible
    damping = 0.0
    for _ in range(iterations):
        size = 0.0
        for attempt in range(12):
            damped = hessian.copy()
            for u in range(PARAMETERS):
                # far from the optimum the profile is not convex: make the diagonal positive
                damped[u, u] += damping + (max(0.0, -hessian[u, u]) if attempt else 0.0)
            step = np.linalg.solve(damped, -gradient)
            down = 0.0
            size = 0.0
            for u in range(PARAMETERS):
                step[u] = min(MAX_STEP, max(-MAX_STEP, step[u]))
                down += step[u] * gradient[u]
                size = max(size, abs(step[u]))
                trial[u] = theta[u] * np.exp(step[u]) if u <= LAG else theta[u] + unit[u] * step[u]
            new = objective(trial, unit, sums, free, centre, precision, known, g2, h2, squares)
            if down < 0.0 and new <= value + 1e-9:
                for u in range(PARAMETERS):
                    theta[u] = trial[u]
                value = new
                gradient, g2 = g2, gradient
                hessian, h2 = h2, hessian
                damping = 0.0 if damping < 1e-3 * sums[COUNT] else 0.1 * damping
                break
            damping = max(10.0 * damping, 0.05 * sums[COUNT] + 1.0)
        else:
            break
        if size < 1e-7:
            break
    objective(theta, unit, sums, free, centre, precision, known, gradient, hessian, squares)
