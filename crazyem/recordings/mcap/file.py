"""Read recordings of crazyem (MCAP), whole or cut off: all complete chunks, in the order of writing."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import GrowingArray, ReadOptions
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap import schemas
from crazyem.recordings.mcap.scan import MCAP_MAGIC, Loss, Part, Problem, from_summary, parse, parts, profile_of
from crazyem.recordings.mcap.schemas import (
    EVENT_TOPICS,
    IMPORT_METADATA,
    OTHER_EVENT_TOPIC,
    PROFILE,
    fields_of,
    findings_from_json,
)
from crazyem.recordings.mcap.stream_codec import MOST_FIELDS, MOST_SIGNALS, FixedMessages, StreamLayout
from crazyem.recordings.motor_meaning import decide
from crazyem.recordings.recording import Event, Recording, SignalArray
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.signals.sample import Block

_PART_BYTES = 256 * 1024 * 1024  # bytes; largest unpacked size of a part of `read_parts`, at any length in time


def recognises(head: bytes) -> bool:
    """True for MCAP of crazyem: profile "crazyem", or a damaged header that still contains the word."""
    profile = profile_of(head)
    return profile == PROFILE or (profile is None and head.startswith(MCAP_MAGIC) and b"crazyem" in head[:128])


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a recording of crazyem; of a cut-off or damaged file all that is readable, with findings about the rest.

    Raises: FileFormatError if the file has no log data of crazyem.
    """
    return next(read_parts(path, options, math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Read a recording of any size in parts, in bounded memory.

    The joined parts equal the result of `read`. Each part has the samples and events of at least `seconds` (by log
    time; chunks are not split), and the metadata and findings known at its end. All parts have the same origin of time.
    One exception: a signal whose rows are not in processing order comes in processing order.

    Raises: as `read`, with the first part.
    """
    in_parts = seconds < math.inf
    reading = _Reading(path, options, in_parts=in_parts)
    if in_parts and not reading.announced:
        # cut off, so without a summary: the channels are known only after a pass over the file
        for part in parts(path, []):
            reading.announced.extend(part.announced)
    reading.content.announce(reading.announced)
    begun: int | None = None
    size, first = 0, True
    for part in reading.parts():
        reading.take(part)
        if part.scan is None or not len(part.scan.messages):
            continue
        times = part.scan.messages[:, 3]
        begun = int(times[0]) if begun is None else begun
        size += part.scan.data.size
        if in_parts and (int(times[-1]) - begun >= seconds * 1e9 or size >= _PART_BYTES):
            yield reading.recording()
            begun, size, first = None, 0, False
    if first:
        reading.check()
    if first or begun is not None or reading.content.events:
        yield reading.recording()


class _Reading:
    """One pass over a file."""

    def __init__(self, path: Path, options: ReadOptions, *, in_parts: bool = False) -> None:
        self.path, self.options = path, options
        self.problems: list[Problem] = []
        self.announced, counts = from_summary(path)
        self.content = Content({} if in_parts else counts)
        self._lost: dict[int, int] = {}  # number of the problem -> messages
        self._sequence = 0
        self._samples = False
        self._motor: str | None = None
        self._told: list[Finding] = []
        self._decided: Mapping[str, Mapping[str, str]] = {}

    def parts(self) -> Iterator[Part]:
        # the summary repeats announcements that may be lost in a damaged chunk
        self.content.announce(self.announced)
        return parts(self.path, self.problems)

    def take(self, part: Part) -> None:
        self.content.take(part)
        if part.scan is None or not len(part.scan.messages):
            return
        numbers = part.scan.messages[:, 5]
        missing = int(numbers[0]) - self._sequence - 1
        damaged = [i for i, p in enumerate(self.problems) if p.loss is Loss.DAMAGED and i not in self._lost]
        if damaged:
            self._lost.update(dict.fromkeys(damaged, 0))
            self._lost[damaged[-1]] = max(missing, 0)
        self._sequence = int(numbers[-1])

    def check(self) -> None:
        """Raise FileFormatError if the file has no data for a recording."""
        if not self.content.empty or IMPORT_METADATA in self.content.metadata:
            return
        what = "it holds no log blocks"
        if self.problems:
            problem = self.problems[0]
            cut = problem.loss is not Loss.DAMAGED
            what = "it was cut off before its first log data" if cut else f"it is damaged at byte {problem.offset}"
        raise FileFormatError(f"{self.path} is an MCAP file, but not a usable recording: {what}.")

    def recording(self) -> Recording:
        """The recording of all parts taken since the last call."""
        own = self.content.metadata.get(IMPORT_METADATA)
        sessions = self.content.tables()
        signals = self._signals(sessions)
        signals.update(self.content.streams())
        self._samples = self._samples or any(array.time.size for array in signals.values())
        if not self._samples and own is None:
            raise FileFormatError(f"{self.path} is a recording without a single sample.")
        events, self.content.events = tuple(self.content.events), []
        metadata = {name: entries for name, entries in self.content.metadata.items() if name != IMPORT_METADATA}
        metadata.update({name: dict(entries) for name, entries in self._decided.items()})
        origin, source, imported = _imported(own)
        return Recording(str(self.path), source, signals, metadata, (*imported, *self._findings()), events, origin)

    def _signals(self, sessions: Mapping[int, list[Table]]) -> dict[str, SignalArray]:
        if not sessions:
            return {}
        motor = self._meaning([table for tables in sessions.values() for table in tables])
        found = []
        for tables in sessions.values():
            signals = signals_from_tables(tables, motor=motor)
            found.append({name: array for name, array in signals.items() if array.time.size})
        return join(found)

    def _meaning(self, tables: Sequence[Table]) -> str:
        """The meaning of motor.m1..4, decided once for a file; without evidence "duty", as in live flight."""
        if self._motor is None:
            decided = decide(tables, given=self.options.motor, metadata=self.content.metadata)
            if any("motor.m1" in table.columns for table in tables):
                self._told = [f for f in decided.findings if f.grade is not Grade.HARMLESS]
                self._decided = decided.metadata
            self._motor = decided.meaning or "duty"
        return self._motor

    def _findings(self) -> tuple[Finding, ...]:
        found = [finding_of(p, lost_messages=self._lost.get(i)) for i, p in enumerate(self.problems)]
        if self.content.unreadable:
            n = self.content.unreadable
            text = f"{n} messages could not be decoded and were dropped."
            found.append(note("integrity", text, Grade.DEGRADES, messages=float(n)))
        return (*self._told, *found)


def _imported(own: Mapping[str, str] | None) -> tuple[float, str, tuple[Finding, ...]]:
    """Origin, source and findings of an imported recording; defaults for a flight recorded by crazyem."""
    if own is None:
        return 0.0, "mcap", ()
    try:
        origin = float(own.get("origin", "0"))
        findings = findings_from_json(own.get("findings", "[]"))
    except (ValueError, RecursionError):
        text = "What the first reader of this recording noticed cannot be read any more."
        return 0.0, own.get("source", "mcap"), (note("integrity", text, Grade.DEGRADES),)
    return origin if math.isfinite(origin) else 0.0, own.get("source", "mcap"), findings


def finding_of(problem: Problem, *, lost_messages: int | None = None) -> Finding:
    """The finding about bytes that a reader could not use."""
    where = f"byte {problem.offset}"
    evidence = {"offset_byte": float(problem.offset), "lost_byte": float(problem.end - problem.offset)}
    lost = ""
    if lost_messages is not None:
        evidence["lost_messages"] = float(lost_messages)
        lost = f", {lost_messages} messages are lost"
    if problem.loss is Loss.OPEN:
        text = "The recording was not closed; every complete chunk was read, at most the last second is missing."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    if problem.loss is Loss.CUT:
        text = f"The file ends in the middle of a record ({where}); everything before it was read."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    text = f"The file is damaged at {where}: {problem.why}; {problem.end - problem.offset} bytes were left out{lost}."
    advice = "Look for another copy of the file; what is between the last sample before and the first after is gone."
    return Finding("integrity", Grade.DEGRADES, text, evidence=evidence, advice=advice)


_PLACES_PER_MESSAGE = MOST_SIGNALS + 1  # places in the processing order for each message of a stream
_KINDS = {schema: kind for kind, (_, schema) in EVENT_TOPICS.items()}


class _Rows:
    """Collects the messages of one channel (fixed length) as arrays, one per group of fields.

    Args:
        codec: of the messages.
        groups: number of fields in each group, in their order; a group has one type.
        expected: number of messages, if known; saves copies while the arrays grow.
    """

    def __init__(self, codec: FixedMessages, groups: Sequence[int], expected: int) -> None:
        self.codec = codec
        ends = np.cumsum(groups).tolist()
        self._groups = list(zip([0, *ends[:-1]], ends, strict=True))
        none, _ = codec.decode(np.empty(0, np.uint8), np.empty(0, np.int64))
        kinds = [none.dtype[first] if last > first else np.dtype(float) for first, last in self._groups]
        self._arrays = [
            GrowingArray(kind, last - first, expected=expected)
            for (first, last), kind in zip(self._groups, kinds, strict=True)
        ]
        self._places = GrowingArray(np.int64, expected=expected)

    def add(self, data: NDArray[np.uint8], messages: NDArray[np.int64], places: NDArray[np.int64]) -> int:
        """Take messages (rows of `Scan.messages`) at `places` in the file; returns the number of unsound ones."""
        right = messages[:, 1] == self.codec.size
        rows, sound = self.codec.decode(data, messages[right, 0])
        rows = rows[sound]
        for array, (first, last) in zip(self._arrays, self._groups, strict=True):
            room = array.more(rows.size)
            for i in range(first, last):
                room[:, i - first] = rows[str(i)]
        self._places.more(rows.size)[:] = places[right][sound]
        return len(messages) - int(sound.sum())

    def take(self) -> tuple[list[NDArray[Any]], NDArray[np.int64]]:
        """(n, fields) values of each group and (n,) places in the file, which are then dropped here."""
        return [array.take() for array in self._arrays], self._places.take()


def _table(block: Block, rows: _Rows) -> Table:
    """The packets of a log block, which are then dropped in `rows`."""
    (stamp, host_time, values), places = rows.take()
    ctypes = {v.name: v.ctype for v in block.variables}
    columns = {v.name: values[:, i] for i, v in enumerate(block.variables)}
    return Table(f"log/{block.identifier}", columns, stamp[:, 0] / 1000.0, places, host_time[:, 0], ctypes=ctypes)


def _stream_signals(layout: StreamLayout, rows: _Rows) -> list[tuple[int, str, SignalArray]]:
    """Index, name and array of each signal of a stream; the messages are then dropped in `rows`."""
    arrays, place = rows.take()
    place *= _PLACES_PER_MESSAGE
    fixed, values = [a[:, 0] for a in arrays[: layout.first]], arrays[layout.first :]
    back = np.argsort(fixed[3], kind="stable") if layout.rows else slice(None)
    time, host_time, marked = (column[back] for column in fixed[:3])
    found = []
    for bit, column in enumerate(layout.signals):
        marks = (marked & np.uint64(1 << bit)) != 0
        known = (column.quantity, column.unit, column.frame, column.clock, layout.stream, column.source)
        array = SignalArray(time, values[bit][back], (place + bit)[back], host_time, marks, *known)
        found.append((column.index, column.name, array))
    return found


class Content:
    """Takes the parts of a file in order.

    Args:
        expected: number of messages of each channel, if known.

    Attributes:
        events: so far; the caller may remove them.
        metadata: section -> key -> text.
        unreadable: messages that could not be decoded.
        messages: so far.
    """

    def __init__(self, expected: Mapping[int, int] | None = None) -> None:
        self._expected = expected or {}
        self.events: list[Event] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.unreadable = 0
        self.messages = 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Any] = {}  # records, to notice another one with the same number
        self._blocks: dict[int, tuple[int, Block, _Rows]] = {}  # session first
        self._streams: dict[int, tuple[StreamLayout, _Rows]] = {}
        self._kinds: dict[int, tuple[str, Any]] = {}

    @property
    def empty(self) -> bool:
        """Whether there is no channel of log data or signals."""
        return not self._blocks and not self._streams

    def take(self, part: Part) -> None:
        """The next part of the file."""
        self.announce(part.announced)
        if part.record.opcode == mcap_scan.METADATA:
            record = parse(mcap_scan.METADATA, part.record.data)
            if record is None:
                self.unreadable += 1
            else:
                self.metadata.setdefault(record.name, {}).update(record.metadata)
        if part.scan is not None and len(part.scan.messages):
            self._take_messages(part.scan)

    def announce(self, records: Iterable[Any]) -> None:
        """Take schemas and channels; a repeated channel is ignored, a changed one replaces the old one."""
        for record in records:
            if not hasattr(record, "topic"):
                self._schemas[record.id] = record.name
            elif self._channels.get(record.id) != record:
                self._channels[record.id] = record
                self._channel(record)

    def _channel(self, record: Any) -> None:
        name = self._schemas.get(record.schema_id, "")
        expected = self._expected.get(record.id, 0)
        for known in (self._blocks, self._streams, self._kinds):
            known.pop(record.id, None)
        try:
            if name.startswith("crazyem.log."):
                block = schemas.block_from_metadata(record.metadata)
                if len(block.variables) > MOST_FIELDS:
                    raise ValueError("too many variables")
                count = len(block.variables)
                rows = _Rows(FixedMessages(["<i8", *["<f8"] * (1 + count)]), [1, 1, count], expected)
                self._blocks[record.id] = (schemas.session_of(record.metadata), block, rows)
            elif name.startswith("crazyem.signals."):
                layout = StreamLayout.from_metadata(record.metadata)
                groups = [*[1] * layout.first, *(s.width for s in layout.signals)]
                self._streams[record.id] = (layout, _Rows(layout.messages, groups, expected))
            elif name in _KINDS and record.topic == EVENT_TOPICS[_KINDS[name]][0]:
                self._kinds[record.id] = (_KINDS[name], schemas.message_class(name))
            elif name == OTHER_EVENT_TOPIC[1]:
                self._kinds[record.id] = ("", schemas.message_class(name))
        except (ValueError, KeyError, TypeError, RecursionError):
            self.unreadable += 1

    def _take_messages(self, scan: mcap_scan.Scan) -> None:
        messages = scan.messages
        places = self.messages + np.arange(len(messages))
        self.messages += len(messages)
        others = []
        for channel in np.unique(messages[:, 2]).tolist():
            known = self._blocks.get(channel) or self._streams.get(channel)
            if known is not None:
                mine = messages[:, 2] == channel
                self.unreadable += known[-1].add(scan.data, messages[mine], places[mine])
            elif channel in self._kinds:
                others.append(channel)
        if others:
            for offset, length, channel, _, stamp, _ in messages[np.isin(messages[:, 2], others)].tolist():
                self._event(channel, scan.data[offset : offset + length].tobytes(), stamp)

    def _event(self, channel: int, data: bytes, stamp: int) -> None:
        kind, message = self._kinds[channel]
        try:
            decoded = message.FromString(data)
            if kind:
                self.events.append(Event((stamp % 2**64) / 10**9, kind, fields_of(decoded)))
                return
            fields = json.loads(decoded.json)
            if not isinstance(fields, dict):
                raise ValueError("not an event")
            self.events.append(Event(decoded.time, decoded.kind, fields))
        except Exception:  # protobuf's DecodeError has no public base across its back ends
            self.unreadable += 1

    def tables(self) -> dict[int, list[Table]]:
        """Session -> tables of its log blocks; the rows are then dropped here."""
        sessions: dict[int, list[Table]] = {}
        for session, block, rows in self._blocks.values():
            sessions.setdefault(session, []).append(_table(block, rows))
        return dict(sorted(sessions.items()))

    def streams(self) -> dict[str, SignalArray]:
        """Signals of an imported recording, in its order; the rows are then dropped here."""
        found = [entry for stream in self._streams.values() for entry in _stream_signals(*stream)]
        return {name: array for _, name, array in sorted(found, key=lambda e: e[0])}


def join(sessions: Iterable[Mapping[str, SignalArray]]) -> dict[str, SignalArray]:
    """The signals of consecutive sessions, joined; a stream that changes its name gets both names."""
    joined: dict[str, SignalArray] = {}
    after = 0
    for signals in sessions:
        for name, unmoved in signals.items():
            array = replace(unmoved, order=unmoved.order + after) if after else unmoved
            before = joined.get(name)
            joined[name] = array if before is None else _appended(before, array)
        after = max((int(a.order.max()) + 1 for a in joined.values() if a.order.size), default=0)
    return joined


def _appended(a: SignalArray, b: SignalArray) -> SignalArray:
    width = min(a.value.shape[1], b.value.shape[1])
    rows: dict[str, Any] = {
        n: np.concatenate([getattr(a, n), getattr(b, n)]) for n in ("time", "order", "host_time", "marked")
    }
    rows["value"] = np.concatenate([a.value[:, :width], b.value[:, :width]])
    stream = a.stream if a.stream == b.stream else f"{a.stream}, {b.stream}"
    return replace(a, **rows, stream=stream, source=tuple(dict.fromkeys((*a.source, *b.source))))
