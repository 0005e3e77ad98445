"""From firmware log variables to signals: the variables of each signal, and conversions of units and signs.

The firmware sends g, degrees, millimetres, PWM counts and an inverted pitch; the rest of the program uses SI, FLU
bodies and scalar-last quaternions. Only this file knows both. Sources: crazyflie-firmware log tables (HEAD of August
2026), src/utils/interface/quatcompress.h, src/modules/src/stabilizer.c.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.signals.mavlink import MAPPINGS, RPM_IN_RAD_PER_S, named
from crazyem.signals.sample import ESTIMATOR_SIGNALS, SIGNALS, Block, Packet, Sample

STANDARD_GRAVITY = 9.81  # m/s^2, the constant in the firmware
_RPM_MISSING = 65535.0
_QUAT_MASK = (1 << 9) - 1
_NAN = float("nan")

Values = tuple[float, ...]


def decompress_quaternion(compressed: int) -> Values:
    """Unit quaternion (x, y, z, w) from the firmware's smallest-three 32-bit code (quatcompress.h).

    Bits 30-31 hold the index of the largest component, which is positive; then 10 bits (sign, 9-bit magnitude in
    units of sqrt(1/2)/511) for each of the others in order x, y, z, w. One step is 0.00138.
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


# Each conversion has a version for one packet (tuples, live) and one for whole columns (arrays, recordings). Both do
# the same arithmetic in the same order, so that live values and replayed values are equal bit for bit.
Columns = Sequence[NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Conversion:
    """Conversion of firmware values to the components of a signal: `one` packet, or `many` ((n,) columns to (n, c))."""

    one: Callable[[Values], Values]
    many: Callable[[Columns], NDArray[np.float64]]


def _scaled(factor: float) -> Conversion:
    return Conversion(
        lambda values: tuple(float(v) * factor for v in values),
        lambda columns: _stacked(columns) * factor,
    )


def _divided(divisor: float) -> Conversion:
    return Conversion(
        lambda values: tuple(float(v) / divisor for v in values),
        lambda columns: _stacked(columns) / divisor,
    )


def _cut_off(divisor: float) -> Conversion:
    """Conversion of truncated counts to the middle of the count; 0 means no measurement and stays 0."""

    def many(columns: Columns) -> NDArray[np.float64]:
        counts = _stacked(columns)
        return np.where(counts > 0.0, counts + 0.5, counts) / divisor

    return Conversion(lambda values: tuple((v + 0.5 if v > 0.0 else float(v)) / divisor for v in values), many)


def _row_by_row(one: Callable[[Values], Values], width: int) -> Conversion:
    """A conversion of columns row by row with scalar arithmetic: numpy's sin and cos may differ in the last bit."""

    def many(columns: Columns) -> NDArray[np.float64]:
        rows = zip(*(np.asarray(c, float).tolist() for c in columns), strict=True)
        flat = [x for row in rows for x in one(row)]
        return np.array(flat, float).reshape(-1, width)

    return Conversion(one, many)


def _stacked(columns: Columns) -> NDArray[np.float64]:
    return np.column_stack([np.asarray(c, float) for c in columns])


_as_is = Conversion(lambda values: tuple(float(v) for v in values), _stacked)

_scalar_first = Conversion(
    lambda values: (float(values[1]), float(values[2]), float(values[3]), float(values[0])),
    lambda columns: _stacked(columns)[:, [1, 2, 3, 0]],
)


def _compressed_one(values: Values) -> Values:
    code = values[0]
    return (_NAN,) * 4 if math.isnan(code) else decompress_quaternion(int(code))


def decompress_quaternions(codes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4) quaternions (x, y, z, w) from (n,) codes; NaN where the code is NaN. See `decompress_quaternion`."""
    codes = np.asarray(codes, float)
    sound = np.isfinite(codes)
    code = np.where(sound, codes, 0.0).astype(np.int64)
    largest = (code >> 30) & 3
    quaternion = np.zeros((code.size, 4))
    squares = np.zeros(code.size)
    for i in (3, 2, 1, 0):
        small = largest != i
        magnitude = math.sqrt(0.5) * ((code & _QUAT_MASK) / _QUAT_MASK)
        value = np.where((code >> 9) & 1, -magnitude, magnitude)
        quaternion[:, i] = np.where(small, value, 0.0)
        squares += np.where(small, magnitude * magnitude, 0.0)
        code = np.where(small, code >> 10, code)
    quaternion[np.arange(code.size), largest] = np.sqrt(np.maximum(0.0, 1.0 - squares))
    quaternion[~sound] = np.nan
    return quaternion


_compressed = Conversion(_compressed_one, lambda columns: decompress_quaternions(columns[0]))


def _legacy_euler_one(values: Values) -> Values:
    roll, pitch, yaw = (math.radians(v) for v in values)
    return quaternion_from_euler(roll, -pitch, yaw)  # stateEstimate.pitch keeps the legacy, inverted sign


_legacy_euler = _row_by_row(_legacy_euler_one, 4)

_legacy_rates = Conversion(
    lambda values: (values[0] / 1000.0, -values[1] / 1000.0, values[2] / 1000.0),  # ratePitch = -gyro.y
    lambda columns: _stacked(columns) / 1000.0 * np.array([1.0, -1.0, 1.0]),
)


def _rpm_many(columns: Columns) -> NDArray[np.float64]:
    rpm = _stacked(columns)
    return np.where(rpm == _RPM_MISSING, np.nan, rpm * RPM_IN_RAD_PER_S)


_rpm = Conversion(
    lambda values: tuple(_NAN if v == _RPM_MISSING else float(v) * RPM_IN_RAD_PER_S for v in values), _rpm_many
)


def _flying_many(columns: Columns) -> NDArray[np.float64]:
    info = np.asarray(columns[0], float)
    sound = np.isfinite(info)
    bit = (np.where(sound, info, 0.0).astype(np.int64) >> 4) & 1
    return np.where(sound, bit, np.nan)[:, None]


_flying_bit = Conversion(
    lambda values: (_NAN,) if math.isnan(values[0]) else (float((int(values[0]) >> 4) & 1),), _flying_many
)

# stateEstimateZ.az includes gravity, in mm/s^2 of the firmware's own 9.81
_compressed_acceleration = Conversion(
    lambda values: (values[0] / 1000.0, values[1] / 1000.0, values[2] / 1000.0 - STANDARD_GRAVITY),
    lambda columns: _stacked(columns) / 1000.0 - np.array([0.0, 0.0, STANDARD_GRAVITY]),
)


@dataclass(frozen=True, slots=True)
class Source:
    """Firmware variables that together, sampled at one instant, give one signal."""

    signal: str
    variables: tuple[str, ...]
    convert: Conversion


def _half_turn(factor: float) -> Conversion:
    """FRD to FLU, NED to NWU (see crazyem.signals.mavlink)."""
    signs = np.array([1.0, -1.0, -1.0])

    def many(columns: Columns) -> NDArray[np.float64]:
        return np.asarray(_stacked(columns) * signs * factor, float)

    return Conversion(lambda v: (float(v[0]) * factor, float(v[1]) * -1.0 * factor, float(v[2]) * -1.0 * factor), many)


_turned_quaternion = Conversion(
    lambda v: (float(v[1]), float(v[2]) * -1.0, float(v[3]) * -1.0, float(v[0])),
    lambda columns: _stacked(columns)[:, [1, 2, 3, 0]] * np.array([1.0, -1.0, -1.0, 1.0]),
)
_turned_angles = _row_by_row(lambda v: quaternion_from_euler(v[0], v[1] * -1.0, v[2] * -1.0), 4)


def _conversion(kind: str, factor: float) -> Conversion:
    fixed = {"quaternion": _turned_quaternion, "angles": _turned_angles}
    return fixed.get(kind) or (_half_turn if kind == "vector" else _scaled)(factor)


MAVLINK_SOURCES: tuple[Source, ...] = tuple(
    Source(m.signal, m.variables, _conversion(m.kind, m.factor)) for m in MAPPINGS
)
_MAVLINK_OUTPUTS = tuple(s for s in MAVLINK_SOURCES if s.signal == "motor_command")

# Best first within a signal: a float log before its quantised form.
SOURCES: tuple[Source, ...] = (
    Source("position", named("stateEstimate.*", "x y z"), _as_is),
    Source("position", named("stateEstimateZ.*", "x y z"), _divided(1000.0)),
    Source("velocity", named("stateEstimate.*", "vx vy vz"), _as_is),
    Source("velocity", named("stateEstimateZ.*", "vx vy vz"), _divided(1000.0)),
    Source("attitude", named("stateEstimate.*", "qx qy qz qw"), _as_is),
    Source("attitude", named("kalman.*", "q0 q1 q2 q3"), _scalar_first),
    Source("attitude", ("stateEstimateZ.quat",), _compressed),
    Source("attitude", named("stateEstimate.*", "roll pitch yaw"), _legacy_euler),
    Source("body_rate", named("gyro.*", "x y z"), _scaled(math.pi / 180.0)),
    Source("body_rate", named("stateEstimateZ.*", "rateRoll ratePitch rateYaw"), _legacy_rates),
    Source("specific_force", named("acc.*", "x y z"), _scaled(STANDARD_GRAVITY)),
    Source("motor_command", named("motor.*", "m1 m2 m3 m4"), _divided(65535.0)),  # present firmware, as over a link
    Source("rotor_speed", named("motor.*_rpm", "m1 m2 m3 m4"), _rpm),
    Source("rotor_speed", named("rpm.*", "m1 m2 m3 m4"), _rpm),
    Source("voltage", ("pm.vbat",), _as_is),
    # whole mV of a cell, truncated (pmSetBatteryVoltage): uncorrected, thrust and mass would be 0.025 % too small
    Source("voltage", ("pm.vbatMV",), _cut_off(1000.0)),
    Source("wrench_command", named("ctrlLee.*", "thrustSi torquex torquey torquez"), _as_is),
    Source("wrench_command", named("ctrlLqg.*", "thrustSi torquex torquey torquez"), _as_is),
    Source("setpoint_position", named("ctrltarget.*", "x y z"), _as_is),
    Source("setpoint_position", named("ctrltargetZ.*", "x y z"), _divided(1000.0)),
    Source("setpoint_velocity", named("ctrltarget.*", "vx vy vz"), _as_is),
    Source("setpoint_velocity", named("ctrltargetZ.*", "vx vy vz"), _divided(1000.0)),
    Source("flying", ("supervisor.info",), _flying_bit),
    Source("flying", ("sys.isFlying",), _as_is),
    Source("acceleration", named("stateEstimate.*", "ax ay az"), _scaled(STANDARD_GRAVITY)),
    Source("acceleration", named("stateEstimateZ.*", "ax ay az"), _compressed_acceleration),
    Source("mixer_command", named("controller.cmd_*", "thrust roll pitch yaw"), _as_is),
    Source("setpoint_acceleration", named("ctrltarget.*", "ax ay az"), _as_is),
    *MAVLINK_SOURCES,
)
# motor.m1..4 is a duty or a request, depending on the firmware (crazyem/recordings/motor_meaning.py); pwm.* is a duty.
DUTY_SOURCES: tuple[Source, ...] = (
    Source("motor_command", named("pwm.*_pwm", "m1 m2 m3 m4"), _divided(65535.0)),
    Source("motor_command", named("motor.*", "m1 m2 m3 m4"), _divided(65535.0)),
    *_MAVLINK_OUTPUTS,
)
REQUEST_SOURCES: tuple[Source, ...] = (
    Source("motor_command", named("pwm.*_pwm", "m1 m2 m3 m4"), _divided(65535.0)),
    Source("motor_request", named("motor.*", "m1 m2 m3 m4"), _divided(65535.0)),
    *_MAVLINK_OUTPUTS,
)

# Default blocks of the estimator; each fits into one packet of 26 bytes.
STATE_BLOCK = named("stateEstimateZ.*", "x y z vx vy vz quat")
IMU_BLOCK = (*named("gyro.*", "x y z"), *named("acc.*", "x y z"))
MOTOR_BLOCK = (*named("motor.*", "m1 m2 m3 m4"), "pm.vbatMV", "supervisor.info")
ROTOR_SPEED_BLOCK = named("motor.*_rpm", "m1 m2 m3 m4")
STANDARD_BLOCKS: tuple[tuple[str, ...], ...] = (STATE_BLOCK, IMU_BLOCK, MOTOR_BLOCK)
# Variables that a session logs.
STATE_VARIABLES = STATE_BLOCK + tuple(f"stateEstimateZ.rate{a}" for a in ("Roll", "Pitch", "Yaw"))
EXTRA_VARIABLES = tuple(f"acc.{a}" for a in "xyz") + tuple(f"ctrltargetZ.{a}" for a in "xyz")
WRENCH_VARIABLES = ("thrustSi", "torquex", "torquey", "torquez")


def block_plan(available: Sequence[str], *, wrench: str = "ctrlLee") -> list[tuple[str, ...]]:
    """Blocks to log from the drone's variables, each within 26 bytes; those for the estimator come first.

    The rigid state of one instant (22 bytes), motors with voltage and flight state (12, or 20 with rotor speeds),
    accelerometer and active setpoint (18), commanded wrench (16). Body rates are in the state block, in steps of
    1 mrad/s, and not gyro.* of another block: blocks are not sampled at the same time, and one complete sample is worth
    more to the estimator than two halves.

    Raises:
        UsageError: a variable that the estimator needs is missing.
    """
    names = set(available)
    for needed in (*STATE_VARIABLES, *MOTOR_BLOCK):
        if needed not in names:
            raise UsageError(f"the drone has no log variable {needed}, which the estimator needs.")
    motors = MOTOR_BLOCK + (ROTOR_SPEED_BLOCK if names.issuperset(ROTOR_SPEED_BLOCK) else ())
    commanded = tuple(f"{wrench}.{n}" for n in WRENCH_VARIABLES)
    optional = (tuple(v for v in extra if v in names) for extra in (EXTRA_VARIABLES, commanded))
    return [STATE_VARIABLES, motors, *(extra for extra in optional if extra)]


def standard_variables(available: Mapping[str, str] | Iterable[str], *, rotor_speed: bool = True) -> tuple[str, ...]:
    """Variables of the drone that the estimator uses.

    Args:
        available: names of the drone's log variables.
        rotor_speed: add measured rotor speeds if the drone has them.

    Returns: state, IMU, motor commands with voltage and flying flag, and rotor speeds if all four exist.
    """
    names = set(available)
    wanted = [name for block in STANDARD_BLOCKS for name in block if name in names]
    if rotor_speed and names.issuperset(ROTOR_SPEED_BLOCK):
        wanted.extend(ROTOR_SPEED_BLOCK)
    return tuple(wanted)


def sampled_together(variables: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Groups of `variables` that must share a packet: the standard blocks, then the components of each signal."""
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
        block: as subscribed or as recorded.
        signals: decode only these, because two blocks may have the same signal; None = all.
    """

    def __init__(self, block: Block, signals: Iterable[str] | None = None) -> None:
        index = {variable.name: i for i, variable in enumerate(block.variables)}
        allowed = set(ESTIMATOR_SIGNALS) if signals is None else set(signals)
        chosen: dict[str, Source] = {}
        for source in SOURCES:
            if source.signal in allowed and source.signal not in chosen and all(v in index for v in source.variables):
                chosen[source.signal] = source
        self.block = block
        self.signals: tuple[str, ...] = tuple(name for name in SIGNALS if name in chosen)
        self._plan = tuple(
            (name, tuple(index[v] for v in chosen[name].variables), chosen[name].convert.one) for name in self.signals
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
    """One decoder for each block; each signal is decoded only from the block with its best source."""
    blocks = tuple(blocks)
    names = {block.identifier: {v.name for v in block.variables} for block in blocks}
    assigned: dict[str, int] = {}
    for source in SOURCES:
        if source.signal in assigned or source.signal not in ESTIMATOR_SIGNALS:
            continue
        for block in blocks:
            if names[block.identifier].issuperset(source.variables):
                assigned[source.signal] = block.identifier
                break
    return {
        block.identifier: BlockDecoder(block, [s for s, where in assigned.items() if where == block.identifier])
        for block in blocks
    }
