"""The tables of contents of log variables and parameters, their storage types, and values in and out of bytes.

Names, types and flags as in crazyflie-firmware (log.h, param.h; PARAM_ADD and LOG_ADD of each module). A name that is
not listed here is a float, which most of the firmware's variables are.
"""

import math
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

Slot = tuple[np.ndarray, int]  # where a value lives: a float64 array and an index into it

LOG_TYPE = {"u8": 1, "u16": 2, "u32": 3, "i8": 4, "i16": 5, "i32": 6, "float": 7, "fp16": 8}
PARAM_TYPE = {"u8": 0x08, "u16": 0x09, "u32": 0x0A, "i8": 0x00, "i16": 0x01, "i32": 0x02, "float": 0x06}
FORMAT = {"u8": "<B", "u16": "<H", "u32": "<I", "i8": "<b", "i16": "<h", "i32": "<i", "float": "<f", "fp16": "<e"}
SIZE = {name: struct.calcsize(form) for name, form in FORMAT.items()}
LOG_TYPE_NAME = {code: name for name, code in LOG_TYPE.items()}

PARAM_READ_ONLY, PARAM_EXTENDED = 0x40, 0x10
MAX_NAME = 24  # len(group) + len(name), so that a table item fits a packet

# "group type names", everything that is not a float.
_LOG_TYPES = """
crtp u16 rxRate txRate
sys i8 testLogParam
sys u8 canfly isFlying isTumbled
memTst u32 errCntW
supervisor u16 info
locSrvZ u16 tick
motor i32 m1req m2req m3req m4req
motor u16 m1 m2 m3 m4 m1_rpm m2_rpm m3_rpm m4_rpm
sensfusion6 u8 isInit isCalibrated
stateEstimateZ i16 x y z vx vy vz ax ay az rateRoll ratePitch rateYaw
stateEstimateZ u32 quat
controller i16 ctr_yaw
stabilizer u32 intToOut
ctrltargetZ i16 x y z vx vy vz ax ay az
ctrltarget u8 mode_x mode_y mode_z mode_roll mode_pitch mode_yaw mode_quat
pm u16 vbatMV
pm i8 state
pm u8 batteryLevel
"""

_PARAM_TYPES = """
system u8 storageStats storageReformat assertInfo testLogParam doAssert taskDump
system i8 selftestPassed
imu_sensors u8 HMC5883L MS5611 BMM150 BMP388 HMC5883L_SIM MS5611_SIM
crtpsrv u16 echoDelay
memTst u8 resetW
supervisor u8 infdmp tmblChckEn
supervisor u16 prefltTimeout landedTimeout spinupTimeout
stabilizer u8 stop estimator controller
commander u8 enHighLevel
flightmode u8 althold poshold posSet yawMode stabModeRoll stabModePitch stabModeYaw
locSrv u8 enRangeStreamFP32 enLhAngleStream enLhMtchStm maxTimeLhMtchStm minBsLhMtchStm
kalman u8 resetEstimation robustTdoa robustTwr
pid_rate i8 rateFiltEn
pid_attitude i8 attFiltEn
posCtlPid u16 thrustBase thrustMin
ctrlINDI u8 outerLoopActive
powerDist u32 idleThrust
motorPowerSet u8 enable
motorPowerSet u16 m1 m2 m3 m4
hlCommander u8 groupmask
firmware u32 revision0
firmware u16 revision1
firmware u8 modified
deck u8 bcZRanger bcZRanger2 bcFlow bcFlow2 bcLighthouse4 bcLoco bcDWM1000 bcLedRing
"""

_READ_ONLY_GROUPS = {"deck", "firmware", "imu_sensors"}
_READ_ONLY = {"system.selftestPassed"}
_PERSISTENT_GROUPS = {"ctrlMel", "pid_rate", "pid_attitude", "posCtlPid", "velCtlPid", "ctrlINDI", "posCtrlIndi"}
_PERSISTENT = {"powerDist.idleThrust"} | {
    f"supervisor.{name}" for name in ("prefltTimeout", "landedTimeout", "tmblChckEn", "spinupTimeout", "crashDetectGs")
}


def _parse(facts: str) -> dict[str, str]:
    types = {}
    for line in facts.split("\n"):
        if line:
            group, kind, *names = line.split()
            types.update({f"{group}.{name}": kind for name in names})
    return types


_LOG_KIND, _PARAM_KIND = _parse(_LOG_TYPES), _parse(_PARAM_TYPES)


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
    """Names with each group contiguous, groups in order of first appearance, as the linker lays the real tables out."""
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
        kind, group = _PARAM_KIND.get(name, "float"), name.split(".", 1)[0]
        flags = PARAM_READ_ONLY if group in _READ_ONLY_GROUPS or name in _READ_ONLY else 0
        flags |= PARAM_EXTENDED if group in _PERSISTENT_GROUPS or name in _PERSISTENT else 0
        items.append(Item(name, kind, PARAM_TYPE[kind] | flags, *slots[name]))
    return Table(items, b"param")


def to_int32(value: float) -> int:
    """C conversion of a float to int32: truncation; the ARM core saturates, and turns NaN into 0."""
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
