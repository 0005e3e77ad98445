"""From firmware log variables to signals: which variables make a signal, and the units and signs between them.

The wire speaks g, degrees, millimetres, PWM counts and an inverted pitch; everything above speaks SI, FLU bodies and
scalar-last quaternions. This file is the only place that knows both. Sources: crazyflie-firmware log tables (HEAD of
August 2026), src/utils/interface/quatcompress.h, src/modules/src/stabilizer.c.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from crazyem.signals.packet import Block, Packet
from crazyem.signals.sample import SIGNALS, Sample

STANDARD_GRAVITY = 9.81  # m/s^2, the constant the firmware multiplies and divides by
_RPM = 2.0 * math.pi / 60.0
_RPM_MISSING = 65535.0
_QUAT_MASK = (1 << 9) - 1
_NAN = float("nan")

Values = tuple[float, ...]


def decompress_quaternion(compressed: int) -> Values:
    """Unit quaternion (x, y, z, w) from the firmware's smallest-three 32-bit code (quatcompress.h).

    Bits 30-31 hold the index of the largest component, which is taken as positive; then 10 bits (sign, 9-bit
    magnitude in units of sqrt(1/2)/511) for each of the others in order x, y, z, w. One step is 0.00138.
    """
    code = int(compressed)
    largest = (code >> 30) & 3
    quaternion = [0.0, 0.0, 0.0, 0.0]
    squares = 0.0
    for i in (3, 2, 1, 0):
        if i == largest:
            continue
        magnitude = math.sqrt(0.5) * ((code & _QUAT_MASK) / _QUAT_MASK)
        quaternion[i] = -magnitude if (code >> 9) & 1 else magnitude
        squares += magnitude * magnitude
        code >>= 10
    quaternion[largest] = math.sqrt(max(0.0, 1.0 - squares))
    return tuple(quaternion)


def compress_quaternion(quaternion: Sequence[float]) -> int:
    """The firmware's 32-bit code of a quaternion (x, y, z, w): inverse of `decompress_quaternion`."""
    largest = max(range(4), key=lambda i: abs(quaternion[i]))
    negate = quaternion[largest] < 0
    code = largest
    for i in range(4):
        if i != largest:
            magnitude = int(_QUAT_MASK * (abs(quaternion[i]) / math.sqrt(0.5)) + 0.5)
            code = (code << 10) | (int((quaternion[i] < 0) != negate) << 9) | min(magnitude, _QUAT_MASK)
    return code


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> Values:
    """Quaternion (x, y, z, w), body FLU to world, of R = Rz(yaw) Ry(pitch) Rx(roll); angles in rad, right-handed."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _scaled(factor: float) -> Callable[[Values], Values]:
    return lambda values: tuple(float(v) * factor for v in values)


def _divided(divisor: float) -> Callable[[Values], Values]:
    return lambda values: tuple(float(v) / divisor for v in values)


def _as_is(values: Values) -> Values:
    return tuple(float(v) for v in values)


def _scalar_first(values: Values) -> Values:
    return (float(values[1]), float(values[2]), float(values[3]), float(values[0]))


def _compressed(values: Values) -> Values:
    code = values[0]
    return (_NAN,) * 4 if math.isnan(code) else decompress_quaternion(int(code))


def _legacy_euler(values: Values) -> Values:
    roll, pitch, yaw = (math.radians(v) for v in values)
    return quaternion_from_euler(roll, -pitch, yaw)  # stateEstimate.pitch keeps the legacy, inverted sign


def _legacy_rates(values: Values) -> Values:
    return (values[0] / 1000.0, -values[1] / 1000.0, values[2] / 1000.0)  # ratePitch = -gyro.y


def _rpm(values: Values) -> Values:
    return tuple(_NAN if v == _RPM_MISSING else float(v) * _RPM for v in values)


def _flying_bit(values: Values) -> Values:
    info = values[0]
    return (_NAN,) if math.isnan(info) else (float((int(info) >> 4) & 1),)


@dataclass(frozen=True, slots=True)
class Source:
    """Firmware variables that together, sampled at one instant, give one signal."""

    signal: str
    variables: tuple[str, ...]
    convert: Callable[[Values], Values]


def _names(pattern: str, parts: str) -> tuple[str, ...]:
    return tuple(pattern.replace("*", part) for part in parts.split())


# Best first within a signal: a float log beats its quantised twin, a real duty beats nothing.
SOURCES: tuple[Source, ...] = (
    Source("position", _names("stateEstimate.*", "x y z"), _as_is),
    Source("position", _names("stateEstimateZ.*", "x y z"), _divided(1000.0)),
    Source("velocity", _names("stateEstimate.*", "vx vy vz"), _as_is),
    Source("velocity", _names("stateEstimateZ.*", "vx vy vz"), _divided(1000.0)),
    Source("attitude", _names("stateEstimate.*", "qx qy qz qw"), _as_is),
    Source("attitude", _names("kalman.*", "q0 q1 q2 q3"), _scalar_first),
    Source("attitude", ("stateEstimateZ.quat",), _compressed),
    Source("attitude", _names("stateEstimate.*", "roll pitch yaw"), _legacy_euler),
    Source("body_rate", _names("gyro.*", "x y z"), _scaled(math.pi / 180.0)),
    Source("body_rate", _names("stateEstimateZ.*", "rateRoll ratePitch rateYaw"), _legacy_rates),
    Source("specific_force", _names("acc.*", "x y z"), _scaled(STANDARD_GRAVITY)),
    Source("motor_command", _names("motor.*", "m1 m2 m3 m4"), _divided(65535.0)),
    Source("rotor_speed", _names("motor.*_rpm", "m1 m2 m3 m4"), _rpm),
    Source("rotor_speed", _names("rpm.*", "m1 m2 m3 m4"), _rpm),
    Source("voltage", ("pm.vbat",), _as_is),
    Source("voltage", ("pm.vbatMV",), _divided(1000.0)),
    Source("wrench_command", _names("ctrlLee.*", "thrustSi torquex torquey torquez"), _as_is),
    Source("wrench_command", _names("ctrlLqg.*", "thrustSi torquex torquey torquez"), _as_is),
    Source("setpoint_position", _names("ctrltarget.*", "x y z"), _as_is),
    Source("setpoint_position", _names("ctrltargetZ.*", "x y z"), _divided(1000.0)),
    Source("setpoint_velocity", _names("ctrltarget.*", "vx vy vz"), _as_is),
    Source("setpoint_velocity", _names("ctrltargetZ.*", "vx vy vz"), _divided(1000.0)),
    Source("flying", ("supervisor.info",), _flying_bit),
    Source("flying", ("sys.isFlying",), _as_is),
)

# Blocks that each fit one packet of 26 bytes; what the estimator asks for when the user names nothing.
STATE_BLOCK = _names("stateEstimateZ.*", "x y z vx vy vz quat")
IMU_BLOCK = (*_names("gyro.*", "x y z"), *_names("acc.*", "x y z"))
MOTOR_BLOCK = (*_names("motor.*", "m1 m2 m3 m4"), "pm.vbatMV", "supervisor.info")
ROTOR_SPEED_BLOCK = _names("motor.*_rpm", "m1 m2 m3 m4")
SETPOINT_BLOCK = _names("ctrltarget.*", "x y z vx vy vz")
STANDARD_BLOCKS: tuple[tuple[str, ...], ...] = (STATE_BLOCK, IMU_BLOCK, MOTOR_BLOCK)


def standard_variables(available: Mapping[str, str] | Iterable[str], *, rotor_speed: bool = True) -> tuple[str, ...]:
    """Variables the estimator wants, out of those the drone offers.

    Args:
        available: names of the drone's log variables.
        rotor_speed: add measured rotor speeds where the drone has them.

    Returns: state, IMU, motor commands with voltage and flying flag, and rotor speeds if all four exist.
    """
    names = set(available)
    wanted = [name for block in STANDARD_BLOCKS for name in block if name in names]
    if rotor_speed and names.issuperset(ROTOR_SPEED_BLOCK):
        wanted.extend(ROTOR_SPEED_BLOCK)
    return tuple(wanted)


def sampled_together(variables: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Groups of `variables` that must share a packet: the standard blocks first, then the parts of each signal."""
    wanted = list(dict.fromkeys(variables))
    groups: list[tuple[str, ...]] = []
    taken: set[str] = set()
    for candidate in (*STANDARD_BLOCKS, ROTOR_SPEED_BLOCK, *(source.variables for source in SOURCES)):
        group = tuple(name for name in candidate if name in wanted and name not in taken)
        if len(group) > 1:
            groups.append(group)
            taken.update(group)
    return tuple(groups)


class BlockDecoder:
    """Turns the packets of one block into samples.

    Args:
        block: the block as subscribed or as recorded.
        signals: decode only these (to avoid counting a signal twice when two blocks carry it); None = all.
    """

    def __init__(self, block: Block, signals: Iterable[str] | None = None) -> None:
        index = {variable.name: i for i, variable in enumerate(block.variables)}
        allowed = set(SIGNALS) if signals is None else set(signals)
        chosen: dict[str, Source] = {}
        for source in SOURCES:
            if source.signal in allowed and source.signal not in chosen and all(v in index for v in source.variables):
                chosen[source.signal] = source
        self.block = block
        self.signals: tuple[str, ...] = tuple(name for name in SIGNALS if name in chosen)
        self._plan = tuple(
            (name, tuple(index[v] for v in chosen[name].variables), chosen[name].convert) for name in self.signals
        )

    def decode(self, packet: Packet) -> list[Sample]:
        """Samples of one packet, in the order of `SIGNALS`; the time is the firmware clock in seconds."""
        time = packet.firmware_time_ms / 1000.0
        values = packet.values
        return [
            Sample(name, time, convert(tuple(values[i] for i in where)), packet.host_time)
            for name, where, convert in self._plan
        ]


def decoders(blocks: Iterable[Block]) -> dict[int, BlockDecoder]:
    """One decoder a block, each signal decoded from one block only: the one with the best source for it."""
    blocks = tuple(blocks)
    names = {block.identifier: {v.name for v in block.variables} for block in blocks}
    assigned: dict[str, int] = {}
    for source in SOURCES:
        if source.signal in assigned:
            continue
        for block in blocks:
            if names[block.identifier].issuperset(source.variables):
                assigned[source.signal] = block.identifier
                break
    return {
        block.identifier: BlockDecoder(block, [s for s, where in assigned.items() if where == block.identifier])
        for block in blocks
    }
