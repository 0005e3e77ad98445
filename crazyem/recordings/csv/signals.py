"""Signals from the columns of a wide CSV by its mapping: units, signs, frames, missing values, lost packets."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.rotations import quaternion_from_euler, quaternion_product, rotate
from crazyem.recordings.csv.mapping import SignalColumns
from crazyem.recordings.finding import Finding, Grade, intervals_of, runs_of
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import SignalArray
from crazyem.signals.sample import SIGNALS

RELATIVE_TOLERANCE = 1e-4  # of the change over two steps; interpolated rows are below 1e-5, noise is far above 1e-2
ABSOLUTE_TOLERANCE = 4e-9  # files have nine decimals, rounded
_CHUNK_ROWS = 1 << 16  # rows processed together, to bound memory


def interpolated_rows(time: Array, values: Array) -> NDArray[np.bool_]:
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


def _centres(time: Array, values: Array) -> NDArray[np.bool_]:
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
    time: Array  # (m,) s
    value: Array  # (m,)


def corners(time: Array, value: Array, *, starts: bool = True, ends: bool = True) -> Corners:
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


def _meeting(time: Array, value: Array, k: NDArray[np.int64]) -> tuple[NDArray[np.bool_], Array]:
    """Whether the lines before row k and after row k+1 meet between these rows, and (time, value) of the point."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        left = (value[k] - value[k - 1]) / (time[k] - time[k - 1])
        right = (value[k + 2] - value[k + 1]) / (time[k + 2] - time[k + 1])
        step = time[k + 1] - time[k]
        share = (value[k + 1] - value[k] - right * step) / (left - right) / step
        met = (share > -_SHARE_OUTSIDE) & (share < 1.0 + _SHARE_OUTSIDE) & (step > 0)
        share = np.clip(np.where(met, share, 0.0), 0.0, 1.0)
        return met, np.stack([time[k] + share * step, value[k] + left * share * step], axis=1)


_HARMLESS_SHARE = 0.05  # of rows drawn across lost packets
_SQRT_HALF = math.sqrt(0.5)
_NED_TO_ENU = (_SQRT_HALF, _SQRT_HALF, 0.0, 0.0)  # x y z w: half a turn about the bisector of north and east
_FLU_TO_FRD = (1.0, 0.0, 0.0, 0.0)  # half a turn about x


@dataclass(frozen=True, slots=True)
class Layout:
    """How the columns of a file become signals."""

    signals: Mapping[str, SignalColumns]  # name -> columns; the vocabulary first, in its order
    # columns without a mapping: column -> (name of the signal, unit, packet or None)
    raw: Mapping[str, tuple[str, str, str | None]]
    packets: Mapping[str, tuple[str, ...]]  # packet -> all its columns
    clock: str  # name of the clock of the rows; "host" means that stamps are host times


@dataclass(slots=True)
class Rows:
    """Some rows of a file, with neighbours before and after that are needed to find interpolated rows."""

    stamp: Array  # (n,) s on the clock of the rows
    origin: float  # s; signals have the time `stamp - origin`
    columns: dict[str, Array]  # name -> (n,)
    keep: tuple[int, int]  # rows first..last-1 of these become signals, the others are neighbours
    number: int = 0  # of row `keep[0]` in the file, from 0
    starts: bool = True  # starts, ends: whether these rows hold the first and the last row of the file
    ends: bool = True
    # signal -> stamp of the last earlier row in which its columns exceeded its threshold
    flown: dict[str, float] = field(default_factory=dict)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a file may hold any double; the doctor checks them
def signals_of(layout: Layout, rows: Rows) -> tuple[dict[str, SignalArray], list[Finding]]:
    """The signals of the kept rows, and findings about interpolated rows; removes columns from `rows`."""
    first, last = rows.keep
    time = rows.stamp - rows.origin
    straight = {}
    findings = []
    for packet, members in layout.packets.items():
        table = np.column_stack([rows.columns[c] for c in members])
        straight[packet] = interpolated_rows(time, table)[first:last]
        names = [n for n, s in layout.signals.items() if s.packet == packet]
        if straight[packet].any():
            findings.append(_lost(packet, names, time[first:last], straight[packet]))
    kept = _Kept(layout, rows, time, straight)
    step = len(layout.signals) + 1
    signals = {}
    uses = Counter(c for s in layout.signals.values() for c in s.columns)
    for place, (name, source) in enumerate(layout.signals.items()):
        if source.corners:
            signals[name] = kept.slow(source, place, step)
        else:
            value, marked = kept.values(name, source)
            signals[name] = kept.signal(source, value, kept.number * step + place, marked)
        uses.subtract(source.columns)
        for column in source.columns:
            if not uses[column]:
                del rows.columns[column]  # frees half of the memory
    for column, (name, unit, raw_packet) in layout.raw.items():
        signals[name] = kept.raw(column, unit, raw_packet, step)
    return signals, findings


def _lost(packet: str, names: list[str], time: Array, rows: NDArray[np.bool_]) -> Finding:
    intervals = intervals_of(time, rows)
    share = float(rows.mean())
    longest = max(b - a for a, b in intervals)
    return Finding(
        "interpolated",
        Grade.DEGRADES if share > _HARMLESS_SHARE else Grade.HARMLESS,
        f"{100.0 * share:.1f} % of the {packet} samples lie on straight lines drawn across lost packets "
        f"(the longest {longest:.2f} s); they are treated as missing.",
        signal=names[0] if names else "",
        intervals=intervals,
        evidence={"share": share, "longest_s": longest, "rows": float(rows.sum())},
        advice=f"Nothing to do; {', '.join(names) or packet} is missing there.",
    )


class _Kept:
    """Converts the kept rows to signals; arrays that signals share are made once."""

    def __init__(self, layout: Layout, rows: Rows, time: Array, straight: Mapping[str, NDArray[np.bool_]]) -> None:
        first, last = rows.keep
        self.layout, self.rows, self.straight = layout, rows, straight
        self.slice = slice(first, last)
        self.whole_time = time
        self.time = time[self.slice].copy()
        self.count = last - first
        self.number = rows.number + np.arange(self.count)
        self.host = rows.stamp[self.slice].copy() if layout.clock == "host" else np.full(self.count, np.nan)
        self.unmarked = np.zeros(self.count, bool)
        self._turned: dict[str, tuple[Array, NDArray[np.bool_]]] = {}
        self._raw_order: NDArray[np.int64] | None = None

    def column(self, name: str) -> Array:
        return self.rows.columns[name][self.slice]

    def signal(
        self, source: SignalColumns, value: Array, order: NDArray[np.int64], marked: NDArray[np.bool_],
        *, time: Array | None = None, host: Array | None = None,
    ) -> SignalArray:  # fmt: skip
        """A signal of the vocabulary; by default with the times of the rows."""
        _, unit, frame = SIGNALS[source.quantity]
        clock = self.layout.clock if source.clock is None else source.clock
        return SignalArray(
            self.time if time is None else time, value, order, self.host if host is None else host, marked,
            source.quantity, unit, frame, clock, source.stream, source.columns,
        )  # fmt: skip

    def raw(self, column: str, unit: str, packet: str | None, step: int) -> SignalArray:
        """A column without a mapping; all these columns have the last place of their row."""
        if self._raw_order is None:
            self._raw_order = self.number * step + step - 1
        value = self.column(column)[:, None].copy()
        marked = self.unmarked
        if packet is not None and self.straight[packet].any():
            marked = self.straight[packet]
            value[marked] = np.nan
        about = ("", unit, "", self.layout.clock, packet or "rows", (column,))
        return SignalArray(self.time, value, self._raw_order, self.host, marked, *about)

    def slow(self, source: SignalColumns, place: int, step: int) -> SignalArray:
        """The original samples of a slow stream that was linearly interpolated at the rows."""
        first, last = self.rows.keep
        found = corners(
            self.whole_time, self.rows.columns[source.columns[0]], starts=self.rows.starts, ends=self.rows.ends
        )
        mine = (found.row >= first) & (found.row < last)
        time = found.time[mine]
        value = source.converted(found.value[mine, None])
        missing = self._missing(source, found.value[mine, None])
        value[missing] = np.nan
        order = (found.row[mine] - first + self.rows.number) * step + place
        host = time + self.rows.origin if self.layout.clock == "host" else np.full(time.size, np.nan)
        return self.signal(source, value, order, missing[:, 0], time=time, host=host)

    def values(self, name: str, source: SignalColumns) -> tuple[Array, NDArray[np.bool_]]:
        """(n, c) SI in FLU and ENU, NaN where missing; (n,) True where this reader set NaN."""
        if source.above is not None:
            return self._held(name, source), self.unmarked
        if source.quantity == "attitude":
            value, marked = self.attitude(name, source)
        else:
            value, marked = self._scaled(source)
            value = self._framed(value, source)
            if source.frame and source.attitude in self.layout.signals:
                turn, unknown = self.attitude(source.attitude, self.layout.signals[source.attitude])
                value = _rotated(turn, value, inverse=source.frame == "world")
                marked = marked | unknown
        if source.packet is not None:
            lost = self.straight[source.packet]
            if lost.any():
                value = value.copy()
                value[lost] = np.nan
                marked = marked | lost
        return value, marked

    def attitude(self, name: str, source: SignalColumns) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 4) x y z w, body FLU to world, of every row (interpolated or not)."""
        if name not in self._turned:
            value, marked = self._scaled(source)
            if len(source.columns) == 3:
                value = quaternion_from_euler(*value.T)
            if source.inverted:
                value = value * [-1.0, -1.0, -1.0, 1.0]
            if source.axes[1] == "NED":
                value = quaternion_product(_NED_TO_ENU, value)
            if source.axes[0] == "FRD":
                value = quaternion_product(value, _FLU_TO_FRD)
            self._turned[name] = value, marked
        return self._turned[name]

    def _scaled(self, source: SignalColumns) -> tuple[Array, NDArray[np.bool_]]:
        value = np.column_stack([self.column(c) for c in source.columns])
        if not (source.missing or source.empty_is_missing):
            return source.converted(value), self.unmarked
        missing = self._missing(source, value)
        theirs = np.isnan(value) & ~missing
        value = source.converted(value)
        value[missing] = np.nan
        return value, np.asarray(missing.any(axis=1) & ~theirs.any(axis=1))

    @staticmethod
    def _missing(source: SignalColumns, value: Array) -> NDArray[np.bool_]:
        missing = np.isin(value, source.missing) if source.missing else np.zeros(value.shape, bool)
        return missing | np.isnan(value) if source.empty_is_missing else missing

    @staticmethod
    def _framed(value: Array, source: SignalColumns) -> Array:
        """Vectors and angles in FLU or ENU, from FRD or NED if necessary."""
        body, world = source.axes
        if body == "FRD" and value.shape[1] == 4:
            return value * [-1.0, 1.0, -1.0, -1.0]  # thrust is positive upwards along the axis of the rotors
        if body == "FRD":
            turned = value * [1.0, -1.0, -1.0]
            if source.quantity.endswith("euler"):
                turned += [0.0, 0.0, 0.5 * math.pi]
            return turned
        if world == "NED":
            return value[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        return value

    def _held(self, name: str, source: SignalColumns) -> Array:
        """1 where any column exceeded the threshold within the last `hold` seconds, else 0."""
        assert source.above is not None
        table = source.converted(np.column_stack([self.column(c) for c in source.columns]))
        on = (table > source.above).any(axis=1)
        stamp = self.rows.stamp[self.slice]
        # stamps of the file, not times since the origin, so that the result is the same in every part of a file
        since = np.maximum.accumulate(np.where(on, stamp, -math.inf))
        since = np.maximum(since, self.rows.flown.get(name, -math.inf))
        if self.count:
            self.rows.flown[name] = float(since[-1])
        return (stamp - since <= source.hold).astype(float)[:, None]


def _rotated(quaternion: Array, vector: Array, *, inverse: bool) -> Array:
    """(n, 3) vectors rotated by (n, 4) quaternions x y z w of any norm (NaN for 0), or by their inverse."""
    turned = np.empty_like(vector)
    for start in range(0, len(vector), _CHUNK_ROWS):
        part = slice(start, start + _CHUNK_ROWS)
        unit = quaternion[part] / np.linalg.norm(quaternion[part], axis=1, keepdims=True)
        turned[part] = rotate(unit, vector[part], inverse=inverse)
    return turned
