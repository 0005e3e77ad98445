"""Exact expected Fisher information of the logarithms of the noise scales."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.kernels.algebra import angular_acceleration, apply, apply_transposed, right_jacobian

SCALES = 11  # intensities of six impulses; standard deviations of five groups of measurements
ACCELEROMETER = 10
WIDTH = 12  # of arrays with a number for each scale: one more than the scales, to fill vector registers
TERMS = 144 + 12  # terms of a sample in the sum: gains (12 each) and innovation variances of 12 measurements


@compiled
def _before_measurements(big, gain, s, after):
    """Carry the information of later innovations on the state back over the measurements of one sample.

    big (12, 12): on entry the information of all innovations after the sample's last measurement, on return of all
    after its prediction. after[i] receives the information of all innovations after measurement i.
    """
    column = np.empty(12)
    for i in range(11, -1, -1):
        if s[i] == 0.0:
            continue
        g = gain[i]
        both = 1.0 / s[i]
        for j in range(12):
            acc = 0.0
            for m in range(12):
                after[i, j, m] = big[j, m]
                acc += big[j, m] * g[m]
            column[j] = acc
            both += g[j] * acc
        for j in range(12):
            big[i, j] -= column[j]
            big[j, i] -= column[j]
        big[i, i] += both


@compiled
def _later_information(first, last, time, kind, lead, gain, s, blocks):
    """Information (n, 12, 12) of all innovations after each sample on the error of its filtered state."""
    later = np.zeros((last - first, 12, 12))
    after = np.empty((12, 12, 12))
    big = np.zeros((12, 12))
    tmp = np.empty((12, 12))
    tra = np.empty((12, 12))
    for k in range(last - 1, first, -1):
        if kind[k] == 1:
            continue  # a break: later innovations do not depend on the state before it
        for i in range(12):
            for j in range(12):
                big[i, j] = later[k - first, i, j]
        _before_measurements(big, gain[k], s[k], after)
        dt = time[k] - time[k - 1]
        apply_transposed(blocks[k], dt, lead * dt, big, tmp)
        for i in range(12):
            for j in range(12):
                tra[i, j] = tmp[j, i]
        apply_transposed(blocks[k], dt, lead * dt, tra, later[k - 1 - first])
    return later


@compiled
def _step_noise(dt, h, bridge, force, middle, jr, q, r_force, big, half, info):
    """Add the noise of a step to the derivatives of the covariance, and the accelerometer's information to info.

    The derivatives are half (12, 12, WIDTH) plus its transpose. big (12, 12) is the information of all later
    innovations on the error of the predicted state.
    """
    fast = np.empty(3)
    g = np.empty(6)
    for c in range(6):
        # impulse c changes velocity and position, or rate and attitude
        at = 0 if c < 3 else 6
        for j in range(3):
            v = middle[j, c] if c < 3 else jr[j, c - 3]
            fast[j] = v
            g[j] = h * v
            g[3 + j] = v if c < 3 else (1.0 if j == c - 3 else 0.0)
        share = 0.0  # share of the impulse's variance that the accelerometer determines
        if c < 3 and not np.isnan(force[c]):
            var = q[c] / dt + r_force
            share = q[c] / dt / var
            moved = 2.0 * share * (1.0 - share)  # derivative of the share by the logarithm of either scale, up to sign
            seen = 0.0
            for i in range(6):
                for j in range(6):
                    seen += g[i] * big[at + i, at + j] * g[j]
            seen *= var * (dt * moved) ** 2
            info[c, c] += seen + 2.0 * share * share
            info[ACCELEROMETER, ACCELEROMETER] += seen + 2.0 * (1.0 - share) ** 2
            info[ACCELEROMETER, c] += moved - seen
        own = q[c] * dt * (1.0 - share) ** 2
        other = q[c] * dt * share * (1.0 - share)
        for i in range(6):
            for j in range(6):
                half[at + i, at + j, c] += own * g[i] * g[j]
                half[at + i, at + j, ACCELEROMETER] += other * g[i] * g[j]
        for i in range(3):
            for j in range(3):
                half[at + i, at + j, c] += q[c] * dt * bridge * fast[i] * fast[j]


@compiled
def _seen_later(big, dk, left, right, at):
    """Put dK (12, WIDTH) into right[:, at:at+12], and big dK, its effect on later innovations, into left."""
    x = np.empty(WIDTH)
    for j in range(12):
        row = big[j]
        for a in range(WIDTH):
            x[a] = 0.0
        for m in range(0, 12, 4):  # unrolled by hand; otherwise the compiler keeps x in memory
            c0, c1, c2, c3 = row[m], row[m + 1], row[m + 2], row[m + 3]
            for a in range(WIDTH):
                x[a] += c0 * dk[m, a] + c1 * dk[m + 1, a] + c2 * dk[m + 2, a] + c3 * dk[m + 3, a]
        for a in range(SCALES):
            left[a, at + j] = x[a]
            right[a, at + j] = dk[j, a]


@compiled
def _measurements(counts, r, gain, s, after, half, flat, left, right):
    """Carry the derivatives of the covariance over the measurements of one sample.

    half (12, 12, WIDTH) as in `_step_noise`, flat (12, 12 WIDTH) is a view of it. after[i] (12, 12) is the information
    of all innovations after measurement i. left, right (SCALES, TERMS) receive the factors whose product is the
    information of the sample.
    """
    dk = np.empty((12, WIDTH))
    ds = np.empty(WIDTH)
    v = np.empty(12 * WIDTH)
    for i in range(12):
        if s[i] == 0.0:
            for a in range(SCALES):
                for j in range(12):
                    left[a, 12 * i + j] = 0.0
                left[a, 144 + i] = 0.0
            continue
        g = gain[i]
        inv = 1.0 / s[i]
        for a in range(WIDTH):
            ds[a] = 2.0 * half[i, i, a]
        ds[6 + i // 3] += 2.0 * r[i]
        for j in range(12):
            for a in range(WIDTH):
                v[WIDTH * j + a] = half[i, j, a] + half[j, i, a] - 0.5 * g[j] * ds[a]
        if counts:
            c = np.sqrt(inv)  # dK times the root of S
            for j in range(12):
                for a in range(WIDTH):
                    dk[j, a] = (v[WIDTH * j + a] - 0.5 * g[j] * ds[a]) * c
            _seen_later(after[i], dk, left, right, 12 * i)
            for a in range(SCALES):
                left[a, 144 + i] = 0.5 * ds[a] * inv
                right[a, 144 + i] = ds[a] * inv
        # derivative of P - K S K': dP - v K' - K v' with v = dP e - K dS / 2; `half` takes one of the last two terms
        for j in range(12):
            c = g[j]
            for m in range(12 * WIDTH):
                flat[j, m] -= c * v[m]


@compiled
def _predict_half(block, dt, h, half, flat, turned):
    """Carry the derivatives over one step: A half A'; flat is half as a matrix, turned is scratch."""
    apply(block, dt, h, flat, turned)
    for i in range(12):
        for j in range(12):
            for a in range(WIDTH):
                half[j, i, a] = turned[i, WIDTH * j + a]
    apply(block, dt, h, flat, turned)
    for i in range(12):
        for j in range(12 * WIDTH):
            flat[i, j] = turned[i, j]


@compiled
def _rotation_jacobian(w, torque, inertia, inverse, dt, h, alpha, phi, jr):
    """The right Jacobian jr (3, 3) of the step's rotation; alpha and phi (3,) are scratch."""
    angular_acceleration(w, torque, inertia, inverse, alpha)
    for i in range(3):
        phi[i] = dt * w[i] + h * dt * alpha[i]
    right_jacobian(phi, jr)


@compiled
def _add_products(left, right, info):
    """info += left right', lower triangle."""
    for a in range(SCALES):
        for b in range(a + 1):
            acc = 0.0
            for j in range(TERMS):
                acc += left[a, j] * right[b, j]
            info[a, b] += acc


@compiled
def noise_information(first, last, time, kind, usable, force, torque, inertia, inverse, q, r, r_force, lead, xf, gain,
                      s, blocks, middle):  # fmt: skip
    """Expected Fisher information of the logarithms of the noise scales in the samples first..last-1.

    Scales in the order of `Noise.logs`: impulses (6), then position, velocity, attitude, body rate and specific force
    (5). With the innovations e_t, scalars of variance S_t, and d_a the derivative by the logarithm of scale a,

        I_ab = sum over t of  d_a(log S_t) d_b(log S_t) / 2 + E[d_a(e_t) d_b(e_t)] / S_t

    The first part needs the derivative of the covariance, which is carried along the filter for each scale. The second
    part exists because a wrong scale gives wrong gains, and so innovations that are correlated in time. In a steady
    filter the second part is larger. A gain that is wrong by dK adds dK e_t to the state, with E[e_t^2] = S_t. The
    information matrix of the smoother gives its effect on later innovations, so no sensitivity is carried.

    The window must have been filtered with the present parameters from the prior at `first`, which does not depend on
    the scales. Mean and scales carry no information about each other (Gaussian), so this matrix is independent of
    `sensitivities`. Derivatives of the Jacobians are left out. Steps that are not usable pass on information, but their
    own noise does not count, as in the statistics of `backward`.

    Returns:
        (11, 11) symmetric; rows and columns of scales without measurements are zero.
    """
    info = np.zeros((SCALES, SCALES))
    left = np.zeros((SCALES, TERMS))
    right = np.zeros((SCALES, TERMS))
    later = _later_information(first, last, time, kind, lead, gain, s, blocks)
    half = np.zeros((12, 12, WIDTH))  # plus its transpose: the derivative of the covariance by each scale
    flat = half.reshape(12, 12 * WIDTH)
    turned = np.empty((12, 12 * WIDTH))
    after = np.empty((12, 12, 12))
    alpha = np.empty(3)
    phi = np.empty(3)
    jr = np.empty((3, 3))
    for k in range(first, last):
        big = later[k - first]
        _before_measurements(big, gain[k], s[k], after)
        if kind[k] == 1 or k == first:
            for i in range(12):
                for j in range(12):
                    for a in range(WIDTH):
                        half[i, j, a] = 0.0
        else:
            dt = time[k] - time[k - 1]
            h = lead * dt
            _predict_half(blocks[k], dt, h, half, flat, turned)
            if usable[k]:
                _rotation_jacobian(xf[k - 1, 10:13], torque[k], inertia, inverse, dt, h, alpha, phi, jr)
                bridge = dt * dt / 12.0 if lead == 0.5 else 0.0
                _step_noise(dt, h, bridge, force[k], middle[k], jr, q, r_force, big, half, info)
        _measurements(kind[k] != 1, r, gain[k], s[k], after, half, flat, left, right)
        if kind[k] != 1:
            _add_products(left, right, info)
    for a in range(SCALES):
        for b in range(a):
            info[b, a] = info[a, b]
    return info
