"""Generalised least squares under the noise a flight has: an autoregression whitens it, its long-run variance widens.

Sources: Cochrane and Orcutt 1949 for the whitening; Newey and West 1987 for what correlation it leaves.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AUTOREGRESSION_ORDER = 12  # of the whitening autoregression
_MAX_LAG = 100


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A regression: value, what noise and what systematic error may be off by one standard deviation, all (p,)."""

    value: Array
    sd: Array
    bias: Array

    def total(self, i: int, *, stretch: float = 1.0) -> float:
        """Standard deviation of parameter i, the random part of a flight `stretch` times as long."""
        return math.hypot(float(self.sd[i]) / math.sqrt(stretch), float(self.bias[i]))


def linear_fit(response: list[Array], columns: list[Array], *, share: float = 1.0, parts: int = 1) -> Fit | None:
    """Generalised least squares of responses (k,) on columns (k, p), stretch by stretch.

    Args:
        response, columns: one array a stretch of neighbouring rows; NaN where missing.
        share: of the data that these rows are: the standard deviations are those of all of it.
        parts: into so many parts of one length the rows are cut too, and the standard deviations widened where they
            disagree by more than their own (Birge 1932).

    Returns: None with too few rows, or columns that say the same.
    """
    fit = _linear_fit_once(response, columns, share)
    if fit is None or parts < 2:
        return fit
    off = []
    for low, high in pairwise(np.linspace(0, sum(r.size for r in response), parts + 1).astype(int)):
        pieces = _between(response, columns, int(low), int(high))
        part = _linear_fit_once([r for r, _ in pieces], [c for _, c in pieces], share) if pieces else None
        if part is not None:
            off.append((part.value - fit.value) / part.sd)
    ratio = np.sqrt(np.mean(np.square(off), axis=0)) if len(off) > 1 else np.ones(fit.value.size)
    return replace(fit, sd=fit.sd * np.maximum(ratio, 1.0))


def _between(response: list[Array], columns: list[Array], low: int, high: int) -> list[tuple[Array, Array]]:
    """Rows low..high-1 of all stretches put end to end."""
    pieces, start = [], 0
    for r, c in zip(response, columns):
        a, b = max(low - start, 0), min(high - start, r.size)
        if b - a > AUTOREGRESSION_ORDER:
            pieces.append((r[a:b], c[a:b]))
        start += r.size
    return pieces


def _linear_fit_once(response: list[Array], columns: list[Array], share: float) -> Fit | None:
    width = columns[0].shape[1]
    y, x = np.concatenate(response), np.concatenate(columns)
    good = np.isfinite(y) & np.isfinite(x).all(axis=1)
    if good.sum() < 10 * AUTOREGRESSION_ORDER:
        return None
    scale = np.sqrt(np.mean(x[good] ** 2, axis=0))
    if not np.all(scale > 0.0):
        return None
    theta = np.linalg.lstsq(x[good] / scale, y[good], rcond=None)[0] / scale
    for _ in range(4):
        weights = autoregression([r - c @ theta for r, c in zip(response, columns)])
        z, f = (np.concatenate([filtered(weights, part) for part in parts]) for parts in (response, columns))
        good = np.isfinite(z) & np.isfinite(f).all(axis=1)
        z, f = z[good], f[good] / scale
        if z.size < 5 * width or np.linalg.matrix_rank(f) < width:
            return None
        theta = np.linalg.lstsq(f, z, rcond=None)[0] / scale
    left = z - f @ (theta * scale)
    variance = float(left @ left) / max(z.size - width, 1)
    covariance = np.linalg.inv(f.T @ f) * variance
    inflation = _inflation(f * left[:, None], covariance)
    return Fit(theta, np.sqrt(np.diag(covariance)) / scale * inflation * math.sqrt(share), np.zeros(width))


def autoregression(parts: list[Array]) -> Array:
    """(AUTOREGRESSION_ORDER + 1,) whitening filter of residuals (k,), by Yule-Walker over all stretches."""
    covariance = np.zeros(AUTOREGRESSION_ORDER + 1)
    for part in parts:
        r = np.where(np.isfinite(part), part, 0.0)
        r = r - r.mean() if r.size else r
        covariance += [
            float(r[lag:] @ r[: r.size - lag]) if r.size > lag else 0.0 for lag in range(AUTOREGRESSION_ORDER + 1)
        ]
    if not covariance[0] > 0.0:
        return np.append(1.0, np.zeros(AUTOREGRESSION_ORDER))
    covariance[0] *= 1.0 + 1e-6
    toeplitz = covariance[np.abs(np.subtract.outer(np.arange(AUTOREGRESSION_ORDER), np.arange(AUTOREGRESSION_ORDER)))]
    return np.append(1.0, -np.linalg.solve(toeplitz, covariance[1:]))


def filtered(weights: Array, part: Array) -> Array:
    """A stretch (k,) or (k, p) through the whitening filter, without its first rows."""
    # what scipy.signal.lfilter does, to the bit; importing that takes a second
    if part.ndim == 1:
        return np.convolve(weights, part)[AUTOREGRESSION_ORDER : part.size]
    return np.column_stack([np.convolve(weights, column)[AUTOREGRESSION_ORDER : column.size] for column in part.T])


def _inflation(terms: Array, covariance: Array) -> Array:
    scaled = terms @ covariance
    plain = np.sum(scaled**2, axis=0)
    return np.sqrt(np.maximum(long_run(scaled) / np.where(plain > 0.0, plain, 1.0), 1.0))


def long_run(terms: Array) -> Array:
    """Variance of the column sums of terms (n, p), Bartlett kernel. (p,)."""
    n = terms.shape[0]
    lags = min(n // 8, _MAX_LAG)
    total = np.sum(terms**2, axis=0)
    for lag in range(1, lags + 1):
        total = total + 2.0 * (1.0 - lag / (lags + 1.0)) * np.einsum("ij,ij->j", terms[lag:], terms[:-lag])
    return np.maximum(total, 0.0)
