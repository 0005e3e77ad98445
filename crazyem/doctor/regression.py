"""Regressions for the checks: slopes with noise on both sides, comparison of hypotheses over blocks, whitening.

Neighbouring samples are not independent, so every uncertainty comes from blocks of about 1.5 s. That of a slope comes
from leaving out one block at a time (jackknife), that of the difference between two hypotheses from a paired test.

Generalised least squares uses the noise of the flight: an autoregression whitens the residual (Cochrane and Orcutt
1949), and the long-run variance of the whitened residual widens the result (Newey and West 1987).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from crazyem.recordings.ordering import Array

BLOCK_SECONDS = 1.5  # s
MOST_BLOCKS = 60  # most blocks; long recordings have longer blocks
FEWEST_BLOCKS = 6  # fewest blocks for a judgement
SLOPE_CONFIDENCE = 0.9995  # one-sided confidence level of a significant slope
RUNNER_UP_RATIO = 2.0  # least unexplained variance of a beaten hypothesis, over that of the best
LOG_LIKELIHOOD_RATIO = 10.0  # nats; least log likelihood ratio between the best and a beaten hypothesis


@dataclass(frozen=True, slots=True)
class Slope:
    """The factor s of y = s x + offset, all components together.

    Noise of x makes the regression of y on x too small, noise of y makes 1 / (regression of x on y) too large. The true
    slope lies between the two if the noises are independent.
    """

    value: float  # geometric mean of the two regressions
    low: float  # 95 % interval: from the lower to the higher regression, each widened by its jackknife error
    high: float
    far_low: float  # the same at the level `SLOPE_CONFIDENCE`
    far_high: float
    explained: float  # squared correlation
    samples: int  # rows times components
    blocks: float  # effective number of blocks, weighted by the motion in each


def blocks(time: Array) -> NDArray[np.int64]:
    """Block number (n,) of each row, from its time: 0, 1, .. without gaps; at most `MOST_BLOCKS` blocks."""
    if time.size == 0:
        return np.zeros(0, np.int64)
    length = max(BLOCK_SECONDS, float(time[-1] - time[0]) / MOST_BLOCKS + 1e-9)
    number = ((time - time[0]) / length).astype(np.int64)
    return np.asarray(np.unique(number, return_inverse=True)[1], np.int64)


def block_sums(block: NDArray[np.int64], *columns: Array) -> Array:
    """(blocks, len(columns)) sums over each block."""
    count = int(block.max()) + 1 if block.size else 0
    return np.column_stack([np.bincount(block, weights=c, minlength=count) for c in columns])


def slope(x: Array, y: Array, block: NDArray[np.int64]) -> Slope | None:
    """Slope of y against x, both (n, c) or (n,); None with too few blocks or no common variance.

    Outliers are left out: rows with a distance from the line above five times the median and above their own size. The
    second condition keeps the manoeuvres of a flight that mostly hovers.
    """
    x, y = np.atleast_2d(x.T).T, np.atleast_2d(y.T).T
    keep = np.ones(len(x), bool)
    for _ in range(3):
        sums = _moments(x[keep], y[keep], block[keep])
        both = _two(sums.sum(axis=0))
        if both is None:
            return None
        line = _middle(both) * (x - np.median(x[keep], axis=0))
        away = np.linalg.norm((y - np.median(y[keep], axis=0)) - line, axis=1)
        limit = 5.0 * float(np.median(away[keep])) / 0.6745
        following = away <= np.maximum(limit, np.linalg.norm(line, axis=1) + 1e-12)
        if (following == keep).all():
            break
        keep = following
    sums = _moments(x[keep], y[keep], block[keep])
    total = sums.sum(axis=0)
    both = _two(total)
    parts = [_two(total - one) for one in sums]
    if both is None or len(sums) < FEWEST_BLOCKS or any(p is None for p in parts):
        return None
    spread = jackknife_error(np.array(parts))
    edges = []
    for level in (0.975, SLOPE_CONFIDENCE):
        wide = float(stats.t.ppf(level, len(sums) - 1)) * spread
        edges.append((min(both[i] - wide[i] for i in (0, 1)), max(both[i] + wide[i] for i in (0, 1))))
    sxx, sxy, syy = total
    return Slope(
        value=_middle(both),
        low=edges[0][0],
        high=edges[0][1],
        far_low=edges[1][0],
        far_high=edges[1][1],
        explained=float(sxy**2 / (sxx * syy)),
        samples=int(keep.sum()) * x.shape[1],
        blocks=float(sxx**2 / max(float(np.square(sums[:, 0]).sum()), 1e-300)),
    )


def jackknife_error(left: Array) -> Array:
    """Standard errors (...) from results (blocks, ...), each with one block left out."""
    return np.asarray(np.sqrt((len(left) - 1) / len(left) * np.square(left - left.mean(axis=0)).sum(axis=0)), float)


def _moments(x: Array, y: Array, block: NDArray[np.int64]) -> Array:
    """(blocks, 3) sums of xx, xy, yy, about the mean; zero with fewer than 20 rows."""
    if len(x) < 20:
        return np.zeros((1, 3))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    number = np.asarray(np.unique(block, return_inverse=True)[1], np.int64)
    return block_sums(number, (x * x).sum(axis=1), (x * y).sum(axis=1), (y * y).sum(axis=1))


def _two(total: Array) -> tuple[float, float] | None:
    """Direct and reverse slope from sums of xx, xy, yy."""
    sxx, sxy, syy = (float(v) for v in total)
    if sxx <= 0.0 or syy <= 0.0 or abs(sxy) <= 1e-9 * math.sqrt(sxx * syy):
        return None
    return sxy / sxx, syy / sxy


def _middle(both: tuple[float, float]) -> float:
    """Geometric mean of two slopes of one sign."""
    return math.copysign(math.sqrt(both[0] * both[1]), both[0])


@dataclass(frozen=True, slots=True)
class Choice:
    """Which hypothesis a measurement supports."""

    name: str  # the simplest hypothesis that is not beaten with certainty; "" if several are equally simple
    best: str  # the hypothesis with the least unexplained variance
    explained: Mapping[str, float]  # share of the variance that each hypothesis explains, the declared one first
    ratio: float  # unexplained variance of the declared hypothesis over that of the best
    denied: bool  # the declared hypothesis is beaten with certainty


def choose(
    measured: Array, candidates: Mapping[str, tuple[int, Array]], block: NDArray[np.int64], *, offset: bool = True
) -> Choice | None:
    """The candidate that explains the measurement, up to one positive factor and free offsets.

    Args:
        measured: (n, c).
        candidates: name -> (cost, lower for simpler hypotheses; (n, c) prediction); the declared one (cost 0) is first.
        block: (n,) from `blocks`.
        offset: whether each component has a free offset.

    A hypothesis is beaten with certainty if three conditions hold. It leaves at least `RUNNER_UP_RATIO` times as much
    unexplained as the best. The best wins without the tenth of the blocks that favours it most, too. The log
    likelihood ratio of Gaussian residuals, one for each block and component, is at least `LOG_LIKELIHOOD_RATIO`.

    Returns: None with too few blocks.
    """
    if len(measured) < 20:
        return None
    number = np.asarray(np.unique(block, return_inverse=True)[1], np.int64)
    y = measured - measured.mean(axis=0) if offset else measured
    whole = float((y * y).sum())
    if whole <= 0.0 or number.max() + 1 < FEWEST_BLOCKS:
        return None
    left: dict[str, Array] = {}
    for name, (_, candidate) in candidates.items():
        x = candidate - candidate.mean(axis=0) if offset else candidate
        sxx = float((x * x).sum())
        factor = max(float((x * y).sum()) / sxx, 0.0) if sxx > 0 else 0.0
        rest = y - factor * x
        left[name] = block_sums(number, (rest * rest).sum(axis=1))[:, 0]
    best = min(left, key=lambda name: float(left[name].sum()))
    least = max(float(left[best].sum()), 1e-12 * whole)
    components = measured.shape[1]
    standing = [name for name in left if not better(left[best], left[name], components)]
    simple = min(candidates[name][0] for name in standing)
    names = [name for name in standing if candidates[name][0] == simple]
    declared = next(iter(candidates))
    return Choice(
        name=names[0] if len(names) == 1 else "",
        best=best,
        explained={name: 1.0 - float(rest.sum()) / whole for name, rest in left.items()},
        ratio=float(left[declared].sum()) / least,
        denied=declared not in standing,
    )


def better(first: Array, second: Array, components: int = 1) -> bool:
    """True if residuals (sums of squares per block) of the first are significantly smaller; see `choose`."""
    gain = np.sort(second - first)
    tenth = max(1, gain.size // 10)
    if gain.size < FEWEST_BLOCKS or gain[:-tenth].sum() <= 0.0:
        return False
    ratio = float(second.sum()) / max(float(first.sum()), 1e-300)
    return ratio >= RUNNER_UP_RATIO and 0.5 * gain.size * components * math.log(ratio) >= LOG_LIKELIHOOD_RATIO


AUTOREGRESSION_ORDER = 12  # of the whitening autoregression
_MAX_LAG = 100


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A regression: values, standard deviations by noise, and systematic errors, all (p,)."""

    value: Array
    sd: Array
    bias: Array

    def total(self, i: int, *, stretch: float = 1.0) -> float:
        """Standard deviation of parameter i, with the random part of a flight `stretch` times as long."""
        return math.hypot(float(self.sd[i]) / math.sqrt(stretch), float(self.bias[i]))


def linear_fit(response: list[Array], columns: list[Array], *, share: float = 1.0, parts: int = 1) -> Fit | None:
    """Generalised least squares of responses (k,) on columns (k, p), in stretches.

    Args:
        response, columns: one array for each stretch of neighbouring rows; NaN where missing.
        share: share of these rows in the data; the standard deviations are those of all the data.
        parts: number of equal parts that are also fitted separately, to widen the standard deviations (`widened`).

    Returns: None with too few rows or linearly dependent columns.
    """
    fit = _linear_fit_once(response, columns, share)
    if fit is None or parts < 2:
        return fit
    edges = np.linspace(0, sum(r.size for r in response), parts + 1).astype(int)
    pieces = [_between(response, columns, int(low), int(high)) for low, high in pairwise(edges)]
    return widened(fit, [_linear_fit_once([r for r, _ in p], [c for _, c in p], share) for p in pieces if p])


def widened(fit: Fit, parts: list[Fit | None]) -> Fit:
    """A fit with sd widened where fits of its parts scatter by more than their errors (Birge 1932)."""
    off = [(part.value - fit.value) / np.hypot(part.sd, part.bias) for part in parts if part is not None]
    ratio = np.sqrt(np.mean(np.square(off), axis=0)) if len(off) > 1 else np.ones(fit.value.size)
    return replace(fit, sd=fit.sd * np.maximum(ratio, 1.0))


def _between(response: list[Array], columns: list[Array], low: int, high: int) -> list[tuple[Array, Array]]:
    """Rows low..high-1, counted over all stretches."""
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
    scaled = f * left[:, None] @ covariance
    plain = np.sum(scaled**2, axis=0)
    inflation = np.sqrt(np.maximum(long_run(scaled) / np.where(plain > 0.0, plain, 1.0), 1.0))
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
    return np.append(1.0, -np.linalg.solve(linalg.toeplitz(covariance[:-1]), covariance[1:]))


def filtered(weights: Array, part: Array) -> Array:
    """A stretch (k,) or (k, p) through the whitening filter, without its first rows."""
    # same result as scipy.signal.lfilter, bit for bit; its import takes a second
    if part.ndim == 1:
        return np.convolve(weights, part)[AUTOREGRESSION_ORDER : part.size]
    return np.column_stack([np.convolve(weights, column)[AUTOREGRESSION_ORDER : column.size] for column in part.T])


def long_run(terms: Array) -> Array:
    """Long-run variance (p,) of the column sums of terms (n, p), with a Bartlett kernel."""
    n = terms.shape[0]
    lags = min(n // 8, _MAX_LAG)
    total = np.sum(terms**2, axis=0)
    for lag in range(1, lags + 1):
        total = total + 2.0 * (1.0 - lag / (lags + 1.0)) * np.einsum("ij,ij->j", terms[lag:], terms[:-lag])
    return np.maximum(total, 0.0)
