"""Reading our own recordings (MCAP), whole or cut off: every complete chunk counts, in the order it was written."""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.recordings import schemas
from crazyem.recordings.finding import note
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.packets import signals_from_packets
from crazyem.recordings.recording import Event, Recording
from crazyem.signals.packet import Block, Packet

MAGIC = b"\x89MCAP0\r\n"
_LARGEST_CHUNK = 256 * 1024 * 1024  # bytes unpacked; ours are a quarter MiB, a damaged length claims anything

_KINDS = {
    "crazyem.Setpoint": "setpoint",
    "crazyem.ParameterWrite": "parameter_write",
    "crazyem.Estimate": "estimate",
    "foxglove.Log": "log",
}


def recognises(head: bytes) -> bool:
    """True if the file starts with MCAP's magic bytes."""
    return head.startswith(MAGIC)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read one of our recordings; a cut-off or damaged one as far as it goes, which `notices` then says.

    Raises: FileFormatError if it holds no log data of ours.
    """
    notices: list[str] = []
    content = _Content()
    for record in _records(path.read_bytes(), notices):
        content.take(record)
    if not content.blocks:
        what = f"it was cut off before its first log data ({notices[0]})" if notices else "it holds no log blocks"
        raise FileFormatError(f"{path} is an MCAP file, but not a usable recording: {what.rstrip('.')}.")
    signals = signals_from_packets(content.blocks.values(), content.packets)
    if not signals:
        raise FileFormatError(f"{path} is a recording without a single sample of a known signal.")
    if content.unreadable:
        notices.append(f"{content.unreadable} messages could not be decoded and were dropped.")
    return Recording(
        str(path),
        "mcap",
        signals,
        content.metadata,
        tuple(note("integrity", n) for n in notices),
        tuple(content.events),
    )


class _Content:
    """What the records of a file add up to."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.codecs: dict[int, schemas.BlockCodec] = {}
        self.kinds: dict[int, tuple[str, Any]] = {}
        self.blocks: dict[int, Block] = {}
        self.packets: list[Packet] = []
        self.events: list[Event] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.unreadable = 0

    def take(self, record: Any) -> None:
        kind = type(record).__name__
        if kind == "Message":
            self._message(record)
        elif kind == "Schema":
            self.schemas[record.id] = record.name
        elif kind == "Channel":
            self._channel(record)
        elif kind == "Metadata":
            self.metadata.setdefault(record.name, {}).update(record.metadata)

    def _channel(self, record: Any) -> None:
        name = self.schemas.get(record.schema_id, "")
        if name.startswith("crazyem.log."):
            if record.id not in self.codecs:
                try:
                    block = schemas.block_from_metadata(record.metadata)
                except (ValueError, KeyError, TypeError):
                    self.unreadable += 1
                    return
                self.codecs[record.id] = schemas.BlockCodec(block)
                self.blocks[block.identifier] = block
        elif name in _KINDS:
            self.kinds[record.id] = (_KINDS[name], schemas.message_class(name))

    def _message(self, record: Any) -> None:
        codec = self.codecs.get(record.channel_id)
        try:
            if codec is not None:
                self.packets.append(codec.decode(record.data))
            elif record.channel_id in self.kinds:
                kind, message = self.kinds[record.channel_id]
                self.events.append(Event(record.log_time / 1e9, kind, _fields(message.FromString(record.data))))
        except Exception:  # protobuf's DecodeError has no public base across its back ends
            self.unreadable += 1


def _fields(message: Any) -> dict[str, object]:
    """All fields of a message by name; nested messages as dictionaries, NaN for an echo that never came kept."""
    result: dict[str, object] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            result[field.name] = value
        elif isinstance(value, (list, tuple)) or hasattr(value, "add"):
            result[field.name] = [_fields(item) for item in value]
        else:
            result[field.name] = _fields(value)
    return result


def _records(data: bytes, notices: list[str]) -> Iterator[Any]:
    """Schemas, channels, messages and metadata in file order, up to where the file ends or breaks."""
    from mcap.records import Chunk, DataEnd
    from mcap.stream_reader import StreamReader, breakup_chunk

    reader = StreamReader(io.BytesIO(data), emit_chunks=True, record_size_limit=max(1, len(data)))
    records = reader.records
    damaged = 0
    while True:
        try:
            record = next(records)
        except StopIteration:
            break
        except Exception as error:  # struct, unicode, mcap's own: a broken file may raise anything
            notices.append(_ending(error))
            break
        if not isinstance(record, Chunk):
            if isinstance(record, DataEnd):
                break  # what follows is a summary of what we have seen
            yield record
            continue
        try:
            if record.uncompressed_size > _LARGEST_CHUNK:
                raise ValueError("chunk too large")
            inner = breakup_chunk(record, validate_crc=True)
        except Exception:
            damaged += 1
            continue
        yield from inner
    if damaged:
        notices.append(f"{damaged} damaged stretches of the file were left out.")


def _ending(error: Exception) -> str:
    cut = isinstance(error, (EOFError, struct.error)) or type(error).__name__ in (
        "EndOfFile",
        "RecordLengthLimitExceeded",
    )
    if cut:
        return "The file ends in the middle of a record; everything before it was read."
    return "The file is damaged towards its end; everything before that was read."
