"""Data from sources: log packets with raw values of the firmware, and time-stamped samples in SI units."""

from dataclasses import dataclass

# C type -> bytes on the wire, for every type a log variable can have (cflib's names).
CTYPE_SIZES: dict[str, int] = {
    "uint8_t": 1,
    "uint16_t": 2,
    "uint32_t": 4,
    "int8_t": 1,
    "int16_t": 2,
    "int32_t": 4,
    "FP16": 2,
    "float": 4,
}


@dataclass(frozen=True, slots=True)
class Variable:
    """A log variable: `group.name` and its storage type (uint8_t, int16_t, float, ...)."""

    name: str
    ctype: str


@dataclass(frozen=True, slots=True)
class Block:
    """Variables that travel in one packet, all sampled at the same firmware time."""

    identifier: int
    variables: tuple[Variable, ...]
    period_ms: int


@dataclass(frozen=True, slots=True)
class Packet:
    """One log packet: raw firmware values (firmware units) in the order of the block's variables.

    Attributes:
        block: identifier of the block.
        firmware_time_ms: firmware clock, ms, unwrapped from its 24 bits.
        host_time: s since the epoch when the host received it.
        values: one number per variable.
    """

    block: int
    firmware_time_ms: int
    host_time: float
    values: tuple[float, ...]


# name -> (number of components, unit, frame), of the signals that the estimator uses
_ESTIMATED: dict[str, tuple[int, str, str]] = {
    "position": (3, "m", "world"),
    "velocity": (3, "m/s", "world"),
    "attitude": (4, "1", "quaternion x y z w, body (FLU) to world"),
    "body_rate": (3, "rad/s", "body FLU"),
    "specific_force": (3, "m/s^2", "body FLU"),
    "motor_command": (4, "1", "duty sent to rotors 1..4, after battery compensation, 0..1"),
    "rotor_speed": (4, "rad/s", "rotors 1..4"),
    "voltage": (1, "V", ""),
    "wrench_command": (4, "N, N m", "thrust and torque asked for by the controller, body FLU"),
    "setpoint_position": (3, "m", "world"),
    "setpoint_velocity": (3, "m/s", "world"),
    "flying": (1, "1", "1 while the firmware says that rotors turn, else 0"),
}
ESTIMATOR_SIGNALS = tuple(_ESTIMATED)
SIGNALS = {
    **_ESTIMATED,
    # additional signals of recordings, for diagnosis and viewers
    "acceleration": (3, "m/s^2", "world, gravity removed"),
    "euler": (3, "rad", "roll, pitch, yaw (ZYX, right-handed), body FLU to world"),
    "motor_request": (4, "1", "thrust asked of rotors 1..4 before battery compensation, 0..1"),
    "mixer_command": (4, "1", "thrust, roll, pitch, yaw handed to the mixer, PWM counts"),
    "setpoint_acceleration": (3, "m/s^2", "world"),
    "setpoint_euler": (3, "rad", "roll, pitch, yaw (ZYX, right-handed), body FLU to world"),
    "setpoint_rate": (3, "rad/s", "body FLU"),
}

# names of the components in files and viewers; a single component has none
COMPONENTS: dict[str, tuple[str, ...]] = {
    "attitude": ("x", "y", "z", "w"),
    "euler": ("roll", "pitch", "yaw"),
    "setpoint_euler": ("roll", "pitch", "yaw"),
    "motor_command": ("m1", "m2", "m3", "m4"),
    "motor_request": ("m1", "m2", "m3", "m4"),
    "rotor_speed": ("m1", "m2", "m3", "m4"),
    "wrench_command": ("thrust", "torque_x", "torque_y", "torque_z"),
    "mixer_command": ("thrust", "roll", "pitch", "yaw"),
}


def components(quantity: str) -> tuple[str, ...]:
    """Names of the components of a vocabulary signal: () for a scalar."""
    count = SIGNALS[quantity][0]
    return COMPONENTS.get(quantity, ("x", "y", "z")[:count] if count > 1 else ())


@dataclass(frozen=True, slots=True)
class Sample:
    """One value of one signal.

    Attributes:
        signal: a key of `SIGNALS`.
        time: seconds on the clock of the source (firmware clock for a drone), unwrapped.
        value: the components, SI; NaN where a component is missing.
        host_time: seconds since the epoch at which the host received it, NaN if unknown.
    """

    signal: str
    time: float
    value: tuple[float, ...]
    host_time: float = float("nan")
