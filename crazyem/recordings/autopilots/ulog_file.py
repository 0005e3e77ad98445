"""Read PX4 ULog files: each topic at its own rate, on the clock of the autopilot, from FRD and NED to FLU and NWU.

pyulog decodes the messages; `ulog_scan` removes damaged ones first. The table `_ULOG_SIGNALS` maps topics to signals;
docs: ulog.md explains the table. Sources: docs.px4.io (ULog file format, uORB message reference).
"""

import contextlib
import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.extras import require
from crazyem.recordings.autopilots.frd_ned import (
    ATTITUDE,
    BODY,
    MOTORS,
    WORLD,
    angles_of_quaternions,
    euler,
    quaternions,
    scaled,
    stacked,
    vectors,
    vehicle_of,
)
from crazyem.recordings.autopilots.ulog_scan import HEADER_BYTES, ULOG_MAGIC, Scan, scan, unknown_flags
from crazyem.recordings.contents import ReadOptions, contents
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import Recording
from crazyem.recordings.stamps import Fault, believed, finding
from crazyem.recordings.topics import Source, Topic, damage, named, ranks, seconds, signals_of, text_of, unconnected
from crazyem.signals.mavlink import RPM_IN_RAD_PER_S

if TYPE_CHECKING:
    from pyulog import ULog

AUTOPILOT_CLOCK = "autopilot"  # microseconds since boot
_MOST_PARAMETERS = 4000  # parameters in the metadata, at most
_MOST_MESSAGES = 500  # texts of the autopilot in the metadata, at most
_SECOND = 1_000_000  # us
# us; longest delay from a sample to its publication; with a longer one the stamp of the sample is not used
_LONGEST_DELAY = 1 * _SECOND


def recognises(head: bytes) -> bool:
    """True if these first bytes are those of a ULog file."""
    return head.startswith(ULOG_MAGIC)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a ULog file. Raises FileFormatError naming the file and the reason."""
    data = contents(path)
    if not recognises(data) or len(data) < HEADER_BYTES:
        raise FileFormatError(
            f"{path}: the header of a ULog file has {HEADER_BYTES} bytes, this one is cut or is none."
        )
    if unknown_flags(data):
        raise FileFormatError(f"{path}: the log is marked as of a kind that readers of today must not read.")
    sound = scan(data)
    del data
    log = _decode(path, sound)
    sound.data = b""  # pyulog has its own copy
    topics, faults = _topics(log, np.frombuffer(sound.identifiers, np.uint16))
    if not any(topic.time.size for topic in topics):
        raise FileFormatError(f"{path}: the log holds not a single message of a topic ({sound.messages} others).")
    mapped = [m for source in _ULOG_SIGNALS for m in source.of(topics)]
    signals, left_out = signals_of(topics, mapped)
    absent, unplugged = unconnected(topics, _ULOG_SIGNALS, signals)
    findings = [*_integrity(sound, topics, log), *finding(faults, signals), *left_out]
    findings += [*unplugged, *_notes(signals)]
    metadata = _metadata(log) | {"vehicle": vehicle_of(_kind(log)), "not_measured": absent}
    return Recording(str(path), "ulog", signals, {k: v for k, v in metadata.items() if v}, tuple(findings))


def _kind(log: "ULog") -> int:
    """MAV_TYPE from the status that PX4 publishes, else from its parameter; 0 without both."""
    status = next((d.data["system_type"] for d in log.data_list if "system_type" in d.data), None)
    if status is not None and status.size and int(status[-1]):
        return int(status[-1])
    parameter = log.initial_parameters.get("MAV_TYPE", 0)
    return int(parameter) if isinstance(parameter, int) else 0


def _decode(path: Path, sound: Scan) -> "ULog":
    """The sound messages, decoded by pyulog. Raises FileFormatError naming the file, MissingExtraError."""
    library = require("pyulog", "Reading a ULog file")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints warnings
            log: ULog = library.ULog(io.BytesIO(sound.data))
            return log
    except Exception as error:  # pyulog raises many kinds
        raise FileFormatError(f"{path}: the log cannot be decoded ({type(error).__name__}: {error}).") from error


def _topics(log: "ULog", identifiers: NDArray[np.uint16]) -> tuple[list[Topic], list[Fault]]:
    """One topic per message and instance, rows in the order of the file, times in s since boot.

    Args:
        log: decoded.
        identifiers: (m,) identifier of the topic of each data message, in the order of the file.

    Returns: the topics without records with impossible stamps, and the faults of these stamps.
    """
    sets = [d for d in log.data_list if d.data["timestamp"].size]
    published = [seconds(d.data["timestamp"]) for d in sets]
    places = [_places(d, identifiers) for d in sets]
    kept, shifts, faults = believed([_name(d) for d in sets], published, places, absent=0.0)
    topics, stamps = [], []
    for d, rows, shift in zip(sets, kept, shifts, strict=True):
        if not rows.any():
            continue
        data = {k: v[rows] for k, v in d.data.items()}
        stamp, used = _stamps(data)
        stamps.append(seconds(stamp) + shift)
        chars = {f.field_name for f in d.field_data if f.type_str == "char"}
        columns = {k: v for k, v in data.items() if k != used and k not in chars and "_padding" not in k}
        units = {k: "us" for k in columns if k.rpartition(".")[2] in ("timestamp", "timestamp_sample")}
        topics.append(Topic(_name(d), columns, stamps[-1], np.empty(0, np.int64), clock=AUTOPILOT_CLOCK, units=units))
    ordered = [replace(topic, order=order) for topic, order in zip(topics, ranks(stamps), strict=True)]
    return ordered, faults


def _name(d: "ULog.Data") -> str:
    return str(d.name) if d.multi_id == 0 else f"{d.name}_{d.multi_id}"


def _places(d: "ULog.Data", identifiers: NDArray[np.uint16]) -> NDArray[np.float64]:
    """(n,) places of the records of a topic among all records of the file; NaN if unknown."""
    places = np.flatnonzero(identifiers == d.msg_id).astype(float)
    count = d.data["timestamp"].size
    return places if places.size == count else np.full(count, np.nan)


def _stamps(data: Mapping[str, NDArray[np.generic]]) -> tuple[NDArray[np.uint64], str]:
    """(n,) times of measurement [us], and their column.

    The column is `timestamp_sample` if it exists and is shortly before the publication, else `timestamp`.
    """
    published = np.asarray(data["timestamp"]).astype(np.uint64)
    column = data.get("timestamp_sample")
    if column is None or column.dtype.kind != "u":
        return published, "timestamp"
    sampled = np.asarray(column).astype(np.uint64)
    early = (sampled > 0) & (sampled <= published) & (published - sampled <= _LONGEST_DELAY)
    return (sampled, "timestamp_sample") if early.all() else (published, "timestamp")


def _valid(*flags: str) -> Callable[[Topic], NDArray[np.bool_]]:
    """Function for the rows in which a flag is not set; a flag that the message does not have counts as set."""

    def invalid(topic: Topic) -> NDArray[np.bool_]:
        rows = [topic.columns[flag] == 0 for flag in flags if flag in topic.columns]
        return np.logical_or.reduce([np.zeros(topic.time.size, bool), *rows])

    return invalid


def _other_frame(topic: Topic) -> NDArray[np.bool_]:
    """Rows of an odometry message that are not in NED."""
    frame = topic.columns.get("pose_frame")
    return np.ones(topic.time.size, bool) if frame is None else frame != 1


def _odometry(topic: str, origin: str) -> tuple[Source, Source]:
    """Pose from an external source, in rows that are in NED."""
    place, turn = named("position[*]", _THREE), named("q[*]", _FOUR)
    return (
        Source("position", topic, place, vectors, _other_frame, absent_is_nan=True, frame=WORLD, origin=origin),
        Source("attitude", topic, turn, quaternions, _other_frame, absent_is_nan=True, frame=ATTITUDE, origin=origin),
    )


_XYZ = named("*", "x y z")
_THREE = "0 1 2"
_FOUR = "0 1 2 3"
_SPEED = scaled(RPM_IN_RAD_PER_S)

_LOCAL = "vehicle_local_position"
_TARGET = "vehicle_local_position_setpoint"
_ULOG_SIGNALS: tuple[Source, ...] = (
    Source("position", _LOCAL, _XYZ, vectors, _valid("xy_valid", "z_valid"), frame=WORLD),
    Source("velocity", _LOCAL, named("*", "vx vy vz"), vectors, _valid("v_xy_valid", "v_z_valid"), frame=WORLD),
    Source("attitude", "vehicle_attitude", named("q[*]", _FOUR), quaternions, frame=ATTITUDE),
    Source("body_rate", "vehicle_angular_velocity", named("xyz[*]", _THREE), vectors, frame=BODY),
    Source("body_rate", "sensor_combined", named("gyro_rad[*]", _THREE), vectors, frame=BODY),
    Source("body_rate", "vehicle_attitude", named("*speed", "roll pitch yaw"), vectors, frame=BODY),
    Source("specific_force", "sensor_combined", named("accelerometer_m_s2[*]", _THREE), vectors, frame=BODY),
    Source("specific_force", "vehicle_acceleration", named("xyz[*]", _THREE), vectors, frame=BODY),
    Source("rotor_speed", "esc_status", named("esc[*].esc_rpm", _FOUR), _SPEED, frame=MOTORS, zero_is_absent=True),
    Source("voltage", "battery_status", ("voltage_v",), stacked, zero_is_absent=True),
    Source("setpoint_position", _TARGET, _XYZ, vectors, absent_is_nan=True, frame=WORLD),
    Source("setpoint_velocity", _TARGET, named("*", "vx vy vz"), vectors, absent_is_nan=True, frame=WORLD),
    Source(
        "flying",
        "vehicle_land_detected",
        ("landed",),
        lambda c: 1.0 - (stacked(c) != 0),
        frame="1 while the autopilot does not say landed",
    ),
    Source("acceleration", _LOCAL, named("*", "ax ay az"), vectors, _valid("v_xy_valid", "v_z_valid"), frame=WORLD),
    Source("motor_request", "actuator_motors", named("control[*]", _FOUR), stacked, absent_is_nan=True, frame=MOTORS),
    Source(
        "setpoint_acceleration", _TARGET, named("acceleration[*]", _THREE), vectors, absent_is_nan=True, frame=WORLD
    ),
    Source("setpoint_acceleration", _TARGET, named("*", "acc_x acc_y acc_z"), vectors, absent_is_nan=True, frame=WORLD),
    Source("setpoint_euler", "vehicle_attitude_setpoint", named("q_d[*]", _FOUR), angles_of_quaternions),
    Source("setpoint_euler", "vehicle_attitude_setpoint", named("*_body", "roll pitch yaw"), euler),
    Source(
        "setpoint_rate", "vehicle_rates_setpoint", named("*", "roll pitch yaw"), vectors, absent_is_nan=True, frame=BODY
    ),
    *_odometry("vehicle_mocap_odometry", "mocap"),
    *_odometry("vehicle_visual_odometry", "vision"),
)


def _integrity(sound: Scan, topics: list[Topic], log: "ULog") -> list[Finding]:
    found = damage(sound.skipped, sound.size, "ULog message")
    for name, reason in sorted(sound.refused.items())[:20]:
        found.append(note("integrity", f"The topic {text_of(name)} is not read: {reason}.", Grade.DEGRADES))
    if log.dropouts:
        intervals = tuple((d.timestamp / 1e6, d.timestamp / 1e6 + d.duration / 1e3) for d in log.dropouts)
        total, longest = sum(d.duration for d in log.dropouts) / 1e3, max(d.duration for d in log.dropouts) / 1e3
        text = f"The logger dropped messages {len(intervals)} times, {total:.3f} s in all, {longest:.3f} s at most."
        evidence = {"dropouts": float(len(intervals)), "total_s": total, "longest_s": longest}
        advice = "Log fewer topics or use a faster card; do not fit across the gaps."
        found.append(Finding("gaps", Grade.DEGRADES, text, "", intervals[:1000], evidence, advice))
    return found


def _notes(signals: Mapping[str, object]) -> list[Finding]:
    if "motor_request" not in signals:
        return []
    text = (
        "actuator_motors is the thrust that the allocation asks of each motor, 0 to 1; it became motor_request. "
        "What the speed controllers were sent depends on the thrust curve and the outputs' calibration."
    )
    return [note("motor_meaning", text)]


def _metadata(log: "ULog") -> dict[str, dict[str, str]]:
    """Information about the autopilot, its parameters and its text messages."""
    info = {text_of(k): text_of(v) for k, v in list(log.msg_info_dict.items())[:200]}
    version = log.get_version_info_str() if isinstance(log.msg_info_dict.get("ver_sw_release"), int) else None
    info |= {"version": version} if version else {}
    parameters = {text_of(k): repr(v) for k, v in list(log.initial_parameters.items())[:_MOST_PARAMETERS]}
    changed = {
        f"{i} {t / 1e6:.6f} s {text_of(k)}": repr(v)
        for i, (t, k, v) in enumerate(log.changed_parameters[:_MOST_PARAMETERS])
    }
    texts = {
        f"{i} {m.timestamp / 1e6:.6f} s {m.log_level_str()}": text_of(m.message)
        for i, m in enumerate(log.logged_messages[:_MOST_MESSAGES])
    }
    sections = {"ulog": info, "parameters": parameters, "changed_parameters": changed, "messages": texts}
    return {name: section for name, section in sections.items() if section}
