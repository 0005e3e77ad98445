"""The recording from the decoded topics of a bag: clocks, log blocks and their variables, known message types."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.links.clock import STAMP_MODULUS, StampUnwrapper
from crazyem.physics.rotations import rotate
from crazyem.recordings.autopilots.frd_ned import Turn, bit, euler_from_quaternions, stacked
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.motor_meaning import decide
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.ros.ros2_messages import MessageType, Rows, rows_of
from crazyem.recordings.stamps import Fault, finding
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.topics import Mapped, Source, Topic, ranks, seconds, signals_of, text_of

HOST_CLOCK = "ros"  # the clock of the host's ROS nodes
FIRMWARE_CLOCK = "firmware"
_LOG = "crazyflie_interfaces/LogDataGeneric"
_STATUS = "crazyflie_interfaces/Status"
_FULL_STATE = "crazyflie_interfaces/FullState"
_ODOMETRY = "nav_msgs/Odometry"
_TF, _MOCAP = "tf2_msgs/TFMessage", "motion_capture_tracking_interfaces/NamedPoseArray"
# message types that show that a namespace belongs to a robot
ROBOT_TYPES = {
    *(_LOG, _STATUS, _FULL_STATE, _ODOMETRY),
    *("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "sensor_msgs/Imu"),
}
WORLD_TOPICS = {"/tf", "/poses"}  # topics with all robots
_FLYING_BIT = 16  # supervisor.info
_NS = 1_000_000_000
_SAME_EPOCH = 3600 * _NS  # a stamp further from the log time is from a simulation or an unset clock
_XYZ, _XYZW = "xyz", "xyzw"


@dataclass(slots=True)
class BagTopic:
    """The messages of a topic: (log time [ns], bytes), and their places among all messages of the bag."""

    name: str
    kind: MessageType
    messages: list[tuple[int, bytes]] = field(default_factory=list)
    places: list[int] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class BagMapping:
    """The mapping of the user for a bag: its file, the robot, the frame of twists, variables by topic."""

    file: str | None = None
    robot: str | None = None
    twist: str | None = None
    variables: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(eq=False)
class _Decoded:
    """The numbers of a topic, their order in the bag, and their times on the axis of the recording."""

    topic: BagTopic
    rows: Rows
    order: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    time: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    clock: str = HOST_CLOCK

    @cached_property
    def unknown(self) -> NDArray[np.bool_]:
        """(n,) True where a message has no stamp, or a stamp far from its log time."""
        own, log = self.rows.stamp, self.rows.log
        return (own <= 0) | (np.abs(own - log) > _SAME_EPOCH)

    @property
    def moved(self) -> bool:
        """Whether some messages, but less than half, are placed by their log time."""
        return bool(self.unknown.any()) and 2 * int(self.unknown.sum()) < self.unknown.size

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(n,) ns: the stamps of the messages, or their log times if most stamps are absent or far from these.

        If only a few stamps are unknown, these messages have the log time minus the median delay of the others.
        """
        own, log = self.rows.stamp, self.rows.log
        if not self.unknown.any():
            return own
        if not self.moved:
            return log
        delay = int(np.median((log - own)[~self.unknown]))
        return np.where(self.unknown, log - delay, own)

    def fault(self) -> Fault:
        """The fault of the unknown stamps of the topic."""
        example = float(self.rows.stamp[self.unknown][0]) / _NS
        return Fault(_label(self), int(self.unknown.sum()), self.unknown.size, "placed by arrival", example)


def recording_of(
    path: Path,
    topics: Sequence[BagTopic],
    robot: str,
    mapping: BagMapping,
    motor: str | None,
    findings: tuple[Finding, ...],
) -> Recording:
    """The recording of one robot. Raises FileFormatError if the bag has no data or the mapping does not fit."""
    decoded = [d for d in (_decode(topic, robot) for topic in topics) if d is not None]
    if not decoded:
        raise FileFormatError(f"{path}: the bag holds not a single sound message of a robot.")
    for d, order in zip(decoded, ranks([d.rows.log for d in decoded]), strict=True):
        d.order = order
    origin, clock_notes, clocks = _place(decoded)
    logs = [d for d in decoded if d.topic.kind.name == _LOG]
    tables, log_notes = _tables(logs, mapping)
    meaning = decide(tables, given=motor)
    firmware = signals_from_tables(tables, motor=meaning.meaning) if tables else {}
    named = {table.name for table in tables}
    others = [(d, _topic(d)) for d in decoded if _label(d) not in named]
    mapped: list[Mapped] = []
    twist_notes: list[Finding] = []
    for d, topic in others:
        mapped += _meaning(d, topic, mapping, twist_notes)
    if any(d.rows.texts.get("child_frame_id") for d in decoded if d.topic.kind.name == _ODOMETRY) and any(
        d.topic.kind.name.startswith("crazyflie_interfaces/") for d in decoded
    ):
        twist_notes.append(_PYTHON_SERVER)
    mapped.sort(key=lambda m: _PREFERRED.get(m.origin, 0))
    have = {*firmware, *(m.quantity for m in mapped if not m.origin)}
    # an external pose becomes the pose if there is no other
    mapped = [m if m.quantity in have else replace(m, origin="") for m in mapped]
    rest, left_out = signals_of([topic for _, topic in others], mapped)
    signals = _together(firmware, rest, {_label(d): d.order for d in decoded})
    broken = [
        note("integrity", f"{n} messages of {text_of(d.topic.name)} do not fit their type.", Grade.DEGRADES, messages=n)
        for d in decoded
        if (n := d.rows.broken)
    ]
    about = {"robot": robot, "topics": " ".join(sorted(text_of(t.name) for t in topics))[:4000], **clocks}
    return Recording(
        str(path),
        "rosbag2",
        signals,
        {"rosbag2": about, **meaning.metadata},
        (
            *findings,
            *broken,
            *finding([d.fault() for d in decoded if d.moved and d.clock == HOST_CLOCK], signals),
            *clock_notes,
            *log_notes,
            *meaning.findings,
            *twist_notes,
            *left_out,
        ),
        (),
        origin,
    )


_PREFERRED = {"mocap": 1, "tf": 2}
# crazyflie_server.py: `_log_odom_data_callback` copies gyro.* and stabilizer.pitch as the firmware logs them
_PYTHON_SERVER = note(
    "mapping",
    "The odometry looks like that of crazyswarm2's Python server, which wrote rates in deg/s and the firmware's "
    "inverted pitch; it is read as published.",
    Grade.DEGRADES,
    "Run crazyem doctor, which tells from the numbers; prefer log blocks.",
)


def _label(d: _Decoded) -> str:
    return d.topic.name.strip("/")


def _decode(topic: BagTopic, robot: str) -> _Decoded | None:
    """The numbers of a topic, None without any; from topics with all robots only those of this robot."""
    keep = topic.kind.name in (_TF, _MOCAP)
    if not (keep or topic.kind.scalars or topic.kind.arrays):
        return None
    rows = rows_of(topic.kind, topic.messages, keep=keep)
    if keep:
        rows = _of_robot(rows, topic.kind.name, robot)
    return _Decoded(topic, rows) if rows.log.size else None


def _of_robot(rows: Rows, kind: str, robot: str) -> Rows:
    """Poses of one robot from messages with many robots."""
    values: list[tuple[float, ...]] = []
    stamps: list[int] = []
    logs: list[int] = []
    for log, message in zip(rows.log.tolist(), rows.objects, strict=True):
        if kind == _TF:
            transforms = [(t, t.transform) for t in message.transforms if t.child_frame_id == robot]
            poses = [(t.header.stamp, pose.translation, pose.rotation) for t, pose in transforms]
        else:
            own = [entry.pose for entry in message.poses if entry.name == robot]
            poses = [(message.header.stamp, pose.position, pose.orientation) for pose in own]
        for stamp, place, turn in poses:
            values.append((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))
            stamps.append(stamp.sec * _NS + stamp.nanosec)
            logs.append(log)
    table = np.array(values, float).reshape(-1, 7)
    names = [*(f"position.{c}" for c in _XYZ), *(f"orientation.{c}" for c in _XYZW)]
    columns = {name: table[:, i] for i, name in enumerate(names)}
    return Rows(columns, np.array(stamps, np.int64), np.array(logs, np.int64), [], rows.broken, {})


def _place(decoded: list[_Decoded]) -> tuple[float, list[Finding], dict[str, str]]:
    """Put every topic on one time axis; returns its origin [s], findings about it, and its constants as metadata."""
    logs = [d for d in decoded if d.topic.kind.name == _LOG and "timestamp" in d.rows.columns]
    if not logs:
        first = min(int(d.stamps.min()) for d in decoded) // _NS
        for d in decoded:
            d.time = seconds(d.stamps - first * _NS, 1e9)
        return float(first), [], {"origin_ns": str(first * _NS)}
    _unwrap(logs)
    lead = np.concatenate([d.stamps - np.round(d.time * 1e9).astype(np.int64) for d in logs])
    offset = int(np.median(lead))
    others = [d for d in decoded if d not in logs]
    for d in others:
        d.time = seconds(d.stamps - offset, 1e9)
    notes = []
    if others:
        spread = float(np.percentile(lead, 95) - np.percentile(lead, 5)) * 1e-9
        text = (
            "The time axis is the firmware's, from the log blocks. Other topics have only the host's stamps: they keep "
            f"their intervals and are shifted by one constant (it varied by {1e3 * spread:.1f} ms in the log blocks)."
        )
        notes.append(note("mapping", text, spread_s=spread, offset_s=offset * 1e-9))
    return 0.0, notes, {"host_minus_firmware_ns": str(offset)}


def _unwrap(logs: list[_Decoded]) -> None:
    """Set the firmware times [s] of log blocks: unwrapped 24-bit milliseconds, all blocks on one clock."""
    stamps = np.concatenate([d.rows.columns["timestamp"] for d in logs]).astype(np.int64)
    small = stamps < STAMP_MODULUS
    if 2 * int(small.sum()) > small.size:  # most stamps have 24 bits; else they are unwrapped already
        order = np.argsort(np.concatenate([d.order for d in logs]))
        order = order[small[order]]
        unwrapper = StampUnwrapper()
        for i, stamp in zip(order.tolist(), stamps[order].tolist(), strict=True):
            stamps[i] = unwrapper.unwrap(stamp)
    for d, part in zip(logs, np.split(stamps, np.cumsum([d.order.size for d in logs])[:-1]), strict=True):
        d.time, d.clock = seconds(part, 1e3), FIRMWARE_CLOCK


def _tables(logs: list[_Decoded], mapping: BagMapping) -> tuple[list[Table], list[Finding]]:
    """Tables of firmware variables from log blocks whose variables the user names; a finding for each other block."""
    tables, notes = [], []
    for d in logs:
        values = [c for c in d.rows.columns if c.startswith("values[")]
        names = mapping.variables.get(d.topic.name)
        if names is None:
            text = (
                f"{text_of(d.topic.name)} is a log block of {len(values)} variables; their names are in "
                "crazyflies.yaml, not in the bag, so they have no meaning here."
            )
            advice = f'Give a mapping file (--map) with [topics."{text_of(d.topic.name)}"] variables = ["..."].'
            notes.append(Finding("mapping", Grade.DEGRADES, text, evidence={"variables": len(values)}, advice=advice))
            continue
        if len(names) != len(values):
            raise FileFormatError(
                f'{mapping.file}: topics."{d.topic.name}".variables has {len(names)} names, but the messages hold '
                f"{len(values)} values."
            )
        columns = {name: d.rows.columns[value] for name, value in zip(names, values, strict=True)}
        host = seconds(d.rows.log, 1e9)
        tables.append(Table(_label(d), columns, d.time, d.order, host, clock=FIRMWARE_CLOCK))
    return tables, notes


def _topic(d: _Decoded) -> Topic:
    used = {"timestamp"} if d.clock == FIRMWARE_CLOCK else set()
    columns = {name: column for name, column in d.rows.columns.items() if name not in used}
    return Topic(_label(d), columns, d.time, d.order, seconds(d.rows.log, 1e9), d.clock)


def _together(
    firmware: dict[str, SignalArray], rest: dict[str, SignalArray], order: Mapping[str, NDArray[np.int64]]
) -> dict[str, SignalArray]:
    """Signals of log blocks, then the others, which are renamed if they measure the same; one order for all."""
    signals = dict(firmware)
    for name, array in rest.items():
        signals[f"{name}@{array.stream}" if name in signals else name] = array
    step = len(signals)
    return {
        name: replace(array, order=order[array.stream] * step + place)
        for place, (name, array) in enumerate(signals.items())
    }


def _no_attitude(prefix: str) -> Callable[[Topic], NDArray[np.bool_]]:
    """Function for the rows with a zero quaternion, or with covariance -1 for "no attitude" (sensor_msgs/Imu)."""

    def absent(topic: Topic) -> NDArray[np.bool_]:
        rows = ~stacked([topic.columns[prefix + c] for c in _XYZW]).any(axis=1)
        unknown = topic.columns.get("orientation_covariance[0]")
        return np.asarray(rows if unknown is None else rows | (unknown == -1), bool)

    return absent


def _source(
    quantity: str, prefix: str, parts: Sequence[str] = _XYZ, convert: Turn = stacked, origin: str = ""
) -> Source:
    invalid = _no_attitude(prefix) if parts == _XYZW else None
    return Source(quantity, "", tuple(prefix + c for c in parts), convert, invalid, origin=origin)


def _pose(prefix: str, origin: str = "") -> tuple[Source, Source]:
    place = _source("position", prefix + "position.", origin=origin)
    return place, _source("attitude", prefix + "orientation.", _XYZW, origin=origin)


# type of messages -> signals of the vocabulary, in any topic
_MEANING: Mapping[str, tuple[Source, ...]] = {
    "geometry_msgs/PoseStamped": _pose("pose."),
    "geometry_msgs/PoseWithCovarianceStamped": _pose("pose.pose."),
    _ODOMETRY: _pose("pose.pose."),
    "sensor_msgs/Imu": (
        _source("body_rate", "angular_velocity."),
        _source("specific_force", "linear_acceleration."),
        _source("attitude", "orientation.", _XYZW),
    ),
    "sensor_msgs/BatteryState": (_source("voltage", "", ["voltage"]),),
    _STATUS: (
        _source("voltage", "", ["battery_voltage"]),
        _source("flying", "", ["supervisor_info"], bit(_FLYING_BIT)),
    ),
    _FULL_STATE: (
        _source("setpoint_position", "pose.position."),
        _source("setpoint_velocity", "twist.linear."),
        _source("setpoint_acceleration", "acc."),
        _source("setpoint_rate", "twist.angular."),
        _source("setpoint_euler", "pose.orientation.", _XYZW, lambda c: euler_from_quaternions(stacked(c))),
    ),
    "crazyflie_interfaces/Position": (_source("setpoint_position", ""),),
    _TF: _pose("", "tf"),
    _MOCAP: _pose("", "mocap"),
}


def _meaning(d: _Decoded, topic: Topic, mapping: BagMapping, notes: list[Finding]) -> list[Mapped]:
    """Signals of the vocabulary in a topic, by the type of its messages."""
    kind = d.topic.kind.name
    found = _of(topic, *_MEANING.get(kind, ()))
    return [*found, *_twist(d, topic, found, mapping, notes)] if kind == _ODOMETRY else found


def _of(topic: Topic, *sources: Source) -> list[Mapped]:
    return [m for source in sources for m in replace(source, topic=topic.name).of([topic])]


def _twist(
    d: _Decoded, topic: Topic, pose: Sequence[Mapped], mapping: BagMapping, notes: list[Finding]
) -> Iterator[Mapped]:
    """World velocity and body rate from odometry. The C++ server of crazyswarm2 sets rates 0 and no child frame."""
    attitude = next((m.value for m in pose if m.quantity == "attitude"), None)
    child = d.rows.texts.get("child_frame_id", "")
    frame = mapping.twist or ("body" if child else "world")
    for m in _of(topic, _source("velocity", "twist.twist.linear.")):
        if frame == "body" and attitude is None:
            continue
        value = m.value if frame == "world" or attitude is None else rotate(attitude, m.value)
        why = f'its child frame is "{text_of(child)}"' if child else "it has no child frame"
        why = "as told" if mapping.twist else why
        text = f"The twist of {text_of(d.topic.name)} is read as in the {frame} frame: {why}."
        advice = 'If that is wrong, say twist = "world" or twist = "body" in a mapping file (--map).'
        notes.append(Finding("mapping", Grade.HARMLESS, text, "velocity", advice=advice))
        yield replace(m, value=value)
    for m in _of(topic, _source("body_rate", "twist.twist.angular.")):
        if m.value.any():
            yield m
