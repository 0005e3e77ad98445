"""Read MAVLink telemetry logs (tlog): each message at its own rate, converted from FRD and NED to FLU and NWU.

A ground station writes a tlog with the time of arrival of each message; some messages also have the time since boot of
the autopilot, which is the time axis (`tlog_frames.Clocks`). The table `TLOG_SIGNALS` maps messages to signals;
docs/reference/formats/tlog.md explains the table.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.physics.rotations import quaternion_from_euler
from crazyem.recordings.autopilots import tlog_frames
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
    vehicle_of,
)
from crazyem.recordings.contents import ReadOptions, contents
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.stamps import finding
from crazyem.recordings.topics import Source, Topic, damage, named, seconds, signals_of, text_of, unconnected
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


_ARDUPILOT = 3
_NOT_A_VEHICLE = {6, 18, 26, 27, 28, 30}  # MAV_TYPE of ground stations, onboard computers, gimbals, cameras ...
_INVALID_AUTOPILOT = 8
_MOST_EVENTS = 2000
_SOUND_FRAMES = 3  # least number of sound frames in a tlog
_SKIPPED_HEAD = 4096  # bytes; most invalid bytes before the first frame
# messages with several instances, and the field with the number of the instance
_INSTANCE = {
    "BATTERY_STATUS": "id",
    "HIGHRES_IMU": "id",
    "SERVO_OUTPUT_RAW": "port",
    "ESC_STATUS": "index",
    "ESC_INFO": "index",
    "NAMED_VALUE_FLOAT": "name",
    "NAMED_VALUE_INT": "name",
    "DEBUG_VECT": "name",
}
_MOST_INSTANCES = 64
_NO_SIGNALS = {"PARAM_VALUE", "STATUSTEXT", "FILE_TRANSFER_PROTOCOL", "LOG_DATA", "SERIAL_CONTROL"}


def recognises(head: bytes) -> bool:
    """True if frames with sound checksums follow each other near the start."""
    found = tlog_frames.scan(head[: 4 * _SKIPPED_HEAD], at_most=_SOUND_FRAMES + 1)
    known = sum(len(f.stamps) for f in found.frames.values())
    return known >= _SOUND_FRAMES and sum(c for o, c in found.skipped if o == 0) <= _SKIPPED_HEAD


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a telemetry log. Raises FileFormatError naming the file and the reason."""
    data = contents(path)
    found = tlog_frames.scan(data)
    size = len(data)
    del data
    if not found.frames:
        raise FileFormatError(f"{path}: not one of the log's frames has a sound checksum.")
    system, others = _vehicle(found)
    clocks = tlog_frames.Clocks(found, system)
    topics = _topics(found, system, clocks)
    topics = [t for t in topics if t.time.size]
    if not topics:
        raise FileFormatError(f"{path}: the log holds no numbers from a vehicle.")
    kind, autopilot = _beat(found, system)
    sources = (*TLOG_SIGNALS, *(RAW_IMU if autopilot == _ARDUPILOT else ()))
    signals, left_out = signals_of(topics, [m for source in sources for m in source.of(topics)])
    absent, unplugged = unconnected(topics, sources, signals)
    losses = tlog_frames.link(found, system, clocks.component, clocks.starts)
    findings = [*damage(found.skipped, size, "MAVLink frame"), *losses.findings(clocks.arrival), *others]
    findings += [*finding(clocks.faults, signals), *clocks.findings(), *left_out, *unplugged]
    findings += _notes(signals, found, autopilot == _ARDUPILOT)
    metadata = {
        "tlog": _about(found, system, clocks),
        "vehicle": vehicle_of(kind),
        "lost_records": {t.name: str(losses.lost) for t in topics if "/" not in t.name},
        "not_measured": absent,
        "parameters": _parameters(found, system),
    }
    return Recording(
        str(path),
        "tlog",
        signals,
        {k: v for k, v in metadata.items() if v},
        tuple(findings),
        _events(found, system),
        clocks.origin,
    )


def _beat(found: tlog_frames.Frameset, system: int) -> tuple[int, int]:
    """MAV_TYPE and MAV_AUTOPILOT of a system by its heartbeats; (-1, -1) if it is not a vehicle."""
    for (sender, _, message), frames in sorted(found.frames.items()):
        if sender == system and message == 0:
            columns = tlog_frames.columns_of(tlog_frames.MESSAGES[0], frames.payloads[:1])
            kind, autopilot = int(columns["type"][0]), int(columns["autopilot"][0])
            if autopilot != _INVALID_AUTOPILOT and kind not in _NOT_A_VEHICLE:
                return kind, autopilot
    return -1, -1


def _vehicle(found: tlog_frames.Frameset) -> tuple[int, list[Finding]]:
    """The system to read: the vehicle (by heartbeats) with most messages, else the system with most; and findings."""
    counts: Counter[int] = Counter()
    for (system, _, _), frames in found.frames.items():
        counts[system] += len(frames.stamps)
    vehicles = [s for s in counts if _beat(found, s) != (-1, -1)] or list(counts)
    chosen = max(vehicles, key=lambda s: (counts[s], -s))
    left = [s for s in sorted(vehicles) if s != chosen]
    if not left:
        return chosen, []
    text = (
        f"The log holds several vehicles, systems {', '.join(map(str, sorted(vehicles)))}; "
        f"system {chosen} is read, which sent most ({counts[chosen]} messages)."
    )
    advice = "Write a log a vehicle to read the others."
    return chosen, [Finding("mapping", Grade.DEGRADES, text, evidence={"vehicles": len(vehicles)}, advice=advice)]


def _topics(found: tlog_frames.Frameset, system: int, clocks: tlog_frames.Clocks) -> list[Topic]:
    """One topic per message, instance and component; suffix and prefix as in "BATTERY_STATUS_1", "158/ATTITUDE"."""
    topics = []
    for (sender, component, identifier), frames in sorted(found.frames.items(), key=lambda kv: kv[1].places[0]):
        message = tlog_frames.MESSAGES[identifier]
        if sender != system or message.msgname in _NO_SIGNALS:
            continue
        columns = tlog_frames.columns_of(message, frames.payloads)
        prefix = "" if component == clocks.component else f"{component}/"
        time, clock = clocks.place(component, frames, message, prefix + message.msgname)
        host = seconds(np.array(frames.stamps, np.int64))
        order = np.array(frames.places, np.int64)
        used = "time_boot_ms" if "time_boot_ms" in columns else "time_usec" if clock != "host" else ""
        for suffix, rows in _instances(message.msgname, columns):
            numbers = {c: v[rows] for c, v in columns.items() if v.dtype.kind != "S" and c != used}
            name = prefix + message.msgname + suffix
            units = tlog_frames.units_of(message, numbers)
            topics.append(Topic(name, numbers, time[rows], order[rows], host[rows], clock, units))
    return topics


def _instances(name: str, columns: Mapping[str, NDArray[np.generic]]) -> list[tuple[str, NDArray[np.int64]]]:
    """Suffix and rows of each instance of a message; the first has no suffix, unless instances have names."""
    key = columns.get(_INSTANCE.get(name, ""))
    if key is None:
        return [("", np.arange(next(iter(columns.values())).size))]
    values = np.unique(key)[:_MOST_INSTANCES]
    text = key.dtype.kind == "S"
    return [(f"_{text_of(value)}" if i or text else "", np.flatnonzero(key == value)) for i, value in enumerate(values)]


def _notes(signals: Mapping[str, object], found: tlog_frames.Frameset, ardupilot: bool) -> list[Finding]:
    notes = []
    if any(name.startswith("SERVO_OUTPUT_RAW.") for name in signals):
        text = (
            "SERVO_OUTPUT_RAW holds pulse lengths in microseconds; which of them are motors and what 0 and full thrust "
            "are is not in the log, so they stay as they are."
        )
        notes.append(note("motor_meaning", text))
    if not ardupilot and any(name.startswith("RAW_IMU.") for name in signals):
        notes.append(note("mapping", "RAW_IMU is in counts of the sensor here and stays as it is."))
    if found.unknown:
        text = f"{found.unknown} messages are of kinds not known here; they could be neither checked nor read."
        notes.append(note("mapping", text, unknown=float(found.unknown)))
    return notes


def _about(found: tlog_frames.Frameset, system: int, clocks: tlog_frames.Clocks) -> dict[str, str]:
    kind, autopilot = _beat(found, system)
    senders = sorted({(s, c) for s, c, _ in found.frames})
    return {
        "system": str(system),
        "component": str(clocks.component),
        "vehicle_type": str(kind),
        "autopilot": str(autopilot),
        "senders": ", ".join(f"{s}/{c}" for s, c in senders[:50]),
        "messages": str(found.total),
        "boot_host_time": "" if clocks.boot is None else repr(clocks.boot),
    }


def _messages(
    found: tlog_frames.Frameset, system: int, name: str
) -> Iterator[tuple[tlog_frames.Frames, dict[str, NDArray[np.generic]]]]:
    """The frames of one message of a system, and their columns, for each component."""
    for (sender, _, identifier), frames in found.frames.items():
        if sender == system and tlog_frames.MESSAGES[identifier].msgname == name:
            yield frames, tlog_frames.columns_of(tlog_frames.MESSAGES[identifier], frames.payloads)


def _parameters(found: tlog_frames.Frameset, system: int) -> dict[str, str]:
    """The last value of each parameter that the vehicle reported."""
    values: dict[str, str] = {}
    for _, columns in _messages(found, system, "PARAM_VALUE"):
        pairs = zip(columns["param_id"].tolist(), columns["param_value"].tolist(), strict=True)
        values |= {text_of(name): repr(value) for name, value in pairs}
    return dict(list(values.items())[:5000])


def _events(found: tlog_frames.Frameset, system: int) -> tuple[Event, ...]:
    """Text messages of the vehicle."""
    events = []
    for frames, columns in _messages(found, system, "STATUSTEXT"):
        rows = zip(frames.stamps, columns["severity"].tolist(), columns["text"].tolist(), strict=True)
        events += [Event(t / 1e6, "log", {"severity": s, "text": text_of(x)}) for t, s, x in rows]
    return tuple(sorted(events, key=lambda e: e.time)[:_MOST_EVENTS])
