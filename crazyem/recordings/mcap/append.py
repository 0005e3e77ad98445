"""Continue an existing recording without loss; its summary is rebuilt from its records.

The summary at the end of a finished file repeats information from its chunks. So the next session overwrites the
summary and begins where the data end. A crash at any moment leaves a file that ends after complete chunks, which all
readers here accept. The first write of the new session is the first change of the file.
"""

from pathlib import Path
from typing import Any

from mcap.records import Channel, MetadataIndex

from crazyem.errors import FileFormatError
from crazyem.recordings.mcap.output import Book, index_record, note_chunk
from crazyem.recordings.mcap.scan import (
    DATA_END,
    HEAD,
    MCAP_MAGIC,
    MESSAGE_INDEX,
    METADATA,
    Loss,
    Part,
    Problem,
    index_of,
    parse,
    parts,
    profile_of,
)
from crazyem.recordings.mcap.schemas import PROFILE, session_of


def reopen(path: Path) -> "Continued":
    """Open a finished or cut-off recording of crazyem to continue it.

    Raises: FileFormatError for a file of another program, an imported recording, or damage before the end; OSError.
    """
    with path.open("rb") as head:
        if profile_of(head.read(4096)) != PROFILE:
            raise FileFormatError(f"{path} is not a recording of crazyem and cannot be continued.")
    problems: list[Problem] = []
    found = Continued()
    for part in parts(path, problems):
        if part.record.opcode == DATA_END:
            break
        found.take(part)
    damaged = next((p for p in problems if p.loss is Loss.DAMAGED), None)
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
        self.book, self.offset = Book(), len(MCAP_MAGIC)
        self.sequence, self.sessions = 0, 1
        self._chunk: Part | None = None
        self._indexes: dict[int, bytes] = {}

    @property
    def log_time(self) -> int:
        """The latest log time [ns]."""
        return min(self.book.end or 0, 2**63 - 1)

    def take(self, part: Part) -> None:
        """The next part of the file."""
        record = part.record
        if record.opcode == MESSAGE_INDEX:
            channel = int.from_bytes(record.data[:2], "little")
            self._indexes[channel] = HEAD.pack(record.opcode, len(record.data)) + record.data
        else:
            self.close_chunk()
        self.offset = record.end
        for entry in part.announced:
            self.book.announce(entry)
            if isinstance(entry, Channel):
                self.sessions = max(self.sessions, session_of(entry.metadata))
        if part.chunk is not None:
            self._chunk = part
        if part.scan is not None and part.scan.messages.size:
            self.sequence = int(part.scan.messages[-1, 5])
        if record.opcode == METADATA:
            metadata = parse(METADATA, record.data)
            if metadata is not None:
                entry = MetadataIndex(length=record.end - record.offset, name=metadata.name, offset=record.offset)
                self.book.metadata.append(entry)

    def close_chunk(self) -> bytes:
        """Enter the last chunk in the book; returns its index records if the file does not have all of them."""
        part, indexes = self._chunk, self._indexes
        self._chunk, self._indexes = None, {}
        if part is None or part.chunk is None or part.scan is None:
            return b""
        record, chunk = part.record, part.chunk
        index = index_of(part.scan.messages)
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
