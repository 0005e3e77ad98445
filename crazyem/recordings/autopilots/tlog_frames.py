"""Find, check and unpack the frames of a MAVLink telemetry log with the message definitions of pymavlink.

A tlog is a sequence of [time of arrival, 8 bytes, big-endian, microseconds since 1970][MAVLink 1 or 2 frame]. pymavlink
decodes messages one by one. For speed, numpy unpacks here all frames of a message together, with the types, order and
checksum seed from pymavlink. Source: mavlink.io/en/guide/serialization.html.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega

from crazyem.links.mavlink.frames import FRAME_MARKS, header, is_sound, layout

MESSAGES: Mapping[int, Any] = ardupilotmega.mavlink_map
_EARLIEST_STAMP = 946_684_800_000_000  # us: the year 2000
_LATEST_STAMP = 4_102_444_800_000_000  # us: the year 2100
# possible start of a frame: a time of arrival between these years, and the mark of a frame
_START = re.compile(rb"(?s)(?=\x00[\x03-\x0e].{6}[\xfd\xfe])")

Key = tuple[int, int, int]  # system, component, message


@dataclass(slots=True)
class Frames:
    """Sound frames of one message from one component: arrival [us], place in the file, sequence number, payload."""

    stamps: list[int] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    sequence: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)


@dataclass(slots=True)
class Frameset:
    """The frames of a log."""

    frames: dict[Key, Frames] = field(default_factory=dict)  # by system, component and message
    # (offset, count) of each run of bytes that is no sound frame
    skipped: list[tuple[int, int]] = field(default_factory=list)
    unknown: int = 0  # number of frames of messages that pymavlink does not know; they cannot be checked or read
    total: int = 0  # number of sound and unknown frames


def scan(data: bytes, at_most: int | None = None) -> Frameset:
    """All sound frames of a log, or the first `at_most`."""
    found = Frameset()
    position, size = 0, len(data)
    while position < size and (at_most is None or found.total < at_most):
        after = _frame(data, position, found)
        if after:
            position = after
            continue
        again = _resume(data, position)
        found.skipped.append((position, again - position))
        position = again
    return found


def _frame(data: bytes, at: int, found: Frameset | None) -> int:
    """Byte after the frame at `at`, 0 if there is no sound one; adds the frame to `found`."""
    if at + 8 + 8 > len(data):
        return 0
    stamp = int.from_bytes(data[at : at + 8], "big")
    if not _EARLIEST_STAMP < stamp < _LATEST_STAMP:
        return 0
    head = header(data, at + 8)
    if head is None or head[-1] > len(data):
        return 0
    sequence, *key, start, end, after = head
    message = MESSAGES.get(key[2])
    if message is None:
        if not _looks_like_frame(data, after):
            return 0
        if found is not None:
            found.unknown += 1
            found.total += 1
        return after
    if not is_sound(data, at + 8, end, message.crc_extra):
        return 0
    if found is not None:
        frames = found.frames.setdefault((key[0], key[1], key[2]), Frames())
        frames.stamps.append(stamp)
        frames.places.append(found.total)
        frames.sequence.append(sequence)
        frames.payloads.append(data[start:end])
        found.total += 1
    return after


def _looks_like_frame(data: bytes, at: int) -> bool:
    """True at the end of the log, or at a time of arrival followed by the mark of a frame."""
    if at == len(data):
        return True
    if at + 9 > len(data):
        return False
    return _EARLIEST_STAMP < int.from_bytes(data[at : at + 8], "big") < _LATEST_STAMP and data[at + 8] in FRAME_MARKS


def _resume(data: bytes, damaged: int) -> int:
    """Offset of the next sound frame after `damaged`; the end of the log if there is none."""
    for start in _START.finditer(data, damaged + 1):
        if _frame(data, start.start(), None):
            return start.start()
    return len(data)


def columns_of(message: Any, payloads: list[bytes]) -> dict[str, NDArray[np.generic]]:
    """Fields of all frames of one message, in the types in which they were sent: name -> (n,).

    Each element of an array becomes a column, "voltages[0]"; a text is one column of bytes. Missing bytes are 0:
    MAVLink 2 cuts zeros off the end of a payload, and MAVLink 1 has no extension fields.
    """
    names: list[str] = []
    kinds: list[Any] = []
    for field_name, (count, code) in zip(message.ordered_fieldnames, layout(message.unpacker.format), strict=True):
        if code == "s":
            names.append(field_name)
            kinds.append(f"S{count}")
        elif count == 1:
            names.append(field_name)
            kinds.append("<" + code)
        else:
            names += [f"{field_name}[{i}]" for i in range(count)]
            kinds += ["<" + code] * count
    dtype = np.dtype(list(zip(names, kinds, strict=True)))
    size = dtype.itemsize
    table = np.frombuffer(b"".join([p[:size].ljust(size, b"\0") for p in payloads]), dtype)
    return {name: table[name] for name in names}


def units_of(message: Any, columns: Mapping[str, object]) -> dict[str, str]:
    """Units of the columns from the MAVLink definitions."""
    units = {name: unit.replace("/s/s", "/s^2") for name, unit in message.fieldunits_by_name.items()}
    return {c: units[c.partition("[")[0]] for c in columns if c.partition("[")[0] in units}
