"""The header of a uSD card log: which kinds of records a file holds, and how a record of each kind is laid out.

Little-endian throughout: 0xBC, version u16, number of event types u16, then for each its id u16, its name ending in
NUL, its number of variables u16 and as many names "group.variable(T)" ending in NUL, T a letter of `TYPE_LETTERS`.
Records follow: id u16, time stamp (version 1: u32 ms; version 2, since 2021-03-18: u64 us), packed values. The last 4
bytes are the CRC-32 of everything before them. Source: src/deck/drivers/src/usddeck.c of crazyflie-firmware.
"""

import struct
from dataclasses import dataclass

import numpy as np

from crazyem.errors import FileFormatError

USD_MAGIC = 0xBC
USD_VERSIONS = (1, 2)
# letter -> (numpy type, C type as the firmware names it)
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
STAMP_TYPES = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}  # type of a stamp, and stamps a second

# The firmware writes at most 20 event types of at most 20 variables; a damaged count claims anything.
_MOST_EVENTS = 256
_MOST_VARIABLES = 1024
_LONGEST_NAME = 256  # bytes


@dataclass(frozen=True, slots=True)
class EventType:
    """A kind of record.

    Attributes:
        identifier: what a record of it starts with; 0xFFFF is "fixedFrequency".
        name: unique in the file.
        variables: unique in the event; those without a "." are the event's own payload.
        letters: type letter of each variable.
        layout: of a whole record; fields "id", "stamp", "0", "1", ...
    """

    identifier: int
    name: str
    variables: tuple[str, ...]
    letters: tuple[str, ...]
    layout: np.dtype[np.void]


@dataclass(frozen=True, slots=True)
class Header:
    """What the file says of itself; `size` is where its records start [bytes]."""

    version: int
    events: tuple[EventType, ...]
    size: int


def parse_header(data: bytes, path: object) -> Header:
    """The header of a log, from its first bytes (all of them, if the file is short).

    Raises: FileFormatError naming `path` and the byte at which the header stops making sense.
    """
    cursor = _Cursor(data, path)
    if cursor.u8("magic byte") != USD_MAGIC:
        raise FileFormatError(f"{path} does not start with 0xBC, as a uSD card log does.")
    version = cursor.u16("version")
    if version not in USD_VERSIONS:
        raise FileFormatError(f"{path}: uSD card log of version {version}, known are 1 and 2.")
    count = cursor.u16("number of event types")
    if not 0 < count <= _MOST_EVENTS:
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


def plausible(head: bytes) -> bool:
    """True if a file that starts with these bytes claims to be a log, and its first event has a name."""
    if len(head) < 8 or head[0] != USD_MAGIC:
        return False
    version, count = struct.unpack_from("<HH", head, 1)
    name = head[7 : 7 + _LONGEST_NAME].split(b"\0", 1)[0]
    return 0 < version < 16 and 0 < count <= _MOST_EVENTS and name.isascii() and name.decode("ascii").isprintable()


def _event(cursor: "_Cursor", version: int, taken: set[str]) -> EventType:
    identifier = cursor.u16("event id")
    name = _unique(cursor.name("event name"), taken, f"@{identifier}")
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
        # a variable may be logged twice in one event: two samples, microseconds apart
        variables.append(_unique(variable, set(variables), f"#{len(variables)}"))
        letters.append(letter)
    fields = [("id", "<u2"), ("stamp", STAMP_TYPES[version][0])]
    fields += [(str(i), TYPE_LETTERS[letter][0]) for i, letter in enumerate(letters)]
    return EventType(identifier, name, tuple(variables), tuple(letters), np.dtype(fields))


def _unique(name: str, taken: set[str], suffix: str) -> str:
    return name + suffix if name in taken else name


class _Cursor:
    """Reads a header front to back; never past its end."""

    def __init__(self, data: bytes, path: object) -> None:
        self.data, self.path, self.at = data, path, 0

    def u8(self, what: str) -> int:
        return self._take(1, what)[0]

    def u16(self, what: str) -> int:
        return int.from_bytes(self._take(2, what), "little")

    def name(self, what: str) -> str:
        """Up to the next NUL, which is skipped."""
        end = self.data.find(0, self.at, self.at + _LONGEST_NAME)
        if end < 0 and len(self.data) < self.at + _LONGEST_NAME:
            raise self._cut(what)
        text = self.data[self.at : end]
        if end < 0 or not text.isascii() or not text.decode("ascii").isprintable():
            raise FileFormatError(f"{self.path}: the {what} at byte {self.at} is not text.")
        self.at = end + 1
        return text.decode("ascii")

    def _take(self, count: int, what: str) -> bytes:
        taken = self.data[self.at : self.at + count]
        if len(taken) < count:
            raise self._cut(what)
        self.at += count
        return taken

    def _cut(self, what: str) -> FileFormatError:
        return FileFormatError(f"{self.path} ends after {len(self.data)} bytes, in its header ({what}).")
