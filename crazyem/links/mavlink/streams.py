"""From MAVLink messages to log blocks: the requested messages, and the fields of each in packets.

A block has the fields of its message as sent. Only outputs, rotor speeds, battery and state are computed here, because
they need parameters or several messages. They have their own names (`crazyem.signals.mavlink`).

The mapping from output channels to our rotors, and the scale of their values, come from the autopilot's parameters.
Our rotors: 1 front right, 2 back right, 3 back left, 4 front left, 1 and 3 counter-clockwise. PX4's and ArduPilot's
motors of an X quad: 1 front right, 2 back left, 3 front left, 4 back right, 1 and 2 counter-clockwise.
Sources: PX4 airframes reference "Quadrotor x" and actuator parameters; ArduPilot "Connect ESCs and motors", Quad X.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from crazyem.signals.mavlink import BATTERY, INFO, MAPPINGS, OUTPUTS, ROTORS
from crazyem.signals.sample import Block, Variable

OUR_ROTOR_PLACES = (0, 3, 1, 2)  # of our rotors 1..4: index of the autopilot's motor
SHORTEST_PULSE, LONGEST_PULSE = 1000.0, 2000.0  # us, the usual range of pulses
_PX4_MOTOR, _ARDUPILOT_MOTOR = 101, 33  # value of a channel's function for motor 1
PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT


def wanted(autopilot: int) -> tuple[str, ...]:
    """Names of the parameters that `Outputs.of` uses."""
    if autopilot == PX4:
        bank = [f"PWM_MAIN_{what}{n}" for what in ("FUNC", "MIN", "MAX") for n in range(1, 5)]
        return (*bank, *(f"CA_ROTOR{n}_P{axis}" for n in range(4) for axis in "XY"))
    if autopilot == ARDUPILOT:
        return ("MOT_PWM_MIN", "MOT_PWM_MAX", *(f"SERVO{n}_FUNCTION" for n in range(1, 5)))
    return ()


@dataclass(frozen=True, slots=True)
class Outputs:
    """Mapping of output channels and rotor speeds to our rotors.

    Attributes:
        channels: index of the output channel of our rotors 1..4. motors: index of the autopilot's motor, likewise.
        least, most: us of each channel 0..3 at no and at full thrust.
        assumed: assumptions in place of missing parameters.
    """

    channels: tuple[int, int, int, int] = OUR_ROTOR_PLACES
    motors: tuple[int, int, int, int] = OUR_ROTOR_PLACES
    least: tuple[float, ...] = (SHORTEST_PULSE,) * 4
    most: tuple[float, ...] = (LONGEST_PULSE,) * 4
    assumed: tuple[str, ...] = ()

    @classmethod
    def of(cls, autopilot: int, parameters: Mapping[str, float]) -> "Outputs":
        """The mapping from the autopilot's parameters; without a parameter, the usual value of an X quad."""
        assumed = []
        motors = _by_place(parameters)
        if motors is None:
            motors = OUR_ROTOR_PLACES
            assumed.append("motors are where an X quad has them")
        first, pattern = (_PX4_MOTOR, "PWM_MAIN_FUNC") if autopilot == PX4 else (_ARDUPILOT_MOTOR, "SERVO{}_FUNCTION")
        names = [pattern.format(n) if "{}" in pattern else f"{pattern}{n}" for n in range(1, 5)]
        functions = [parameters.get(name, math.nan) - first for name in names]
        if sorted(functions) == [0.0, 1.0, 2.0, 3.0]:
            channel = [functions.index(m) for m in range(4)]
        else:
            channel = [0, 1, 2, 3]
            assumed.append("outputs 1 to 4 drive motors 1 to 4")
        low = [parameters.get(f"PWM_MAIN_MIN{n}", parameters.get("MOT_PWM_MIN", math.nan)) for n in range(1, 5)]
        high = [parameters.get(f"PWM_MAIN_MAX{n}", parameters.get("MOT_PWM_MAX", math.nan)) for n in range(1, 5)]
        if not all(500.0 <= a < b <= 2500.0 for a, b in zip(low, high)):
            low, high = [SHORTEST_PULSE] * 4, [LONGEST_PULSE] * 4
            assumed.append("pulses go from 1000 to 2000 us")
        a, b, c, d = (channel[m] for m in motors)
        return cls((a, b, c, d), motors, tuple(low), tuple(high), tuple(assumed))

    def duty(self, values: Sequence[float]) -> tuple[float, float, float, float] | None:
        """Shares 0..1 of the full thrust command of our rotors, from the first outputs as sent; None if invalid.

        Numbers within -1..1 are shares (negative: reversed or stopped, 0 here); other numbers are pulses in us.
        """
        used = [float(values[i]) for i in self.channels]
        if not all(math.isfinite(v) for v in used):
            return None
        if all(-1.0 <= v <= 1.0 for v in used):
            a, b, c, d = (max(v, 0.0) for v in used)
            return a, b, c, d
        if not all(0.0 <= v <= 3000.0 for v in used):
            return None
        shares = [
            min(max((v - self.least[i]) / (self.most[i] - self.least[i]), 0.0), 1.0)
            for v, i in zip(used, self.channels, strict=True)
        ]
        a, b, c, d = shares
        return a, b, c, d

    def speeds(self, rpm: Sequence[float]) -> tuple[float, float, float, float]:
        """Speeds [rpm] of our rotors 1..4 from those of the autopilot's motors, without sign."""
        a, b, c, d = (abs(float(rpm[i])) for i in self.motors)
        return a, b, c, d


def _by_place(parameters: Mapping[str, float]) -> tuple[int, int, int, int] | None:
    """Motors by the signs of their positions (x forward, y right); None unless each corner has one."""
    corners: dict[tuple[bool, bool], int] = {}
    for n in range(4):
        x, y = (parameters.get(f"CA_ROTOR{n}_P{axis}", 0.0) for axis in "XY")
        if not (x and y):
            return None
        corners[(x > 0, y > 0)] = n
    if len(corners) < 4:
        return None
    return corners[True, True], corners[False, True], corners[False, False], corners[True, False]


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
