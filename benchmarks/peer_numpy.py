"""The E-step in plain numpy, written for speed: preallocated arrays, one transition matrix filled in place, no objects.

Extended Kalman filter with one joint measurement update per sample and Rauch-Tung-Striebel smoother over the error
state, optimised with a profiler. benchmarks/reference.py is the same in textbook form.
"""

from collections.abc import Callable
from math import cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray
from window import Window


def _product(a: NDArray, b: NDArray) -> NDArray:
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    w = aw * bw - ax * bx - ay * by - az * bz
    n = 1.0 / sqrt(x * x + y * y + z * z + w * w)
    return np.array([x * n, y * n, z * n, w * n])


def _exp(v: NDArray) -> NDArray:
    x, y, z = v.tolist()
    angle = sqrt(x * x + y * y + z * z)
    s = sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    return np.array([s * x, s * y, s * z, cos(0.5 * angle)])


def _difference(a: NDArray, b: NDArray) -> NDArray:
    """Rotation vector from attitude b to a, small angles."""
    x, y, z, w = b.tolist()
    turn = _product(np.array([-x, -y, -z, w]), a)
    return turn[:3] * (2.0 if turn[3] >= 0 else -2.0)


def _matrix(q: NDArray) -> NDArray:
    x, y, z, w = q.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _skew(v: NDArray) -> NDArray:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def make(window: Window) -> Callable[[], float]:
    """A call that runs filter and smoother over the window and returns the log-likelihood."""
    n = len(window.time)
    inverse = np.linalg.inv(window.inertia)
    inertia = window.inertia
    r = np.diag(window.r)
    eye3, e3 = np.eye(3), np.array([0.0, 0.0, 1.0])
    gravity = 9.81 * e3
    xf, xp = np.empty((n, 13)), np.empty((n, 13))
    pf, pp, phi = np.empty((n, 12, 12)), np.empty((n, 12, 12)), np.empty((n, 12, 12))
    xs, ps = np.empty((n, 13)), np.empty((n, 12, 12))
    times = window.time.tolist()

    def plus(x: NDArray, d: NDArray, out: NDArray) -> None:
        out[:6] = x[:6] + d[:6]
        out[6:10] = _product(x[6:10], _exp(d[6:9]))
        out[10:] = x[10:] + d[9:]

    def minus(a: NDArray, b: NDArray) -> NDArray:
        return np.concatenate([a[:6] - b[:6], _difference(a[6:10], b[6:10]), a[10:] - b[10:]])

    def run() -> float:
        likelihood = 0.0
        f = np.eye(12)
        g = np.zeros((12, 6))
        noise = np.zeros((12, 12))
        for k in range(n):
            if k == 0:
                xp[0], pp[0] = window.prior, window.prior_cov
            else:
                dt = times[k] - times[k - 1]
                x = xf[k - 1]
                w = x[10:]
                middle = _matrix(_product(x[6:10], _exp(0.5 * dt * w)))
                acc = window.thrust[k] / window.mass
                momentum = inertia @ w
                spin = _skew(w)
                w2 = w + dt * (inverse @ (window.torque[k] - spin @ momentum))
                v2 = x[3:6] + dt * (middle[:, 2] * acc - gravity)
                xp[k, :3] = x[:3] + 0.5 * dt * (x[3:6] + v2)
                xp[k, 3:6] = v2
                turn = _exp(0.5 * dt * (w + w2))
                xp[k, 6:10] = _product(x[6:10], turn)
                xp[k, 10:] = w2
                rate = eye3 + dt * inverse @ (_skew(momentum) - spin @ inertia)
                tilt = -dt * acc * middle @ _skew(e3)
                f[:3, 3:6] = dt * eye3
                f[3:6, 6:9] = tilt
                f[:3, 6:9] = 0.5 * dt * tilt
                f[6:9, 6:9] = _matrix(turn).T
                f[6:9, 9:] = 0.5 * dt * (eye3 + rate)
                f[9:, 9:] = rate
                g[:3, :3] = 0.5 * dt * middle
                g[3:6, :3] = middle
                g[6:9, 3:] = 0.5 * dt * eye3
                g[9:, 3:] = eye3
                np.matmul(g * (dt * window.q), g.T, out=noise)
                noise[:3, :3] += dt**3 / 12 * (middle * window.q[:3]) @ middle.T
                noise[6:9, 6:9] += np.diag(dt**3 / 12 * window.q[3:])
                phi[k] = f
                pp[k] = f @ pf[k - 1] @ f.T + noise
            s = pp[k] + r
            e = minus(window.y[k], xp[k])
            factor = np.linalg.inv(s)
            gain = pp[k] @ factor
            plus(xp[k], gain @ e, xf[k])
            pf[k] = pp[k] - gain @ pp[k]
            likelihood -= 0.5 * (e @ factor @ e + np.linalg.slogdet(s)[1])
        xs[-1], ps[-1] = xf[-1], pf[-1]
        for k in range(n - 2, -1, -1):
            gain = pf[k] @ phi[k + 1].T @ np.linalg.inv(pp[k + 1])
            plus(xf[k], gain @ minus(xs[k + 1], xp[k + 1]), xs[k])
            ps[k] = pf[k] + gain @ (ps[k + 1] - pp[k + 1]) @ gain.T
        return likelihood - 0.5 * 12 * n * float(np.log(2 * np.pi))

    return run
