"""What the messages of our MCAP files add up to: tables of log blocks, streams of signals, events, metadata."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings import mcap_scan, schemas
from crazyem.recordings.mcap_messages import EVENTS, OTHER_EVENTS, fields_of
from crazyem.recordings.mcap_survey import Part, parse
from crazyem.recordings.recording import Event, SignalArray
from crazyem.recordings.stream_codec import MOST_FIELDS, MOST_SIGNALS, FixedMessages, StreamLayout
from crazyem.recordings.tables import Table
from crazyem.signals.packet import Block

_STEP = MOST_SIGNALS + 1  # places in the processing order for each message of a stream
_KINDS = {schema: kind for kind, (_, schema) in EVENTS.items()}


@dataclass
class _Rows:
    """Messages of one channel with fixed length, as they come."""

    codec: FixedMessages
    parts: list[NDArray[Any]] = field(default_factory=list)
    places: list[NDArray[np.int64]] = field(default_factory=list)

    def add(self, data: NDArray[np.uint8], messages: NDArray[np.int64], places: NDArray[np.int64]) -> int:
        """Take messages (rows of `Scan.messages`) at `places` in the file; returns how many are not sound."""
        right = messages[:, 1] == self.codec.size
        rows, sound = self.codec.decode(data, messages[right, 0])
        self.parts.append(rows[sound])
        self.places.append(places[right][sound])
        return len(messages) - int(sound.sum())

    def column(self, number: int) -> NDArray[Any]:
        """(n,) values of a field, from 0."""
        parts = [part[str(number)] for part in self.parts]
        return np.concatenate(parts) if parts else self.codec.decode(np.empty(0, np.uint8), np.empty(0, np.int64))[0][
            str(number)
        ].copy()  # fmt: skip

    def columns(self, first: int, last: int) -> NDArray[np.float64]:
        """(n, last - first) values of fields."""
        size = sum(part.size for part in self.parts)
        values = np.empty((size, last - first))
        at = 0
        for part in self.parts:
            for i in range(first, last):
                values[at : at + part.size, i - first] = part[str(i)]
            at += part.size
        return values

    def place(self) -> NDArray[np.int64]:
        return np.concatenate(self.places) if self.places else np.empty(0, np.int64)

    def clear(self) -> None:
        self.parts, self.places = [], []


@dataclass
class _BlockChannel:
    block: Block
    session: int
    rows: _Rows

    def table(self) -> Table:
        names = [v.name for v in self.block.variables]
        values = self.rows.columns(2, 2 + len(names))
        table = Table(
            name=f"log/{self.block.identifier}",
            columns={name: values[:, i] for i, name in enumerate(names)},
            time=self.rows.column(0) / 1000.0,
            order=self.rows.place(),
            host_time=self.rows.column(1),
            clock="firmware",
            ctypes={v.name: v.ctype for v in self.block.variables},
        )
        self.rows.clear()
        return table


@dataclass
class _StreamChannel:
    layout: StreamLayout
    rows: _Rows

    def signals(self) -> list[tuple[int, str, SignalArray]]:
        """Index, name and array of each signal."""
        time, host_time, marked = (self.rows.column(i) for i in range(3))
        place = self.rows.place() * _STEP
        back = np.argsort(self.rows.column(3), kind="stable") if self.layout.rows else slice(None)
        found, at = [], self.layout.first
        time, host_time = time[back], host_time[back]
        for bit, column in enumerate(self.layout.signals):
            value = self.rows.columns(at, at + column.width)
            at += column.width
            array = SignalArray(
                time,
                value[back],
                (place + bit)[back],
                host_time,
                ((marked >> np.uint64(bit)) & np.uint64(1)).astype(bool)[back],
                quantity=column.quantity,
                unit=column.unit,
                frame=column.frame,
                clock=column.clock,
                stream=self.layout.stream,
                source=column.source,
            )
            found.append((column.index, column.name, array))
        self.rows.clear()
        return found


class Content:
    """Takes the parts of a file in order.

    Attributes:
        events: so far; the caller may take them away.
        metadata: section -> key -> text.
        unreadable: messages that could not be decoded.
        messages: so far.
    """

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.unreadable = 0
        self.messages = 0
        self._schemas: dict[int, str] = {}
        self._told: dict[int, Any] = {}  # channel records, to notice another one with the same number
        self._blocks: dict[int, _BlockChannel] = {}
        self._streams: dict[int, _StreamChannel] = {}
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
        """Schemas and channels; the first word on a number counts as long as it stays the same."""
        for record in records:
            if not hasattr(record, "topic"):
                self._schemas[record.id] = record.name
            elif self._told.get(record.id) != record:
                self._told[record.id] = record
                self._channel(record)

    def _channel(self, record: Any) -> None:
        name = self._schemas.get(record.schema_id, "")
        for known in (self._blocks, self._streams, self._kinds):
            known.pop(record.id, None)
        try:
            if name.startswith("crazyem.log."):
                block = schemas.block_from_metadata(record.metadata)
                if len(block.variables) > MOST_FIELDS:
                    raise ValueError("too many variables")
                number = record.metadata.get("session", "1")
                session = int(number) if number.isdecimal() and len(number) < 6 else 1
                rows = _Rows(schemas.BlockCodec(block).table())
                self._blocks[record.id] = _BlockChannel(block, session, rows)
            elif name.startswith("crazyem.signals."):
                layout = StreamLayout.from_metadata(record.metadata)
                self._streams[record.id] = _StreamChannel(layout, _Rows(layout.messages))
            elif name in _KINDS and record.topic == EVENTS[_KINDS[name]][0]:
                self._kinds[record.id] = (_KINDS[name], schemas.message_class(name))
            elif name == OTHER_EVENTS[1]:
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
                self.unreadable += known.rows.add(scan.data, messages[mine], places[mine])
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
        """Session -> tables of its log blocks; their rows are handed over, not kept."""
        sessions: dict[int, list[Table]] = {}
        for channel in self._blocks.values():
            sessions.setdefault(channel.session, []).append(channel.table())
        return dict(sorted(sessions.items()))

    def streams(self) -> dict[str, SignalArray]:
        """Signals of an imported recording, in its order; their rows are handed over, not kept."""
        found = [entry for channel in self._streams.values() for entry in channel.signals()]
        return {name: array for _, name, array in sorted(found, key=lambda e: e[0])}


def join(sessions: Iterable[Mapping[str, SignalArray]]) -> dict[str, SignalArray]:
    """The signals of several sessions, one after the other; a stream that changed is named after both."""
    joined: dict[str, SignalArray] = {}
    after = 0
    for signals in sessions:
        for name, unmoved in signals.items():
            array = _moved(unmoved, after)
            before = joined.get(name)
            joined[name] = array if before is None else _appended(before, array)
        after = max((int(a.order.max()) + 1 for a in joined.values() if a.order.size), default=0)
    return joined


def _moved(array: SignalArray, after: int) -> SignalArray:
    if not after or not array.order.size:
        return array
    return replace(array, order=array.order + after)


def _appended(a: SignalArray, b: SignalArray) -> SignalArray:
    stream = a.stream if a.stream == b.stream else f"{a.stream}, {b.stream}"
    width = min(a.value.shape[1], b.value.shape[1])
    return replace(
        a,
        time=np.concatenate([a.time, b.time]),
        value=np.concatenate([a.value[:, :width], b.value[:, :width]]),
        order=np.concatenate([a.order, b.order]),
        host_time=np.concatenate([a.host_time, b.host_time]),
        marked=np.concatenate([a.marked, b.marked]),
        stream=stream,
        source=tuple(dict.fromkeys((*a.source, *b.source))) if a.source != b.source else a.source,
    )
