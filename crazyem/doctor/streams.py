"""What the stream checks share: signals sampled together, their real cadence, runs of rows, and when the drone flew."""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Grade, intervals_of
from crazyem.recordings.recording import Recording, SignalArray

MOST_INTERVALS = 50  # a finding names at most this many places, the longest ones; its evidence counts all
Intervals = tuple[tuple[float, float], ...]

# What a drone is told or wants, rather than what was measured: may be straight, constant or stepped in good health.
COMMANDED = frozenset(
    {
        "setpoint_position",
        "setpoint_velocity",
        "setpoint_acceleration",
        "setpoint_euler",
        "setpoint_rate",
        "wrench_command",
        "mixer_command",
        "flying",
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Signals that were sampled together.

    Attributes:
        name: for people: the name of the log block, table or topic, else the names of its signals.
        names: of its signals.
        arrays: of its signals, one time axis.
    """

    name: str
    names: tuple[str, ...]
    arrays: tuple[SignalArray, ...]

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
        return all(array.quantity in COMMANDED for array in self.arrays)

    @property
    def slow(self) -> bool:
        """True if it varies so slowly that a lost sample does not matter: the voltage alone."""
        return all(array.quantity == "voltage" for array in self.arrays)


# Hostile values may overflow anywhere; what comes out then is compared, and compares false.
QUIET: Any = np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore")


def streams(recording: Recording) -> list[Stream]:
    """Signals grouped by common time axis; those with a stamp that is not a number are left out."""
    keys: dict[int, tuple[int, int]] = {}  # of a time axis: by its bytes; signals of a table mostly share the array
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


def listed(names: Sequence[str], most: int = 4) -> str:
    """ "a, b and 3 more"."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"


@dataclass(frozen=True, slots=True)
class Cadence:
    """How often a stream comes.

    Attributes:
        period: s between samples when none is lost; NaN with fewer than eight samples.
        jitter: s, median deviation of an interval from the period.
        regular: True if the stream keeps to the period (but for losses); False for events.
    """

    period: float
    jitter: float
    regular: bool


def cadence(time: NDArray[np.float64]) -> Cadence:
    """The period of a stream from (n,) stamps in order, also if half of the samples were lost.

    Random loss stretches intervals to multiples of the period, of which the period itself stays the most frequent.
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
    """The period over windows of sixteen samples: coarse stamps and jitter average out, losses are whole periods."""
    if time.size < 40:
        return period
    spans = (time[16:] - time[:-16])[:: max(1, time.size // 50_000)]
    count = np.round(spans / period)
    spans = spans[count >= 8]
    return float(np.median(spans / count[count >= 8])) if spans.size else period


def runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(k, 2) first row and row after the last of each run of True in (n,) flags."""
    edges = np.flatnonzero(flags[1:] != flags[:-1]) + 1 if flags.size else np.empty(0, np.int64)
    if flags.size and flags[0]:
        edges = np.concatenate([[0], edges])
    if edges.size % 2:
        edges = np.concatenate([edges, [flags.size]])
    return edges.reshape(-1, 2).astype(np.int64)


def longest(intervals: Iterable[tuple[float, float]]) -> Intervals:
    """The longest `MOST_INTERVALS`, in order of time."""
    spans = [(float(min(a, b)), float(max(a, b))) for a, b in intervals if math.isfinite(a) and math.isfinite(b)]
    return tuple(sorted(sorted(spans, key=lambda span: span[0] - span[1])[:MOST_INTERVALS]))


def places(time: NDArray[np.float64], flags: NDArray[np.bool_]) -> Intervals:
    """Intervals of the runs of True, the longest ones."""
    return longest((float(time[a]), float(time[b - 1])) for a, b in runs(flags))


def same_as_before(value: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) True where a row of (n, c) equals the one before in every component; NaN equals nothing."""
    same = np.zeros(value.shape[0], bool)
    if value.shape[0] > 1:
        same[1:] = value[1:, 0] == value[:-1, 0]
        for column in range(1, value.shape[1]):
            same[1:] &= value[1:, column] == value[:-1, column]
    return same


def inside(time: NDArray[np.float64], intervals: Intervals) -> NDArray[np.bool_]:
    """(n,) True where a time lies in one of the intervals."""
    flags = np.zeros(time.size, bool)
    for start, end in intervals:
        flags |= (time >= start) & (time <= end)
    return flags


def sound_rows(value: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) True where all components of (n, c) are finite; column by column, which is fastest."""
    sound = np.isfinite(value[:, 0])
    for column in range(1, value.shape[1]):
        sound &= np.isfinite(value[:, column])
    return sound


def thinned(array: SignalArray) -> SignalArray:
    """Every k-th sample, so that some 200 a second are left: enough to see take-off and landing."""
    if array.time.size < 2:
        return array
    period = (float(array.time[-1]) - float(array.time[0])) / max(array.time.size - 1, 1)
    step = int(0.005 / period) if 0.0 < period < 0.0025 else 1
    if step < 2:
        return array
    return array.rows(slice(None, None, step))


def ordered(array: SignalArray, *, finite: bool = True) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n,) times and (n, c) values with increasing times; rows with NaN dropped if `finite`. No copy if avoidable."""
    time, value = array.time, array.value
    keep = np.isfinite(time)
    if finite:
        keep &= sound_rows(value)
    if not keep.all():
        time, value = time[keep], value[keep]
    if time.size > 1 and (time[1:] < time[:-1]).any():
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
    return time, value


def graded(share: float, *, degrades: float, unusable: float = math.inf) -> Grade:
    """By the share of samples concerned."""
    if share >= unusable:
        return Grade.UNUSABLE
    return Grade.DEGRADES if share >= degrades else Grade.HARMLESS


# -- when the drone flew ----------------------------------------------------------------------------------------------

SHORTEST_FLIGHT = 0.4  # s of lift; less is a hop or a test of the rotors
LONGEST_FALL = 0.6  # s without lift that a manoeuvre may have
LIFTED, CLEAR = 0.03, 0.1  # m above the ground: in the air; and surely so,
BOUNCE = 0.25  # or this share of the greatest height: a hard landing throws a drone up by 0.12 m, from 1 m
# No signal of a drone is larger (SI; the fastest rotors reach 6e3 rad/s): a sample beyond is an error of transmission.
POSSIBLE = {"rotor_speed": 8000.0, "motor_command": 1.5, "motor_request": 1.5}
_RAW_MOTORS = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_LIFT_SIGNALS = ("motor_command", "motor_request", "rotor_speed", "wrench_command", "mixer_command")


@dataclass(frozen=True, slots=True)
class Airtime:
    """When the drone flew.

    Attributes:
        lifting: intervals in which the rotors carried about the weight [s].
        airborne: the same, less the time before it left the ground and after it came back, where a position tells.
        ground: height of the ground in the frame of the position [m]; NaN where unknown.
        peak: greatest thrust as a share of what the signal can say (duty squared, ...), for "never left the ground".
        climbed: m, range of height; NaN without a position.
        begin, end: s, of what the rotors said.
        flown: as `airborne`, without bounces before the climb and after the descent: no force of the floor in it.
    """

    lifting: Intervals
    airborne: Intervals
    ground: float
    peak: float
    climbed: float
    begin: float
    end: float
    flown: Intervals


def airtime(recording: Recording) -> Airtime | None:
    """When the drone flew, from rotors and height; None if the recording has neither."""
    height = _height(recording)
    for name in _LIFT_SIGNALS:
        if name in recording.signals:
            time, value = ordered(thinned(recording.signals[name]))
            if time.size > 10:
                return _from_rotors(name, time, value, height)
    raw = [recording.signals[name] for name in _RAW_MOTORS if name in recording.signals]
    if len(raw) == len(_RAW_MOTORS) and len({array.time.size for array in raw}) == 1 and raw[0].time.size > 10:
        # duty or request: nobody knows which, but both say when the rotors carried
        value = np.column_stack([array.value[:, 0] for array in raw]) / 65535.0
        sound = np.isfinite(value).all(axis=1) & np.isfinite(raw[0].time)
        if sound.sum() > 10 and (np.diff(raw[0].time[sound]) >= 0).all():
            return _from_rotors("motor_command", raw[0].time[sound], value[sound], height)
    if height is None:
        return None
    time, z = height
    ground = float(np.percentile(z, 2))
    flags = z > ground + 0.1
    found = _closed(time, flags) if np.ptp(z) > 0.15 else ()
    return Airtime(found, found, ground, math.nan, float(np.ptp(z)), float(time[0]), float(time[-1]), found)


def _height(recording: Recording) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    for name, array in recording.signals.items():
        if array.quantity == "position" or name == "position":
            time, value = ordered(thinned(array))
            if time.size > 10:
                return time, value[:, 2]
    return None


def _from_rotors(
    name: str,
    time: NDArray[np.float64],
    value: NDArray[np.float64],
    height: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> Airtime:
    possible = np.abs(value).max(axis=1) <= POSSIBLE.get(name, math.inf)
    if possible.sum() > 10:  # a wild sample is no flight
        time, value = time[possible], value[possible]
    thrust = value[:, 0] if name in ("wrench_command", "mixer_command") else value.mean(axis=1)
    thrust = np.maximum(thrust, 0.0)
    if name in ("motor_command", "rotor_speed"):
        thrust = thrust * thrust  # about: thrust grows with the square of duty and of speed
    peak = float(np.percentile(thrust, 99))
    floor = {"motor_command": 0.03, "motor_request": 0.1, "rotor_speed": 200.0**2, "mixer_command": 3000.0}
    lifting: Intervals = ()
    if peak > floor.get(name, 1e-3):
        high = thrust[thrust > 0.4 * peak]
        level = float(np.median(high)) if high.size else peak  # near hover: most of a flight is
        lifting = _closed(time, thrust > 0.3 * level)
    if height is None:
        return Airtime(lifting, lifting, math.nan, peak, math.nan, float(time[0]), float(time[-1]), lifting)
    when, z = height
    known = (when >= time[0]) & (when <= time[-1] + 0.5)
    resting = known & ~inside(when, tuple((a - 0.1, b + 0.5) for a, b in lifting))
    climbed = float(np.ptp(z))
    if resting.sum() < 5:  # the rotors never rest: the recording does not show the ground
        return Airtime(lifting, lifting, math.nan, peak, climbed, float(time[0]), float(time[-1]), lifting)
    ground = float(np.median(z[resting]))
    airborne: list[tuple[float, float]] = []
    flown: list[tuple[float, float]] = []
    for start, end in lifting:
        within = np.flatnonzero((when >= start) & (when <= end))
        if not within.size:
            airborne.append((start, end))
            flown.append((start, end))
        for found, up in ((airborne, z[within] - ground > LIFTED), (flown, _off_the_ground(z[within] - ground))):
            if up.any():
                found.append((float(when[within[up][0]]), float(when[within[up][-1]])))
    begin, end = float(time[0]), float(time[-1])
    return Airtime(lifting, tuple(airborne), ground, peak, climbed, begin, end, tuple(flown))


def _off_the_ground(height: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Rows (n,) in the air, of heights above the ground [m]: without bounces before the climb and after the descent."""
    lifted = height > LIFTED
    high = np.flatnonzero(height > max(CLEAR, BOUNCE * float(height.max(initial=0.0))))
    if high.size:
        down = np.flatnonzero(~lifted)
        first, last = np.searchsorted(down, high[0]) - 1, np.searchsorted(down, high[-1])
        lifted[: down[first] if first >= 0 else 0] = False
        lifted[down[last] if last < down.size else height.size :] = False
    return lifted


def _closed(time: NDArray[np.float64], flags: NDArray[np.bool_]) -> Intervals:
    """Runs of True with short breaks closed and short runs dropped."""
    merged: list[tuple[float, float]] = []
    for start, end in intervals_of(time, flags):
        if merged and start - merged[-1][1] <= LONGEST_FALL:
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((start, end))
    return tuple(span for span in merged if span[1] - span[0] >= SHORTEST_FLIGHT)
