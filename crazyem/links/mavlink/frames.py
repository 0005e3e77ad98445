"""MAVLink 1 and 2 frames in a stream of bytes: search, check and unpacking; and losses by their sequence numbers.

The definitions come from pymavlink, but not the parser, which makes an object of every message and raises on some
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
_LARGEST_BUFFER = 4096  # bytes of incomplete frames; a frame has at most 280
_REVERSED_BITS = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))


@dataclass(frozen=True, slots=True)
class Definition:
    """A message: name, number, checksum seed, wire format, and its fields with the number of elements (0: no array)."""

    name: str
    number: int
    seed: int
    unpacker: struct.Struct
    fields: tuple[tuple[str, int], ...]


@cache
def definitions() -> Mapping[int, Definition]:
    """Message number -> definition."""
    found = {}
    for number, message in ardupilotmega.mavlink_map.items():
        counts = [n if code != "s" else 0 for n, code in layout(message.unpacker.format)]
        arrays = message.array_lengths
        fields = tuple((name, n if a and n else 0) for name, n, a in zip(message.ordered_fieldnames, counts, arrays))
        found[number] = Definition(message.msgname, number, message.crc_extra, message.unpacker, fields)
    # in MAVLink's common.xml, but not in pymavlink 2.4.50
    four = (("time_usec", 0), ("rpm", 4), ("voltage", 4), ("current", 4), ("index", 0))
    found.setdefault(291, Definition("ESC_STATUS", 291, 10, struct.Struct("<Q4i4f4fB"), four))
    return found


def layout(form: str) -> list[tuple[int, str]]:
    """Count and letter of each part of a struct format."""
    return [(int(count or 1), letter) for count, letter in re.findall(r"(\d*)([a-zA-Z])", form)]


@cache
def number_of(name: str) -> int:
    """Message number of a name; KeyError if there is none."""
    return {d.name: n for n, d in definitions().items()}[name]


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX, the reflected form of binascii's CRC-CCITT (which is fast)."""
    straight = binascii.crc_hqx(data.translate(_REVERSED_BITS), 0xFFFF)
    return _REVERSED_BITS[straight & 0xFF] << 8 | _REVERSED_BITS[straight >> 8]


def header(data: bytes, at: int) -> tuple[int, int, int, int, int, int, int] | None:
    """Sequence, system, component, message; begin and end of the payload, and end of the frame at `at`.

    None if no known kind of frame begins there, or its head is incomplete.
    """
    head = 10 if data[at] == _V2 else 6
    if data[at] not in FRAME_MARKS or len(data) - at < head:
        return None
    if head == 10:
        flags, _, sequence, system, component = data[at + 2 : at + 7]
        number = int.from_bytes(data[at + 7 : at + 10], "little")
    else:
        flags, (sequence, system, component, number) = 0, data[at + 2 : at + 6]
    if flags & ~_SIGNED:  # unknown incompatibility flags
        return None
    end = at + head + data[at + 1]
    return sequence, system, component, number, at + head, end, end + 2 + (_SIGNATURE if flags else 0)


def is_sound(data: bytes, at: int, end: int, seed: int) -> bool:
    """Whether the checksum after the payload (end: `end`) is right for the frame at `at`."""
    return checksum(data[at + 1 : end] + bytes((seed,))) == data[end] | data[end + 1] << 8


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame with a right checksum; `raw` is the whole frame with its signature (not verified: we have no key)."""

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
        """Field -> number, tuple of numbers or bytes; fields that MAVLink 2 cut off at the end are zero."""
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
    """Parser of a stream of bytes with bounded memory.

    Attributes:
        damaged: number of frames of a known kind with a wrong checksum. unknown: number of frames without a definition.
        skipped: number of bytes outside frames.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = self.unknown = self.skipped = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Complete frames with a right checksum, in order."""
        data = self._buffer + data
        found: list[Frame] = []
        at = 0
        while at < len(data):
            places = [p for p in (data.find(b"\xfd", at), data.find(b"\xfe", at)) if p >= 0]
            start = min(places, default=len(data))  # where the next frame may begin
            self.skipped += start - at
            at = start
            if at == len(data):
                break
            step = self._take(data, at, found)
            if step == 0:
                break  # the frame is incomplete
            at += step
        self._buffer = data[at:][-_LARGEST_BUFFER:]
        return found

    def _take(self, data: bytes, at: int, found: list[Frame]) -> int:
        """Number of bytes to skip; 0: the frame that begins here is incomplete."""
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
            return 1  # another frame may begin inside the damaged one
        found.append(Frame(system, component, number, sequence, data[start:end], data[at:after]))
        return after - at


_REPEAT_MEMORY = 64  # newest frames in which repetitions are recognised
_LATE_NUMBERS = 128  # up to so many numbers ahead are a gap, else the frame is late
_MODULUS = 256


class SequenceCounter:
    """Counts of frames by sequence numbers: received, lost (at least: 256 in a row look like none), late, repeated."""

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.repeated = 0
        self._newest: int | None = None  # continued beyond 8 bits
        self._missing: set[int] = set()
        self._seen: deque[bytes] = deque(maxlen=_REPEAT_MEMORY)

    def take(self, sequence: int, raw: bytes) -> bool:
        """Count a frame; False: a repetition, to be dropped."""
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
            self._missing = {n for n in self._missing if n > self._newest - _LATE_NUMBERS}
        elif ahead:  # 0: 256 lost, or a sender without sequence numbers
            self.late += 1
            number = self._newest + ahead - _MODULUS
            if number in self._missing:  # else an old repetition
                self._missing.remove(number)
                self.lost -= 1
        return True
