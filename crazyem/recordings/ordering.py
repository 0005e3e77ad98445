"""Samples of a signal sorted by time or thinned, and intervals of time: helpers for arrays of a recording."""

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.recording import Recording, SignalArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Intervals = tuple[tuple[float, float], ...]

FINEST_INTERVAL = 0.005  # s; period of thinned samples, short enough to show take-off and landing


def sound_rows(value: Array) -> Flags:
    """(n,) True where all components of (n, c) are finite; column by column, which is fastest."""
    sound = np.ones(value.shape[0], bool)
    for column in range(value.shape[1]):
        sound &= np.isfinite(value[:, column])
    return sound


def ordered(array: SignalArray) -> tuple[Array, Array]:
    """(n,) times and (n, c) values, sorted by time, without rows with NaN; copies only if necessary."""
    time, value = array.time, array.value
    keep = np.isfinite(time) & sound_rows(value)
    if not keep.all():
        time, value = time[keep], value[keep]
    if time.size > 1 and (time[1:] < time[:-1]).any():
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
    return time, value


def thinned(array: SignalArray) -> SignalArray:
    """Every k-th sample, so that about 200 samples per second remain."""
    if array.time.size < 2:
        return array
    period = (float(array.time[-1]) - float(array.time[0])) / max(array.time.size - 1, 1)
    step = int(FINEST_INTERVAL / period) if 0.0 < period < 0.5 * FINEST_INTERVAL else 1
    return array if step < 2 else array.rows(slice(None, None, step))


def all_time(recording: Recording) -> Intervals:
    """The interval from the first to the last finite stamp of all signals; () without any."""
    finite = [array.time[np.isfinite(array.time)] for array in recording.signals.values()]
    times = [t for t in finite if t.size]
    return ((float(min(t.min() for t in times)), float(max(t.max() for t in times))),) if times else ()


def inside(time: Array, intervals: Intervals) -> Flags:
    """(n,) True where a time lies in one of the intervals."""
    flags = np.zeros(time.size, bool)
    for start, end in intervals:
        flags |= (time >= start) & (time <= end)
    return flags


def common(one: Intervals, other: Intervals) -> Intervals:
    """The intervals that lie in both."""
    spans = [(max(a, c), min(b, d)) for a, b in one for c, d in other]
    return tuple(sorted((a, b) for a, b in spans if b > a))


def held(time: Array, value: Array, at: Array) -> Array:
    """(n,) the latest value at or before each of the times `at`; before the first sample: the first value."""
    return value[np.maximum(np.searchsorted(time, at, side="right") - 1, 0)]


def sound_samples(array: SignalArray) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of the samples that are numbers, in order of time; None if there are none."""
    if array.value.ndim != 2 or not array.value.shape[1]:
        return None
    time, value = ordered(array)
    return (time, value) if time.size else None


def sound_signal(recording: Recording, name: str) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of the samples that are numbers, in order of time; None if there are none."""
    array = recording.signals.get(name)
    return None if array is None else sound_samples(array)
