"""What the tests of docs: errata.md share: the paper's formulas as printed, the right ones, and simulated flights.

Nothing here is taken from crazyem but the simulator, which makes the flights; all formulas are written down anew from
the paper, or from textbooks, for many flights at once: arrays are (flights, rows, ...), row k is at t = k dt.
"""

import functools
from typing import NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from crazyem.paper.flight import fly
from crazyem.paper.settings import Settings

MASS, INERTIA, G, DT = 0.18, np.array([2.5e-4, 3.1e-4, 2.0e-4]), 9.81, 0.005
Q0, R0 = 0.0707, 0.00707  # eq. 119, 120

# The settings are written out, so that the numbers of the page do not move when a default does.
P5 = {
    "mass": MASS, "inertia": tuple(INERTIA), "dt": DT, "duration": 20.0, "smooth": False, "force_noise": 0.005,
    "torque_noise": 0.002, "position_sd": 0.00707, "velocity_sd": 0.00707, "attitude_sd": 0.00707,
    "body_rate_sd": 0.0707, "acceleration_sd": 0.0707, "angle_gain": 20.0, "rate_gain": 20.0, "position_weight": 16.0,
    "velocity_weight": 4.0, "acceleration_limit": 9.0, "filter_process": Q0, "filter_measurement": R0,
    "filter_start": 1.0, "substeps": 1,
}  # fmt: skip
STIFF = {"angle_gain": 40.0, "rate_gain": 25.0}  # K_theta as printed (eq. 19)

# -- symbols ----------------------------------------------------------------------------------------------------------

phi, theta, psi = sp.symbols("phi theta psi", real=True)
wx, wy, wz = sp.symbols("omega_x omega_y omega_z", real=True)
rate = sp.Matrix([wx, wy, wz])
m, g, thrust, dt = sp.symbols("m g F dt", positive=True)
Ix, Iy, Iz = sp.symbols("I_xx I_yy I_zz", positive=True)
E3 = sp.Matrix([0, 0, 1])


def turn(axis: str, angle: sp.Expr) -> sp.Matrix:
    """Right-handed rotation matrix about a coordinate axis."""
    c, s = sp.cos(angle), sp.sin(angle)
    return {
        "x": sp.Matrix([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": sp.Matrix([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": sp.Matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


R = turn("z", psi) * turn("y", theta) * turn("x", phi)  # body to world

_sf, _cf, _st, _ct, _ss, _cs = sp.sin(phi), sp.cos(phi), sp.sin(theta), sp.cos(theta), sp.sin(psi), sp.cos(psi)
PRINTED_46 = sp.Matrix(
    [
        [_ct * _cs, _ct * _ss, -_st],
        [_sf * _st * _cs - _cf * _ss, _sf * _st * _ss + _cf * _cs, _sf * _ct],
        [_cf * _st * _cs + _sf * _ss, _cf * _st * _ss - _sf * _cs, _cf * _ct],
    ]
)
PRINTED_47 = sp.Matrix([[1, _sf * _st / _ct, _cf * _st / _ct], [0, _cf, -_sf], [0, _sf / _ct, _cf / _ct]])
PRINTED_21 = sp.Matrix([[1, 0, -_st], [0, _cf, _ct * _sf], [0, -_sf, _ct * _cf]])


def zero(expression: sp.Matrix | sp.Expr) -> bool:
    """Whether an expression vanishes identically."""
    return all(sp.simplify(e) == 0 for e in sp.Matrix([expression]))


def skew(a: sp.Matrix) -> sp.Matrix:
    """Matrix of the cross product."""
    return sp.Matrix([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


# -- flights ----------------------------------------------------------------------------------------------------------


class Flights(NamedTuple):
    """Flights of seeds 0..n-1: truth, filter's estimate (n, rows, 12), wrench (n, rows, 4), readings (n, rows, 18)."""

    truth: NDArray
    estimate: NDArray
    wrench: NDArray
    readings: NDArray
    crashed: int

    @property
    def upright(self) -> NDArray:
        """cos(roll) cos(pitch), the r of eq. 101."""
        return np.cos(self.truth[..., 6]) * np.cos(self.truth[..., 7])

    @property
    def tilt(self) -> float:
        """Rms angle between body z and the vertical [deg]."""
        return float(np.degrees(np.sqrt(np.mean(np.arccos(self.upright) ** 2))))


@functools.cache
def _flights(n: int, changes: tuple) -> Flights:
    flights = [fly(Settings(**{**P5, **dict(changes)}), seed) for seed in range(n)]
    arrays = [np.array([getattr(f, name) for f in flights]) for name in ("truth", "estimate", "wrench", "readings")]
    return Flights(*arrays, sum(f.crashed for f in flights))


def flights(n: int, **changes) -> Flights:
    """n flights with the settings above but for `changes`."""
    return _flights(n, tuple(sorted(changes.items())))


# -- the paper's M-step, with true or given states plugged in ---------------------------------------------------------


def mass_107(speed: NDArray, upright: NDArray, force: NDArray) -> NDArray:
    """Eq. 107 without its last factor: vertical velocity, r and thrust of all rows (n, rows) -> (n,) kg."""
    dv, rf = np.diff(speed), (upright * force)[:, : speed.shape[1] - 1]
    return np.sum(rf**2 * DT, 1) / np.sum(rf * (G * DT + dv), 1)


def gyroscopic(w: NDArray) -> NDArray:
    """(wy wz, wz wx, wx wy): what (I_j - I_k) multiplies in each axis."""
    return np.stack([w[..., 1] * w[..., 2], w[..., 2] * w[..., 0], w[..., 0] * w[..., 1]], -1)


def appendix(w: NDArray, torque: NDArray, sweeps: int = 20) -> NDArray:
    """Fixed point of the appendix' formulas, from the truth: rate (n, rows, 3), torque (n, rows, 3) -> (n, 3)."""
    dw, products, torque = np.diff(w, axis=1), gyroscopic(w[:, :-1]), torque[:, : w.shape[1] - 1]
    inertia = np.tile(INERTIA, (len(w), 1))
    for _ in range(sweeps):
        new = inertia.copy()
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            c = torque[..., i] + (inertia[:, j] - inertia[:, k])[:, None] * products[..., i]
            new[:, i] = np.sum(c**2 * DT, 1) / np.sum(dw[..., i] * c, 1)
        inertia = new
    return inertia


# -- dynamics and E-steps ---------------------------------------------------------------------------------------------


def axis(angles: NDArray) -> NDArray:
    """Third column of R."""
    sr, sp_, sy = np.moveaxis(np.sin(angles), -1, 0)
    cr, cp, cy = np.moveaxis(np.cos(angles), -1, 0)
    return np.stack([cr * sp_ * cy + sr * sy, cr * sp_ * sy - sr * cy, cr * cp], -1)


def derivative(x: NDArray, u: NDArray, mass: float, inertia: NDArray) -> NDArray:
    """Eq. 52 with the errata: states (..., 12), inputs (..., 4)."""
    w, s, c, t = x[..., 9:], np.sin(x[..., 6]), np.cos(x[..., 6]), np.tan(x[..., 7])
    across = s * w[..., 1] + c * w[..., 2]
    angles = np.stack([w[..., 0] + t * across, c * w[..., 1] - s * w[..., 2], across / np.cos(x[..., 7])], -1)
    acceleration = axis(x[..., 6:9]) * u[..., :1] / mass - G * np.array([0.0, 0.0, 1.0])
    return np.concatenate([x[..., 3:6], acceleration, angles, (u[..., 1:] - np.cross(w, inertia * w)) / inertia], -1)


def jacobian_59(x: NDArray) -> NDArray:
    """Eq. 59-70: states (n, 12) -> (n, 12, 12)."""
    out = np.tile(np.eye(12), (len(x), 1, 1))
    s, c, t, ct = np.sin(x[:, 6]), np.cos(x[:, 6]), np.tan(x[:, 7]), np.cos(x[:, 7])
    y, z = x[:, 10], x[:, 11]
    out[:, [0, 1, 2], [3, 4, 5]] = DT
    out[:, 6, 6] += DT * t * (c * y - s * z)
    out[:, 6, 7] = DT * (s * y + c * z) / ct**2
    out[:, 6, 9], out[:, 6, 10], out[:, 6, 11] = DT, DT * s * t, DT * c * t
    out[:, 7, 6], out[:, 7, 10], out[:, 7, 11] = -DT * (s * y + c * z), DT * c, -DT * s
    out[:, 8, 6], out[:, 8, 7] = DT * (c * y - s * z) / ct, DT * (s * y + c * z) * t / ct
    out[:, 8, 10], out[:, 8, 11] = DT * s / ct, DT * c / ct
    return out


def printed_e_step(y: NDArray, u: NDArray, mass: float, inertia: NDArray) -> NDArray:
    """Eq. 88-98 with H = 1 (all states observed) and the printed Q0, R0: y (n, rows, 12) -> smoothed (n, rows, 12).

    Corrected only where it could not run: the mean is predicted with eq. 52, not with the Jacobian.
    """
    rows = y.shape[1]
    filtered, covariances = np.empty_like(y), np.empty((rows, len(y), 12, 12))
    x, p = y[:, 0], np.tile(np.eye(12), (len(y), 1, 1))
    for k in range(rows):
        if k:
            f = jacobian_59(x)
            x = x + DT * derivative(x, u[:, k - 1], mass, inertia)
            p = f @ p @ np.swapaxes(f, 1, 2) + Q0 * np.eye(12)
        gain = p @ np.linalg.inv(p + R0 * np.eye(12))
        x = x + (gain @ (y[:, k] - x)[..., None])[..., 0]
        p = p - gain @ p
        filtered[:, k], covariances[k] = x, p
    smoothed = filtered.copy()
    for k in range(rows - 2, -1, -1):
        predicted = filtered[:, k] + DT * derivative(filtered[:, k], u[:, k], mass, inertia)
        c = covariances[k] @ np.linalg.inv(covariances[k] + Q0 * np.eye(12))
        smoothed[:, k] += (c @ (smoothed[:, k + 1] - predicted)[..., None])[..., 0]
    return smoothed


def proper_inertia(
    y: NDArray, torque: NDArray, *, rate_variance: float, iterations: int = 6, prior: float = 1.0
) -> NDArray:
    """Inertia by EM on body rates alone, as a textbook has it: y, torque (n, rows, 3) -> (n, 3).

    Filter and smoother for w' = w + dt (M - w x I w) / I + n with the Jacobian, noise of each axis estimated, all
    moments with the covariance of both ends of a step; the M-step maximises over one inertia after the other.
    """
    n, rows, _ = y.shape
    inertia, noise = np.tile(INERTIA, (n, 1)), np.full((n, 3), 8.0**2 * DT)
    for _ in range(iterations):
        x, p = y[:, 0], np.tile(prior * np.eye(3), (n, 1, 1))
        means, covs = np.empty((rows, n, 3)), np.empty((rows, n, 3, 3))
        heads, head_covs, jacobians = np.empty((rows, n, 3)), np.empty((rows, n, 3, 3)), np.empty((rows, n, 3, 3))
        ratio = np.stack([(inertia[:, (i + 1) % 3] - inertia[:, (i + 2) % 3]) / inertia[:, i] for i in range(3)], -1)
        for k in range(rows):
            if k:
                f = np.tile(np.eye(3), (n, 1, 1))
                for i in range(3):
                    a, b = (i + 1) % 3, (i + 2) % 3
                    f[:, i, a], f[:, i, b] = DT * ratio[:, i] * x[:, b], DT * ratio[:, i] * x[:, a]
                x = x + DT * (torque[:, k - 1] / inertia + ratio * gyroscopic(x))
                p = f @ p @ np.swapaxes(f, 1, 2) + noise[..., None] * np.eye(3)
                jacobians[k] = f
            heads[k], head_covs[k] = x, p
            gain = p @ np.linalg.inv(p + rate_variance * np.eye(3))
            x = x + (gain @ (y[:, k] - x)[..., None])[..., 0]
            p = p - gain @ p
            means[k], covs[k] = x, p
        s, ps = means.copy(), covs.copy()
        lag = np.empty((rows, n, 3, 3))  # cov(w_k, w_k-1)
        for k in range(rows - 2, -1, -1):
            c = covs[k] @ np.swapaxes(jacobians[k + 1], 1, 2) @ np.linalg.inv(head_covs[k + 1])
            s[k] += (c @ (s[k + 1] - heads[k + 1])[..., None])[..., 0]
            ps[k] += c @ (ps[k + 1] - head_covs[k + 1]) @ np.swapaxes(c, 1, 2)
            lag[k + 1] = ps[k + 1] @ np.swapaxes(c, 1, 2)
        inertia, noise = _moments(s, ps, lag, torque, inertia)
    return inertia


def _moments(s, ps, lag, torque, inertia):
    """M-step: sums of E[dw^2], E[dw c] and E[c^2] with c = M + (I_j - I_k) w_j w_k, then I = E[c^2] dt / E[dw c]."""
    new, noise = inertia.copy(), np.empty_like(inertia)
    w, cov, dw = s[:-1], ps[:-1], np.diff(s, axis=0)
    steps = len(dw)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        d = new[:, j] - new[:, k]
        moment = torque[:, :steps, i].T
        wj, wk = w[..., j], w[..., k]
        mean = wj * wk + cov[..., j, k]
        variance = wj**2 * cov[..., k, k] + wk**2 * cov[..., j, j] + 2 * wj * wk * cov[..., j, k]
        cross = wj * (lag[1:, :, i, k] - cov[..., i, k]) + wk * (lag[1:, :, i, j] - cov[..., i, j])
        c = moment + d * mean
        cc = np.sum(c**2 + d**2 * variance, 0) * DT
        dc = np.sum(dw[..., i] * c + d * cross, 0)
        dd = np.sum(dw[..., i] ** 2 + ps[1:, :, i, i] + cov[..., i, i] - 2 * lag[1:, :, i, i], 0)
        new[:, i] = cc / dc
        noise[:, i] = (dd - 2 * dc * DT / new[:, i] + cc * DT / new[:, i] ** 2) / steps
    return new, noise
