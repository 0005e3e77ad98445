"""MAVLink 1 and 2 frames out of any bytes: found, checked, unpacked; and what their sequence numbers say of losses.

pymavlink's definitions, not its parser: that one makes an object of every message, wanted or not, and raises on some
bytes. Source: mavlink.io/en/guide/serialization.html.
"""

import binascii
import re
import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

FRAME_MARKS = _V1, _V2 = 0xFE, 0xFD
_SIGNED, _SIGNATURE = 1, 13
_LARGEST_BUFFER = 4096  # bytes that may wait for the rest of their frame; a frame has at most 280
_REVERSED_BITS = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))


@dataclass(frozen=True, slots=True)
class Definition:
    """A message: name, number, checksum seed, wire format, and its fields with the number of elements (0: no array)."""

    name: str
    number: int
    seed: int
    unpacker: struct.Struct
    fields: tuple[tuple[str, int], ...]


def _definitions() -> dict[int, Definition]:
    found = {}
    for number, message in ardupilotmega.mavlink_map.items():
        counts = [n if code != "s" else 0 for n, code in layout(message.unpacker.format)]
        arrays = message.array_lengths
        fields = tuple((name, n if a and n else 0) for name, n, a in zip(message.ordered_fieldnames, counts, arrays))
        found[number] = Definition(message.msgname, number, message.crc_extra, message.unpacker, fields)
    # in MAVLink's common.xml, but left out of pymavlink 2.4.50
    four = (("time_usec", 0), ("rpm", 4), ("voltage", 4), ("current", 4), ("index", 0))
    found.setdefault(291, Definition("ESC_STATUS", 291, 10, struct.Struct("<Q4i4f4fB"), four))
    return found


def layout(form: str) -> list[tuple[int, str]]:
    """Count and letter of each part of a struct format."""
    return [(int(count or 1), letter) for count, letter in re.findall(r"(\d*)([a-zA-Z])", form)]


@cache
def definitions() -> Mapping[int, Definition]:
    """Message number -> definition."""
    return _definitions()


@cache
def number_of(name: str) -> int:
    """Message number of a name; KeyError if there is none."""
    return {d.name: n for n, d in definitions().items()}[name]


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX: the reflected twin of the CCITT polynomial that binascii has in C."""
    straight = binascii.crc_hqx(data.translate(_REVERSED_BITS), 0xFFFF)
    return _REVERSED_BITS[straight & 0xFF] << 8 | _REVERSED_BITS[straight >> 8]


def header(data: bytes, at: int) -> tuple[int, int, int, int, int, int, int] | None:
    """Sequence, system, component, message; where the payload begins and ends, and where the frame at `at` ends.

    None where no frame begins that is known here, or the data end within its head.
    """
    head = 10 if data[at] == _V2 else 6
    if data[at] not in FRAME_MARKS or len(data) - at < head:
        return None
    if head == 10:
        flags, _, sequence, system, component = data[at + 2 : at + 7]
        number = int.from_bytes(data[at + 7 : at + 10], "little")
    else:
        flags, (sequence, system, component, number) = 0, data[at + 2 : at + 6]
    if flags & ~_SIGNED:  # incompatible with what we know
        return None
    end = at + head + data[at + 1]
    return sequence, system, component, number, at + head, end, end + 2 + (_SIGNATURE if flags else 0)


def is_sound(data: bytes, at: int, end: int, seed: int) -> bool:
    """Whether the checksum behind the payload that ends at `end` is that of the frame at `at`."""
    return checksum(data[at + 1 : end] + bytes((seed,))) == data[end] | data[end + 1] << 8


@dataclass(frozen=True, slots=True)
class Frame:
    """A sound frame; `raw` is all of it, signature included (which is not verified: we hold no key)."""

    system: int
    component: int
    message: int
    sequence: int
    payload: bytes
    raw: bytes

    @property
    def name(self) -> str:
        return definitions()[self.message].name

    def fields(self) -> dict[str, Any]:
        """Field -> number, tuple of numbers or bytes; what MAVLink 2 cut off the end is zero."""
        d = definitions()[self.message]
        size = d.unpacker.size
        values = d.unpacker.unpack(self.payload[:size].ljust(size, b"\0"))
        result: dict[str, Any] = {}
        at = 0
        for name, count in d.fields:
            result[name] = values[at : at + count] if count else values[at]
            at += count or 1
        return result


class FrameParser:
    """Feed it bytes as they come; bounded memory whatever they are.

    Attributes:
        damaged: frames of known kind and wrong checksum. unknown: frames of kinds without definition, skipped.
        skipped: bytes that belong to no frame.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = self.unknown = self.skipped = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Sound frames that are complete now, in order."""
        data = self._buffer + data
        found: list[Frame] = []
        at = 0
        while at < len(data):
            start = _mark(data, at)
            self.skipped += start - at
            at = start
            if at == len(data):
                break
            step = self._take(data, at, found)
            if step == 0:
                break  # more is to come
            at += step
        self._buffer = data[at:][-_LARGEST_BUFFER:]
        return found

    def _take(self, data: bytes, at: int, found: list[Frame]) -> int:
        """Bytes to go on by; 0: the frame that begins here is not complete."""
        if len(data) - at < (10 if data[at] == _V2 else 6):
            return 0
        head = header(data, at)
        if head is None:
            self.skipped += 1
            return 1
        sequence, system, component, number, start, end, after = head
        definition = definitions().get(number)
        if after > len(data):
            return 0
        if definition is None:
            if after == len(data) or data[after] in FRAME_MARKS:
                self.unknown += 1
                return after - at
            self.skipped += 1
            return 1
        if not is_sound(data, at, end, definition.seed):
            self.damaged += 1
            self.skipped += 1
            return 1  # a frame may begin inside of what was taken for one
        found.append(Frame(system, component, number, sequence, data[start:end], data[at:after]))
        return after - at


def _mark(data: bytes, at: int) -> int:
    """The next place where a frame may begin, len(data) if there is none."""
    places = [p for p in (data.find(b"\xfd", at), data.find(b"\xfe", at)) if p >= 0]
    return min(places, default=len(data))


_REPEAT_MEMORY = 64  # newest frames that a repetition is recognised among
_LATE_NUMBERS = 128  # numbers behind count as late, numbers ahead as a gap
_MODULUS = 256


class SequenceCounter:
    """Attributes: received, lost (at least: 256 lost in a row look like none), late, repeated."""

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.repeated = 0
        self._newest: int | None = None  # continued beyond 8 bits
        self._missing: set[int] = set()
        self._seen: deque[bytes] = deque(maxlen=_REPEAT_MEMORY)

    def take(self, sequence: int, raw: bytes) -> bool:
        """Account for a frame; False: it was here before, drop it."""
        if raw in self._seen:
            self.repeated += 1
            return False
        self._seen.append(raw)
        self.received += 1
        if self._newest is None:
            self._newest = sequence
            return True
        ahead = (sequence - self._newest) % _MODULUS
        if 0 < ahead <= _LATE_NUMBERS:
            self.lost += ahead - 1
            self._missing.update(range(self._newest + 1, self._newest + ahead))
            self._newest += ahead
            self._missing = (
                {n for n in self._missing if n > self._newest - _LATE_NUMBERS} if self._missing else self._missing
            )
        elif ahead:  # 0: 256 lost, or a sender that does not count
            self.late += 1
            number = self._newest + ahead - _MODULUS
            if number in self._missing:  # else it is a repetition whose first arrival is forgotten
                self._missing.remove(number)
                self.lost -= 1
        return True
