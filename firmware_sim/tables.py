"""The tables of contents of log variables and parameters, their storage types, and values in and out of bytes.

Types and flags are those of the real tables (contents.py); type bytes and conversions as in crazyflie-firmware (log.h,
param.h, log.c). A name in no table is a float, as most of the firmware's variables.
"""

import math
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from firmware_sim import contents

Slot = tuple[np.ndarray, int]  # place of a value: a float64 array and an index into it

LOG_TYPE = {"u8": 1, "u16": 2, "u32": 3, "i8": 4, "i16": 5, "i32": 6, "float": 7, "fp16": 8}
PARAM_TYPE = {"u8": 0x08, "u16": 0x09, "u32": 0x0A, "i8": 0x00, "i16": 0x01, "i32": 0x02, "float": 0x06}
FORMAT = {"u8": "<B", "u16": "<H", "u32": "<I", "i8": "<b", "i16": "<h", "i32": "<i", "float": "<f", "fp16": "<e"}
SIZE = {name: struct.calcsize(form) for name, form in FORMAT.items()}
LOG_TYPE_NAME = {code: name for name, code in LOG_TYPE.items()}

PARAM_READ_ONLY, PARAM_CORE, PARAM_EXTENDED = 0x40, 0x20, 0x10
MAX_NAME = 24  # len(group) + len(name), so that a table item fits a packet

# Variables of a drone that the build for a PC (contents.py) lacks. Any other name is a float.
_LOG_EXTRA = dict.fromkeys((f"motor.m{n}_rpm" for n in range(1, 5)), "u16")
DECKS = tuple(  # cfclient needs this group
    f"deck.{name}"
    for name in ("bcZRanger", "bcZRanger2", "bcFlow", "bcFlow2", "bcLighthouse4", "bcLoco", "bcDWM1000", "bcLedRing")
)
_LOG_KIND = contents.LOG | _LOG_EXTRA
_PARAM = contents.PARAMETERS | dict.fromkeys(DECKS, contents.Parameter("u8", "rc", 0.0))
_FLAGS = {"r": PARAM_READ_ONLY, "c": PARAM_CORE, "p": PARAM_EXTENDED}


@dataclass(frozen=True)
class Item:
    """One table entry: its full name, storage type name, type byte on the wire and the slot that holds its value."""

    name: str
    kind: str
    type_byte: int
    array: np.ndarray
    index: int

    @property
    def value(self) -> float:
        """The current value as a number, in the firmware's unit."""
        return float(self.array[self.index])

    @property
    def read_only(self) -> bool:
        """True for a parameter that a client cannot write."""
        return bool(self.type_byte & PARAM_READ_ONLY)

    @property
    def persistent(self) -> bool:
        """True for a parameter that can be stored over a reboot."""
        return bool(self.type_byte & PARAM_EXTENDED)

    @property
    def wire_name(self) -> bytes:
        """group NUL name NUL: the last NUL is required, cflib drops the last byte of the name."""
        group, name = self.name.split(".", 1)
        return group.encode() + b"\0" + name.encode() + b"\0"


class Table:
    """A table of contents: items by id (position) and by name, with a checksum over everything a client may cache."""

    def __init__(self, items: Iterable[Item], salt: bytes):
        self.items = list(items)
        self.by_name = {item.name: item for item in self.items}
        content = salt + b"".join(bytes((item.type_byte,)) + item.wire_name for item in self.items)
        self.crc = zlib.crc32(content)

    def get(self, index: int) -> Item | None:
        """The item of that id, None if there is none."""
        return self.items[index] if 0 <= index < len(self.items) else None


def _grouped(slots: Mapping[str, Slot]) -> list[str]:
    """Names with each group contiguous, groups in order of first appearance, as in the real tables."""
    order = {group: n for n, group in enumerate(dict.fromkeys(name.split(".", 1)[0] for name in slots))}
    for name in slots:
        if len(name) - 1 > MAX_NAME:
            raise ValueError(f"{name} is too long for a table of contents ({MAX_NAME} characters)")
    return sorted(slots, key=lambda name: order[name.split(".", 1)[0]])  # sorted() is stable


def log_table(slots: Mapping[str, Slot]) -> Table:
    """The log table over live values, slots: name -> (float64 array, index)."""
    items = []
    for name in _grouped(slots):
        kind = _LOG_KIND.get(name, "float")
        items.append(Item(name, kind, LOG_TYPE[kind], *slots[name]))
    return Table(items, b"log")


def param_table(slots: Mapping[str, Slot]) -> Table:
    """The parameter table over live values, slots: name -> (float64 array, index)."""
    items = []
    for name in _grouped(slots):
        facts = _PARAM.get(name, contents.Parameter("float", "", 0.0))
        flags = sum(_FLAGS[flag] for flag in facts.flags)
        items.append(Item(name, facts.kind, PARAM_TYPE[facts.kind] | flags, *slots[name]))
    return Table(items, b"param")


def to_int32(value: float) -> int:
    """C conversion of a float to int32 on an ARM core: truncation, saturation, NaN to 0."""
    if math.isnan(value):
        return 0
    return max(-(2**31), min(2**31 - 1, int(value))) if math.isfinite(value) else (2**31 - 1 if value > 0 else -(2**31))


def _pack_float(form: str, value: float) -> bytes:
    try:
        return struct.pack(form, value)
    except OverflowError:
        return struct.pack(form, math.copysign(math.inf, value))


def pack(value: float, kind: str) -> bytes:
    """The bytes a variable of that storage type holds; whole numbers wrap around as in C."""
    if kind in {"float", "fp16"}:
        return _pack_float(FORMAT[kind], value)
    whole = int(value) if math.isfinite(value) else 0
    return (whole & (2 ** (8 * SIZE[kind]) - 1)).to_bytes(SIZE[kind], "little")


def unpack(data: bytes, kind: str) -> float:
    """The value of those bytes; missing bytes count as zero (the firmware copies without a length check)."""
    size = SIZE[kind]
    return float(struct.unpack(FORMAT[kind], data[:size].ljust(size, b"\0"))[0])


def fetch(value: float, stored: str, fetched: str) -> bytes:
    """A log value converted from its storage type to the type a client asked for, as log.c does it.

    float to whole number: C truncation to int32, then the low bytes (1013.25 as i8 is 0xF5); to float: exact.
    """
    if fetched in {"float", "fp16"}:
        if stored not in {"float", "fp16"}:
            value = unpack(pack(value, stored), stored)
        return _pack_float(FORMAT[fetched], value)
    whole = to_int32(value) if stored == "float" else int(unpack(pack(value, stored), stored))
    return (whole & 0xFFFFFFFF).to_bytes(4, "little")[: SIZE[fetched]]


def slots(values: Mapping[str, float]) -> dict[str, Slot]:
    """A slot for each name, holding that value, all in one new array."""
    array = np.array(list(values.values()), dtype=np.float64)
    return {name: (array, index) for index, name in enumerate(values)}
