"""Write any recording as MCAP of crazyem: one channel per stream, exact signals, in processing order.

`mcap.file.read` returns the same recording: times, values, host times and marks bit for bit; units, frames, clocks and
sources; events, findings and metadata. docs/reference/formats/mcap.md describes the channels.
"""

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.atomic_file import new_file
from crazyem.recordings.columns import entry_of
from crazyem.recordings.finding import Grade
from crazyem.recordings.mcap import schemas
from crazyem.recordings.mcap.output import Output
from crazyem.recordings.mcap.stream_codec import MOST_FIELDS, MOST_SIGNALS, Column, StreamLayout, unique_name
from crazyem.recordings.recording import Event, Recording, SignalArray
from crazyem.recordings.topics import ranks

_EPOCH_RANGE = (9.0e8, 4.2e9)  # s; stamps between 1998 and 2103 count as times since 1970
_BLOCK_ROWS = 1 << 14  # messages prepared together; bounds the memory used besides the recording
_LOG_LEVELS = {Grade.HARMLESS: 2, Grade.DEGRADES: 3, Grade.UNUSABLE: 4}  # of foxglove.Log


def write_recording(recording: Recording, path: str | Path, *, replace: bool = False) -> None:
    """Write a recording as MCAP, completely or not at all.

    Args:
        recording: from any reader.
        path: the file.
        replace: an existing file may be replaced.

    Raises: UsageError if the file exists or cannot be written.
    """
    with new_file(Path(path), force=replace) as temporary, temporary.open("wb") as stream:
        _write(recording, Output(stream))


def _write(recording: Recording, output: Output) -> None:
    output.start(schemas.PROFILE, f"crazyem {schemas.versions()['crazyem']}")
    own = {
        **schemas.versions(),
        "origin": repr(float(recording.origin)),
        "source": recording.source,
        "path": recording.path,
        "findings": schemas.findings_to_json(recording.findings),
    }
    output.metadata(schemas.IMPORT_METADATA, own)
    for section, entries in recording.metadata.items():
        output.metadata(section, entries)
    # place of each sample among all samples of the recording, in processing order
    places = dict(zip(recording.signals, ranks([array.order for array in recording.signals.values()]), strict=True))
    streams = [_Stream(output, group) for group in _groups(recording.signals, places)]
    clock = _Clock(recording, streams)
    extras = [*_poses(output, recording, places, clock), *_events(output, recording, clock), *_notes(output, recording)]
    _write_merged(output, streams, extras, clock)
    output.finish()


# --- which signals share messages -------------------------------------------------------------------------------------


@dataclass
class _Group:
    """Signals of one stream whose samples were taken and processed together, row by row."""

    stream: str
    base: NDArray[np.int64]  # (n,) places of the samples of the first signal in the processing order
    members: list[tuple[str, int, SignalArray]] = field(default_factory=list)  # name, place in the recording, array

    def takes(self, array: SignalArray, rank: NDArray[np.int64]) -> bool:
        """Whether `array` fits into the same messages, after the present arrays."""
        width = array.value.shape[1] + sum(a.value.shape[1] for *_, a in self.members)
        if len(self.members) >= MOST_SIGNALS or width > MOST_FIELDS:
            return False
        mine = self.members[0][2]
        return (
            array.time.size == mine.time.size
            and np.array_equal(rank, self.base + len(self.members))
            and _same_bits(array.time, mine.time)
            and _same_bits(array.host_time, mine.host_time)
        )


def _same_bits(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    if a is b:
        return True
    return np.array_equal(np.ascontiguousarray(a).view(np.int64), np.ascontiguousarray(b).view(np.int64))


def _groups(signals: Mapping[str, SignalArray], places: Mapping[str, NDArray[np.int64]]) -> list[_Group]:
    """Groups in order of their first sample, which is the order of the channels."""
    index = {name: i for i, name in enumerate(signals)}
    groups: list[_Group] = []
    for name in sorted(signals, key=lambda n: (int(places[n][0]) if places[n].size else -1, index[n])):
        array = signals[name]
        # only the newest group of a stream: its signals are neighbours in the processing order
        newest = next((g for g in reversed(groups) if g.stream == array.stream), None)
        if newest is None or not newest.takes(array, places[name]):
            newest = _Group(array.stream, places[name])
            groups.append(newest)
        newest.members.append((name, index[name], array))
    return groups


class _Stream:
    """A group as a channel: encodes any of its rows."""

    def __init__(self, output: Output, group: _Group) -> None:
        taken = {topic.removeprefix("/signals/") for topic in (c.topic for c in output.book.channels.values())}
        # rows in processing order; if the arrays have another order, each message contains its row
        self.rows = np.argsort(group.base, kind="stable")
        shuffled = not np.array_equal(self.rows, np.arange(self.rows.size))
        self.arrays = [array for *_, array in group.members]
        self.keys = group.base[self.rows].astype(float)
        self.layout = StreamLayout(
            identifier=unique_name(group.stream or "table", taken),
            stream=group.stream,
            signals=tuple(
                Column(n, i, entry_of(n, a).components, a.quantity, a.unit, a.frame, a.clock, a.source)
                for n, i, a in group.members
            ),
            rows=shuffled,
        )
        schema = output.schema(self.layout.schema_name, "protobuf", self.layout.schema_data())
        topic = f"/signals/{self.layout.identifier}"
        self.channel = output.channel(topic, "protobuf", schema, self.layout.metadata())

    def contents(self) -> Iterator[bytes]:
        """The content of each message, in processing order."""
        for first in range(0, self.rows.size, _BLOCK_ROWS):
            rows = self.rows[first : first + _BLOCK_ROWS]
            marked = np.zeros(rows.size, np.uint64)
            for bit, array in enumerate(self.arrays):
                marked |= array.marked[rows].astype(np.uint64) << np.uint64(bit)
            columns: list[NDArray[Any]] = [self.arrays[0].time[rows], self.arrays[0].host_time[rows], marked]
            columns += [rows] if self.layout.rows else []
            columns += [column for array in self.arrays for column in array.value[rows].T]
            yield from map(bytes, self.layout.messages.encode(columns))


# --- times and order in the file --------------------------------------------------------------------------------------


class _Clock:
    """Log times [ns]: host times if known, else source times since 1970, else source times shifted to be >= 0."""

    def __init__(self, recording: Recording, streams: Sequence[_Stream]) -> None:
        times = [s.arrays[0].time for s in streams if s.arrays[0].time.size]
        least = min((float(np.nanmin(t)) for t in times if np.isfinite(t).any()), default=0.0)
        self.host_known = any(np.isfinite(s.arrays[0].host_time).any() for s in streams)
        epoch = _EPOCH_RANGE[0] <= least + recording.origin <= _EPOCH_RANGE[1]
        self.shift = recording.origin if epoch else -min(least, 0.0)

    def of(self, time: NDArray[np.float64], host_time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log times [ns], NaN if unknown."""
        with np.errstate(over="ignore", invalid="ignore"):  # huge stamps become infinite and are clipped when written
            return (host_time if self.host_known else time + self.shift) * 1e9


@dataclass
class _Extra:
    """A message beside the samples; `key` is its place among them, NaN: placed by its `log_time` [ns, 0: unknown]."""

    channel: int
    data: bytes
    log_time: int
    key: float = math.nan
    publish: int | None = None  # time of publication [ns], None: as `log_time` in the file


def _write_merged(output: Output, streams: Sequence[_Stream], extras: Sequence[_Extra], clock: _Clock) -> None:
    """Write all messages in one order, in chunks; sequence numbers are consecutive in the file."""
    key = np.concatenate([np.empty(0), *(s.keys for s in streams)])
    times = [clock.of(s.arrays[0].time[s.rows], s.arrays[0].host_time[s.rows]) for s in streams]
    time = np.concatenate([np.empty(0), *times])
    running = _running(time[np.argsort(key)])
    ordered = np.sort(key)
    newest = 0
    for extra in extras:
        if math.isnan(extra.key):
            newest = max(newest, extra.log_time)
            place = int(np.searchsorted(running, np.uint64(newest)))
            extra.key = float(ordered[place]) - 0.5 if place < key.size else math.inf
    extras = sorted(extras, key=lambda e: e.key)
    which = np.concatenate([np.full(s.keys.size, i) for i, s in enumerate(streams)] + [np.full(len(extras), -1)])
    order = np.argsort(np.concatenate([key, [e.key for e in extras]]), kind="stable")
    which = which[order]
    log_times = _running(np.concatenate([time, [e.log_time or math.nan for e in extras]])[order])
    contents, others = [s.contents() for s in streams], iter(extras)
    for first in range(0, which.size, _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        for number, i, stamp in zip(itertools.count(first + 1), which[rows].tolist(), log_times[rows].tolist()):
            if i >= 0:
                output.message(streams[i].channel, stamp, next(contents[i]), sequence=number, publish_time=stamp)
            else:
                extra = next(others)
                publish = stamp if extra.publish is None else extra.publish
                output.message(extra.channel, stamp, extra.data, sequence=number, publish_time=publish)


def _running(time: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Log times that never decrease, from times in ns with gaps (NaN)."""
    known = np.where(np.isfinite(time), np.clip(time, 0.0, 9.0e18), 0.0)
    if not known.size:
        return np.empty(0, np.uint64)
    finite = known[np.isfinite(time)]
    known[0] = known[0] if math.isfinite(time[0]) or not finite.size else finite[0]
    return np.maximum.accumulate(known).astype(np.uint64)


# --- what else is in the file -----------------------------------------------------------------------------------------


def _channel(output: Output, topic: str, schema_name: str) -> int:
    for known in output.book.channels.values():
        if known.topic == topic:
            return known.id
    schema = output.schema(schema_name, "protobuf", schemas.schema_data(schema_name))
    return output.channel(topic, "protobuf", schema)


def _poses(
    output: Output, recording: Recording, places: Mapping[str, NDArray[np.int64]], clock: _Clock
) -> list[_Extra]:
    """foxglove.PoseInFrame and FrameTransform at 25 Hz, for the 3D panels of viewers; never read back."""
    position, attitude = recording.signals.get("position"), recording.signals.get("attitude")
    if position is None or attitude is None or not position.time.size or not attitude.time.size:
        return []
    if position.value.shape[1] != 3 or attitude.value.shape[1] != 4:
        return []
    whole = np.asarray(np.isfinite(attitude.value).all(axis=1))
    turns = np.argsort(places["attitude"])
    turns = turns[whole[turns]]
    log_times = clock.of(position.time, position.host_time)
    known = places["attitude"][turns]
    extras, newest = [], -math.inf
    for row in np.argsort(places["position"]).tolist():
        time = float(position.time[row])
        if not abs(time - newest) >= schemas.POSE_PERIOD:
            continue
        # the latest attitude at the position, or the next sample in processing order
        at = int(np.searchsorted(known, places["position"][row] + 1, side="right")) - 1
        if at < 0 or not np.isfinite(position.value[row]).all():
            continue
        newest = time
        stamp = log_times[row] if math.isfinite(log_times[row]) else 0.0
        rotation = dict(zip("xyzw", attitude.value[turns[at]].tolist(), strict=True))
        translation = dict(zip("xyz", position.value[row].tolist(), strict=True))
        nanoseconds = int(min(max(stamp, 0.0), 9.0e18))
        key = float(places["position"][row]) + 0.25
        for topic, schema, fields in schemas.pose_messages(nanoseconds, translation, rotation):
            extras.append(_Extra(_channel(output, topic, schema), schemas.encode(schema, fields), nanoseconds, key))
    return extras


def _events(output: Output, recording: Recording, clock: _Clock) -> list[_Extra]:
    """Events as messages of their own kind if this is lossless, else as JSON."""
    extras = []
    for event in recording.events:
        topic, schema = schemas.EVENT_TOPICS.get(event.kind, schemas.OTHER_EVENT_TOPIC)
        data = _native(event)
        if data is None:
            topic, schema = schemas.OTHER_EVENT_TOPIC
            fields = {"time": event.time, "kind": event.kind, "json": json.dumps(dict(event.data), default=str)}
            data = schemas.encode(schema, fields)
        stamp = _nanoseconds(event.time)
        shown = stamp if clock.host_known or clock.shift > _EPOCH_RANGE[0] else 0
        extras.append(_Extra(_channel(output, topic, schema), data, shown, publish=stamp))
    return extras


def _native(event: Event) -> bytes | None:
    """The event as a message of its own kind, None if this would lose data."""
    if event.kind not in schemas.EVENT_TOPICS or _nanoseconds(event.time) / 10**9 != event.time:
        return None
    schema = schemas.EVENT_TOPICS[event.kind][1]
    try:
        data = schemas.encode(schema, event.data)
        same = repr(schemas.fields_of(schemas.message_class(schema).FromString(data))) == repr(dict(event.data))
    except (TypeError, ValueError, AttributeError):
        return None
    return data if same else None


def _nanoseconds(seconds: float) -> int:
    """Seconds as exact ns, clipped to the range of log times; 0 for NaN or infinity."""
    return min(max(round(Fraction(seconds) * 10**9), 0), 2**63 - 1) if math.isfinite(seconds) else 0


def _notes(output: Output, recording: Recording) -> list[_Extra]:
    """Findings as log messages for viewers; the reader uses those in the metadata."""
    extras = []
    for finding in recording.findings:
        fields = {
            "timestamp": {},
            "level": _LOG_LEVELS[finding.grade],
            "message": f"{finding.signal}: {finding.text}" if finding.signal else finding.text,
            "name": finding.check,
        }
        channel = _channel(output, schemas.FINDINGS_TOPIC, "foxglove.Log")
        extras.append(_Extra(channel, schemas.encode("foxglove.Log", fields), log_time=0))
    return extras
