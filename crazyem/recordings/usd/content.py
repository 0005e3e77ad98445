"""Times, tables, events and metadata from the records of a uSD card log, and the check of its checksum."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Event
from crazyem.recordings.tables import Table
from crazyem.recordings.usd.format import STAMP_TYPES, TYPE_LETTERS, EventType, Header

CRC_BYTES = 4
_DAMAGE_ADVICE = "Copy the file from the card again; what stands before the place named was read."


@dataclass(frozen=True, slots=True)
class Checksum:
    """The last four bytes against the CRC-32 of everything before them; None where the file has no room for one."""

    stored: int | None
    computed: int | None

    @property
    def right(self) -> bool:
        return self.stored is not None and self.stored == self.computed


class Clock:
    """Stamps of all records in file order as seconds; 32-bit stamps are continued where they wrap (49.7 days)."""

    def __init__(self, header: Header) -> None:
        self.kind, self.rate = STAMP_TYPES[header.version]
        self.wraps = header.version == 1
        self._last: tuple[int, int] | None = None  # the last stamp: raw and continued

    def seconds(
        self, order: Sequence[NDArray[np.intp]], stamps: Sequence[NDArray[np.unsignedinteger]]
    ) -> NDArray[np.float64]:
        """(n,) s of the next records, from the rows and the stamps of each kind."""
        merged = np.empty(sum(rows.size for rows in order), self.kind)
        for rows, stamp in zip(order, stamps, strict=True):
            merged[rows] = stamp
        if not self.wraps or not merged.size:
            return merged / self.rate
        before, value = self._last or (int(merged[0]), int(merged[0]))
        with np.errstate(over="ignore"):
            # signed difference modulo 2^32: a step back remains a step back
            steps = np.diff(merged, prepend=np.uint32(before)).view(np.int32)
        continued = value + np.cumsum(steps, dtype=np.int64)
        self._last = int(merged[-1]), int(continued[-1])
        return continued / self.rate


def table(event: EventType, values: NDArray[np.void], time: NDArray[np.float64], rows: NDArray[np.integer]) -> Table:
    """Records of one kind as a table; `time` and `rows` are their times and places among all records."""
    return Table(
        event.name,
        {name: values[str(i)] for i, name in enumerate(event.variables)},
        time,
        rows.astype(np.int64, copy=False),
        ctypes={name: TYPE_LETTERS[letter][1] for name, letter in zip(event.variables, event.letters, strict=True)},
    )


def events(header: Header, order: Sequence[NDArray[np.intp]], time: NDArray[np.float64]) -> tuple[Event, ...]:
    """Events without variables."""
    bare = [(i, event.name) for i, event in enumerate(header.events) if not event.variables]
    rows = sorted((int(row), name) for i, name in bare for row in order[i])
    return tuple(Event(float(time[row]), "log", {"name": name, "clock": "firmware"}) for row, name in rows)


def metadata(header: Header, counts: Sequence[int], verdict: str) -> dict[str, str]:
    """The section "usd": data of the header, number of records of each kind, result of the CRC check."""
    section = {"version": str(header.version), "crc": verdict, "events": " ".join(e.name for e in header.events)}
    for event, count in zip(header.events, counts, strict=True):
        names = " ".join(f"{v}({t})" for v, t in zip(event.variables, event.letters, strict=True))
        section[f"records.{event.name}"] = str(count)
        section[f"variables.{event.name}"] = names
    return section


def integrity(
    *, size: int, stop: int, unknown: int | None, checksum: Checksum, last: float, blank: int | None = None
) -> tuple[str, list[Finding]]:
    """Result of the checksum and of the end of a file: one word for the metadata, and findings.

    Args:
        size: of the file [bytes].
        stop, unknown: end of the last whole record and the event id there, as in `Records`.
        checksum: of the file.
        last: time of the last record [s].
        blank: first byte of the unwritten end of the file.
    """
    left = size - stop - (CRC_BYTES if checksum.right else 0)
    evidence = {"offset_bytes": float(stop), "left_bytes": float(left), "last_s": last}
    if checksum.right and not left:
        return "ok", []
    if blank is not None and not checksum.right and blank <= stop and left > CRC_BYTES:
        text = (
            f"From byte {stop} on there are only bytes that nobody wrote (0xFF of erased flash, or 0): {left} bytes "
            f"were not read (the last record read is at {last:.3f} s; power lost while logging?)."
        )
        return "missing", [Finding("integrity", Grade.HARMLESS, text, evidence=evidence)]
    if checksum.right or (unknown is not None and left > CRC_BYTES):
        what = "is cut off" if unknown is None else f"is of the unknown event {unknown}"
        text = (
            f"Damaged: the record at byte {stop} {what}; {left} bytes from there on were not read "
            f"(the last record read is at {last:.3f} s)."
        )
        finding = Finding("integrity", Grade.DEGRADES, text, evidence=evidence, advice=_DAMAGE_ADVICE)
        return ("ok" if checksum.right else "wrong"), [finding]
    # four bytes that start no record are a checksum; other remaining bytes mean a cut file
    if left == CRC_BYTES and unknown is not None:
        text = (
            f"The CRC is wrong: the file says {checksum.stored:08x}, its bytes give {checksum.computed:08x}; "
            "at least one byte is not what was written."
        )
        evidence = {"stored": float(checksum.stored or 0), "computed": float(checksum.computed or 0)}
        grade = Grade.DEGRADES
        finding = Finding("integrity", grade, text, "", (), evidence, "Copy the file from the card again.")
        return "wrong", [finding]
    text = (
        f"The file was cut off (power lost while logging?): there is no CRC, {left} bytes are left over after "
        f"the last whole record at {last:.3f} s."
    )
    return "missing", [Finding("integrity", Grade.HARMLESS, text, evidence=evidence)]
