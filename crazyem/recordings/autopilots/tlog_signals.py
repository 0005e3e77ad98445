"""Signals of a telemetry log and their fields in MAVLink messages, the best source first.

docs: tlog.md explains the table. Sources: mavlink.io/en/messages/common.html, ArduPilot's GCS_MAVLINK (units of
RAW_IMU).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.rotations import quaternion_from_euler
from crazyem.recordings.autopilots.frd_ned import (
    ATTITUDE,
    BODY,
    MOTORS,
    WORLD,
    Columns,
    angles_of_quaternions,
    bit,
    euler,
    quaternions,
    scaled,
    stacked,
    vectors,
)
from crazyem.recordings.topics import Source, Topic, named
from crazyem.signals.mavlink import RPM_IN_RAD_PER_S, mapping

ARMED = 128  # in HEARTBEAT.base_mode


def _cells(columns: Columns) -> NDArray[np.float64]:
    """Voltage of a battery [V] from its cells [mV]; an absent cell has 65535, in the extension field 0."""
    cells = stacked(columns)
    return np.where(cells == 65535, 0.0, cells).sum(axis=1, keepdims=True) * 1e-3


def _equal(column: str, value: int) -> Callable[[Topic], NDArray[np.bool_]]:
    return lambda topic: topic.columns[column] == value


def _masked(bits: int, *, local: bool = False) -> Callable[[Topic], NDArray[np.bool_]]:
    """Function for the rows whose `type_mask` excludes the value; with `local`, also rows not in the local frame."""

    def invalid(topic: Topic) -> NDArray[np.bool_]:
        rows = (topic.columns["type_mask"].astype(np.int64) & bits) != 0
        return rows | (topic.columns["coordinate_frame"] != 1) if local else rows

    return invalid


def _shared(signal: str, message: str) -> Source:
    """The source of a signal in a log with the same mapping as for a live link."""
    row = mapping(signal, message)
    kinds = {"vector": vectors, "quaternion": quaternions, "angles": lambda c: quaternion_from_euler(*euler(c).T)}
    frame = {"position": WORLD, "velocity": WORLD, "attitude": ATTITUDE}.get(signal, BODY)
    return Source(signal, message, row.fields, scaled(row.factor, kinds[row.kind]), frame=frame)


_XYZ = named("*", "x y z")
_V = named("v*", "x y z")
_ANGLES = named("*", "roll pitch yaw")
_Q = named("q[*]", "0 1 2 3")
_RPMS = named("rpm[*]", "0 1 2 3")
_VOLTAGES = named("voltages[*]", "0 1 2 3 4 5 6 7 8 9") + named("voltages_ext[*]", "0 1 2 3")
_TARGET = "POSITION_TARGET_LOCAL_NED"
_BODY_RATES = named("body_*_rate", "roll pitch yaw")

TLOG_SIGNALS: tuple[Source, ...] = (
    _shared("position", "LOCAL_POSITION_NED"),
    _shared("velocity", "LOCAL_POSITION_NED"),
    _shared("attitude", "ATTITUDE_QUATERNION"),
    _shared("attitude", "ATTITUDE"),
    _shared("body_rate", "HIGHRES_IMU"),
    _shared("body_rate", "SCALED_IMU"),
    _shared("body_rate", "ATTITUDE_QUATERNION"),
    _shared("body_rate", "ATTITUDE"),
    _shared("specific_force", "HIGHRES_IMU"),
    _shared("specific_force", "SCALED_IMU"),
    Source("rotor_speed", "ESC_STATUS", _RPMS, scaled(RPM_IN_RAD_PER_S), frame=MOTORS, zero_is_absent=True),
    Source("rotor_speed", "ESC_TELEMETRY_1_TO_4", _RPMS, scaled(RPM_IN_RAD_PER_S), frame=MOTORS, zero_is_absent=True),
    Source("voltage", "BATTERY_STATUS", _VOLTAGES, _cells, _equal("voltages[0]", 65535), zero_is_absent=True),
    Source(
        "voltage",
        "SYS_STATUS",
        ("voltage_battery",),
        scaled(1e-3),
        _equal("voltage_battery", 65535),
        zero_is_absent=True,
    ),
    Source("setpoint_position", _TARGET, _XYZ, vectors, _masked(0x007, local=True), frame=WORLD),
    Source("setpoint_velocity", _TARGET, _V, vectors, _masked(0x038, local=True), frame=WORLD),
    Source(
        "flying",
        "EXTENDED_SYS_STATE",
        ("landed_state",),
        lambda columns: (stacked(columns) >= 2).astype(float),
        _equal("landed_state", 0),
        frame="1 while in the air, taking off or landing",
    ),
    Source("flying", "HEARTBEAT", ("base_mode",), bit(ARMED), frame="1 while armed"),
    Source("euler", "ATTITUDE", _ANGLES, euler, frame="roll, pitch, yaw (ZYX), body FLU to world (north-west-up)"),
    Source("setpoint_acceleration", _TARGET, named("af*", "x y z"), vectors, _masked(0x3C0, local=True), frame=WORLD),
    Source("setpoint_euler", "ATTITUDE_TARGET", _Q, angles_of_quaternions, _masked(0x80)),
    Source("setpoint_rate", "ATTITUDE_TARGET", _BODY_RATES, vectors, _masked(0x07), frame=BODY),
    Source("position", "ATT_POS_MOCAP", _XYZ, vectors, frame=WORLD, origin="mocap"),
    Source("attitude", "ATT_POS_MOCAP", _Q, quaternions, frame=ATTITUDE, origin="mocap"),
    Source("position", "VISION_POSITION_ESTIMATE", _XYZ, vectors, frame=WORLD, origin="vision"),
)
# MAVLink defines raw counts; ArduPilot sends milli-g and mrad/s
RAW_IMU: tuple[Source, ...] = (_shared("body_rate", "RAW_IMU"), _shared("specific_force", "RAW_IMU"))
