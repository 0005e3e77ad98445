"""The protobuf messages of MCAP files, without generated code; every viewer can decode them.

Log packets have one message type per block and one field per variable. `struct` packs and unpacks them: all fields have
8 bytes, so a message has a fixed length and takes about a microsecond. All other messages are defined in
messages.textproto and use google.protobuf.
"""

import functools
import json
import struct
from collections.abc import Iterable
from importlib import resources
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format

from crazyem.signals.sample import Block, Packet, Variable

_F = descriptor_pb2.FieldDescriptorProto
_TYPES = {"double": _F.TYPE_DOUBLE, "sfixed64": _F.TYPE_SFIXED64, "fixed64": _F.TYPE_FIXED64}  # of 8 bytes


@functools.cache
def _files() -> tuple[Any, ...]:
    """Descriptors of all fixed files, dependencies first."""
    text = (resources.files("crazyem.recordings.mcap") / "messages.textproto").read_text(encoding="utf-8")
    return tuple(text_format.Parse(text, descriptor_pb2.FileDescriptorSet()).file)


@functools.cache
def message_class(name: str) -> Any:
    """The message class of a full name such as "crazyem.Estimate" or "foxglove.Log"."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files():
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


@functools.cache
def schema_data(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message, dependencies included, as MCAP requires."""
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
    """Messages of one log block: `firmware_time_ms`, `host_time`, then one double per variable.

    A double holds every firmware value (integers of up to 32 bits, float, half) exactly, so decoding returns the same
    packet bit for bit. Raises ValueError if bytes are not such a message.
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
        """Metadata of the channel, sufficient to decode the block without any other record."""
        block = self.block
        variables = json.dumps([[v.name, v.ctype] for v in block.variables])
        return {"identifier": str(block.identifier), "period_ms": str(block.period_ms), "variables": variables}


def block_from_metadata(metadata: dict[str, str]) -> Block:
    """Inverse of `BlockCodec.metadata`; raises ValueError, KeyError or TypeError on anything else."""
    variables = tuple(Variable(str(name), str(ctype)) for name, ctype in json.loads(metadata["variables"]))
    return Block(int(metadata["identifier"]), variables, int(metadata["period_ms"]))


def dynamic_schema(package: str, name: str, fields: Iterable[tuple[str, str]]) -> bytes:
    """The serialised FileDescriptorSet of a message that is defined at run time, from (field, type) in order."""
    message = descriptor_pb2.DescriptorProto(name=name)
    for number, (field, kind) in enumerate(fields, start=1):
        message.field.add(name=field, number=number, label=_F.LABEL_OPTIONAL, type=_TYPES[kind])
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package.replace('.', '/')}/{name}.proto", package=package, syntax="proto3", message_type=[message]
    )
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


def tag(number: int, wire_type: int) -> bytes:
    """The tag bytes before a field."""
    key, data = number << 3 | wire_type, bytearray()
    while key >= 0x80:
        data.append(key & 0x7F | 0x80)
        key >>= 7
    return bytes(data) + bytes([key])
