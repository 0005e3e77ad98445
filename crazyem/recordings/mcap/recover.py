"""Recover a damaged MCAP file of any program: copy every complete chunk to a new, valid file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.atomic_file import new_file
from crazyem.errors import FileFormatError, UsageError
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap.output import Output
from crazyem.recordings.mcap.schemas import PROFILE


@dataclass
class Report:
    """Result of a recovery.

    Attributes:
        profile: of the file, "" if its header is damaged.
        messages, chunks, metadata, attachments: numbers of recovered records.
        lost_messages: by the sequence numbers; None for a file of another program.
        problems: the bytes that could not be used, by offset.
        closed: whether the file was complete.
    """

    profile: str = ""
    messages: int = 0
    chunks: int = 0
    metadata: int = 0
    attachments: int = 0
    lost_messages: int | None = None
    problems: list[mcap_scan.Problem] = field(default_factory=list)

    @property
    def closed(self) -> bool:
        return not any(p.loss in (mcap_scan.Loss.CUT, mcap_scan.Loss.OPEN) for p in self.problems)

    @property
    def lost_bytes(self) -> int:
        return sum(p.end - p.offset for p in self.problems)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        problems = [{"kind": str(p.loss), "offset": p.offset, "end": p.end, "text": p.why} for p in self.problems]
        return {**vars(self), "lost_bytes": self.lost_bytes, "closed": self.closed, "problems": problems}

    def __str__(self) -> str:
        lines = [f"{self.messages} messages in {self.chunks} chunks recovered"]
        if self.lost_messages:
            lines.append(f"{self.lost_messages} messages lost")
        lines += [f"byte {p.offset} to {p.end}: {p.why}" for p in self.problems if p.loss is not mcap_scan.Loss.OPEN]
        return "\n".join(lines)


def recover(source: str | Path, target: str | Path, *, replace: bool = False) -> Report:
    """Write all readable data of an MCAP file to a new file, with new index and statistics.

    Args:
        source: a file of any profile; it is not changed.
        target: another file.
        replace: an existing target may be replaced.

    Raises: UsageError (no such file, target exists or cannot be written), FileFormatError (no MCAP file, or nothing in
        it that can be read).
    """
    source, target = Path(source), Path(target)
    if not source.is_file():
        raise UsageError(f"{source}: no such file.")
    if target.exists() and target.samefile(source):
        raise UsageError(f"{target} is the damaged file itself; it was left as it is.")
    with new_file(target, force=replace) as temporary:
        with source.open("rb") as stream:
            head = stream.read(4096)
        if not head.startswith(mcap_scan.MCAP_MAGIC):
            raise FileFormatError(f"{source} is not an MCAP file.")
        with temporary.open("wb") as stream:
            report = _copy(source, head, Output(stream))
        if not report.messages:
            where = f" (byte {report.problems[0].offset}: {report.problems[0].why})" if report.problems else ""
            raise FileFormatError(f"{source}: not one message can be recovered{where}.")
    return report


def _copy(source: Path, head: bytes, output: Output) -> Report:
    profile = mcap_scan.profile_of(head)
    report = Report(profile=profile or "")
    output.start(report.profile, "crazyem recover")
    # the summary repeats announcements that may be lost in a damaged chunk
    known = {(type(r).__name__, r.id): r for r in mcap_scan.from_summary(source)[0]}
    seen: set[tuple[str, int]] = set()
    summary = False
    newest = lost = 0  # sequence numbers are consecutive in a whole file of crazyem
    for part in mcap_scan.parts(source, report.problems):
        summary = summary or part.record.opcode == mcap_scan.DATA_END
        for entry in part.announced:
            if not summary:
                output.book.announce(entry)
                seen.add((type(entry).__name__, entry.id))
        if part.scan is not None:
            _restore(output, part, known, seen)
            _messages(output, part, report)
            numbers = part.scan.messages[:, 5]
            if numbers.size:
                lost += max(int(numbers[0]) - newest - 1, 0)
                newest = int(numbers[-1])
        elif part.record.opcode == mcap_scan.METADATA:
            record = mcap_scan.parse(mcap_scan.METADATA, part.record.data)
            if record is not None:
                output.metadata(record.name, record.metadata)
                report.metadata += 1
        elif part.record.opcode == mcap_scan.ATTACHMENT:
            with source.open("rb") as stream:
                stream.seek(part.record.offset + mcap_scan.HEAD.size)
                record = mcap_scan.parse(mcap_scan.ATTACHMENT, stream.read(part.record.end - stream.tell()))
            if record is not None:
                output.attachment(record)
                report.attachments += 1
    report.lost_messages = lost if report.profile == PROFILE else None
    output.finish()
    return report


def _restore(
    output: Output, part: mcap_scan.Part, known: dict[tuple[str, int], Any], seen: set[tuple[str, int]]
) -> None:
    """Announce, from the summary, channels and schemas that this part needs and no earlier part has announced."""
    assert part.scan is not None
    needed = []
    for channel in set(part.scan.messages[:, 2].tolist()):
        entry = known.get(("Channel", channel))
        if entry is None or ("Channel", channel) in seen:
            continue
        schema = known.get(("Schema", entry.schema_id))
        if schema is not None and ("Schema", schema.id) not in seen:
            needed.append(schema)
        needed.append(entry)
    for entry in needed:
        seen.add((type(entry).__name__, entry.id))
        output.book.announce(entry)
    if needed:
        output.announce_again()


def _messages(output: Output, part: mcap_scan.Part, report: Report) -> None:
    """Copy a chunk byte for byte; records outside chunks, and a part of a chunk, are written as a chunk."""
    assert part.scan is not None
    scan, book = part.scan, output.book
    known = [c.id for c in book.channels.values() if c.schema_id == 0 or c.schema_id in book.schemas]
    defined = np.isin(scan.messages[:, 2], known)  # messages of announced channels, which a reader can decode
    messages = scan.messages[defined]
    if not defined.all():
        why = f"{int((~defined).sum())} messages of channels that nothing announces any more"
        report.problems.append(mcap_scan.Problem(mcap_scan.Loss.DAMAGED, part.record.offset, part.record.end, why))
    if not len(messages):
        output.announce_again()
        return
    report.messages += len(messages)
    report.chunks += 1
    if part.chunk is not None and defined.all():
        chunk = part.chunk
        output.flush_announcements()
        output.chunk(
            chunk.compression, bytes(chunk.packed), size=chunk.size, crc=chunk.crc, index=mcap_scan.index_of(messages)
        )
        return
    output.announce_again()
    for at, length, channel, log_time, published, sequence in messages.tolist():
        data = scan.data[at : at + length].tobytes()
        output.message(channel, log_time % 2**64, data, sequence=sequence, publish_time=published % 2**64)
    output.flush()
