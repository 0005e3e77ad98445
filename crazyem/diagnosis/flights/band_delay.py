"""The delay of one series behind another, in a band in which a drone shakes and sensors show more than noise.

At the delay, one series explains most of the other. Noise in either makes this share smaller, but does not move the
delay. Sums are kept by blocks of flight, so that a jackknife gives the standard error.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.settings import CLOCKS


def delays_within(reach: float) -> NDArray:
    """(d,) s: delays to try, up to `reach` [s] on either side."""
    return np.arange(-reach, reach + CLOCKS.step / 2, CLOCKS.step)


def on_grid(time: NDArray, when: NDArray, value: NDArray) -> NDArray:
    """(n, k): columns of value (m, k) with stamps `when` (m,) s, interpolated at times (n,) s."""
    return np.stack([np.interp(time, when, column) for column in value.T], 1)


def spacing(time: NDArray, when: NDArray) -> NDArray:
    """(n,) s between the stamps (m,) on either side of times (n,)."""
    after = np.clip(np.searchsorted(when, time), 1, when.size - 1)
    return when[after] - when[after - 1]


def _kernel() -> NDArray:
    """A difference of Gaussians of zero sum, of finite length."""
    t = np.arange(-round(CLOCKS.filter_half / CLOCKS.grid), round(CLOCKS.filter_half / CLOCKS.grid) + 1) * CLOCKS.grid
    narrow, wide = (np.exp(-0.5 * np.square(t / width)) for width in CLOCKS.band)
    return narrow / narrow.sum() - wide / wide.sum()


def band_passed(value: NDArray) -> NDArray:
    """(n, k): columns on the grid, in the band."""
    kernel = _kernel()
    return np.stack([np.convolve(column, kernel, "same") for column in value.T], 1)


def products(
    index: NDArray, block: NDArray, wanted: NDArray, cause: NDArray, beside: list[NDArray], delay: float
) -> NDArray:
    """(axes, blocks, k + 2, k + 2) sums of products of [cause(t - delay), beside, wanted], for each axis.

    Args:
        index: (r,) rows of the grid. block: (r,) their blocks.
        wanted, cause: (n, axes). beside: (n, axes) each, other regressors of the wanted series.
    """
    steps = delay / CLOCKS.grid
    low = int(np.floor(steps))
    part = steps - low
    out = []
    for axis in range(wanted.shape[1]):
        moved = (1 - part) * cause[index - low, axis] + part * cause[index - low - 1, axis]
        rows = np.stack([moved, *(b[index, axis] for b in beside), wanted[index, axis]], 1)
        squares = np.einsum("ni,nj->nij", rows, rows).reshape(len(rows), -1)
        total = np.stack([np.bincount(block, weights=column) for column in squares.T], 1)
        out.append(total.reshape(-1, rows.shape[1], rows.shape[1]))
    return np.stack(out)


def explained_share(sums: NDArray) -> NDArray:
    """Share (..., delays) of the wanted series that its cause explains beyond the other regressors.

    sums: (..., delays, k, k).
    """
    size = sums.shape[-1] - 1
    whole = np.maximum(sums[..., size, size], 1e-300)
    a = sums[..., :size, :size]
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    a = a / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(size)
    b = sums[..., :size, size] / scale
    got = np.linalg.solve(a, b[..., None])[..., 0]
    gain = np.where(got[..., 0] > 0, 1.0, 0.0)  # a cause has a positive coefficient
    rest = np.linalg.solve(a[..., 1:, 1:], b[..., 1:, None])[..., 0]
    return gain * (np.sum(got * b, -1) - np.sum(rest * b[..., 1:], -1)) / whole


def peak(delays: NDArray, curve: NDArray) -> float:
    """Delay of the maximum, interpolated by a parabola; NaN at the edge."""
    top = int(np.argmax(curve))
    if top in (0, curve.size - 1) or curve[top] <= 0:
        return float("nan")
    left, middle, right = curve[top - 1 : top + 2]
    bend = left - 2 * middle + right
    return float(delays[top] + CLOCKS.step * (0.5 * (left - right) / bend if bend < 0 else 0.0))


def delay_of(delays: NDArray, sums: NDArray) -> tuple[float, float]:
    """Delay [s] by all axes together, from sums (axes, delays, k, k), and the explained share."""
    share = explained_share(sums)
    whole = sums[:, 0, -1, -1]
    curve = (share * whole[:, None]).sum(0) / max(float(whole.sum()), 1e-300)
    return peak(delays, curve), float(curve.max())


def standard_error(delays: NDArray, sums: NDArray, total: NDArray) -> float:
    """Standard error of the delay [s]: each of up to 12 groups of blocks left out (jackknife).

    sums: (axes, blocks, delays, k, k). total: (axes, delays, k, k).
    """
    groups = np.array_split(np.arange(sums.shape[1]), min(12, sums.shape[1]))
    found = np.array([delay_of(delays, total - sums[:, g].sum(1))[0] for g in groups])
    if not np.isfinite(found).all():
        return float("inf")
    n = len(groups)
    return float(np.sqrt((n - 1) / n * np.square(found - found.mean()).sum()))
