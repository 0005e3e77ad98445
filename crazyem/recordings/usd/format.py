"""Parse the header of a uSD card log, which defines the layout of each kind of record, and locate the records.

All numbers are little-endian: 0xBC, version u16, number of event types u16. For each event type: id u16, name ending in
NUL, number of variables u16, and their names "group.variable(T)" ending in NUL, T a letter of `TYPE_LETTERS`.
Records follow: id u16, time stamp (version 1: u32 ms; version 2, since 2021-03-18: u64 us), packed values. The last 4
bytes are the CRC-32 of everything before them. Source: src/deck/drivers/src/usddeck.c of crazyflie-firmware.

Only the id of a record gives its length, so the records must be located one after the other (0.3 us per record).
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.tables import Table

USD_MAGIC = 0xBC
USD_VERSIONS = (1, 2)
# letter -> (numpy type, C type in the firmware)
TYPE_LETTERS: dict[str, tuple[str, str]] = {
    "B": ("u1", "uint8_t"),
    "b": ("i1", "int8_t"),
    "H": ("<u2", "uint16_t"),
    "h": ("<i2", "int16_t"),
    "I": ("<u4", "uint32_t"),
    "i": ("<i4", "int32_t"),
    "f": ("<f4", "float"),
    "e": ("<f2", "FP16"),
}
STAMP_TYPES = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}  # type of a stamp, and stamp units per second

# The firmware writes at most 20 event types of at most 20 variables; damaged counts may be huge.
MOST_EVENTS = 256
_MOST_VARIABLES = 1024
LONGEST_NAME = 256  # bytes


@dataclass(frozen=True, slots=True)
class EventType:
    """A kind of record."""

    identifier: int  # first two bytes of its records; 0xFFFF is "fixedFrequency"
    name: str  # unique in the file
    variables: tuple[str, ...]  # unique in the event; names without a "." are the payload of the event
    letters: tuple[str, ...]  # type letter of each variable
    layout: np.dtype[np.void]  # of a whole record; fields "id", "stamp", "0", "1", ...


@dataclass(frozen=True, slots=True)
class Header:
    """Contents of the header; the records start at byte `size`."""

    version: int
    events: tuple[EventType, ...]
    size: int


def parse_header(data: bytes, path: object) -> Header:
    """The header of a log, from its first bytes (all of them, if the file is short).

    Raises: FileFormatError naming `path` and the first invalid byte of the header.
    """
    cursor = _Cursor(data, path)
    if not data:
        raise cursor.cut("magic byte")
    if data[0] != USD_MAGIC:
        raise FileFormatError(f"{path} does not start with 0xBC, as a uSD card log does.")
    cursor.at = 1
    version = cursor.u16("version")
    if version not in USD_VERSIONS:
        raise FileFormatError(f"{path}: uSD card log of version {version}, known are 1 and 2.")
    count = cursor.u16("number of event types")
    if not 0 < count <= MOST_EVENTS:
        raise FileFormatError(f"{path}: the header declares {count} event types (byte 3).")
    events: list[EventType] = []
    for _ in range(count):
        events.append(_event(cursor, version, {e.name for e in events}))
    seen: set[int] = set()
    for event in events:
        if event.identifier in seen:
            raise FileFormatError(f"{path}: the header declares event {event.identifier} twice.")
        seen.add(event.identifier)
    return Header(version, tuple(events), cursor.at)


def _event(cursor: "_Cursor", version: int, taken: set[str]) -> EventType:
    identifier = cursor.u16("event id")
    name = cursor.name("event name")
    name += f"@{identifier}" if name in taken else ""
    count = cursor.u16(f"number of variables of {name}")
    if count > _MOST_VARIABLES:
        raise FileFormatError(f"{cursor.path}: the header declares {count} variables in {name} (byte {cursor.at - 2}).")
    variables: list[str] = []
    letters: list[str] = []
    for _ in range(count):
        start = cursor.at
        text = cursor.name(f"variable name of {name}")
        variable, letter = text[:-3], text[-2:-1]
        if text[-3:-2] != "(" or text[-1:] != ")" or letter not in TYPE_LETTERS:
            raise FileFormatError(f'{cursor.path}: "{text[:40]}" (byte {start}) is not a variable with a known type.')
        # a variable may occur twice in an event, as two samples microseconds apart
        variables.append(variable + (f"#{len(variables)}" if variable in variables else ""))
        letters.append(letter)
    fields = [("id", "<u2"), ("stamp", STAMP_TYPES[version][0])]
    fields += [(str(i), TYPE_LETTERS[letter][0]) for i, letter in enumerate(letters)]
    return EventType(identifier, name, tuple(variables), tuple(letters), np.dtype(fields))


class _Cursor:
    """Reads a header from front to back, never past its end."""

    def __init__(self, data: bytes, path: object) -> None:
        self.data, self.path, self.at = data, path, 0

    def u16(self, what: str) -> int:
        if self.at + 2 > len(self.data):
            raise self.cut(what)
        self.at += 2
        return int.from_bytes(self.data[self.at - 2 : self.at], "little")

    def name(self, what: str) -> str:
        """The text up to the next NUL; the cursor moves behind the NUL."""
        end = self.data.find(0, self.at, self.at + LONGEST_NAME)
        if end < 0 and len(self.data) < self.at + LONGEST_NAME:
            raise self.cut(what)
        text = self.data[self.at : end]
        if end < 0 or not text.isascii() or not text.decode("ascii").isprintable():
            raise FileFormatError(f"{self.path}: the {what} at byte {self.at} is not text.")
        self.at = end + 1
        return text.decode("ascii")

    def cut(self, what: str) -> FileFormatError:
        return FileFormatError(f"{self.path} ends after {len(self.data)} bytes, in its header ({what}).")


BLANK_BYTES = (b"\xff", b"\x00")  # erased flash; reserved clusters that were never written


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Whole records in file order."""

    start: NDArray[np.int64]  # (n,) first byte of each record
    kind: NDArray[np.uint16]  # (n,) index of the event type of each record
    order: list[NDArray[np.intp]]  # rows of each kind among these records
    stop: int  # byte after the last whole record
    unknown: int | None  # the event id found at `stop`, None if the data end there


def locate(data: bytes, events: tuple[EventType, ...], begin: int, end: int, blank: int) -> Records:
    """Every whole record of `data[begin:end]` before the first that is cut off or of an unknown kind.

    Records that begin at byte `blank` or later are left out: erased flash looks like records of event 0xFFFF.
    """
    known = {event.identifier.to_bytes(2, "little"): (k, event.layout.itemsize) for k, event in enumerate(events)}
    start, kind = array("q"), array("H")
    at = begin
    while at < blank:
        k, size = known.get(data[at : at + 2], (0, end + 1))
        if at + size > end:
            break
        start.append(at)
        kind.append(k)
        at += size
    unknown = data[at : at + 2] not in known and at + 2 <= end
    kinds = np.frombuffer(kind, np.uint16)
    order = [np.flatnonzero(kinds == k) for k in range(len(events))]
    identifier = int.from_bytes(data[at : at + 2], "little") if unknown else None
    return Records(np.frombuffer(start, np.int64), kinds, order, at, identifier)


def gather(data: bytes, event: EventType, start: NDArray[np.int64]) -> NDArray[np.void]:
    """(n,) records of one kind, copied."""
    if not start.size:
        return np.empty(0, event.layout)
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), event.layout.itemsize)
    return windows[start].reshape(-1).view(event.layout)


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
