"""Write MCAP records: chunks of bounded size, their indexes, and the summary; also into an existing file.

Differences to mcap.writer, whose record types are used: chunks stay below their limit, a file can be continued, and
schemas and channels are repeated every few chunks (so that a damaged chunk does not make other chunks unreadable).
"""

import errno
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.mcap import scan
from crazyem.recordings.mcap.schemas import PROFILE, session_of

# a chunk is closed before it grows beyond this; a single larger message makes a larger chunk
CHUNK_BYTES = 256 * 1024
ANNOUNCE_EVERY = 20  # chunks


@dataclass
class Book:
    """Contents of the summary of a file: collected while writing, or rebuilt from a file."""

    schemas: dict[int, records.Schema] = field(default_factory=dict)  # schemas, channels: by identifier
    channels: dict[int, records.Channel] = field(default_factory=dict)
    # chunks, attachments, metadata: index entries with places in the file
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)  # messages of each channel
    start: int | None = None  # start, end: log times of the first and last message [ns], None without messages
    end: int | None = None

    def announce(self, record: records.Schema | records.Channel) -> None:
        """Enter a schema or channel of the file; the first one with a number counts."""
        known: dict[int, Any] = self.channels if isinstance(record, records.Channel) else self.schemas
        known.setdefault(record.id, record)


class Output:
    """An MCAP file being written.

    Args:
        stream: opened for writing, at the place of the next record; stays open.
        book, offset: of a continued file: its contents and the place of the next record [bytes].

    Raises: OSError of the stream.
    """

    def __init__(self, stream: BinaryIO, *, book: Book | None = None, offset: int = 0) -> None:
        self.book = book or Book()
        self._stream, self._offset = stream, offset
        self._buffer = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._since = 0  # chunks since the last repetition of all announcements

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._offset += len(data)

    def start(self, profile: str, library: str) -> None:
        """Magic bytes and header of a new file."""
        self._put(scan.MCAP_MAGIC + _bytes(records.Header(profile, library)))

    # --- announcements ------------------------------------------------------------------------------------------

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Announce a schema; returns its identifier, the same for the same schema."""
        for known in self.book.schemas.values():
            if (known.name, known.encoding, known.data) == (name, encoding, data):
                return known.id
        schema = records.Schema(id=max(self.book.schemas, default=0) + 1, name=name, encoding=encoding, data=data)
        self.book.schemas[schema.id] = schema
        self._buffer += _bytes(schema)
        return schema.id

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None) -> int:
        """Announce a channel; returns its new identifier. Raises ValueError when all 65535 are taken."""
        identifier = max(self.book.channels, default=0) + 1
        if identifier > 0xFFFF:
            raise ValueError("too many channels for one file")
        channel = records.Channel(identifier, topic, encoding, dict(metadata or {}), schema_id=schema)
        self.book.channels[identifier] = channel
        self._buffer += _bytes(channel)
        return identifier

    def _announcements(self) -> bytes:
        return b"".join(map(_bytes, (*self.book.schemas.values(), *self.book.channels.values())))

    def announce_again(self) -> None:
        """Repeat all announcements before the messages of the next chunk."""
        self._buffer[:] = self._announcements()

    def flush_announcements(self) -> None:
        """Write waiting announcements as records outside chunks, before a copied chunk."""
        if not self._index and self._buffer:
            self._put(bytes(self._buffer))
            self._buffer.clear()

    # --- messages -----------------------------------------------------------------------------------------------

    def message(self, channel: int, log_time: int, data: bytes, *, sequence: int, publish_time: int) -> None:
        """Write a message; times in ns since the epoch. Closes the chunk first if it would become too large."""
        head = scan.MESSAGE_HEAD.pack(
            scan.MESSAGE, 22 + len(data), channel, sequence & 0xFFFFFFFF, log_time, publish_time
        )
        record = head + data
        if self._index and len(self._buffer) + len(record) > CHUNK_BYTES:
            self.flush()
        self._index.setdefault(channel, []).append((log_time, self._place()))
        self._buffer += record

    def _place(self) -> int:
        """Offset of the next message in the chunk; first repeats the announcements if due."""
        if not self._index and self._since >= ANNOUNCE_EVERY:
            announcements = self._announcements()
            if len(announcements) <= CHUNK_BYTES // 4:
                self._buffer[:] = announcements
            self._since = 0
        return len(self._buffer)

    def flush(self, *, sync: bool = False) -> None:
        """Close the current chunk, if it has messages, and pass all data to the operating system.

        Args:
            sync: wait until the data are on the disk.
        """
        if self._index:
            self._close_chunk({c: np.array(pairs, np.uint64) for c, pairs in self._index.items()})
        self._stream.flush()
        if sync:
            try:
                os.fsync(self._stream.fileno())
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # not a disk: a pipe, a null device
                    raise

    def _close_chunk(self, index: Mapping[int, NDArray[np.uint64]]) -> None:
        raw = bytes(self._buffer)
        self._buffer.clear()
        self._index = {}
        self._since += 1
        self.chunk("zstd", zstandard.compress(raw), size=len(raw), crc=zlib.crc32(raw), index=index)

    def chunk(
        self, compression: str, packed: bytes, *, size: int, crc: int, index: Mapping[int, NDArray[np.uint64]]
    ) -> None:
        """Write a packed chunk, with its index: channel -> (n, 2) log time [ns] and offset in the unpacked chunk.

        Its schemas and channels must be announced already, or be in the chunk.
        """
        start, end = _span(index)
        record = _bytes(records.Chunk(compression, packed, end, start, uncompressed_crc=crc, uncompressed_size=size))
        offset = self._offset
        indexes = {channel: index_record(channel, pairs) for channel, pairs in index.items()}
        self._put(b"".join((record, *indexes.values())))
        note_chunk(self.book, offset, len(record), compression, len(packed), size, index, indexes)

    # --- beside the chunks --------------------------------------------------------------------------------------

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record at once, before the current chunk."""
        record = _bytes(records.Metadata(name=_text(name), metadata={_text(k): _text(v) for k, v in entries.items()}))
        self.book.metadata.append(records.MetadataIndex(offset=self._offset, length=len(record), name=_text(name)))
        self._put(record)

    def attachment(self, record: records.Attachment) -> None:
        """Write an attachment at once."""
        data = _bytes(record)
        entry = records.AttachmentIndex(
            offset=self._offset,
            length=len(data),
            log_time=record.log_time,
            create_time=record.create_time,
            data_size=len(record.data),
            name=record.name,
            media_type=record.media_type,
        )
        self.book.attachments.append(entry)
        self._put(data)

    def finish(self) -> None:
        """Write all waiting data and the summary; the file is then complete."""
        self.flush()
        self._put(_bytes(records.DataEnd(0)))
        self._put(_summary(self.book, self._offset) + scan.MCAP_MAGIC)
        self._stream.flush()


def note_chunk(
    book: Book,
    offset: int,
    length: int,
    compression: str,
    packed_size: int,
    size: int,
    index: Mapping[int, NDArray[np.uint64]],
    indexes: Mapping[int, bytes],
) -> None:
    """Enter a chunk at `offset` in the book; its index records follow the chunk in the order of `indexes`."""
    start, end = _span(index)
    places, at = {}, offset + length
    for channel, record in indexes.items():
        places[channel] = at
        at += len(record)
    book.chunks.append(
        records.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=packed_size,
            message_end_time=end,
            message_index_length=at - offset - length,
            message_index_offsets=places,
            message_start_time=start,
            uncompressed_size=size,
        )
    )
    for channel, pairs in index.items():
        book.counts[channel] = book.counts.get(channel, 0) + len(pairs)
    if index:
        book.start, book.end = min(start, start if book.start is None else book.start), max(end, book.end or 0)


def index_record(channel: int, pairs: NDArray[np.uint64]) -> bytes:
    """A message index record: (n, 2) log times [ns] and offsets in the unpacked chunk."""
    entries = pairs.astype("<u8").tobytes()
    content = channel.to_bytes(2, "little") + len(entries).to_bytes(4, "little") + entries
    return scan.HEAD.pack(scan.MESSAGE_INDEX, len(content)) + content


def _summary(book: Book, offset: int) -> bytes:
    statistics = records.Statistics(
        attachment_count=len(book.attachments),
        channel_count=len(book.channels),
        channel_message_counts=dict(book.counts),
        chunk_count=len(book.chunks),
        message_count=sum(book.counts.values()),
        message_end_time=book.end or 0,
        message_start_time=book.start or 0,
        metadata_count=len(book.metadata),
        schema_count=len(book.schemas),
    )
    groups: tuple[tuple[Opcode, Iterable[records.McapRecord]], ...] = (
        (Opcode.SCHEMA, book.schemas.values()),
        (Opcode.CHANNEL, book.channels.values()),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, book.chunks),
        (Opcode.ATTACHMENT_INDEX, book.attachments),
        (Opcode.METADATA_INDEX, book.metadata),
    )
    data, offsets = b"", b""
    for opcode, entries in groups:
        group = b"".join(map(_bytes, entries))
        if group:
            offsets += _bytes(records.SummaryOffset(opcode, group_length=len(group), group_start=offset + len(data)))
        data += group
    where = offset + len(data)
    data += offsets
    footer = _bytes(records.Footer(summary_crc=0, summary_offset_start=where, summary_start=offset))
    crc = zlib.crc32(footer[:-4], zlib.crc32(data))
    return data + footer[:-4] + crc.to_bytes(4, "little")


def _span(index: Mapping[int, NDArray[np.uint64]]) -> tuple[int, int]:
    times = [pairs[:, 0] for pairs in index.values() if len(pairs)]
    return (int(min(t.min() for t in times)), int(max(t.max() for t in times))) if times else (0, 0)


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _text(value: object) -> str:
    """Valid UTF-8 text: file names may contain other bytes."""
    return str(value).encode("utf-8", "replace").decode("utf-8")


def reopen(path: Path) -> "Continued":
    """Open a finished or cut-off recording of crazyem to continue it without loss.

    The summary at its end repeats information from its chunks. So the next session overwrites the summary and begins
    where the data end. A crash at any moment leaves a file that ends after complete chunks. The first write of the new
    session is the first change of the file.

    Raises: FileFormatError for a file of another program, an imported recording, or damage before the end; OSError.
    """
    with path.open("rb") as head:
        if scan.profile_of(head.read(4096)) != PROFILE:
            raise FileFormatError(f"{path} is not a recording of crazyem and cannot be continued.")
    problems: list[scan.Problem] = []
    found = Continued()
    for part in scan.parts(path, problems):
        if part.record.opcode == scan.DATA_END:
            break
        found.take(part)
    damaged = next((p for p in problems if p.loss is scan.Loss.DAMAGED), None)
    if damaged is not None:
        raise FileFormatError(f"{path} is damaged at byte {damaged.offset}; recover it before it is continued.")
    if any(channel.topic.startswith("/signals/") for channel in found.book.channels.values()):
        raise FileFormatError(f"{path} is an imported recording, to which no flight can be added.")
    missing = found.close_chunk()
    found.stream = _Tail(path, found.offset, missing)
    found.offset += len(missing)
    return found


class Continued:
    """A recording to continue, rebuilt from its records.

    Attributes:
        stream: positioned after the last complete record. offset: place of the next record [bytes].
        book: contents of the file so far.
        sequence: number of the last message.
        sessions: number of sessions in the file.
    """

    def __init__(self) -> None:
        self.stream: Any = None
        self.book, self.offset = Book(), len(scan.MCAP_MAGIC)
        self.sequence, self.sessions = 0, 1
        self._chunk: scan.Part | None = None
        self._indexes: dict[int, bytes] = {}

    @property
    def log_time(self) -> int:
        """The latest log time [ns]."""
        return min(self.book.end or 0, 2**63 - 1)

    def take(self, part: scan.Part) -> None:
        """The next part of the file."""
        record = part.record
        if record.opcode == scan.MESSAGE_INDEX:
            channel = int.from_bytes(record.data[:2], "little")
            self._indexes[channel] = scan.HEAD.pack(record.opcode, len(record.data)) + record.data
        else:
            self.close_chunk()
        self.offset = record.end
        for entry in part.announced:
            self.book.announce(entry)
            if isinstance(entry, records.Channel):
                self.sessions = max(self.sessions, session_of(entry.metadata))
        if part.chunk is not None:
            self._chunk = part
        if part.scan is not None and part.scan.messages.size:
            self.sequence = int(part.scan.messages[-1, 5])
        if record.opcode == scan.METADATA:
            metadata = scan.parse(scan.METADATA, record.data)
            if metadata is not None:
                entry = records.MetadataIndex(
                    length=record.end - record.offset, name=metadata.name, offset=record.offset
                )
                self.book.metadata.append(entry)

    def close_chunk(self) -> bytes:
        """Enter the last chunk in the book; returns its index records if the file does not have all of them."""
        part, indexes = self._chunk, self._indexes
        self._chunk, self._indexes = None, {}
        if part is None or part.chunk is None or part.scan is None:
            return b""
        record, chunk = part.record, part.chunk
        index = scan.index_of(part.scan.messages)
        missing = b""
        if indexes.keys() != index.keys():
            indexes = {channel: index_record(channel, pairs) for channel, pairs in index.items()}
            missing = b"".join(indexes.values())
            self.offset = record.end
        note_chunk(
            self.book, record.offset, record.end - record.offset, chunk.compression, len(chunk.packed), chunk.size,
            index, indexes,
        )  # fmt: skip
        return missing


class _Tail:
    """A file for writing from `offset` on; the first write cuts the file there and writes `first` before its data."""

    def __init__(self, path: Path, offset: int, first: bytes) -> None:
        self._file = path.open("r+b")
        self._offset, self._first = offset, first
        self._begun = False

    def write(self, data: bytes) -> int:
        if not self._begun:
            self._file.truncate(self._offset)
            self._file.seek(self._offset)
            self._file.write(self._first)
            self._begun = True
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
