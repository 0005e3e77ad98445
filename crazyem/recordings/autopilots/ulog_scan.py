"""Check the messages of a ULog file: sound ones are passed to pyulog, damaged ones are located.

pyulog trusts the sizes in a file (an array of 10^9 elements becomes 10^9 fields) and skips damage byte by byte. So this
module first checks every message: its type exists, its size fits its type, and a data message belongs to a topic and
has the size of its format. After damage the scan continues at the next four consecutive sound messages. ULog has no
checksums, so a flipped bit inside a value cannot be detected.

Source: docs.px4.io/main/en/dev_log/ulog_file_format.
"""

import re
import struct
from array import array
from dataclasses import dataclass, field

ULOG_MAGIC = b"ULog\x01\x12\x35"
HEADER_BYTES = 16
SYNC_BYTES = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
TYPE_SIZES = {f"{sign}int{bits}_t": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)}
TYPE_SIZES |= {"float": 4, "double": 8, "bool": 1, "char": 1}
_LARGEST_MESSAGE = 65535  # bytes; the size of a message has 16 bits
_MOST_FIELDS = 200_000  # of all topics together
_DEEPEST_NESTING = 8  # types within types
_SOUND_MESSAGES = 4  # consecutive sound messages at which the scan continues after damage
_MESSAGE_TYPES = b"DAFIMPQLCOSRB"
_CANDIDATE = re.compile(b"(?=[\x00-\x1f][" + _MESSAGE_TYPES + b"])")  # upper half of a size below 8 KiB, type
_FORMAT = re.compile(rb"[A-Za-z0-9_\-/]+:(?:\w+(?:\[\d{1,10}\])? \w+;)*(?:\w+(?:\[\d{1,10}\])? \w+)?\Z")
_FIELD = re.compile(r"(\w+?)(?:\[(\d+)\])? (\w+)")
_KEY = re.compile(rb"(\w+)(?:\[(\d{1,10})\])? [^\x00-\x1f]+\Z")


@dataclass(slots=True)
class Scan:
    """Result of the scan of a file."""

    data: bytes = b""  # header and all sound messages; the file itself if all of it is sound
    # (offset, count) of each run of bytes that is no sound message
    skipped: list[tuple[int, int]] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)  # name of a topic that is not read -> reason
    messages: int = 0  # number of sound messages
    # identifier of the topic of each sound data message, in the order of the file
    identifiers: "array[int]" = field(default_factory=lambda: array("H"))
    size: int = 0  # of the file, bytes


class _Types:
    """Formats and topics so far, and the size of their messages."""

    def __init__(self) -> None:
        self.formats: dict[str, list[tuple[str, int, str]]] = {}
        self.topics: dict[int, tuple[int, int]] = {}  # message id -> least and greatest size
        self.names: dict[int, str] = {}
        self.refused_ids: set[int] = set()
        self.fields = 0

    def define(self, text: str) -> None:
        name, _, fields = text.partition(":")
        self.formats[name] = [(kind, int(count or 0), label) for kind, count, label in _FIELD.findall(fields)]

    def announce(self, identifier: int, name: str) -> str:
        """Add a topic; returns "" or the reason why it cannot be read."""
        reason = self._refusal(identifier, name)
        self.names[identifier] = name
        if reason:
            self.refused_ids.add(identifier)
            self.topics.pop(identifier, None)
        return reason

    def _refusal(self, identifier: int, name: str) -> str:
        if identifier in self.names:
            return f"its number belongs to {self.names[identifier]}"
        if name not in self.formats:
            return "its format is not defined"
        size, count = self._extent(name, 0)
        if not size or size > _LARGEST_MESSAGE:
            return "its format is larger than a message, or contains itself or an unknown type"
        if not any(f == ("uint64_t", 0, "timestamp") for f in self.formats[name]):
            return "its format has no timestamp"
        if self.fields + count > _MOST_FIELDS:
            return f"the topics have more than {_MOST_FIELDS} fields together"
        self.fields += count
        self.topics[identifier] = (size - self._padding(name), size)
        return ""

    def _extent(self, name: str, depth: int) -> tuple[int, int]:
        """Bytes and fields of a type; (0, 0) if it is empty, too large, recursive or has an unknown type."""
        if depth > _DEEPEST_NESTING:
            return 0, 0
        size = count = 0
        for kind, length, _ in self.formats.get(name, ()):
            one, fields = (TYPE_SIZES[kind], 1) if kind in TYPE_SIZES else self._extent(kind, depth + 1)
            if not one:
                return 0, 0
            size += one * max(length, 1)
            count += fields * max(length, 1)
            if size > _LARGEST_MESSAGE:
                return 0, 0
        return size, count

    def _padding(self, name: str) -> int:
        """Bytes of padding at the end, which the logger leaves out."""
        total = 0
        for kind, length, label in reversed(self.formats[name]):
            if not label.startswith("_padding") or kind not in TYPE_SIZES:
                break
            total += TYPE_SIZES[kind] * max(length, 1)
        return total


def scan(data: bytes) -> Scan:
    """Every sound message of a file that starts with `ULOG_MAGIC` and has its 16 bytes of header."""
    found = Scan(size=len(data))
    types = _Types()
    flags, appended = _flags(data)
    offsets = [offset for offset in appended if offset > HEADER_BYTES]
    view = memoryview(data)
    kept: list[memoryview | bytes] = []  # runs of sound messages before `start`
    position, start, size = HEADER_BYTES, HEADER_BYTES, len(data)
    limit = HEADER_BYTES  # no message ends after this: end of the file or of the part before appended data
    unpack = struct.Struct("<HB").unpack_from
    two = struct.Struct("<H").unpack_from
    topics = types.topics
    record = found.identifiers.append
    while position < size:
        if position >= limit:
            limit = min((o for o in offsets if position < o < size), default=size)
        length, kind = unpack(data, position) if position + 3 <= limit else (size, 0)
        after = position + 3 + length
        data_message = kind == 0x44 and length > 2 and after <= limit  # 'D', nearly all of a file
        identifier = two(data, position + 3)[0] if data_message else -1
        limits = topics.get(identifier)
        sound, replacement = after <= limit, None  # None: pyulog gets the message as it is
        if limits is not None and limits[0] <= length - 2 <= limits[1]:
            record(identifier)
            if length - 2 > limits[0]:
                replacement = _without_padding(data, position, limits[0])
        elif sound:
            sound, keep = _check(data, position, length, kind, types, found)
            replacement = None if keep else b""
        if not sound:
            kept.append(view[start:position])
            again = _resume(data, position, limit, types)
            found.skipped.append((position, again - position))
            start = position = again
            continue
        found.messages += 1
        if replacement is not None:
            kept += [view[start:position], replacement]
            start = after
        position = after
    kept.append(view[start:size])
    header = data[:7] + b"\x01" + data[8:HEADER_BYTES]  # without the mark of appended data
    whole = len(kept) == 1 and not any(flags) and not any(appended)
    found.data = data if whole else b"".join([header, *kept])
    return found


def _without_padding(data: bytes, at: int, size: int) -> bytes:
    """A data message as the logger of PX4 writes it: without the padding at its end, as pyulog expects."""
    return struct.pack("<HB", size + 2, 0x44) + data[at + 3 : at + 5 + size]


def _check(data: bytes, at: int, length: int, kind: int, types: _Types, found: Scan) -> tuple[bool, bool]:
    """Whether another message is sound, and whether to pass it to pyulog; stores formats and topics."""
    if not _sound(data, at, length, kind, types):
        return False, False
    if kind == 0x44:
        return True, False  # data of a refused topic
    body = data[at + 3 : at + 3 + length]
    if kind == 0x46:  # 'F'
        if types.names:
            return True, False  # too late: formats must come before topics
        types.define(body.decode("ascii"))
    elif kind == 0x41:  # 'A'
        name, identifier = body[3:].decode("ascii"), int.from_bytes(body[1:3], "little")
        if types.names.get(identifier) == name:
            return True, False  # repeated in appended data
        reason = types.announce(identifier, name)
        if reason:
            found.refused[name] = reason
            return True, False
    elif kind in b"BR":
        return True, kind == 0x42 and not any(body[8:])
    return True, True


def _plausible(body: bytes, kind: int, at: int) -> bool:
    """Whether a message has the size and the shape of its type; `at` is its offset."""
    match chr(kind):
        case "F":
            return len(body) <= 8192 and _FORMAT.match(body) is not None
        case "A":
            return 3 < len(body) <= 300 and body[3:].isascii() and body[3:].decode("ascii").isprintable()
        case "I" | "P":
            return _key_value(body)
        case "M" | "Q":
            return _key_value(body[1:])
        case "L":
            return len(body) >= 9 and 0x30 <= body[0] <= 0x37
        case "C":
            return len(body) >= 11 and 0x30 <= body[0] <= 0x37
        case "O" | "R":
            return len(body) == 2
        case "S":
            return body == SYNC_BYTES
        case "B":
            return len(body) >= 40 and at == HEADER_BYTES
    return False


def _key_value(body: bytes) -> bool:
    """Whether a body is: length of key, key ("char[5] name"), value of the size of the type."""
    if len(body) < 2 or len(body) < 1 + body[0]:
        return False
    key = _KEY.match(body[1 : 1 + body[0]])
    if key is None or key[1].decode("ascii", "replace") not in TYPE_SIZES:
        return False
    return len(body) - 1 - body[0] == TYPE_SIZES[key[1].decode()] * int(key[2] or 1)


def _resume(data: bytes, damaged: int, limit: int, types: _Types) -> int:
    """Offset of the next consecutive sound messages after `damaged`; `limit` if there are none."""
    starts = (match.start() - 1 for match in _CANDIDATE.finditer(data, damaged + 2, limit))
    return next((start for start in starts if _sound_run(data, start, limit, types)), limit)


def _sound_run(data: bytes, position: int, limit: int, types: _Types) -> bool:
    """Whether `_SOUND_MESSAGES` sound messages, or fewer up to `limit`, follow each other at `position`."""
    for _ in range(_SOUND_MESSAGES):
        if position == limit:
            return True
        if position + 3 > limit:
            return False
        length, kind = struct.unpack_from("<HB", data, position)
        short = kind == 0x44 or length <= 8192
        if position + 3 + length > limit or not short or not _sound(data, position, length, kind, types):
            return False
        position += 3 + length
    return True


def _sound(data: bytes, at: int, length: int, kind: int, types: _Types) -> bool:
    """Whether a message fits its type, and a data message its topic."""
    body = data[at + 3 : at + 3 + length]
    if kind != 0x44:
        return _plausible(body, kind, at)
    identifier = int.from_bytes(body[:2], "little")
    least, most = types.topics.get(identifier, (1, 0))
    return length > 2 and (identifier in types.refused_ids or least <= length - 2 <= most)


def _flags(data: bytes) -> tuple[bytes, tuple[int, ...]]:
    """The incompatible flags and the offsets of appended data; zeros in a file without the message of flags."""
    if data[HEADER_BYTES + 2 : HEADER_BYTES + 3] != b"B" or len(data) < HEADER_BYTES + 43:
        return bytes(8), ()
    return data[HEADER_BYTES + 11 : HEADER_BYTES + 19], struct.unpack_from("<3Q", data, HEADER_BYTES + 19)


def unknown_flags(data: bytes) -> bool:
    """True if the file has incompatible flags that this reader does not know."""
    flags, _ = _flags(data)
    return bool(flags[0] & ~1) or any(flags[1:])
