"""Streams with linear interpolation by their publisher: find interpolated rows, recover measured samples."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import runs_of

RELATIVE_TOLERANCE = 1e-4  # of the change over two steps; interpolated rows are below 1e-5, noise is far above 1e-2
ABSOLUTE_TOLERANCE = 4e-9  # files have nine decimals, rounded
_CHUNK_ROWS = 1 << 16  # rows processed together, to bound memory


def interpolated_rows(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Rows in runs of three or more samples on one straight line in every component.

    A packet carries all components, so a lost packet affects all of them at once. Constant components are no evidence
    (saturation, motors off): at least one component must change along the line.

    Args:
        time: (n,) s, may be unevenly spaced.
        values: (n, c), any unit.

    Returns: (n,) True for every row of such a run, with its ends.
    """
    n = time.size
    rows = np.zeros(n, bool)
    for start in range(0, max(n - 2, 0), _CHUNK_ROWS):
        part = slice(start, min(start + _CHUNK_ROWS + 2, n))
        centres = _centres(time[part], values[part])
        for shift in (0, 1, 2):
            rows[start + shift : start + shift + centres.size] |= centres
    return rows


def _centres(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n - 2,) whether each inner row lies on the line through its neighbours, and the values change."""
    span = time[2:] - time[:-2]
    share = np.where(span > 0, (time[1:-1] - time[:-2]) / np.where(span > 0, span, 1.0), np.nan)
    with np.errstate(invalid="ignore", over="ignore"):
        change = values[2:] - values[:-2]
        deviation = np.abs(values[1:-1] - values[:-2] - share[:, None] * change)
        on_line = (deviation <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * np.abs(change)).all(axis=1)
        # a change near the rounding error of the file looks straight in any case
        moving = (np.abs(change) > 1e3 * ABSOLUTE_TOLERANCE).any(axis=1)
    return np.asarray(on_line & moving)


CONTEXT_ROWS = 32  # rows on either side of a row that the rules below use at most
_LONGEST_GROUP = 8  # consecutive rows off every line that may be corners; longer groups are measured rows
_SHARE_OUTSIDE = 0.02  # of the interval between two rows; a corner may lie so far outside, for rounding


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The samples of a slow stream that was linearly interpolated at faster rows."""

    row: NDArray[np.int64]  # (m,) the last row at or before each sample, increasing
    time: NDArray[np.float64]  # (m,) s
    value: NDArray[np.float64]  # (m,)


def corners(
    time: NDArray[np.float64], value: NDArray[np.float64], *, starts: bool = True, ends: bool = True
) -> Corners:
    """Recover the samples of a linear interpolation: its corners, between two rows or on a row.

    The corner between rows k and k+1 is the intersection of the line through k-1 and k with the line through k+1 and
    k+2. A sample in the middle of a straight part looks like the line and is not recovered. If more than eight
    consecutive rows lie on no line, these rows are the samples.

    Args:
        time: (n,) s, may be unevenly spaced.
        value: (n,)
        starts, ends: whether row 0 and row n-1 are the first and the last row of the file.
    """
    n = time.size
    if n < 4:
        return Corners(np.arange(n), time.copy(), value.copy())
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
        deviation = np.abs(value[1:-1] - value[:-2] - share * (value[2:] - value[:-2]))
    off = np.zeros(n, bool)
    off[1:-1] = ~(deviation <= ABSOLUTE_TOLERANCE)  # NaN is off every line
    begin, end = runs_of(off).T
    length = end - begin
    pairs = [
        (begin[length == size, None] + np.arange(0, size, 2)[None, :]).ravel()
        for size in range(2, _LONGEST_GROUP + 1, 2)
    ]
    before = np.sort(np.concatenate(pairs)).astype(np.int64)
    met, where = _meeting(time, value, before)
    measured = np.zeros(n, bool)
    # a corner on a row; not beside the first or last row, where the corner may also lie between the two rows
    measured[begin[(length == 1) & (begin > 1) & (begin < n - 2)]] = True
    measured[before[~met]] = measured[before[~met] + 1] = True
    for first, count in zip(begin[length > _LONGEST_GROUP], length[length > _LONGEST_GROUP], strict=True):
        last = first + count
        measured[first - (starts and first == 1) : last + (ends and last == n - 1)] = True
    if starts and value[0] == value[1] == value[2]:
        measured[0] = True  # constant from the first row on: not interpolated
    measured |= ~np.isfinite(value)  # NaN is not interpolated and is kept
    rows = np.flatnonzero(measured)
    row = np.concatenate([rows, before[met]])
    stamp = np.concatenate([time[rows], where[met, 0]])
    level = np.concatenate([value[rows], where[met, 1]])
    place = np.argsort(row, kind="stable")
    return Corners(row[place], stamp[place], level[place])


def _meeting(
    time: NDArray[np.float64], value: NDArray[np.float64], k: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether the lines before row k and after row k+1 meet between these rows, and (time, value) of the point."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        left = (value[k] - value[k - 1]) / (time[k] - time[k - 1])
        right = (value[k + 2] - value[k + 1]) / (time[k + 2] - time[k + 1])
        step = time[k + 1] - time[k]
        share = (value[k + 1] - value[k] - right * step) / (left - right) / step
        met = (share > -_SHARE_OUTSIDE) & (share < 1.0 + _SHARE_OUTSIDE) & (step > 0)
        share = np.clip(np.where(met, share, 0.0), 0.0, 1.0)
        return met, np.stack([time[k] + share * step, value[k] + left * share * step], axis=1)
