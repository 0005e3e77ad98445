"""From MAVLink messages to log blocks: the requested messages, and the fields of each in packets.

A block has the fields of its message as sent. Only outputs, rotor speeds, battery and state are computed here, because
they need parameters or several messages. They have their own names (`crazyem.signals.mavlink`).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from crazyem.links.mavlink.motors import Outputs
from crazyem.signals.mavlink import BATTERY, INFO, MAPPINGS, OUTPUTS, ROTORS
from crazyem.signals.sample import Block, Variable

# Bits of the Crazyflie's supervisor, as used in the rest of the program.
CAN_ARM, ARMED, AUTO_ARM, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << i for i in range(8))
_SAFETY_ARMED = 128  # bit of HEARTBEAT.base_mode
_STANDBY, _ACTIVE, _CRITICAL, _EMERGENCY, _POWEROFF, _TERMINATION = range(3, 9)  # MAV_STATE
_IN_AIR = {2, 3, 4}  # MAV_LANDED_STATE: in air, taking off, landing
NO_CELL = 65535

# Requested at the rate of the log; the states of battery and drone are slower.
FAST_MESSAGES = ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "ATTITUDE", "HIGHRES_IMU", "ACTUATOR_OUTPUT_STATUS",
        "SERVO_OUTPUT_RAW", "ESC_STATUS", "ESC_TELEMETRY_1_TO_4", "POSITION_TARGET_LOCAL_NED")  # fmt: skip
SLOW_MESSAGES = ("BATTERY_STATUS", "SYS_STATUS", "EXTENDED_SYS_STATE")
SLOW_HZ = 10.0
# The older request: MAV_DATA_STREAM raw sensors, extended status, RC channels (servos), position, extra 1, extra 2.
STREAM_GROUPS = ((1, True), (2, False), (3, True), (6, True), (10, True), (11, True))

_INTEGER_TYPES = {"battery": "uint32_t", "SCALED_IMU": "int16_t", "RAW_IMU": "int16_t"}
# Of several messages with the same content, only one is used: the first in this order that arrives.
ALTERNATIVE_MESSAGES: tuple[tuple[str, ...], ...] = (
    ("ATTITUDE_QUATERNION", "ATTITUDE"),
    ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"),
    ("ACTUATOR_OUTPUT_STATUS", "SERVO_OUTPUT_RAW"),
    ("ESC_STATUS", "ESC_TELEMETRY_1_TO_4"),
    ("BATTERY_STATUS", "SYS_STATUS"),
)
_POSITION_BITS, _LOCAL_FRAME = 0x007, 1


def block_names() -> tuple[str, ...]:
    """All possible blocks, in the order of their numbers."""
    return (*dict.fromkeys(m.message for m in MAPPINGS), INFO)


def variables_of(name: str) -> tuple[Variable, ...]:
    """Variables of a block: each field once, in the order of the table."""
    if name == INFO:
        return (Variable(f"{INFO}.info", "uint16_t"),)
    ctype = _INTEGER_TYPES.get(name, "float")
    found = dict.fromkeys(v for m in MAPPINGS if m.message == name for v in m.variables)
    return tuple(Variable(v, ctype) for v in found)


class Streams:
    """Turns messages into values of blocks.

    Args:
        outputs: mapping of the motor outputs.

    Attributes:
        cells: number of battery cells, 0 if unknown.
    """

    def __init__(self, outputs: Outputs | None = None) -> None:
        self.outputs = outputs or Outputs()
        self.cells = 0
        self._landed: int | None = None
        self._beat: tuple[int, int] = (0, 0)  # base mode, state
        self._taken: set[str] | None = None
        plain = {m.message for m in MAPPINGS} - {OUTPUTS, ROTORS, BATTERY}
        self._plain = {n: tuple(v.name.partition(".")[2] for v in variables_of(n)) for n in plain}
        self._special: dict[str, Callable[[Mapping[str, Any]], tuple[str, tuple[float, ...]] | None]] = {
            "ACTUATOR_OUTPUT_STATUS": self._actuators,
            "SERVO_OUTPUT_RAW": self._servos,
            "ESC_STATUS": self._speeds,
            "ESC_TELEMETRY_1_TO_4": self._speeds,
            "BATTERY_STATUS": self._battery,
            "SYS_STATUS": self._system,
            "HEARTBEAT": self._heartbeat,
            "EXTENDED_SYS_STATE": self._extended,
        }

    @property
    def messages(self) -> set[str]:
        """Names of all messages that can be used."""
        return {*self._plain, *self._special}

    def choose(self, seen: set[str], *, raw_imu: bool) -> set[str]:
        """Select the messages to use, from those `seen`; returns the names of their blocks."""
        dropped: set[str] = set() if raw_imu else {"RAW_IMU"}
        for group in ALTERNATIVE_MESSAGES:
            present = [m for m in group if m in seen and m not in dropped]
            # if no alternative has arrived, all remain possible
            dropped |= set(group) - set(present[:1]) if present else set()
        self._taken = self.messages - dropped
        blocks = {m for m in seen if m in self._plain} - dropped
        blocks |= {OUTPUTS} if {"ACTUATOR_OUTPUT_STATUS", "SERVO_OUTPUT_RAW"} & seen else set()
        blocks |= {ROTORS} if {"ESC_STATUS", "ESC_TELEMETRY_1_TO_4"} & seen else set()
        return blocks | {BATTERY, INFO, "POSITION_TARGET_LOCAL_NED"}

    def uses(self, name: str) -> bool:
        """Whether this message is selected, or no selection was made yet."""
        return self._taken is None or name in self._taken

    def values(self, name: str, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        """Block and its values from a message; None: not for a block, or no valid value (NaN, masked, no reading)."""
        special = self._special.get(name)
        found = special(fields) if special is not None else self._fields(name, fields)
        if found is None or not all(math.isfinite(v) for v in found[1]):
            return None
        return found

    def _fields(self, name: str, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        names = self._plain.get(name)
        if names is None or fields.get("id", 0) != 0:  # a second sensor
            return None
        if name == "POSITION_TARGET_LOCAL_NED" and (
            fields["type_mask"] & _POSITION_BITS or fields["coordinate_frame"] != _LOCAL_FRAME
        ):
            return None
        values = tuple(fields[n] for n in names)
        if name == "ATTITUDE_QUATERNION" and not 0.5 < math.hypot(*values[:4]) < 2.0:
            return None
        return name, values

    def _actuators(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        duty = self.outputs.duty(fields["actuator"])
        return None if duty is None else (OUTPUTS, duty)

    def _servos(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        if fields["port"] != 0:
            return None
        duty = self.outputs.duty([fields[f"servo{n}_raw"] for n in range(1, 9)])
        return None if duty is None else (OUTPUTS, duty)

    def _speeds(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        return None if fields.get("index", 0) != 0 else (ROTORS, self.outputs.speeds(fields["rpm"]))

    def _battery(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        cells = [v for v in fields["voltages"] if v != NO_CELL] + [v for v in fields["voltages_ext"] if v]
        if fields["id"] != 0 or not cells or not sum(cells):
            return None
        self._count_cells(len(cells), sum(cells))
        return BATTERY, (float(sum(cells)),)

    def _system(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        millivolts = fields["voltage_battery"]
        if millivolts in (0, NO_CELL):
            return None
        self._count_cells(1, millivolts)
        return BATTERY, (float(millivolts),)

    def _count_cells(self, told: int, millivolts: float) -> None:
        """Update the number of cells; if only the total voltage is known, the least number with at most 4.3 V each."""
        self.cells = max(self.cells, told if told > 1 else math.ceil(millivolts / 4300.0))

    def _heartbeat(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
        self._beat = (fields["base_mode"], fields["system_status"])
        return self._state()

    def _extended(self, fields: Mapping[str, Any]) -> tuple[str, tuple[float, ...]] | None:
        if fields["landed_state"]:
            self._landed = fields["landed_state"]
        return self._state() if self._beat != (0, 0) else None

    def _state(self) -> tuple[str, tuple[float, ...]]:
        mode, state = self._beat
        armed = bool(mode & _SAFETY_ARMED)
        flying = armed and (self._landed in _IN_AIR if self._landed is not None else state == _ACTIVE)
        ill = state in (_EMERGENCY, _POWEROFF, _TERMINATION)
        info = armed * ARMED | flying * FLYING | ill * CRASHED
        info |= (state in (_STANDBY, _ACTIVE, _CRITICAL)) * (CAN_ARM | CAN_FLY)
        return INFO, (float(info),)


def blocks_of(names: set[str], rate_hz: float) -> dict[str, Block]:
    """Blocks of these names, numbered by their position among all possible blocks."""
    slow = {BATTERY, INFO}
    return {
        name: Block(number, variables_of(name), round(1000.0 / (min(SLOW_HZ, rate_hz) if name in slow else rate_hz)))
        for number, name in enumerate(block_names())
        if name in names
    }
