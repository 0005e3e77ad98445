"""Tools of the stream checks: signals sampled together, their true period, and runs of rows."""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Grade, intervals_of
from crazyem.recordings.ordering import Intervals
from crazyem.recordings.recording import Recording, SignalArray

MOST_INTERVALS = 50  # most intervals in a finding, the longest ones; its evidence counts all

# Commands, not measurements: they may be straight, constant or stepped without a fault.
COMMAND_SIGNALS = frozenset({
    "setpoint_position", "setpoint_velocity", "setpoint_acceleration", "setpoint_euler", "setpoint_rate",
    "wrench_command", "mixer_command", "flying",
})  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Signals that were sampled together."""

    name: str  # to display: the name of the log block, table or topic, else the names of its signals
    names: tuple[str, ...]  # of its signals
    arrays: tuple[SignalArray, ...]  # of its signals, one time axis

    @property
    def time(self) -> NDArray[np.float64]:
        return self.arrays[0].time

    @property
    def axis(self) -> tuple[str, int, float, float, float]:
        """Equal for streams that share their stamps, as those of one resampled table do."""
        t = self.time
        return (self.clock, t.size, float(t[0]), float(t[-1]), float(t.sum()))

    @property
    def clock(self) -> str:
        return self.arrays[0].clock

    @property
    def commanded(self) -> bool:
        """True if nothing in it was measured."""
        return all(array.quantity in COMMAND_SIGNALS for array in self.arrays)

    @property
    def used(self) -> bool:
        """True if anything here uses one of its signals."""
        return any(array.quantity for array in self.arrays)

    @property
    def slow(self) -> bool:
        """True if the stream holds only the voltage, which varies so slowly that a lost sample does not matter."""
        return all(array.quantity == "voltage" for array in self.arrays)


def streams(recording: Recording) -> list[Stream]:
    """Signals grouped by common time axis; those with a stamp that is not a number are left out."""
    keys: dict[int, tuple[int, int]] = {}  # of time axes, from their bytes; signals of a table mostly share the array
    groups: dict[tuple[str, str, tuple[int, int]], list[str]] = {}
    for name, array in recording.signals.items():
        if array.time.size == 0:
            continue
        if id(array.time) not in keys:
            finite = bool(np.isfinite(array.time).all())
            checksum = zlib.crc32(np.ascontiguousarray(array.time).data) if finite else -1
            keys[id(array.time)] = (array.time.size, checksum)
        if keys[id(array.time)][1] >= 0:
            groups.setdefault((array.clock, array.stream, keys[id(array.time)]), []).append(name)
    found = []
    for (_, label, _), names in groups.items():
        arrays = tuple(recording.signals[name] for name in names)
        found.append(Stream(label or listed(names), tuple(names), arrays))
    return found


def sole(names: Sequence[str]) -> str:
    """The name of a finding's signal: that of the only one, "" for several."""
    return names[0] if len(names) == 1 else ""


def listed(names: Sequence[str], most: int = 4) -> str:
    """ "a, b and 3 more"."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"


@dataclass(frozen=True, slots=True)
class Cadence:
    """Period and jitter of a stream."""

    period: float  # s between samples if none is lost; NaN with fewer than eight samples
    jitter: float  # s, median deviation of an interval from the period
    regular: bool  # True if the stream keeps the period, apart from losses; False for events


def cadence(time: NDArray[np.float64]) -> Cadence:
    """The period of a stream from (n,) ordered stamps, even if half of the samples are lost.

    Random loss makes intervals that are multiples of the period; the period itself remains the most frequent.
    """
    steps = np.diff(time)
    steps = steps[:: max(1, steps.size // 50_000)]
    steps = steps[steps > 0]
    if steps.size < 7:
        return Cadence(math.nan, math.nan, False)
    middle = float(np.median(steps))
    bins = np.log(np.clip(steps / middle, 0.05, 20.0)) / 0.08
    counts = np.bincount(np.round(bins).astype(np.int64) + 40, minlength=81).astype(float)
    smooth = np.convolve(counts, [0.5, 1.0, 0.5], mode="same")
    mode = middle * math.exp(0.08 * (int(np.argmax(smooth)) - 40))
    near = steps[np.abs(steps - mode) <= 0.25 * mode]
    period = float(np.median(near)) if near.size else middle
    near = steps[np.abs(steps - period) <= 0.2 * period]
    period = _refined(time, float(near.mean()) if near.size else period)
    multiple = np.maximum(np.round(steps / period), 1.0)
    off = np.abs(steps - multiple * period)
    regular = bool((off <= 0.3 * period).mean() >= 0.75) and bool((np.abs(steps - period) <= 0.3 * period).mean() > 0.2)
    return Cadence(period, float(np.median(np.abs(steps - period))), regular)


def _refined(time: NDArray[np.float64], period: float) -> float:
    """The period from spans of sixteen samples: jitter and rounding average out, losses are whole periods."""
    if time.size < 40:
        return period
    spans = (time[16:] - time[:-16])[:: max(1, time.size // 50_000)]
    count = np.round(spans / period)
    spans = spans[count >= 8]
    return float(np.median(spans / count[count >= 8])) if spans.size else period


def longest(intervals: Iterable[tuple[float, float]]) -> Intervals:
    """The longest `MOST_INTERVALS`, in order of time."""
    spans = [(float(min(a, b)), float(max(a, b))) for a, b in intervals if math.isfinite(a) and math.isfinite(b)]
    return tuple(sorted(sorted(spans, key=lambda span: span[0] - span[1])[:MOST_INTERVALS]))


def places(time: NDArray[np.float64], flags: NDArray[np.bool_]) -> Intervals:
    """Intervals of the runs of True, the longest ones."""
    return longest(intervals_of(time, flags))


def same_as_before(value: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) True where a row of (n, c) equals the one before in every component; NaN equals nothing."""
    same = np.zeros(value.shape[0], bool)
    same[1:] = np.logical_and.reduce([column[1:] == column[:-1] for column in value.T])
    return same


def graded(share: float, *, degrades: float, unusable: float = math.inf) -> Grade:
    """The grade of a finding by the share of its samples."""
    if share >= unusable:
        return Grade.UNUSABLE
    return Grade.DEGRADES if share >= degrades else Grade.HARMLESS
