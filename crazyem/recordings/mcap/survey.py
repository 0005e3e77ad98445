"""The contents of an MCAP file, part by part: unpacked and checked chunks, schemas and channels, losses."""

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, UsageError
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap.scan import HEAD, MCAP_MAGIC, MESSAGE_HEAD, Loss, PackedChunk, Problem, Record, Scan

# unpacked size over file size (beyond 64 MiB); more is a decompression bomb, flights have 2 to 5
LARGEST_UNPACKED_RATIO = 100
_BATCH_BYTES = 256 * 1024  # bytes of records outside chunks that form one part


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A chunk, or records outside chunks.

    Attributes:
        record: the first record.
        scan: messages of a chunk or of a run of records outside chunks; None for anything else.
        chunk: the packed chunk of the file, None outside chunks.
        announced: its schemas and channels (records of the mcap library).
    """

    record: Record
    scan: Scan | None = None
    chunk: PackedChunk | None = None
    announced: list[Any] = field(default_factory=list)


def parts(path: Path, problems: list[Problem], *, most: int | None = None) -> Iterator[Part]:
    """All readable parts of a file in order; unreadable bytes are appended to `problems`.

    Args:
        most: largest unpacked size of all chunks [bytes]; None: `LARGEST_UNPACKED_RATIO` times the file, and a chunk.

    Raises: UsageError if the file cannot be opened, FileFormatError for a decompression bomb.
    """
    try:
        with path.open("rb") as stream:
            if most is None:
                most = mcap_scan.LARGEST_CHUNK + LARGEST_UNPACKED_RATIO * path.stat().st_size
            yield from _parts(path, stream, problems, most)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def _parts(path: Path, stream: BinaryIO, problems: list[Problem], most: int) -> Iterator[Part]:
    loose: list[Record] = []
    unpacked = waiting = 0
    for record in mcap_scan.records(stream, problems):
        outside = record.opcode in (mcap_scan.SCHEMA, mcap_scan.CHANNEL, mcap_scan.MESSAGE)
        if outside:
            loose.append(record)
            waiting += record.end - record.offset
        if loose and (waiting >= _BATCH_BYTES or not outside):
            yield from _loose(loose, problems)
            loose, waiting = [], 0
        if outside:
            continue
        if record.opcode != mcap_scan.CHUNK:
            yield Part(record)
            continue
        try:
            chunk = mcap_scan.parse_chunk(record.data)
            unpacked += min(chunk.size, mcap_scan.LARGEST_CHUNK)
            if unpacked > most:
                raise FileFormatError(f"{path} unpacks to more than {most} bytes; it is no recording of a flight.")
            scan = mcap_scan.scan(mcap_scan.unpack(chunk))
        except ValueError as error:
            problems.append(Problem(Loss.DAMAGED, record.offset, record.end, str(error)))
            continue
        yield Part(record, scan, chunk, _announced(scan))
    if loose:
        yield from _loose(loose, problems)


def _loose(loose: list[Record], problems: list[Problem]) -> Iterator[Part]:
    data = b"".join(HEAD.pack(r.opcode, len(r.data)) + r.data for r in loose)
    whole = Record(loose[0].offset, loose[-1].end, loose[0].opcode, b"")
    try:
        scan = mcap_scan.scan(data)
    except ValueError as error:
        problems.append(Problem(Loss.DAMAGED, whole.offset, whole.end, str(error)))
        return
    yield Part(whole, scan, None, _announced(scan))


def _announced(scan: Scan) -> list[Any]:
    found = []
    for opcode, offset, length in scan.others.tolist():
        record = parse(opcode, scan.data[offset : offset + length].tobytes())
        if record is not None:
            found.append(record)
    return found


def parse(opcode: int, data: bytes) -> Any:
    """A record of the mcap library (schema, channel, metadata, header, footer), None if the bytes are invalid."""
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    kinds: dict[int, Any] = {
        mcap_scan.HEADER: records.Header,
        mcap_scan.FOOTER: records.Footer,
        mcap_scan.SCHEMA: records.Schema,
        mcap_scan.CHANNEL: records.Channel,
        mcap_scan.STATISTICS: records.Statistics,
        mcap_scan.METADATA: records.Metadata,
        mcap_scan.ATTACHMENT: records.Attachment,
    }
    try:
        return kinds[opcode].read(ReadDataStream(io.BytesIO(data)))
    except (McapError, ValueError, EOFError, OverflowError, struct.error):
        return None


def profile_of(head: bytes) -> str | None:
    """The profile from the header record in the first bytes of an MCAP file; None without one."""
    start = len(MCAP_MAGIC) + HEAD.size
    if not head.startswith(MCAP_MAGIC) or len(head) < start + 4 or head[len(MCAP_MAGIC)] != mcap_scan.HEADER:
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
            footer: Any = parse(mcap_scan.FOOTER, end[HEAD.size :]) if end.endswith(MCAP_MAGIC) else None
            start = footer.summary_start if footer is not None else 0
            if not 0 < start <= size - tail or size - start > mcap_scan.LARGEST_RECORD:
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
        if opcode in (mcap_scan.SCHEMA, mcap_scan.CHANNEL) and len(content) == length:
            found.append(parse(opcode, content))
        elif opcode == mcap_scan.STATISTICS and len(content) == length:
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
