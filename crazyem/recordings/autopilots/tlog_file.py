"""MAVLink telemetry logs (tlog): each message at its own rate, turned from FRD and NED to FLU and NWU.

A ground station writes a tlog: it knows when it received a message and, where the message says so, the autopilot's
time since boot. The latter is the time axis. What becomes which signal is the table `_SIGNALS`; docs/formats/tlog.md
explains it. Sources: mavlink.io/en/messages/common.html, ArduPilot's GCS_MAVLINK (units of RAW_IMU).
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.autopilots.frd_ned import (
    ATTITUDE,
    BODY,
    MOTORS,
    WORLD,
    Columns,
    euler,
    euler_from_quaternions,
    quaternions,
    quaternions_from_euler,
    stacked,
    vectors,
)
from crazyem.recordings.autopilots.tlog_frames import MESSAGES, Frames, Frameset, columns_of, scan, units_of
from crazyem.recordings.contents import contents
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.topics import Source, Topic, damage, named, seconds, signals_of, text_of
from crazyem.signals.mavlink import RPM, mapping

_EPOCH = 10**15  # us; a `time_usec` beyond is since 1970, below since boot
_ARMED = 128
_ARDUPILOT = 3
_NOT_A_VEHICLE = {6, 18, 26, 27, 28, 30}  # MAV_TYPE of ground stations, onboard computers, gimbals, cameras ...
_INVALID_AUTOPILOT = 8
_EVENTS = 2000
_SOUND_FRAMES = 3  # that make a file a tlog
_SKIPPED_HEAD = 4096  # bytes of garbage before them that are tolerated
# messages that come several at once, and the field that tells them apart
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
_INSTANCES = 64
_NO_SIGNALS = {"PARAM_VALUE", "STATUSTEXT", "FILE_TRANSFER_PROTOCOL", "LOG_DATA", "SERIAL_CONTROL"}

Stamps = NDArray[np.int64]


def recognises(head: bytes) -> bool:
    """True if frames with sound checksums follow each other near the start."""
    found = scan(head[: 4 * _SKIPPED_HEAD], at_most=_SOUND_FRAMES + 1)
    known = sum(len(f.stamps) for f in found.frames.values())
    return known >= _SOUND_FRAMES and sum(c for o, c in found.skipped if o == 0) <= _SKIPPED_HEAD


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a telemetry log. Raises FileFormatError naming the file and what is wrong with it."""
    data = contents(path)
    found = scan(data)
    size = len(data)
    del data
    if not found.frames:
        raise FileFormatError(f"{path}: not one of the log's frames has a sound checksum.")
    system, others = _vehicle(found)
    clocks = _Clocks(found, system)
    topics = _topics(found, system, clocks)
    topics = [t for t in topics if t.time.size]
    if not topics:
        raise FileFormatError(f"{path}: the log holds no numbers from a vehicle.")
    ardupilot = _beat(found, system)[1] == _ARDUPILOT
    sources = (*_SIGNALS, *(_RAW_IMU if ardupilot else ()))
    signals, left_out = signals_of(topics, [m for source in sources for m in source.of(topics)])
    findings = [*damage(found.skipped, size, "MAVLink frame"), *_losses(found, system, clocks.component), *others]
    findings += [*clocks.findings(), *left_out, *_notes(signals, found, ardupilot)]
    metadata = {"tlog": _about(found, system, clocks), "parameters": _parameters(found, system)}
    return Recording(
        str(path),
        "tlog",
        signals,
        {k: v for k, v in metadata.items() if v},
        tuple(findings),
        _events(found, system),
        clocks.origin,
    )


def _beat(found: Frameset, system: int) -> tuple[int, int]:
    """MAV_TYPE and MAV_AUTOPILOT of a system by its heartbeats; (-1, -1) where none says that it is a vehicle."""
    for (sender, _, message), frames in sorted(found.frames.items()):
        if sender == system and message == 0:
            columns = columns_of(MESSAGES[0], frames.payloads[:1])
            kind, autopilot = int(columns["type"][0]), int(columns["autopilot"][0])
            if autopilot != _INVALID_AUTOPILOT and kind not in _NOT_A_VEHICLE:
                return kind, autopilot
    return -1, -1


def _vehicle(found: Frameset) -> tuple[int, list[Finding]]:
    """The system to read: a vehicle by its heartbeat if there is one, of several the one that sent most."""
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


class _Clocks:
    """The clocks of a log on one axis: time since boot of the autopilot, or the host's if no message has that.

    A message without a time of its own is placed by its arrival, less the median of what others took to arrive.
    """

    def __init__(self, found: Frameset, system: int) -> None:
        self._offset: dict[int, float] = {}  # component -> host time minus its time since boot, s
        self._utc: dict[int, float] = {}  # component -> host time minus its own UTC, s
        counts: Counter[int] = Counter()
        boots: dict[int, list[NDArray[np.float64]]] = {}
        epochs: dict[int, list[NDArray[np.float64]]] = {}
        for (sender, component, identifier), frames in found.frames.items():
            if sender != system:
                continue
            counts[component] += len(frames.stamps) * (1000 if identifier == 0 else 1)
            boot, utc = _own_time(MESSAGES[identifier], frames)
            host = seconds(np.array(frames.stamps, np.int64))
            if boot is not None:
                boots.setdefault(component, []).append(host - boot)
            if utc is not None:
                epochs.setdefault(component, []).append(host - utc)
        self._offset = {c: float(np.median(np.concatenate(v))) for c, v in boots.items()}
        self._utc = {c: float(np.median(np.concatenate(v))) for c, v in epochs.items()}
        self.component = max(counts, key=lambda c: (c in self._offset, counts[c], -c))
        first = min(f.stamps[0] for f in found.frames.values())
        self.boot = self._offset.get(self.component)  # host time at which the axis is 0, None: no such axis
        self.origin = 0.0 if self.boot is not None else float(first // 1_000_000)

    def place(self, component: int, frames: Frames, message: object) -> tuple[NDArray[np.float64], str]:
        """Times of frames on the axis [s], and the clock they are of."""
        host = np.array(frames.stamps, np.int64)
        boot, utc = _own_time(message, frames)
        if self.boot is None:
            return seconds(host - int(self.origin) * 1_000_000), "host"
        if boot is not None:
            if component == self.component:
                return boot, "autopilot"
            return boot + (self._offset[component] - self.boot), f"component {component}"
        if utc is not None:
            return utc + (self._utc[component] - self.boot), f"UTC of component {component}"
        return seconds(host) - self.boot, "host"

    def findings(self) -> list[Finding]:
        if self.boot is None:
            text = "No message has the autopilot's own time; all times are those of arrival at the ground station."
            return [note("mapping", text, Grade.DEGRADES)]
        text = (
            'Messages without a time of their own (clock "host") are placed by their arrival less the median delay '
            'of the others; among signals of clock "host" times are exact, against others they are not.'
        )
        return [note("mapping", text, boot_s=self.boot)]


def _own_time(message: object, frames: Frames) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Times that messages carry: since boot [s], and since 1970 [s]; at most one of them."""
    names = message.fieldnames  # type: ignore[attr-defined]
    if "time_boot_ms" in names:
        return seconds(columns_of(message, frames.payloads)["time_boot_ms"], 1e3), None
    if "time_usec" not in names:
        return None, None
    raw = columns_of(message, frames.payloads)["time_usec"]
    stamps = np.asarray(raw).astype(np.int64)
    if raw.dtype.itemsize == 4:  # wraps after 71 minutes
        steps = (np.diff(stamps) + (1 << 31)) % (1 << 32) - (1 << 31)
        stamps = stamps[:1].repeat(stamps.size) + np.concatenate([[0], np.cumsum(steps)])
    if (stamps <= 0).any():
        return None, None
    if (stamps > _EPOCH).all():
        return None, seconds(stamps)
    return (seconds(stamps), None) if (stamps < _EPOCH).all() else (None, None)


def _topics(found: Frameset, system: int, clocks: _Clocks) -> list[Topic]:
    """A topic a message, and one an instance and a component beyond the first: "BATTERY_STATUS_1", "158/ATTITUDE"."""
    topics = []
    for (sender, component, identifier), frames in sorted(found.frames.items(), key=lambda kv: kv[1].places[0]):
        message = MESSAGES[identifier]
        if sender != system or message.msgname in _NO_SIGNALS:
            continue
        columns = columns_of(message, frames.payloads)
        time, clock = clocks.place(component, frames, message)
        host = seconds(np.array(frames.stamps, np.int64))
        order = np.array(frames.places, np.int64)
        used = "time_boot_ms" if "time_boot_ms" in columns else "time_usec" if clock != "host" else ""
        prefix = "" if component == clocks.component else f"{component}/"
        for suffix, rows in _instances(message.msgname, columns):
            numbers = {c: v[rows] for c, v in columns.items() if v.dtype.kind != "S" and c != used}
            name = prefix + message.msgname + suffix
            units = units_of(message, numbers)
            topics.append(Topic(name, numbers, time[rows], order[rows], host[rows], clock, units))
    return topics


def _instances(name: str, columns: Mapping[str, NDArray[np.generic]]) -> list[tuple[str, NDArray[np.int64]]]:
    """Suffix and rows of each instance of a message: the first, whatever its number, has no suffix."""
    key = columns.get(_INSTANCE.get(name, ""))
    if key is None:
        return [("", np.arange(next(iter(columns.values())).size))]
    values = np.unique(key)[:_INSTANCES]
    text = key.dtype.kind == "S"
    return [(f"_{text_of(value)}" if i or text else "", np.flatnonzero(key == value)) for i, value in enumerate(values)]


def _scaled(factor: float, turned: Callable[[Columns], NDArray[np.float64]] = stacked) -> Callable:
    return lambda columns: turned(columns) * factor


def _quaternions_of_angles(columns: Columns) -> NDArray[np.float64]:
    return quaternions_from_euler(euler(columns))


def _angles_of_quaternion(columns: Columns) -> NDArray[np.float64]:
    return euler_from_quaternions(quaternions(columns))


def _cells(columns: Columns) -> NDArray[np.float64]:
    """V of a battery from its cells [mV]; 65535 is a cell that is not there, 0 one of the extension that is not."""
    cells = stacked(columns)
    return np.where(cells == 65535, 0.0, cells).sum(axis=1, keepdims=True) * 1e-3


def _in_air(columns: Columns) -> NDArray[np.float64]:
    return (stacked(columns) >= 2).astype(float)


def _armed(columns: Columns) -> NDArray[np.float64]:
    return ((np.asarray(columns[0]).astype(np.int64) & _ARMED) != 0).astype(float)[:, None]


def _equal(column: str, value: int) -> Callable[[Topic], NDArray[np.bool_]]:
    return lambda topic: topic.columns[column] == value


def _masked(bits: int, *, local: bool = False) -> Callable[[Topic], NDArray[np.bool_]]:
    """Rows whose `type_mask` says to ignore the value; with `local`, also those that are not in the local frame."""

    def invalid(topic: Topic) -> NDArray[np.bool_]:
        rows = (topic.columns["type_mask"].astype(np.int64) & bits) != 0
        return rows | (topic.columns["coordinate_frame"] != 1) if local else rows

    return invalid


def _shared(signal: str, message: str) -> Source:
    """What a live link reads from a message, read from a log the same way."""
    row = mapping(signal, message)
    turned = {"vector": vectors, "quaternion": quaternions, "angles": _quaternions_of_angles}[row.kind]
    frame = {"position": WORLD, "velocity": WORLD, "attitude": ATTITUDE}.get(signal, BODY)
    return Source(signal, message, row.fields, _scaled(row.factor, turned), frame=frame)


_XYZ = named("*", "x y z")
_V = named("v*", "x y z")
_ANGLES = named("*", "roll pitch yaw")
_Q = named("q[*]", "0 1 2 3")
_RPMS = named("rpm[*]", "0 1 2 3")
_VOLTAGES = named("voltages[*]", "0 1 2 3 4 5 6 7 8 9") + named("voltages_ext[*]", "0 1 2 3")
_TARGET = "POSITION_TARGET_LOCAL_NED"
_BODY_RATES = named("body_*_rate", "roll pitch yaw")

_SIGNALS: tuple[Source, ...] = (
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
    Source("rotor_speed", "ESC_STATUS", _RPMS, _scaled(RPM), frame=MOTORS),
    Source("rotor_speed", "ESC_TELEMETRY_1_TO_4", _RPMS, _scaled(RPM), frame=MOTORS),
    Source("voltage", "BATTERY_STATUS", _VOLTAGES, _cells, _equal("voltages[0]", 65535)),
    Source("voltage", "SYS_STATUS", ("voltage_battery",), _scaled(1e-3), _equal("voltage_battery", 65535)),
    Source("setpoint_position", _TARGET, _XYZ, vectors, _masked(0x007, local=True), frame=WORLD),
    Source("setpoint_velocity", _TARGET, _V, vectors, _masked(0x038, local=True), frame=WORLD),
    Source(
        "flying",
        "EXTENDED_SYS_STATE",
        ("landed_state",),
        _in_air,
        _equal("landed_state", 0),
        frame="1 while in the air, taking off or landing",
    ),
    Source("flying", "HEARTBEAT", ("base_mode",), _armed, frame="1 while armed"),
    Source("euler", "ATTITUDE", _ANGLES, euler, frame="roll, pitch, yaw (ZYX), body FLU to world (north-west-up)"),
    Source("setpoint_acceleration", _TARGET, named("af*", "x y z"), vectors, _masked(0x3C0, local=True), frame=WORLD),
    Source("setpoint_euler", "ATTITUDE_TARGET", _Q, _angles_of_quaternion, _masked(0x80)),
    Source("setpoint_rate", "ATTITUDE_TARGET", _BODY_RATES, vectors, _masked(0x07), frame=BODY),
    Source("position", "ATT_POS_MOCAP", _XYZ, vectors, frame=WORLD, origin="mocap"),
    Source("attitude", "ATT_POS_MOCAP", _Q, quaternions, frame=ATTITUDE, origin="mocap"),
    Source("position", "VISION_POSITION_ESTIMATE", _XYZ, vectors, frame=WORLD, origin="vision"),
)
# raw counts by the definition, milli-g and mrad/s from ArduPilot
_RAW_IMU: tuple[Source, ...] = (_shared("body_rate", "RAW_IMU"), _shared("specific_force", "RAW_IMU"))


@dataclass(frozen=True, slots=True)
class _Link:
    received: int
    lost: int


def _link(found: Frameset, system: int, component: int) -> _Link:
    """Messages of a component, and how many its sequence numbers (8 bits) say are missing: at least so many."""
    chosen = [f for (s, c, _), f in found.frames.items() if (s, c) == (system, component)]
    places = np.concatenate([np.array(f.places, np.int64) for f in chosen])
    sequence = np.concatenate([np.array(f.sequence, np.int64) for f in chosen])[np.argsort(places)]
    return _Link(sequence.size, int(((np.diff(sequence) - 1) % 256).sum()))


def _losses(found: Frameset, system: int, component: int) -> list[Finding]:
    link = _link(found, system, component)
    if not link.lost:
        return []
    share = link.lost / (link.lost + link.received)
    text = (
        f"By their sequence numbers at least {link.lost} messages of the vehicle never reached the log "
        f"({100.0 * share:.1f} %)."
    )
    grade = Grade.HARMLESS if share < 0.02 else Grade.DEGRADES
    return [note("gaps", text, grade, lost=float(link.lost), received=float(link.received), share=share)]


def _notes(signals: Mapping[str, object], found: Frameset, ardupilot: bool) -> list[Finding]:
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


def _about(found: Frameset, system: int, clocks: _Clocks) -> dict[str, str]:
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


def _parameters(found: Frameset, system: int) -> dict[str, str]:
    """The last value of each parameter that the vehicle reported."""
    values: dict[str, str] = {}
    for (sender, _, identifier), frames in found.frames.items():
        if sender == system and MESSAGES[identifier].msgname == "PARAM_VALUE":
            columns = columns_of(MESSAGES[identifier], frames.payloads)
            for name, value in zip(columns["param_id"].tolist(), columns["param_value"].tolist(), strict=True):
                values[text_of(name)] = repr(value)
    return dict(list(values.items())[:5000])


def _events(found: Frameset, system: int) -> tuple[Event, ...]:
    """What the vehicle said in words."""
    events = []
    for (sender, _, identifier), frames in found.frames.items():
        if sender == system and MESSAGES[identifier].msgname == "STATUSTEXT":
            columns = columns_of(MESSAGES[identifier], frames.payloads)
            rows = zip(frames.stamps, columns["severity"].tolist(), columns["text"].tolist(), strict=True)
            events += [Event(t / 1e6, "log", {"severity": s, "text": text_of(x)}) for t, s, x in rows]
    return tuple(sorted(events, key=lambda e: e.time)[:_EVENTS])
