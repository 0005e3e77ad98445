"""Read logs of the uSD card deck (Crazyflie), versions 1 and 2: one table per event, up to the last whole record."""

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings import motor_meaning
from crazyem.recordings.contents import ReadOptions, pieces
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.motor_meaning import MOTOR_VARIABLES
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.usd import format as usd_format

CRC_BYTES = 4
_READ_BYTES = 1 << 22  # bytes read at a time
_LONGEST_HEADER = 1 << 27  # bytes; more than the limits of usd/format.py allow
STRETCH_BYTES = 1 << 26  # bytes of records in a part, at any length in time
_SAMPLED_ROWS = 1 << 19  # rows that decide the meaning of motor.m1..4

Packed = list[NDArray[np.void]]  # records of each kind
_Piece = tuple[NDArray[np.float64], NDArray[np.uint16], Packed]  # times and kinds in file order, records of each kind


def recognises(head: bytes) -> bool:
    """True if these first bytes have the form of a log header with a named first event."""
    if len(head) < 8 or head[0] != usd_format.USD_MAGIC:
        return False
    version, count = struct.unpack_from("<HH", head, 1)
    name = head[7 : 7 + usd_format.LONGEST_NAME].split(b"\0", 1)[0]
    return (
        0 < version < 16
        and 0 < count <= usd_format.MOST_EVENTS
        and name.isascii()
        and name.decode("ascii").isprintable()
    )


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a log: signals of stream "fixedFrequency" and of each other event, on the firmware's clock.

    Time is the stamp of the file in seconds (`origin` is 0). Events without variables become `Event`s, with times on
    the same firmware clock, the only clock of the file.

    Raises: FileFormatError if the header is invalid or no whole record follows it.
    """
    return next(_recordings(path, options, seconds=math.inf, largest=math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive parts of at least `seconds` of a log, in bounded memory; joined they equal the result of `read`.

    The file is read twice. The first pass gives the checksum, the number of records of each kind, and the meaning of
    motor.m1..4 (from evenly spread rows if there are many). All parts have all signals, some perhaps empty, and the
    metadata of the whole log. The first part has the findings about motors, the last those about the end of the file.

    Raises: as `read`, with the first part.
    """
    return _recordings(path, options, seconds=seconds, largest=STRETCH_BYTES)


def _recordings(path: Path, options: ReadOptions, *, seconds: float, largest: float) -> Iterator[Recording]:
    """A recording for each stretch of at least `seconds`, or of `largest` bytes of records if earlier."""
    survey = Survey(path)
    header = survey.header
    if not sum(survey.counts):
        raise FileFormatError(f"{path} has a header of {header.size} bytes and not a single whole record after it.")
    verdict = survey.integrity(last=0.0)[0]
    metadata = {"usd": _metadata(header, survey.counts, verdict)}
    meaning = motor_meaning.decide(survey.tables(), given=options.motor, metadata=metadata)
    findings = meaning.findings
    for part in stretches(survey, seconds, largest):
        tables = [
            usd_format.table(event, values, part.time[rows], part.first + rows)
            for event, values, rows, count in zip(header.events, part.packed, part.order, survey.counts, strict=True)
            if count and event.variables
        ]
        if part.ends:
            findings = (*survey.integrity(last=float(part.time[-1]))[1], *findings)
        yield Recording(
            str(path),
            f"usd:{header.version}",
            signals_from_tables(tables, motor=meaning.meaning),
            metadata | meaning.metadata,
            findings,
            _events(header, part.order, part.time),
        )
        findings = ()


def _events(
    header: usd_format.Header, order: Sequence[NDArray[np.intp]], time: NDArray[np.float64]
) -> tuple[Event, ...]:
    """Events without variables."""
    bare = [(i, event.name) for i, event in enumerate(header.events) if not event.variables]
    rows = sorted((int(row), name) for i, name in bare for row in order[i])
    return tuple(Event(float(time[row]), "log", {"name": name, "clock": "firmware"}) for row, name in rows)


def _metadata(header: usd_format.Header, counts: Sequence[int], verdict: str) -> dict[str, str]:
    """The section "usd": data of the header, number of records of each kind, result of the CRC check."""
    section = {"version": str(header.version), "crc": verdict, "events": " ".join(e.name for e in header.events)}
    for event, count in zip(header.events, counts, strict=True):
        names = " ".join(f"{v}({t})" for v, t in zip(event.variables, event.letters, strict=True))
        section[f"records.{event.name}"] = str(count)
        section[f"variables.{event.name}"] = names
    return section


class Survey:
    """Result of a pass over the whole file, without its records.

    Attributes:
        header: of the file.
        size: of the file, unpacked [bytes].
        stored, computed: the last four bytes, and the CRC-32 of everything before them.
        right: whether they are equal, and the file has room for them.
        blank: first byte of the unwritten end: of the run of one of `BLANK_BYTES` that ends the file.
        stop, unknown: end of the last whole record and the event id there, as in `Records`.
        counts: number of records of each kind.

    Raises: FileFormatError if the header is invalid or the file cannot be unpacked; UsageError if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header = _header(path)
        self.counts = [0] * len(self.header.events)
        self.unknown: int | None = None
        self.stop = self.header.size
        samples = {k: _Sample() for k, e in enumerate(self.header.events) if set(MOTOR_VARIABLES) <= set(e.variables)}
        tail = b""
        self.size, computed = 0, 0
        blanks = dict.fromkeys(usd_format.BLANK_BYTES, 0)  # blank byte -> end of the last other byte
        for piece in pieces(path, _READ_BYTES):
            blanks = {b: self.size + len(r) if (r := piece.rstrip(b)) else at for b, at in blanks.items()}
            self.size += len(piece)
            tail += piece
            computed = zlib.crc32(memoryview(tail)[:-CRC_BYTES], computed)
            tail = tail[-CRC_BYTES:]
        room = self.size >= self.header.size + CRC_BYTES
        self.stored, self.computed = int.from_bytes(tail, "little"), computed
        self.right = room and self.stored == self.computed
        self.blank = self.size if self.right else min(blanks.values())
        for begin, data, records in _walk(self):
            self.stop, self.unknown = begin + records.stop, records.unknown
            for k, sample in samples.items():
                sample.add(usd_format.gather(data, self.header.events[k], records.start[records.order[k]]))
            self.counts = [n + rows.size for n, rows in zip(self.counts, records.order, strict=True)]
        self._samples = {k: sample.rows(self.header.events[k].layout) for k, sample in samples.items()}

    def integrity(self, *, last: float) -> tuple[str, list[Finding]]:
        """Result of the checksum and of the end of the file: one word for the metadata, and findings.

        Args:
            last: time of the last record [s].
        """
        stop, unknown, right = self.stop, self.unknown, self.right
        left = self.size - stop - (CRC_BYTES if right else 0)
        if right and not left:
            return "ok", []
        evidence = {"offset_bytes": float(stop), "left_bytes": float(left), "last_s": last}
        verdict, grade, advice = "missing", Grade.HARMLESS, ""
        if not right and self.blank <= stop and left > CRC_BYTES:
            text = (
                f"From byte {stop} on there are only bytes that nobody wrote (0xFF of erased flash, or 0): "
                f"{left} bytes were not read (the last record read is at {last:.3f} s; power lost while logging?)."
            )
        elif right or (unknown is not None and left > CRC_BYTES):
            verdict, grade = "ok" if right else "wrong", Grade.DEGRADES
            advice = "Copy the file from the card again; what stands before the place named was read."
            what = "is cut off" if unknown is None else f"is of the unknown event {unknown}"
            text = (
                f"Damaged: the record at byte {stop} {what}; {left} bytes from there on were not read "
                f"(the last record read is at {last:.3f} s)."
            )
        elif left == CRC_BYTES and unknown is not None:  # four bytes that start no record are a checksum
            verdict, grade, advice = "wrong", Grade.DEGRADES, "Copy the file from the card again."
            evidence = {"stored": float(self.stored), "computed": float(self.computed)}
            text = (
                f"The CRC is wrong: the file says {self.stored:08x}, its bytes give {self.computed:08x}; "
                "at least one byte is not what was written."
            )
        else:
            text = (
                f"The file was cut off (power lost while logging?): there is no CRC, {left} bytes are left over after "
                f"the last whole record at {last:.3f} s."
            )
        return verdict, [Finding("integrity", grade, text, evidence=evidence, advice=advice)]

    def tables(self) -> list[Table]:
        """The tables of the file, with sampled rows if they have motor.m1..4, else without rows."""
        result = []
        for k, (event, count) in enumerate(zip(self.header.events, self.counts, strict=True)):
            if count and event.variables:
                rows = self._samples.get(k, np.empty(0, event.layout))
                result.append(usd_format.table(event, rows, np.zeros(rows.size), np.arange(rows.size)))
        return result


class _Sample:
    """Every k-th of the added records; k doubles when the sample becomes too large."""

    def __init__(self) -> None:
        self.step, self.count, self.held = 1, 0, 0
        self.kept: list[NDArray[np.void]] = []

    def add(self, records: NDArray[np.void]) -> None:
        self.kept.append(records[-self.count % self.step :: self.step].copy())
        self.count += records.size
        self.held += self.kept[-1].size
        while self.held > _SAMPLED_ROWS:
            self.kept = [np.concatenate(self.kept)[::2].copy()]
            self.held = self.kept[0].size
            self.step *= 2

    def rows(self, layout: np.dtype[np.void]) -> NDArray[np.void]:
        return np.concatenate([np.empty(0, layout), *self.kept])


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Consecutive records."""

    first: int  # number of the first record in the file
    time: NDArray[np.float64]  # (n,) s
    order: Sequence[NDArray[np.intp]]  # rows of each kind among these records
    packed: Packed  # records of each kind
    ends: bool  # True if no others follow


def stretches(survey: Survey, seconds: float, largest: float = STRETCH_BYTES) -> Iterator[Stretch]:
    """The records of a file in stretches of at least `seconds`, or of `largest` bytes if earlier."""
    header = survey.header
    total, first, begin, held_bytes = sum(survey.counts), 0, 0.0, 0
    clock = usd_format.Clock(header)
    held: list[_Piece] = []
    rows = 0
    for _, data, records in _walk(survey):
        order = records.order
        packed = [usd_format.gather(data, e, records.start[r]) for e, r in zip(header.events, order, strict=True)]
        time = clock.seconds(order, [p["stamp"] for p in packed])
        at = 0
        while at < time.size:
            begin = begin if held else float(time[at])
            late = np.flatnonzero(time[at:] - begin >= seconds)
            end = at + int(late[0]) + 1 if late.size else time.size
            spans = [slice(*np.searchsorted(rows_of_kind, (at, end))) for rows_of_kind in order]
            mine = [p[span] for p, span in zip(packed, spans, strict=True)]
            held.append((time[at:end], records.kind[at:end], mine))
            rows += end - at
            held_bytes += sum(p.nbytes for p in mine)
            at = end
            ends = first + rows == total
            if late.size or held_bytes >= largest or ends:
                yield _joined(header, held, first, ends)
                first, rows, held, held_bytes = first + rows, 0, [], 0
    if held:  # the file became shorter during reading
        yield _joined(header, held, first, True)


def _joined(header: usd_format.Header, held: list[_Piece], first: int, ends: bool) -> Stretch:
    kind = np.concatenate([k for _, k, _ in held])
    packed = []
    for number, event in enumerate(header.events):
        # joining bytes is faster than joining fields
        parts = [p[number].view(np.uint8) for _, _, p in held if p[number].size]
        packed.append((np.concatenate(parts) if parts else np.empty(0, np.uint8)).view(event.layout))
    order = [np.flatnonzero(kind == number) for number in range(len(header.events))]
    return Stretch(first, np.concatenate([t for t, _, _ in held]), order, packed, ends)


def _walk(survey: Survey) -> Iterator[tuple[int, bytes, usd_format.Records]]:
    """For each piece of the file: (its offset, its bytes, the whole records in it)."""
    header = survey.header
    end = survey.size - (CRC_BYTES if survey.right else 0)
    data, begin = b"", 0  # a piece of the file and its offset
    skip = header.size
    for piece in pieces(survey.path, _READ_BYTES):
        data += piece
        if len(data) <= skip:
            continue
        records = usd_format.locate(data, header.events, skip, min(len(data), end - begin), survey.blank - begin)
        yield begin, data, records
        if records.unknown is not None or begin + records.stop >= survey.blank:
            return
        data, begin, skip = data[records.stop :], begin + records.stop, 0


def _header(path: Path) -> usd_format.Header:
    data = b""
    for piece in pieces(path, _READ_BYTES):
        data += piece
        try:
            return usd_format.parse_header(data, path)
        except FileFormatError:
            if len(data) > _LONGEST_HEADER:
                raise
    return usd_format.parse_header(data, path)
