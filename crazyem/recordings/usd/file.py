"""Logs of the Crazyflie's uSD card deck, versions 1 and 2: a table for each event, read to the last whole record."""

import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings import motor_meaning
from crazyem.recordings.contents import contents
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.usd.format import LETTERS, STAMPS, EventType, Header, parse_header, plausible
from crazyem.recordings.usd.records import Records, gather, locate

_CRC_BYTES = 4
_DAMAGE_ADVICE = "Copy the file from the card again; what stands before the place named was read."


def recognises(head: bytes) -> bool:
    """True if a file starting with these bytes is one: the files have no extension, only a magic byte and a header."""
    return plausible(head)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a log: signals of stream "fixedFrequency" and of each other event, on the firmware's clock.

    Time is the stamp in seconds, as the file has it (`origin` is 0). Events without variables become `Event`s, whose
    time is on the firmware's clock too: the file has no other.

    Raises: FileFormatError if the header makes no sense or not a single whole record follows it.
    """
    data = contents(path)
    header = parse_header(data, path)
    checksum = _Checksum(data, header)
    records = locate(data, header.events, header.size, len(data) - (_CRC_BYTES if checksum.right else 0))
    if not records.start.size:
        raise FileFormatError(f"{path} has a header of {header.size} bytes and not a single whole record after it.")
    order = [np.flatnonzero(records.kind == kind) for kind in range(len(header.events))]
    packed = [gather(data, e, records.start[rows]) for e, rows in zip(header.events, order, strict=True)]
    time = _times(header, order, [p["stamp"] for p in packed])
    tables = tuple(
        _table(event, values, time[rows], rows)
        for event, values, rows in zip(header.events, packed, order, strict=True)
        if rows.size and event.variables
    )
    del packed
    verdict, findings = _integrity(data, header, records, checksum, float(time[-1]))
    metadata = {"usd": _metadata(header, order, verdict)}
    meaning = motor_meaning.decide(tables, given=options.motor, metadata=metadata)
    return Recording(
        str(path),
        f"usd:{header.version}",
        signals_from_tables(tables, motor=meaning.meaning),
        metadata | meaning.metadata,
        (*findings, *meaning.findings),
        _events(header, order, time),
    )


class _Checksum:
    """The last four bytes against the CRC-32 of everything before them."""

    def __init__(self, data: bytes, header: Header) -> None:
        room = len(data) >= header.size + _CRC_BYTES
        self.stored = int.from_bytes(data[-_CRC_BYTES:], "little") if room else None
        self.computed = zlib.crc32(memoryview(data)[:-_CRC_BYTES]) if room else None
        self.right = room and self.stored == self.computed


def _times(
    header: Header, order: list[NDArray[np.intp]], stamps: list[NDArray[np.unsignedinteger]]
) -> NDArray[np.float64]:
    """(n,) s of all records in file order; 32-bit stamps are continued where they wrap (49.7 days)."""
    kind, rate = STAMPS[header.version]
    merged = np.empty(sum(rows.size for rows in order), kind)
    for rows, stamp in zip(order, stamps, strict=True):
        merged[rows] = stamp
    if header.version == 1:
        steps = np.diff(merged).view(np.int32)  # modulo 2^32, so that a step back stays a step back
        return (int(merged[0]) + np.concatenate([[0], np.cumsum(steps, dtype=np.int64)])) / rate
    return merged / rate


def _table(event: EventType, values: NDArray[np.void], time: NDArray[np.float64], rows: NDArray[np.intp]) -> Table:
    return Table(
        event.name,
        {name: values[str(i)] for i, name in enumerate(event.variables)},
        time,
        rows.astype(np.int64, copy=False),
        ctypes={name: LETTERS[letter][1] for name, letter in zip(event.variables, event.letters, strict=True)},
    )


def _events(header: Header, order: list[NDArray[np.intp]], time: NDArray[np.float64]) -> tuple[Event, ...]:
    """Events that carry nothing but their time."""
    bare = [(i, event.name) for i, event in enumerate(header.events) if not event.variables]
    rows = sorted((int(row), name) for i, name in bare for row in order[i])
    return tuple(Event(float(time[row]), "log", {"name": name, "clock": "firmware"}) for row, name in rows)


def _metadata(header: Header, order: list[NDArray[np.intp]], verdict: str) -> dict[str, str]:
    section = {"version": str(header.version), "crc": verdict, "events": " ".join(e.name for e in header.events)}
    for event, rows in zip(header.events, order, strict=True):
        names = " ".join(f"{v}({t})" for v, t in zip(event.variables, event.letters, strict=True))
        section[f"records.{event.name}"] = str(rows.size)
        section[f"variables.{event.name}"] = names
    return section


def _integrity(
    data: bytes, header: Header, records: Records, checksum: _Checksum, last: float
) -> tuple[str, list[Finding]]:
    """What the checksum and the end of the file say: one word for the metadata, and findings."""
    left = len(data) - records.stop - (_CRC_BYTES if checksum.right else 0)
    evidence = {"offset_bytes": records.stop, "left_bytes": left, "last_s": last}
    if checksum.right and not left:
        return "ok", []
    if checksum.right or (records.unknown is not None and left > _CRC_BYTES):
        what = "is cut off" if records.unknown is None else f"is of the unknown event {records.unknown}"
        text = (
            f"Damaged: the record at byte {records.stop} {what}; {left} bytes from there on were not read "
            f"(the last record read is at {last:.3f} s)."
        )
        finding = Finding("integrity", Grade.DEGRADES, text, evidence=evidence, advice=_DAMAGE_ADVICE)
        return ("ok" if checksum.right else "wrong"), [finding]
    # four bytes that do not start a record are a checksum; fewer, or the start of a record, are a cut
    if left == _CRC_BYTES and records.unknown is not None:
        text = (
            f"The CRC is wrong: the file says {checksum.stored:08x}, its bytes give {checksum.computed:08x}; "
            "at least one byte is not what was written."
        )
        evidence = {"stored": float(checksum.stored or 0), "computed": float(checksum.computed or 0)}
        finding = Finding(
            "integrity", Grade.DEGRADES, text, evidence=evidence, advice="Copy the file from the card again."
        )
        return "wrong", [finding]
    text = (
        f"The file was cut off (power lost while logging?): there is no CRC, {left} bytes are left over after "
        f"the last whole record at {last:.3f} s."
    )
    return "missing", [Finding("integrity", Grade.HARMLESS, text, evidence=evidence)]
