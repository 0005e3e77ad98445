"""Read a whole or damaged MCAP file record by record; locate lost bytes.

The reader trusts no number in the file: it checks lengths against the file and against each other, unpacks chunks into
a bounded buffer and checks their CRC. After invalid bytes it continues at the next chunk.
Format: https://mcap.dev/spec (version 0).
"""

import io
import math
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, UsageError

MCAP_MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 64 * 1024 * 1024  # bytes unpacked; chunks of crazyem have a quarter MiB, damaged lengths may be huge
LARGEST_RECORD = 64 * 1024 * 1024  # bytes of any record but chunks and attachments
MOST_DEFINITIONS = 100_000  # schemas and channels in one chunk; no sound file has more

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = 8, 9, 10, 11, 12, 13
SUMMARY_OFFSET, DATA_END = 14, 15

HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
_WINDOW_BYTES = 1024 * 1024
# where a chunk may begin: opcode, length, times, size, CRC, compression, length of what follows
_CHUNK_START = re.compile(rb"(?s)\x06(?=.{36}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{8})")


class Loss(StrEnum):
    """Why bytes of a file could not be used."""

    CUT = "cut"  # the file ends in the middle of a record
    DAMAGED = "damaged"  # bytes have changed since they were written
    OPEN = "open"  # only the end is missing: the writer was stopped


@dataclass(frozen=True, slots=True)
class Problem:
    """Bytes `offset` to `end` of the file that could not be used, with the reason."""

    loss: Loss
    offset: int
    end: int
    why: str


@dataclass(frozen=True, slots=True)
class Record:
    """A record at the top level of a file: its offset, the offset of the next record, and its content.

    The content of attachments is left out: `data` is empty.
    """

    offset: int
    end: int
    opcode: int
    data: bytes


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """The fields of a chunk record; times in ns."""

    start: int
    end: int
    size: int
    crc: int
    compression: str
    packed: memoryview


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """The records of an unpacked chunk."""

    data: NDArray[np.uint8]  # (b,) bytes of the chunk
    # (n, 6) in order: offset of the payload in `data`, its length, channel, log time, publish time [ns, both unsigned,
    # stored in signed numbers], sequence
    messages: NDArray[np.int64]
    others: NDArray[np.int64]  # (m, 3) opcode, offset of the content, length


def records(stream: BinaryIO, problems: list[Problem]) -> Iterator[Record]:
    """The records between the magic bytes, with the summary; unreadable bytes are appended to `problems`.

    Only the lengths in chunks are checked here; `unpack` checks the rest.
    """
    size = stream.seek(0, 2)
    offset = len(MCAP_MAGIC)
    closed = False
    while offset < size:
        stream.seek(offset)
        head = stream.read(HEAD.size)
        if closed and head[: len(MCAP_MAGIC)] == MCAP_MAGIC and size - offset == len(MCAP_MAGIC):
            return
        opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (head[0], size)
        end = offset + HEAD.size + length
        data = None
        if end <= size and _plausible(opcode, length):
            data = b"" if opcode == ATTACHMENT else stream.read(length)
            if not _consistent(opcode, data):
                data = None
        if data is None:
            found = _next_chunk(stream, offset + 1, size)
            if found is None and end > size and (0 < opcode <= DATA_END or len(head) < HEAD.size):
                problems.append(Problem(Loss.CUT, offset, size, "the file ends in the middle of a record"))
                return
            problems.append(Problem(Loss.DAMAGED, offset, found or size, "the bytes are no record"))
            if found is None:
                return
            offset = found
            continue
        closed = opcode == FOOTER
        yield Record(offset, end, opcode, data)
        offset = end
    problems.append(Problem(Loss.OPEN, size, size, "the recording was not closed"))


# opcode -> least and greatest length of a record, where not 0 and `LARGEST_RECORD`
_LENGTHS: dict[int, tuple[int, float]] = {
    CHUNK: (_CHUNK_HEAD.size + 8, math.inf),
    MESSAGE: (22, LARGEST_RECORD),
    DATA_END: (4, 4),
    FOOTER: (20, 20),
    ATTACHMENT: (36, math.inf),
}


def _plausible(opcode: int, length: int) -> bool:
    least, most = _LENGTHS.get(opcode, (0, LARGEST_RECORD))
    return (0 < opcode <= DATA_END or opcode >= 0x80) and least <= length <= most


def _consistent(opcode: int, data: bytes) -> bool:
    """Whether the lengths inside a record agree with the length of the record."""
    try:
        compression = parse_chunk(data).compression
    except ValueError:
        compression = None
    if opcode == CHUNK or compression in ("", "lz4", "zstd"):  # any other record is a chunk with a damaged opcode
        return opcode == CHUNK and compression is not None
    if opcode == MESSAGE_INDEX:
        return len(data) >= 6 and int.from_bytes(data[2:6], "little") == len(data) - 6
    name = int.from_bytes(data[:4], "little")
    return opcode != METADATA or int.from_bytes(data[4 + name : 8 + name], "little") == len(data) - 8 - name


def _next_chunk(stream: BinaryIO, offset: int, size: int) -> int | None:
    """Offset of the next complete chunk record with consistent lengths; None if there is none."""
    overlap = 64
    while offset < size:
        stream.seek(offset)
        window = stream.read(_WINDOW_BYTES + overlap)
        for match in _CHUNK_START.finditer(window):
            at = match.start()
            length = int.from_bytes(window[at + 1 : at + 9], "little")
            name = int.from_bytes(window[at + 37 : at + 41], "little")
            inner = int.from_bytes(window[at + 41 + name : at + 49 + name], "little")
            if length == _CHUNK_HEAD.size + name + 8 + inner and offset + at + HEAD.size + length <= size:
                return offset + at
        offset += _WINDOW_BYTES
    return None


def parse_chunk(data: bytes) -> PackedChunk:
    """The fields of a chunk record. Raises ValueError if its lengths do not agree."""
    if len(data) < _CHUNK_HEAD.size + 8:
        raise ValueError("a chunk is too short")
    start, end, size, crc, name = _CHUNK_HEAD.unpack_from(data)
    at = _CHUNK_HEAD.size + name + 8
    if name > 16 or len(data) < at or int.from_bytes(data[at - 8 : at], "little") != len(data) - at:
        raise ValueError("the lengths in a chunk do not agree")
    try:
        compression = data[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name].decode("ascii")
    except UnicodeDecodeError as error:
        raise ValueError("a chunk does not name its compression") from error
    return PackedChunk(start, end, size, crc, compression, memoryview(data)[at:])


def unpack(chunk: PackedChunk) -> bytes:
    """The records of a chunk, unpacked and checked. Raises ValueError, with the reason."""
    if chunk.size > LARGEST_CHUNK:
        raise ValueError(f"a chunk claims {chunk.size} bytes, more than {LARGEST_CHUNK}")
    try:
        data = _unpacked(chunk)
    except (RuntimeError, EOFError, MemoryError, zstandard.ZstdError) as error:
        raise ValueError("a chunk does not unpack") from error
    if len(data) != chunk.size:
        raise ValueError("a chunk does not unpack to its size")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise ValueError("the CRC of a chunk does not match")
    return data


def _unpacked(chunk: PackedChunk) -> bytes:
    """The chunk unpacked, at most one byte more than its claimed size, which shows that the claim is false."""
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=2 * LARGEST_CHUNK)
        with decompressor.stream_reader(chunk.packed, read_across_frames=True) as reader:
            return reader.read(chunk.size + 1)
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(bytes(chunk.packed), max_length=chunk.size + 1))
    if chunk.compression == "":
        return bytes(chunk.packed)
    raise ValueError(f"unknown compression {chunk.compression!r}")


def scan(data: bytes) -> Scan:
    """The records in the bytes of a chunk. Raises ValueError where they make no sense."""
    from crazyem.recordings.mcap.kernel import chunk_records  # numba takes a second to import

    array = np.frombuffer(data, np.uint8)
    count, definitions = chunk_records(array, np.empty((0, 6), np.int64), np.empty((0, 3), np.int64))
    if count < 0 or definitions > MOST_DEFINITIONS:
        raise ValueError("the records in a chunk make no sense")
    messages, others = np.empty((count, 6), np.int64), np.empty((definitions, 3), np.int64)
    chunk_records(array, messages, others)
    return Scan(array, messages, others)


# unpacked size over file size (beyond 64 MiB); more is a decompression bomb, flights have 2 to 5
LARGEST_UNPACKED_RATIO = 100
_BATCH_BYTES = 256 * 1024  # bytes of records outside chunks that form one part


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A chunk, or records outside chunks."""

    record: Record  # the first record
    scan: Scan | None = None  # messages of a chunk or of a run of records outside chunks; None for anything else
    chunk: PackedChunk | None = None  # the packed chunk of the file, None outside chunks
    announced: list[Any] = field(default_factory=list)  # its schemas and channels (records of the mcap library)


def parts(path: Path, problems: list[Problem], *, most: int | None = None) -> Iterator[Part]:
    """All readable parts of a file in order; unreadable bytes are appended to `problems`.

    Args:
        most: largest unpacked size of all chunks [bytes]; None: `LARGEST_UNPACKED_RATIO` times the file, and a chunk.

    Raises: UsageError if the file cannot be opened, FileFormatError for a decompression bomb.
    """
    try:
        with path.open("rb") as stream:
            if most is None:
                most = LARGEST_CHUNK + LARGEST_UNPACKED_RATIO * path.stat().st_size
            yield from _parts(path, stream, problems, most)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def _parts(path: Path, stream: BinaryIO, problems: list[Problem], most: int) -> Iterator[Part]:
    loose: list[Record] = []
    unpacked = waiting = 0
    for record in records(stream, problems):
        outside = record.opcode in (SCHEMA, CHANNEL, MESSAGE)
        if outside:
            loose.append(record)
            waiting += record.end - record.offset
        if loose and (waiting >= _BATCH_BYTES or not outside):
            yield from _loose(loose, problems)
            loose, waiting = [], 0
        if outside:
            continue
        if record.opcode != CHUNK:
            yield Part(record)
            continue
        try:
            chunk = parse_chunk(record.data)
            unpacked += min(chunk.size, LARGEST_CHUNK)
            if unpacked > most:
                raise FileFormatError(f"{path} unpacks to more than {most} bytes; it is no recording of a flight.")
            found = scan(unpack(chunk))
        except ValueError as error:
            problems.append(Problem(Loss.DAMAGED, record.offset, record.end, str(error)))
            continue
        yield Part(record, found, chunk, _announced(found))
    if loose:
        yield from _loose(loose, problems)


def _loose(loose: list[Record], problems: list[Problem]) -> Iterator[Part]:
    data = b"".join(HEAD.pack(r.opcode, len(r.data)) + r.data for r in loose)
    whole = Record(loose[0].offset, loose[-1].end, loose[0].opcode, b"")
    try:
        found = scan(data)
    except ValueError as error:
        problems.append(Problem(Loss.DAMAGED, whole.offset, whole.end, str(error)))
        return
    yield Part(whole, found, None, _announced(found))


def _announced(found: Scan) -> list[Any]:
    content = [(opcode, found.data[at : at + length].tobytes()) for opcode, at, length in found.others.tolist()]
    return [record for entry in content if (record := parse(*entry)) is not None]


_KINDS: dict[int, Any] = {
    HEADER: mcap_records.Header,
    FOOTER: mcap_records.Footer,
    SCHEMA: mcap_records.Schema,
    CHANNEL: mcap_records.Channel,
    STATISTICS: mcap_records.Statistics,
    METADATA: mcap_records.Metadata,
    ATTACHMENT: mcap_records.Attachment,
}


def parse(opcode: int, data: bytes) -> Any:
    """A record of the mcap library (schema, channel, metadata, header, footer), None if the bytes are invalid."""
    try:
        return _KINDS[opcode].read(ReadDataStream(io.BytesIO(data)))
    except (McapError, ValueError, EOFError, OverflowError, struct.error):
        return None


def profile_of(head: bytes) -> str | None:
    """The profile from the header record in the first bytes of an MCAP file; None without one."""
    start = len(MCAP_MAGIC) + HEAD.size
    if not head.startswith(MCAP_MAGIC) or len(head) < start + 4 or head[len(MCAP_MAGIC)] != HEADER:
        return None
    length = int.from_bytes(head[start : start + 4], "little")
    return head[start + 4 : start + 4 + length].decode("utf-8", "replace") if length < 1024 else None


def from_summary(path: Path) -> tuple[list[Any], dict[int, int]]:
    """Schemas and channels in the summary of a file, and the number of messages by channel; empty without summary."""
    tail = HEAD.size + 20 + len(MCAP_MAGIC)
    found: list[Any] = []
    counts: dict[int, int] = {}
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(max(0, size - tail))
            end = stream.read()
            footer: Any = parse(FOOTER, end[HEAD.size :]) if end.endswith(MCAP_MAGIC) else None
            start = footer.summary_start if footer is not None else 0
            if not 0 < start <= size - tail or size - start > LARGEST_RECORD:
                return [], {}
            stream.seek(start)
            data = stream.read(size - start - tail)
            if footer.summary_crc and zlib.crc32(end[: HEAD.size + 16], zlib.crc32(data)) != footer.summary_crc:
                return [], {}
    except OSError:
        return [], {}
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        content = data[at + HEAD.size : at + HEAD.size + length]
        if opcode in (SCHEMA, CHANNEL) and len(content) == length:
            found.append(parse(opcode, content))
        elif opcode == STATISTICS and len(content) == length:
            statistics = parse(opcode, content)
            counts = statistics.channel_message_counts if statistics is not None else {}
        at += HEAD.size + length
    if sum(counts.values()) * MESSAGE_HEAD.size > LARGEST_UNPACKED_RATIO * size:
        counts = {}  # more than can be in the file
    return [record for record in found if record is not None], counts


def index_of(messages: NDArray[np.int64]) -> dict[int, NDArray[np.uint64]]:
    """Channel -> (n, 2) log time [ns] and offset of each message record, from `Scan.messages`."""
    index = {}
    for channel in np.unique(messages[:, 2]).tolist():
        mine = messages[messages[:, 2] == channel]
        index[channel] = np.column_stack([mine[:, 3], mine[:, 0] - 31]).astype(np.uint64)
    return index
