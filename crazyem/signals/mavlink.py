"""Table from fields of MAVLink messages to signals, for live links and for the reader of tlogs.

PX4 and MAVLink use FRD bodies and a north-east-down world; ours are FLU and north-west-up: half a turn about x.
Sources: mavlink.io/en/messages/common.html; units of RAW_IMU: ArduPilot's GCS_MAVLINK.
"""

import math
from dataclasses import dataclass

MILLI_G = 9.80665e-3  # m/s^2, the standard gravity of autopilots
RPM_IN_RAD_PER_S = 2.0 * math.pi / 60.0

# Blocks that are computed from several messages or parameters have their own names, and our order of rotors.
OUTPUTS, ROTORS, BATTERY, INFO = "outputs", "rotors", "battery", "supervisor"


@dataclass(frozen=True, slots=True)
class Mapping:
    """Fields of one message that form a signal.

    Attributes:
        signal: key of `crazyem.signals.sample.SIGNALS`.
        message, fields: names in MAVLink; for computed blocks, see `OUTPUTS`.
        kind: change of frame: "vector", "quaternion" (w x y z), "angles" (roll, pitch, yaw), "plain" (none).
        factor: to SI units.
    """

    signal: str
    message: str
    fields: tuple[str, ...]
    kind: str = "vector"
    factor: float = 1.0

    @property
    def variables(self) -> tuple[str, ...]:
        """Names in log blocks."""
        return tuple(f"{self.message}.{name}" for name in self.fields)


def named(pattern: str, parts: str) -> tuple[str, ...]:
    """The names that `pattern` gives with each word of `parts` for its asterisk."""
    return tuple(pattern.replace("*", part) for part in parts.split())


_XYZ, _V = named("*", "x y z"), named("v*", "x y z")
_ANGLES, _SPEEDS = named("*", "roll pitch yaw"), named("*speed", "roll pitch yaw")
_ACC, _GYRO = named("*acc", "x y z"), named("*gyro", "x y z")
_FOUR = named("m*", "1 2 3 4")

# Best first within a signal: body rates from the message of the attitude are better than those of another instant.
MAPPINGS: tuple[Mapping, ...] = (
    Mapping("position", "LOCAL_POSITION_NED", _XYZ),
    Mapping("velocity", "LOCAL_POSITION_NED", _V),
    Mapping("attitude", "ATTITUDE_QUATERNION", named("q*", "1 2 3 4"), "quaternion"),
    Mapping("attitude", "ATTITUDE", _ANGLES, "angles"),
    Mapping("body_rate", "ATTITUDE_QUATERNION", _SPEEDS),
    Mapping("body_rate", "ATTITUDE", _SPEEDS),
    Mapping("body_rate", "HIGHRES_IMU", _GYRO),
    Mapping("body_rate", "SCALED_IMU", _GYRO, factor=1e-3),
    Mapping("body_rate", "RAW_IMU", _GYRO, factor=1e-3),
    Mapping("specific_force", "HIGHRES_IMU", _ACC),
    Mapping("specific_force", "SCALED_IMU", _ACC, factor=MILLI_G),
    Mapping("specific_force", "RAW_IMU", _ACC, factor=MILLI_G),
    Mapping("motor_command", OUTPUTS, _FOUR, "plain"),
    Mapping("rotor_speed", ROTORS, _FOUR, "plain", RPM_IN_RAD_PER_S),
    Mapping("voltage", BATTERY, ("mV",), "plain", 1e-3),
    Mapping("setpoint_position", "POSITION_TARGET_LOCAL_NED", _XYZ),
)

_ATTITUDES = frozenset(row.message for row in MAPPINGS if row.signal == "attitude")


def carries_attitude(variable: str) -> bool:
    """Whether a log variable belongs to a message with an attitude; a prefix with the sender ("158/") is ignored."""
    return variable.rsplit("/", 1)[-1].split(".", maxsplit=1)[0] in _ATTITUDES


def mapping(signal: str, message: str) -> Mapping:
    """The row of a signal and a message; KeyError if there is none."""
    for row in MAPPINGS:
        if (row.signal, row.message) == (signal, message):
            return row
    raise KeyError((signal, message))
