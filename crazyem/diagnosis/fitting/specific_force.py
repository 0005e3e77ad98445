"""The accelerometer as evidence of forces that nothing else shows.

The filter does not use the accelerometer, because no model contains its low pass and vibration. Two kinds of recordings
need it. Without a measured position or velocity (a log of gyro, accelerometer and commands), only the accelerometer
shows forces. And an onboard filter believes that thrust alone acts: its position and velocity do not answer to a force
along body x and y, until fixes of the pose draw them back.

The residual r of a row, measured less modelled force, is white noise plus noise with a memory (vibration, gusts), which
is an ARMA process (Box and Jenkins, Time Series Analysis, ch. 4):

    r[k] - decay r[k-1] = e[k] - average e[k-1],    e white.

Its parameters maximise the likelihood at every model. Bias and tilt of the sensor, its lag and its place in the body
are nuisances with flat priors. They are regressed out along x and y, so score and information are those of the profile
likelihood.
"""

import itertools
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import lfilter

from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE

LATERAL = (0, 1)  # axes along which an onboard filter knows no force


@dataclass(frozen=True)
class ForceNoise:
    """An ARMA(1, 1) process: the autoregressive coefficient `decay`, the moving-average coefficient `average`, and the
    log-likelihood [nats] of the residuals that it was fitted to."""

    decay: float
    average: float
    loglik: float = 0.0

    def white(self, values: NDArray) -> NDArray:
        """e (n, ...) of residuals, or the same linear operation on their derivatives."""
        return np.asarray(lfilter([1.0, -self.decay], [1.0, -self.average], values, axis=0))

    def spread(self, residual: NDArray) -> float:
        """Standard deviation of the part with a memory, by the spectral densities at frequency 0 and at the highest."""
        variance = float(np.mean(np.square(self.white(residual))))
        low, high = ((1.0 - self.average) / (1.0 - self.decay)) ** 2, ((1.0 + self.average) / (1.0 + self.decay)) ** 2
        return float(np.sqrt(max(variance * (low - high) * (1.0 - self.decay) / (1.0 + self.decay), 0.0)))


def axes_needed(flight: Flight) -> tuple[int, ...]:
    """Axes along which only the accelerometer shows forces."""
    if np.isfinite(flight.force).all(axis=1).sum() <= NOISE.min_forces:
        return ()
    if not np.isfinite(flight.y[:, 0:6]).any():
        return (0, 1, 2)
    return LATERAL if flight.fused else ()


def loglik_of(white: NDArray) -> NDArray:
    """(n,) log-likelihoods of white residuals (n,) with the variance that suits them best, but no less than usual."""
    variance = max(float(np.mean(np.square(white))), NOISE.min_vibration**2)
    return np.asarray(-0.5 * (np.square(white) / variance + np.log(2.0 * np.pi * variance)))


def noise_of(residual: NDArray, *, decay: float | None = None) -> ForceNoise:
    """The most likely noise of residuals (n,) [m/s^2], with a given decay from row to row if there is one."""

    def cost(average: float, decay: float) -> float:
        return -float(loglik_of(ForceNoise(decay, average).white(residual)).sum())

    most = NOISE.max_force_decay
    if decay is not None:
        found = minimize_scalar(partial(cost, decay=decay), bounds=(-most, most), method="bounded")
        return ForceNoise(decay, float(found.x), -float(found.fun))
    start = min(itertools.product((-0.5, 0.0, 0.5, 0.8), (0.0, 0.6, 0.95, 0.99)), key=lambda x: cost(*x))
    # by hyperbolic tangents, so that the process stays stationary and invertible
    best = minimize(lambda x: cost(*most * np.tanh(x)), np.arctanh(np.array(start) / most), method="Nelder-Mead",
                    options={"xatol": 1e-2, "fatol": 1e-2})  # fmt: skip
    average, kept = most * np.tanh(best.x)
    return ForceNoise(float(kept), float(average), -float(best.fun))


def sensor_errors(flight: Flight, model: NDArray, rate: NDArray) -> NDArray:
    """(n, 2, 9) derivatives of the lateral specific force that an accelerometer shows, by its errors.

    Args:
        flight: with a force (n, 3).
        model: (n, 3) specific force over the steps that end at the rows [m/s^2].
        rate: (n, 3) body rate [rad/s].

    Returns: by bias along x and y [m/s^2], tilt about y and x [rad], place of the sensor in the body [m], and lags of x
    and y [s].
    """
    p, q, r = rate.T
    dp, dq, dr = np.gradient(rate, flight.time, axis=0).T
    out = np.zeros((len(rate), 2, 9))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 0, 2], out[:, 1, 3] = flight.force[:, 2], flight.force[:, 2]
    out[:, 0, 4:7] = np.stack([-(q**2) - r**2, p * q - dr, p * r + dq], axis=1)
    out[:, 1, 4:7] = np.stack([p * q + dr, -(p**2) - r**2, q * r - dp], axis=1)
    out[:, 0, 7], out[:, 1, 8] = -np.gradient(model[:, :2], flight.time, axis=0).T
    return out


def residuals(flight: Flight, model: NDArray, errors: NDArray) -> tuple[NDArray, NDArray]:
    """Rows (m,) with a measured force, and measured less modelled force there (m, 3), without the sensor's errors.

    model: (n, 3) m/s^2; errors: (n, 2, k). Outliers (collisions) are clipped.
    """
    rows = np.flatnonzero(np.isfinite(flight.force).all(axis=1) & ~flight.starts)
    left = flight.force[rows] - _at_rows(flight, model)[rows]
    left[:, :2] = _without(errors[rows], left[:, :2, None])[:, :, 0]
    reach = NOISE.max_force_residual * np.maximum(1.4826 * np.median(np.abs(left), axis=0), NOISE.min_vibration)
    return rows, np.clip(left, -reach, reach)


def _at_rows(flight: Flight, means: NDArray) -> NDArray:
    """Values (n, ...) at the rows, of means (n, ...) over the steps that end there: the mean of both steps at a row."""
    after = np.append(means[1:], means[-1:], axis=0)
    last = np.append(flight.starts[1:], True)
    return np.asarray(np.where(last.reshape(-1, *[1] * (means.ndim - 1)), means, 0.5 * (means + after)))


def _without(errors: NDArray, values: NDArray) -> NDArray:
    """Values (n, 2, c) less their regression on errors (n, 2, k)."""
    flat, errors = values.reshape(2 * len(values), -1), errors.reshape(2 * len(values), -1)
    return np.asarray((flat - errors @ np.linalg.lstsq(errors, flat)[0]).reshape(values.shape))


def evidence(
    flight: Flight, model: NDArray, acting: NDArray, errors: NDArray, axes: tuple[int, ...]
) -> tuple[NDArray, NDArray, NDArray]:
    """Log-likelihood (n,), score (b, c) and information (b, c, c) of the specific force.

    Args:
        flight: with a force (n, 3).
        model: (n, 3) specific force over the steps that end at the rows [m/s^2].
        acting: (n, 3, c) its derivatives by the columns.
        errors: (n, 2, k) derivatives along x and y by the sensor's errors.
        axes: that count.
    """
    columns = acting.shape[2]
    rows, left = residuals(flight, model, errors)
    changing = np.flatnonzero(acting.any(axis=(0, 1)))
    both = np.concatenate([left[:, :, None], _at_rows(flight, acting[:, :, changing])[rows]], axis=2)
    kept = errors[rows]
    for axis in axes:
        noise = noise_of(left[:, axis])
        both[:, axis] = noise.white(both[:, axis])
        kept[:, axis : axis + 1] = noise.white(kept[:, axis : axis + 1])
    both[:, :2] = _without(kept, both[:, :2])
    both = both[:, axes]
    loglik = np.zeros(flight.time.size)
    loglik[rows] = sum(loglik_of(both[:, i, 0]) for i in range(len(axes)))
    score, information = np.zeros((flight.blocks, columns)), np.zeros((flight.blocks, columns, columns))
    both /= np.maximum(np.sqrt(np.mean(np.square(both[:, :, :1]), axis=0)), NOISE.min_vibration)
    for b in np.unique(flight.block[rows]) if changing.size else ():
        part = both[flight.block[rows] == b].reshape(-1, 1 + changing.size)
        score[b, changing] = part[:, 1:].T @ part[:, 0]
        information[b, changing[:, None], changing] = part[:, 1:].T @ part[:, 1:]
    return loglik, score, information
