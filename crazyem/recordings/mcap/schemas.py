"""The protobuf messages of our MCAP files, built in memory: no generated code, and every viewer can decode them.

Log packets have one message type a block, with one field a variable, and are packed and unpacked by `struct`: all their
fields are 8 bytes wide, so a message has a fixed length and costs about a microsecond. Every other message goes
through google.protobuf. Field numbers are part of the file format (docs/reference/formats/mcap.md).
"""

import functools
import json
import struct
from collections.abc import Iterable
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from crazyem.signals.sample import Block, Packet, Variable

_F = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "double": _F.TYPE_DOUBLE,
    "sfixed64": _F.TYPE_SFIXED64,
    "fixed64": _F.TYPE_FIXED64,
    "int64": _F.TYPE_INT64,
    "int32": _F.TYPE_INT32,
    "uint32": _F.TYPE_UINT32,
    "string": _F.TYPE_STRING,
    "bool": _F.TYPE_BOOL,
}

# message -> (field, type); numbered from 1 in this order. A type with a dot is a message; "*" after it: repeated.
_MESSAGES: dict[str, tuple[tuple[str, str], ...]] = {
    "crazyem.Setpoint": (
        ("time", "double"),
        ("host_time", "double"),
        *((f"{what}_{axis}", "double") for what in ("position", "velocity", "acceleration") for axis in "xyz"),
        ("yaw", "double"),
        ("yaw_rate", "double"),
    ),
    "crazyem.ParameterWrite": (
        ("host_time", "double"),
        ("name", "string"),
        ("value", "double"),
        ("echoed", "double"),
        ("verified", "bool"),
    ),
    "crazyem.ParameterEstimate": (
        ("name", "string"),
        ("value", "double"),
        ("sd", "double"),
        ("ci95_low", "double"),
        ("ci95_high", "double"),
        ("unit", "string"),
        ("identifiable", "bool"),
        ("reason", "string"),
    ),
    "crazyem.Estimate": (
        ("time", "double"),
        ("host_time", "double"),
        ("parameters", "crazyem.ParameterEstimate*"),
        ("samples", "int64"),
        ("updates", "int64"),
        ("converged", "bool"),
    ),
    # the drone's packets so far, and over the last second
    "crazyem.Link": (
        ("host_time", "double"),
        ("received", "int64"),
        ("lost", "int64"),
        ("late", "int64"),
        ("rate", "double"),
        ("loss", "double"),
        ("latency", "double"),
        ("round_trip", "double"),
        ("clock_offset", "double"),
        ("clock_rate", "double"),
        ("outages", "int64"),
    ),
    # what the newest sample had that the model did not predict, and the standard deviation it was expected to have
    "crazyem.Residual": (
        ("time", "double"),
        ("host_time", "double"),
        *((f"{w}_{axis}", "double") for w in ("position", "velocity", "attitude", "body_rate") for axis in "xyz"),
        *((f"{w}_{axis}_sd", "double") for w in ("position", "velocity", "attitude", "body_rate") for axis in "xyz"),
    ),
    # anything that happened and has no message of its own
    "crazyem.Event": (("time", "double"), ("kind", "string"), ("json", "string")),
    "foxglove.Vector3": (("x", "double"), ("y", "double"), ("z", "double")),
    "foxglove.Quaternion": (("x", "double"), ("y", "double"), ("z", "double"), ("w", "double")),
    "foxglove.Pose": (("position", "foxglove.Vector3"), ("orientation", "foxglove.Quaternion")),
    "foxglove.Time": (("seconds", "int64"), ("nanos", "int32")),
}


def _message(name: str, fields: tuple[tuple[str, str], ...]) -> descriptor_pb2.DescriptorProto:
    message = descriptor_pb2.DescriptorProto(name=name)
    for number, (field, kind) in enumerate(fields, start=1):
        entry = message.field.add(name=field, number=number)
        entry.label = _F.LABEL_REPEATED if kind.endswith("*") else _F.LABEL_OPTIONAL
        base = kind.rstrip("*")
        entry.type = _TYPES.get(base, _F.TYPE_MESSAGE)
        if base not in _TYPES:
            entry.type_name = f".{base}"
    return message


def _file(name: str, package: str, messages: list[descriptor_pb2.DescriptorProto], *needs: str) -> Any:
    return descriptor_pb2.FileDescriptorProto(
        name=name, package=package, syntax="proto3", dependency=list(needs), message_type=messages
    )


@functools.cache
def _files() -> tuple[Any, ...]:
    """Descriptors of all fixed files, dependencies first."""
    time = ("timestamp", "google.protobuf.Timestamp")
    stamp = "google/protobuf/timestamp.proto"
    ours = [_message(n.split(".")[1], f) for n, f in _MESSAGES.items() if n.startswith("crazyem.")]
    pose = [
        _message(n.split(".")[1], _MESSAGES[n]) for n in ("foxglove.Vector3", "foxglove.Quaternion", "foxglove.Pose")
    ]
    log = _message("Log", (time, ("level", "int32"), ("message", "string"), ("name", "string")))
    log.field[1].type = _F.TYPE_ENUM
    log.field[1].type_name = ".foxglove.Log.Level"
    level = log.enum_type.add(name="Level")
    for number, word in enumerate(("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")):
        level.value.add(name=word, number=number)
    transform = (
        time,
        ("parent_frame_id", "string"),
        ("child_frame_id", "string"),
        ("translation", "foxglove.Vector3"),
        ("rotation", "foxglove.Quaternion"),
    )
    in_frame = (time, ("frame_id", "string"), ("pose", "foxglove.Pose"))
    timestamp = _file(stamp, "google.protobuf", [_message("Timestamp", _MESSAGES["foxglove.Time"])])
    return (
        timestamp,
        _file("crazyem.proto", "crazyem", ours),
        _file("foxglove/Pose.proto", "foxglove", pose),
        _file("foxglove/Log.proto", "foxglove", [log], stamp),
        _file(
            "foxglove/PoseInFrame.proto", "foxglove", [_message("PoseInFrame", in_frame)], stamp, "foxglove/Pose.proto"
        ),
        _file(
            "foxglove/FrameTransform.proto",
            "foxglove",
            [_message("FrameTransform", transform)],
            stamp,
            "foxglove/Pose.proto",
        ),
    )


@functools.cache
def message_class(name: str) -> Any:
    """The message class of a full name such as "crazyem.Estimate" or "foxglove.Log"."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files():
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


@functools.cache
def schema_data(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message, dependencies included, as MCAP wants it."""
    by_name = {file.name: file for file in _files()}
    wanted: list[Any] = []

    def add(file: Any) -> None:
        for need in file.dependency:
            add(by_name[need])
        if file not in wanted:
            wanted.append(file)

    add(by_name[message_class(name).DESCRIPTOR.file.name])
    return descriptor_pb2.FileDescriptorSet(file=wanted).SerializeToString()


class BlockCodec:
    """Messages of one log block: `firmware_time_ms`, `host_time`, then one double a variable.

    Every firmware value (integers of up to 32 bits, float, half) is exact in a double, so the packet comes back bit
    for bit. Raises ValueError where bytes are not such a message.
    """

    def __init__(self, block: Block) -> None:
        self.block = block
        self.schema_name = f"crazyem.log.Block{block.identifier}"
        tags = [tag(1, 1), tag(2, 1), *(tag(n, 1) for n in range(3, 3 + len(block.variables)))]
        kinds = ["q", *("d" for _ in tags[1:])]
        self._struct = struct.Struct("<" + "".join(f"{len(t)}s{k}" for t, k in zip(tags, kinds, strict=True)))
        self._tags = tuple(tags)

    def encode(self, packet: Packet) -> bytes:
        fields: list[Any] = [None] * (2 * len(self._tags))
        fields[0::2] = self._tags
        fields[1::2] = (packet.firmware_time_ms, packet.host_time, *packet.values)
        return self._struct.pack(*fields)

    def decode(self, data: bytes) -> Packet:
        if len(data) != self._struct.size:
            raise ValueError("not a message of this block")
        fields = self._struct.unpack(data)
        if fields[0::2] != self._tags:
            raise ValueError("not a message of this block")
        return Packet(self.block.identifier, fields[1], fields[3], fields[5::2])

    def schema_data(self) -> bytes:
        fields = [("firmware_time_ms", "sfixed64"), ("host_time", "double")]
        fields += [(v.name.replace(".", "_"), "double") for v in self.block.variables]
        return dynamic_schema("crazyem.log", self.schema_name.rsplit(".", 1)[1], fields)

    def metadata(self) -> dict[str, str]:
        """What the channel says of the block: enough to decode it without any other record."""
        block = self.block
        variables = json.dumps([[v.name, v.ctype] for v in block.variables])
        return {"identifier": str(block.identifier), "period_ms": str(block.period_ms), "variables": variables}


def block_from_metadata(metadata: dict[str, str]) -> Block:
    """Inverse of `BlockCodec.metadata`; raises ValueError, KeyError or TypeError on anything else."""
    variables = tuple(Variable(str(name), str(ctype)) for name, ctype in json.loads(metadata["variables"]))
    return Block(int(metadata["identifier"]), variables, int(metadata["period_ms"]))


def dynamic_schema(package: str, name: str, fields: Iterable[tuple[str, str]]) -> bytes:
    """The serialised FileDescriptorSet of a message made up at run time, from (field, type) in order."""
    file = _file(f"{package.replace('.', '/')}/{name}.proto", package, [_message(name, tuple(fields))])
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


def tag(number: int, wire_type: int) -> bytes:
    """The bytes before a field."""
    key, data = number << 3 | wire_type, bytearray()
    while key >= 0x80:
        data.append(key & 0x7F | 0x80)
        key >>= 7
    return bytes(data) + bytes([key])
