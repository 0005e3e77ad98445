"""The lag between two tracks of one motion, to a fraction of a grid step and for any units and axes."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.kinematics import GRID_STEP, Track
from crazyem.doctor.regression import jackknife_error
from crazyem.recordings.ordering import Array

LARGEST_LAG = 0.3  # s, largest lag of the search, on either side
COARSE_LAG_STEP = 3  # grid steps between lags tried at first
MOST_CORRELATION_ROWS = 4000  # most rows of the grid in a correlation
JACKKNIFE_REACH = 6  # grid steps by which a lag may move, on either side, when a block is left out
FEWEST_CORRELATION_ROWS = 45  # fewest rows of the grid in a correlation


@dataclass(frozen=True, slots=True)
class Delay:
    """Lag of the second track behind the first."""

    value: float  # s; positive where the second is late
    explained: float  # share of the variance of the second track that the first explains at this lag
    at_edge: bool  # the best lag is at the end of the range, so there is no maximum inside


def delay(first: Track, second: Track, *, reach: float = LARGEST_LAG, mixed: bool = True) -> Delay | None:
    """Lag of `second` behind `first`, (m, c) each; None if they have too few valid rows in common.

    Args:
        first, second: on one grid, smoothed with the same window.
        reach: s, largest lag on either side.
        mixed: explain each component of the second by all components of the first (any axes, signs and units); else
            by the same component with a free factor.
    """
    most = round(reach / GRID_STEP)
    steps = np.arange(-most, most + 1)
    curve = np.full(steps.size, np.nan)
    # a smoothed signal has no peak narrower than the window: every third lag finds the peak, its neighbours refine it
    for k in range(0, steps.size, COARSE_LAG_STEP):
        curve[k] = _explained(first, second, int(steps[k]), mixed)
    if not np.isfinite(curve).any():
        return None
    near = int(np.nanargmax(curve))
    for k in range(max(near - COARSE_LAG_STEP, 0), min(near + COARSE_LAG_STEP + 1, steps.size)):
        curve[k] = _explained(first, second, int(steps[k]), mixed)
    top = int(np.nanargmax(curve))
    edge = top in (0, steps.size - 1) or not np.isfinite(curve[top - 1 : top + 2]).all()
    place = float(steps[top])
    if not edge:
        place = place - 1.0 + _peak(curve[top - 1 : top + 2])
    return Delay(place * GRID_STEP, float(curve[top]), edge)


def _explained(first: Track, second: Track, steps: int, mixed: bool) -> float:
    """Share of the variance of second(t) that first(t - steps) explains; NaN with too few common rows."""
    x, y, _ = _common(first, second, steps)
    count = len(x)
    if count < FEWEST_CORRELATION_ROWS:
        return math.nan
    one = np.full(count, 1.0 / count)
    mx, my = one @ x, one @ y
    sxx = x.T @ x / count - np.outer(mx, mx)
    sxy = x.T @ y / count - np.outer(mx, my)
    syy = np.einsum("ij,ij->j", y, y) / count - my * my
    whole = float(syy.sum())
    if whole <= 0.0 or np.trace(sxx) <= 0.0:
        return math.nan
    if mixed:
        sxx = sxx + np.eye(len(sxx)) * (1e-9 * np.trace(sxx))
        got = float(np.einsum("ij,ij->", sxy, np.linalg.solve(sxx, sxy)))
    else:
        got = float((np.diag(sxy) ** 2 / np.maximum(np.diag(sxx), 1e-300)).sum())
    return got / whole


def _common(first: Track, second: Track, steps: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """first(t - steps) and second(t), (n, c) each, at every second valid row t or fewer, and these rows (n,)."""
    n = len(first.value) - abs(steps)
    a, b = max(0, -steps), max(0, steps)
    stride = max(2, n // MOST_CORRELATION_ROWS)
    good = first.valid[a : a + n : stride] & second.valid[b : b + n : stride]
    x, y = first.value[a : a + n : stride][good], second.value[b : b + n : stride][good]
    return x, y, np.arange(b, b + n, stride)[good]


def spread(first: Track, second: Track, found: Delay, block_rows: int) -> tuple[float, int]:
    """Standard error [s] of a lag by leaving out one block at a time (jackknife), and the number of blocks.

    Args:
        first, second, found: arguments and result of `delay`.
        block_rows: grid steps of a block.
    """
    middle = round(found.value / GRID_STEP)
    steps = np.arange(middle - JACKKNIFE_REACH, middle + JACKKNIFE_REACH + 1)
    sums = np.array([_block_sums(first, second, int(k), block_rows) for k in steps])
    used = sums[:, :, 0, 0].min(axis=0) > 0
    sums = sums[:, used]
    count = int(used.sum())
    if count < 3:
        return math.inf, count
    total = sums.sum(axis=1)
    peaks = np.array([_peak(_share(total - sums[:, b])) for b in range(count)]) * GRID_STEP
    if peaks.min() <= 0.0 or peaks.max() >= 2 * JACKKNIFE_REACH * GRID_STEP:
        return math.inf, count
    return float(jackknife_error(peaks)), count


def _block_sums(first: Track, second: Track, steps: int, block_rows: int) -> Array:
    """(blocks, 6, c) sums of 1, x, y, xx, xy, yy of x = first(t - steps), y = second(t), by blocks of t."""
    x, y, rows = _common(first, second, steps)
    block, blocks = rows // block_rows, -(-len(first.value) // block_rows)
    parts = (np.ones_like(x), x, y, x * x, x * y, y * y)
    sums = [[np.bincount(block, weights=column, minlength=blocks) for column in part.T] for part in parts]
    return np.array(sums).transpose(2, 0, 1)


def _share(sums: Array) -> Array:
    """Explained share at each lag, from (lags, 6, c) sums."""
    n = np.maximum(sums[:, 0], 1.0)
    mx, my = sums[:, 1] / n, sums[:, 2] / n
    sxx, sxy, syy = sums[:, 3] / n - mx * mx, sums[:, 4] / n - mx * my, sums[:, 5] / n - my * my
    # a variance this small is the rounding error of sums that cancel
    still = (sxx <= 1e-12 * (sums[:, 3] / n)) | (syy <= 1e-12 * (sums[:, 5] / n))
    got = np.where(still, 0.0, sxy**2 / np.where(still, 1.0, sxx)).sum(axis=1)
    whole = np.where(still, 0.0, syy).sum(axis=1)
    return np.asarray(np.where(whole > 0.0, got / np.where(whole > 0.0, whole, 1.0), 0.0), float)


def _peak(curve: Array) -> float:
    """Position of the maximum in samples, from a parabola through three samples."""
    top = int(np.argmax(curve))
    if top in (0, curve.size - 1):
        return float(top)
    left, middle, right = curve[top - 1 : top + 2]
    bend = left - 2.0 * middle + right
    return top + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
