"""The protobuf messages of MCAP files, without generated code; every viewer can decode them.

Log packets have one message type per block and one field per variable. `struct` packs and unpacks them: all fields have
8 bytes, so a message has a fixed length and takes about a microsecond. All other messages stand in the table
`_MESSAGES` and use google.protobuf.
"""

import functools
import json
import struct
from collections.abc import Iterable, Mapping
from importlib import metadata as package_metadata
from typing import Any

import msgspec
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding
from crazyem.signals.sample import Block, Packet, Variable

_F = descriptor_pb2.FieldDescriptorProto


def axes(*quantities: str) -> str:
    """Names of three fields for each quantity: "position_x position_y position_z"."""
    return " ".join(f"{quantity}_{axis}" for quantity in quantities for axis in "xyz")


RESIDUALS = axes("position", "velocity", "attitude", "body_rate")
_TIMESTAMP, _POSE = "google/protobuf/timestamp.proto", "foxglove/Pose.proto"
# file -> message -> types and names of its fields, numbered from 1; the numbers are part of the file format
# (docs/reference/formats/mcap.md)
_MESSAGES: dict[str, dict[str, str]] = {
    _TIMESTAMP: {"Timestamp": "int64 seconds, int32 nanos"},
    "crazyem.proto": {
        "Setpoint": f"double time host_time {axes('position', 'velocity', 'acceleration')} yaw yaw_rate",
        "ParameterWrite": "double host_time, string name, double value echoed, bool verified",
        "ParameterEstimate": "string name, double value sd ci95_low ci95_high, string unit, bool identifiable, "
        "string reason",
        "Estimate": "double time host_time, crazyem.ParameterEstimate[] parameters, int64 samples updates, "
        "bool converged",
        # the drone's packets so far, and over the last second
        "Link": "double host_time, int64 received lost late, double rate loss latency, "
        "double round_trip clock_offset clock_rate, int64 outages",
        # measured minus predicted in the newest sample, and the expected standard deviation
        "Residual": f"double time host_time {RESIDUALS} {RESIDUALS.replace(' ', '_sd ')}_sd",
        # any event without a message of its own
        "Event": "double time, string kind json",
    },
    _POSE: {
        "Vector3": "double x y z",
        "Quaternion": "double x y z w",
        "Pose": "foxglove.Vector3 position, foxglove.Quaternion orientation",
    },
    "foxglove/Log.proto": {
        "Log": "google.protobuf.Timestamp timestamp, foxglove.Log.Level level, string message name",
    },
    "foxglove/PoseInFrame.proto": {
        "PoseInFrame": "google.protobuf.Timestamp timestamp, string frame_id, foxglove.Pose pose",
    },
    "foxglove/FrameTransform.proto": {
        "FrameTransform": "google.protobuf.Timestamp timestamp, string parent_frame_id child_frame_id, "
        "foxglove.Vector3 translation, foxglove.Quaternion rotation",
    },
}
_DEPENDENCIES = {
    "foxglove/Log.proto": [_TIMESTAMP],
    "foxglove/PoseInFrame.proto": [_TIMESTAMP, _POSE],
    "foxglove/FrameTransform.proto": [_TIMESTAMP, _POSE],
}
_LOG_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


def _message(name: str, fields: Iterable[tuple[str, str]]) -> descriptor_pb2.DescriptorProto:
    """The descriptor of a message from (type, name) of its fields."""
    message = descriptor_pb2.DescriptorProto(name=name)
    for number, (kind, field) in enumerate(fields, start=1):
        added = message.field.add(name=field, number=number, label=_F.LABEL_OPTIONAL)
        if kind.endswith("[]"):
            added.label = _F.LABEL_REPEATED
        if "." in kind:
            added.type = _F.TYPE_ENUM if kind == "foxglove.Log.Level" else _F.TYPE_MESSAGE
            added.type_name = "." + kind.removesuffix("[]")
        else:
            added.type = _F.Type.Value(f"TYPE_{kind.upper()}")
    return message


def _fields(text: str) -> list[tuple[str, str]]:
    """(type, name) of each field of "double x y, bool flag"."""
    return [(kind, name) for kind, *names in map(str.split, text.split(",")) for name in names]


def _file(name: str, package: str, messages: Iterable[Any]) -> Any:
    return descriptor_pb2.FileDescriptorProto(name=name, package=package, syntax="proto3", message_type=messages)


@functools.cache
def _files() -> tuple[Any, ...]:
    """Descriptors of all fixed files, dependencies first."""
    files = []
    for name, messages in _MESSAGES.items():
        package = name.removesuffix(".proto").rpartition("/")[0].replace("/", ".") or "crazyem"
        file = _file(name, package, [_message(m, _fields(text)) for m, text in messages.items()])
        file.dependency.extend(_DEPENDENCIES.get(name, ()))
        if name == "foxglove/Log.proto":
            enum = file.message_type[0].enum_type.add(name="Level")
            for number, level in enumerate(_LOG_LEVELS):
                enum.value.add(name=level, number=number)
        files.append(file)
    return tuple(files)


@functools.cache
def message_class(name: str) -> Any:
    """The message class of a full name such as "crazyem.Estimate" or "foxglove.Log"."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files():
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def encode(name: str, fields: Mapping[str, Any]) -> bytes:
    """The bytes of a message with these fields."""
    return bytes(message_class(name)(**fields).SerializeToString())


@functools.cache
def schema_data(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message, dependencies included, as MCAP requires."""
    own = message_class(name).DESCRIPTOR.file.name
    wanted = [file for file in _files() if file.name in (own, *_DEPENDENCIES.get(own, ()))]
    return descriptor_pb2.FileDescriptorSet(file=wanted).SerializeToString()


class BlockCodec:
    """Messages of one log block: `firmware_time_ms`, `host_time`, then one double per variable.

    A double holds every firmware value (integers of up to 32 bits, float, half) exactly; `stream_codec` decodes.
    """

    def __init__(self, block: Block) -> None:
        self.block = block
        self.schema_name = f"crazyem.log.Block{block.identifier}"
        self._tags = [tag(number) for number in range(1, 3 + len(block.variables))]
        kinds = "q" + "d" * (len(self._tags) - 1)
        self._struct = struct.Struct("<" + "".join(f"{len(t)}s{k}" for t, k in zip(self._tags, kinds, strict=True)))

    def encode(self, packet: Packet) -> bytes:
        fields: list[Any] = [None] * (2 * len(self._tags))
        fields[0::2] = self._tags
        fields[1::2] = (packet.firmware_time_ms, packet.host_time, *packet.values)
        return self._struct.pack(*fields)

    def schema_data(self) -> bytes:
        fields = [("firmware_time_ms", "sfixed64"), ("host_time", "double")]
        fields += [(v.name.replace(".", "_"), "double") for v in self.block.variables]
        return dynamic_schema("crazyem.log", self.schema_name.rsplit(".", 1)[1], fields)

    def metadata(self) -> dict[str, str]:
        """Metadata of the channel, sufficient to decode the block without any other record."""
        block = self.block
        variables = json.dumps([[v.name, v.ctype] for v in block.variables])
        return {"identifier": str(block.identifier), "period_ms": str(block.period_ms), "variables": variables}


def block_from_metadata(metadata: dict[str, str]) -> Block:
    """Inverse of `BlockCodec.metadata`; raises ValueError, KeyError or TypeError on anything else."""
    variables = tuple(Variable(str(name), str(ctype)) for name, ctype in json.loads(metadata["variables"]))
    return Block(int(metadata["identifier"]), variables, int(metadata["period_ms"]))


def session_of(metadata: dict[str, str]) -> int:
    """Number of the session of a log channel, from its metadata; 1 if it is absent or damaged."""
    number = metadata.get("session", "1")
    return int(number) if number.isdecimal() and len(number) < 6 else 1


def dynamic_schema(package: str, name: str, fields: Iterable[tuple[str, str]]) -> bytes:
    """The serialised FileDescriptorSet of a message that is defined at run time, from (field, type) in order."""
    message = _message(name, [(kind, field) for field, kind in fields])
    file = _file(f"{package.replace('.', '/')}/{name}.proto", package, [message])
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


def tag(number: int) -> bytes:
    """The tag bytes before a field of eight bytes."""
    key, data = number << 3 | 1, bytearray()
    while key >= 0x80:
        data.append(key & 0x7F | 0x80)
        key >>= 7
    return bytes(data) + bytes([key])


PROFILE = "crazyem"
FORMAT_VERSION = "1"
WORLD_FRAME, BODY_FRAME = "world", "crazyflie"
POSE_PERIOD = 0.04  # s between poses, which are for viewers only

# kind of event -> topic, schema
EVENT_TOPICS: dict[str, tuple[str, str]] = {
    "setpoint": ("/setpoint", "crazyem.Setpoint"),
    "parameter_write": ("/parameter_write", "crazyem.ParameterWrite"),
    "estimate": ("/estimate", "crazyem.Estimate"),
    "log": ("/events", "foxglove.Log"),
    "link": ("/link", "crazyem.Link"),
    "residual": ("/residual", "crazyem.Residual"),
}
OTHER_EVENT_TOPIC = ("/other_events", "crazyem.Event")
FINDINGS_TOPIC = "/findings"
FRAMES_TOPIC = "/mavlink"  # unchanged frames, message encoding "mavlink"; for other programs, never read back


def pose_messages(
    nanoseconds: int, translation: dict[str, float], rotation: dict[str, float]
) -> list[tuple[str, str, dict[str, Any]]]:
    """Topic, schema and fields of a pose (m, quaternion body to world) for viewers; time since 1970."""
    stamp = timestamp(nanoseconds)
    pose = {"position": translation, "orientation": rotation}
    frame = {
        "parent_frame_id": WORLD_FRAME,
        "child_frame_id": BODY_FRAME,
        "translation": translation,
        "rotation": rotation,
    }
    return [
        ("/pose", "foxglove.PoseInFrame", {"timestamp": stamp, "frame_id": WORLD_FRAME, "pose": pose}),
        ("/tf", "foxglove.FrameTransform", {"timestamp": stamp, **frame}),
    ]


def timestamp(nanoseconds: int) -> dict[str, int]:
    """Fields of google.protobuf.Timestamp."""
    return {"seconds": nanoseconds // 10**9, "nanos": nanoseconds % 10**9}


def fields_of(message: Any) -> dict[str, object]:
    """All fields of a message by name; nested messages as dictionaries, NaN is kept (echo that never arrived)."""
    result: dict[str, object] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            result[field.name] = value
        elif isinstance(value, (list, tuple)) or hasattr(value, "add"):
            result[field.name] = [fields_of(item) for item in value]
        else:
            result[field.name] = fields_of(value)
    return result


def versions() -> dict[str, str]:
    """Versions of the format and of the packages that write a file."""
    names = ("crazyem", "cflib", "mcap", "numpy")
    return {"format": FORMAT_VERSION, **{name: _version(name) for name in names}}


def _version(package: str) -> str:
    try:
        return package_metadata.version(package)
    except package_metadata.PackageNotFoundError:
        return "unknown"


IMPORT_METADATA = "crazyem.signals"  # metadata record that crazyem adds to an imported recording
_MOST_ROWS = 100_000_000  # rows of a fix; guards against damaged runs


def findings_to_json(findings: Iterable[Finding]) -> str:
    """The findings as one text; the sample numbers of fixes as runs."""
    return json.dumps([finding.to_dict(rows=_runs) for finding in findings])


def findings_from_json(text: str) -> tuple[Finding, ...]:
    """Inverse of `findings_to_json`. Raises ValueError or RecursionError on anything else."""
    return msgspec.convert(json.loads(text), tuple[Finding, ...], dec_hook=_rows_of_runs)


def _rows_of_runs(kind: type, value: Any) -> NDArray[np.int64]:
    """Rows of a fix: the only numpy array in a finding."""
    runs = msgspec.convert(value, list[tuple[int, int]])
    if any(a < 0 or b < a for a, b in runs) or sum(b - a for a, b in runs) > _MOST_ROWS:
        raise ValueError("not rows")
    return np.concatenate([np.empty(0, np.int64), *(np.arange(a, b) for a, b in runs)]).astype(np.int64)


def _runs(rows: NDArray[np.int64]) -> list[list[int]]:
    """[first, last + 1] of each run of consecutive numbers, in the given order."""
    if not rows.size:
        return []
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    starts, ends = rows[np.r_[0, breaks]], rows[np.r_[breaks - 1, rows.size - 1]] + 1
    return [[int(a), int(b)] for a, b in zip(starts, ends, strict=True)]
