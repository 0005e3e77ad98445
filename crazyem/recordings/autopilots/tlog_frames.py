"""The frames of a MAVLink telemetry log with the message definitions of pymavlink, its clocks and its losses.

A tlog is a sequence of [time of arrival, 8 bytes, big-endian, microseconds since 1970][MAVLink 1 or 2 frame]. pymavlink
decodes messages one by one. For speed, numpy unpacks here all frames of a message together, with the types, order and
checksum seed from pymavlink. Source: mavlink.io/en/guide/serialization.html.
"""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega

from crazyem.links.mavlink.frames import FRAME_MARKS, header, is_sound, layout
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.stamps import RESTART_SECONDS, STAMP_CHECK, Fault, impossible, restarts
from crazyem.recordings.topics import seconds

MESSAGES: Mapping[int, Any] = ardupilotmega.mavlink_map
_EARLIEST_STAMP = 946_684_800_000_000  # us: the year 2000
_LATEST_STAMP = 4_102_444_800_000_000  # us: the year 2100
# possible start of a frame: a time of arrival between these years, and the mark of a frame
_START = re.compile(rb"(?s)(?=\x00[\x03-\x0e].{6}[\xfd\xfe])")

Key = tuple[int, int, int]  # system, component, message


@dataclass(slots=True)
class Frames:
    """Sound frames of one message from one component: arrival [us], place in the file, sequence number, payload."""

    stamps: list[int] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    sequence: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)


@dataclass(slots=True)
class Frameset:
    """The frames of a log."""

    frames: dict[Key, Frames] = field(default_factory=dict)  # by system, component and message
    # (offset, count) of each run of bytes that is no sound frame
    skipped: list[tuple[int, int]] = field(default_factory=list)
    unknown: int = 0  # number of frames of messages that pymavlink does not know; they cannot be checked or read
    total: int = 0  # number of sound and unknown frames


def scan(data: bytes, at_most: int | None = None) -> Frameset:
    """All sound frames of a log, or the first `at_most`."""
    found = Frameset()
    position, size = 0, len(data)
    while position < size and (at_most is None or found.total < at_most):
        after = _frame(data, position, found)
        if after:
            position = after
            continue
        again = _resume(data, position)
        found.skipped.append((position, again - position))
        position = again
    return found


def _frame(data: bytes, at: int, found: Frameset | None) -> int:
    """Byte after the frame at `at`, 0 if there is no sound one; adds the frame to `found`."""
    if at + 8 + 8 > len(data):
        return 0
    stamp = int.from_bytes(data[at : at + 8], "big")
    if not _EARLIEST_STAMP < stamp < _LATEST_STAMP:
        return 0
    head = header(data, at + 8)
    if head is None or head[-1] > len(data):
        return 0
    sequence, *key, start, end, after = head
    message = MESSAGES.get(key[2])
    if message is None:
        if not _looks_like_frame(data, after):
            return 0
        if found is not None:
            found.unknown += 1
            found.total += 1
        return after
    if not is_sound(data, at + 8, end, message.crc_extra):
        return 0
    if found is not None:
        frames = found.frames.setdefault((key[0], key[1], key[2]), Frames())
        frames.stamps.append(stamp)
        frames.places.append(found.total)
        frames.sequence.append(sequence)
        frames.payloads.append(data[start:end])
        found.total += 1
    return after


def _looks_like_frame(data: bytes, at: int) -> bool:
    """True at the end of the log, or at a time of arrival followed by the mark of a frame."""
    if at == len(data):
        return True
    if at + 9 > len(data):
        return False
    return _EARLIEST_STAMP < int.from_bytes(data[at : at + 8], "big") < _LATEST_STAMP and data[at + 8] in FRAME_MARKS


def _resume(data: bytes, damaged: int) -> int:
    """Offset of the next sound frame after `damaged`; the end of the log if there is none."""
    for start in _START.finditer(data, damaged + 1):
        if _frame(data, start.start(), None):
            return start.start()
    return len(data)


def columns_of(message: Any, payloads: list[bytes]) -> dict[str, NDArray[np.generic]]:
    """Fields of all frames of one message, in the types in which they were sent: name -> (n,).

    Each element of an array becomes a column, "voltages[0]"; a text is one column of bytes. Missing bytes are 0:
    MAVLink 2 cuts zeros off the end of a payload, and MAVLink 1 has no extension fields.
    """
    names: list[str] = []
    kinds: list[Any] = []
    for field_name, (count, code) in zip(message.ordered_fieldnames, layout(message.unpacker.format), strict=True):
        if code == "s":
            names.append(field_name)
            kinds.append(f"S{count}")
        elif count == 1:
            names.append(field_name)
            kinds.append("<" + code)
        else:
            names += [f"{field_name}[{i}]" for i in range(count)]
            kinds += ["<" + code] * count
    dtype = np.dtype(list(zip(names, kinds, strict=True)))
    size = dtype.itemsize
    table = np.frombuffer(b"".join([p[:size].ljust(size, b"\0") for p in payloads]), dtype)
    return {name: table[name] for name in names}


def units_of(message: Any, columns: Mapping[str, object]) -> dict[str, str]:
    """Units of the columns from the MAVLink definitions."""
    units = {name: unit.replace("/s/s", "/s^2") for name, unit in message.fieldunits_by_name.items()}
    return {c: units[c.partition("[")[0]] for c in columns if c.partition("[")[0] in units}


_EPOCH_US = 10**15  # us; a larger `time_usec` is since 1970, a smaller one since boot


@dataclass(frozen=True, slots=True, eq=False)
class _MessageTimes:
    """The times in messages of one kind."""

    time: NDArray[np.float64]  # (n,) s since boot, or since 1970
    utc: bool  # whether the times are since 1970
    bad: NDArray[np.bool_]  # (n,) True where the time is absent or impossible
    host: NDArray[np.float64]  # (n,) time of arrival, s since 1970
    place: NDArray[np.int64]  # (n,) place in the log

    @property
    def lead(self) -> NDArray[np.float64]:
        """Arrival minus the own time [s], where this is known."""
        return (self.host - self.time)[~self.bad]


class Clocks:
    """The clocks of a log on one axis: time since boot of the autopilot, or host time if no message has it.

    A message without its own time is placed by its arrival minus the median delay of the other messages. If the
    autopilot restarts within a log, each start has its own median for the messages that follow.
    """

    def __init__(self, found: Frameset, system: int) -> None:
        counts: Counter[int] = Counter()
        boots: dict[int, list[_MessageTimes]] = {}
        epochs: dict[int, list[_MessageTimes]] = {}
        for (sender, component, identifier), frames in found.frames.items():
            if sender != system:
                continue
            counts[component] += len(frames.stamps) * (1000 if identifier == 0 else 1)
            own = _message_times(MESSAGES[identifier], frames)
            if own is not None:
                (epochs if own.utc else boots).setdefault(component, []).append(own)
        self._utc = {c: float(np.median(np.concatenate([o.lead for o in v]))) for c, v in epochs.items()}
        # component -> place of the first message of each restart; host time of each start
        self._starts = {c: _starts(v) for c, v in boots.items()}
        self._boots = {c: _offsets(v, self._starts[c]) for c, v in boots.items()}
        self.component = max(counts, key=lambda c: (c in self._boots, counts[c], -c))
        self.boot: float | None = None  # host time at 0 of the axis; None: axis of arrival
        if self.component in self._boots:
            self.boot = float(self._boots[self.component][0])
        own_of = boots.get(self.component, [])
        self._ends = (min(o.host.min() for o in own_of), max(o.host.max() for o in own_of)) if own_of else (0.0, 0.0)
        self._firsts = [min(o.host[o.place >= s].min(initial=np.inf) for o in own_of) for s in self.starts]
        first = min(f.stamps[0] for f in found.frames.values())
        self.origin = 0.0 if self.boot is not None else float(first // 1_000_000)
        self.faults: list[Fault] = []

    @property
    def starts(self) -> NDArray[np.int64]:
        """Places (k,) in the log at which the autopilot restarts."""
        return self._starts.get(self.component, np.empty(0, np.int64))

    def place(self, component: int, frames: Frames, message: object, name: str) -> tuple[NDArray[np.float64], str]:
        """Times of frames on the axis [s], and the name of their clock; adds impossible stamps to `faults`."""
        arrival = self.arrival(np.array(frames.stamps, np.int64))
        own = _message_times(message, frames) if self.boot is not None else None
        if own is None or self.boot is None:
            return arrival, "host"
        if own.utc:
            time, clock = own.time + (self._utc[component] - self.boot), f"UTC of component {component}"
        else:
            start = np.searchsorted(self._starts[component], own.place, side="right")
            time = own.time + (self._boots[component] - self.boot)[start]
            clock = "autopilot" if component == self.component else f"component {component}"
        if own.bad.any():
            example = float(own.time[int(np.argmax(own.bad))])
            self.faults.append(Fault(name, int(own.bad.sum()), own.bad.size, "placed by arrival", example))
        return np.where(own.bad, arrival, time), clock

    def arrival(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Times on the axis [s] from times of arrival [us]."""
        if self.boot is None:
            return seconds(stamps - int(self.origin) * 1_000_000)
        return seconds(stamps) - self.boot

    def findings(self) -> list[Finding]:
        """Findings about the time axis."""
        if self.boot is None:
            text = "No message has the autopilot's own time; all times are those of arrival at the ground station."
            return [note("mapping", text, Grade.DEGRADES)]
        text = (
            'Messages without a time of their own (clock "host") are placed by their arrival less the median delay '
            'of the others; among signals of clock "host" times are exact, against others they are not.'
        )
        return [note("mapping", text, boot_s=self.boot), *self._parts(self.boot)]

    def _parts(self, boot: float) -> list[Finding]:
        """A finding about restarts of the autopilot, with the times of the parts of the log."""
        if not self._firsts:
            return []
        edges = [self._ends[0], *self._firsts, self._ends[1]]
        parts = tuple((a - boot, b - boot) for a, b in itertools.pairwise(edges))
        said = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in parts[:10])
        text = (
            f"The autopilot was started {len(parts)} times within the log, whose parts are {said}; "
            "each part is placed by when its messages arrived."
        )
        advice = f"Use one part at a time: --from {parts[-1][0]:.1f} for the last."
        evidence = {"starts": float(len(parts))}
        return [Finding(STAMP_CHECK, Grade.DEGRADES, text, intervals=parts, evidence=evidence, advice=advice)]


def _starts(own: list[_MessageTimes]) -> NDArray[np.int64]:
    """Places (k,) of the first message after each restart of an autopilot.

    The most frequent message shows the step back of the clock. Other messages of the new start may arrive before it.
    """
    most = max(own, key=lambda o: int((~o.bad).sum()))
    time, place = most.time[~most.bad], most.place[~most.bad]
    first = []
    for row in restarts(time).tolist():
        since = [o.place[~o.bad & (o.place > place[row - 1]) & (o.time < time[row - 1] - RESTART_SECONDS)] for o in own]
        first.append(min(int(p.min()) for p in since if p.size))
    return np.array(first, np.int64)


def _offsets(own: list[_MessageTimes], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Host time [s] of each start."""
    part = np.searchsorted(starts, np.concatenate([o.place[~o.bad] for o in own]), side="right")
    lead = np.concatenate([o.lead for o in own])
    return np.array([float(np.median(lead[part == k])) for k in range(starts.size + 1)])


def _message_times(message: object, frames: Frames) -> _MessageTimes | None:
    """Times in messages; None if they have none, or at most half of them are known."""
    names = message.fieldnames  # type: ignore[attr-defined]
    column = next((name for name in ("time_boot_ms", "time_usec") if name in names), None)
    if column is None:
        return None
    raw = np.asarray(columns_of(message, frames.payloads)[column])
    stamps = raw.astype(np.int64)
    known = stamps > 0
    if 2 * known.sum() <= known.size:
        return None
    utc = False
    if column == "time_usec":
        utc = bool(np.median(stamps[known]) > _EPOCH_US)
        known &= (stamps > _EPOCH_US) == utc
        if raw.dtype.itemsize == 4:  # wraps after 71 minutes
            steps = (np.diff(stamps[known]) + (1 << 31)) % (1 << 32) - (1 << 31)
            stamps[known] = stamps[known][0] + np.concatenate([[0], np.cumsum(steps)])
    time = seconds(stamps, 1e3 if column == "time_boot_ms" else 1e6)
    bad = ~known
    bad[known] = impossible(time[known])
    host = seconds(np.array(frames.stamps, np.int64))
    return _MessageTimes(time, utc, bad, host, np.array(frames.places, np.int64))


# a sequence number up to this many behind is a late or repeated message; more is the next cycle of 256 numbers
_LATE_PLACES = 16


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Losses of one component by its sequence numbers."""

    received: int  # number of different messages in the log
    lost: int  # least number of missing messages: sequence numbers have 8 bits
    before: NDArray[np.int64]  # before, after: (k,) times of arrival before and after each loss [us]
    after: NDArray[np.int64]

    def findings(self, time: Callable[[NDArray[np.int64]], NDArray[np.float64]]) -> Iterator[Finding]:
        """One finding with the times of missing messages; none without losses.

        Args:
            time: function from times of arrival [us] to times on the axis of the recording [s].
        """
        if not self.lost:
            return
        share = self.lost / (self.lost + self.received)
        places = zip(time(self.before).tolist(), time(self.after).tolist(), strict=True)
        text = (
            f"By their sequence numbers at least {self.lost} messages of the vehicle never reached the log "
            f"({100.0 * share:.1f} %)."
        )
        evidence = {"lost": float(self.lost), "received": float(self.received), "share": share}
        yield Finding("gaps", Grade.HARMLESS if share < 0.02 else Grade.DEGRADES, text, "", tuple(places), evidence)


def link(found: Frameset, system: int, component: int, starts: NDArray[np.int64]) -> Link:
    """Losses of a component; a late message is not lost, and a repeated one counts once.

    Args:
        starts: places (k,) in the log at which the sequence numbers restart.
    """
    chosen = [f for (s, c, _), f in found.frames.items() if (s, c) == (system, component)]
    rows = np.concatenate([np.array([f.places, f.stamps, f.sequence], np.int64) for f in chosen], axis=1)
    place, stamp, sequence = rows[:, np.argsort(rows[0])]
    cuts = np.searchsorted(place, starts)
    received = lost = 0
    before, after = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for numbers, stamps in zip(np.split(sequence, cuts), np.split(stamp, cuts), strict=True):
        if not numbers.size:
            continue
        number = np.concatenate([[0], np.cumsum((np.diff(numbers) + _LATE_PLACES) % 256 - _LATE_PLACES)])
        sent, first = np.unique(number, return_index=True)
        missing = np.diff(sent) - 1
        gaps = np.flatnonzero(missing)
        received, lost = received + sent.size, lost + int(missing.sum())
        before.append(stamps[first[gaps]])
        after.append(stamps[first[gaps + 1]])
    return Link(received, lost, np.concatenate(before), np.concatenate(after))
