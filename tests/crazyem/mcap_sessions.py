"""Small recordings of two log blocks, and plain readers of their bytes: for the tests of damaged files."""

import struct

from mcap.reader import SeekingReader

from crazyem.recordings.mcap.writer import RecordingWriter
from crazyem.signals.sample import Block, Packet, Variable

MAGIC = b"\x89MCAP0\r\n"
STATE = Block(0, tuple(Variable(f"stateEstimate.{n}", "float") for n in "xyz"), 10)
POWER = Block(1, (Variable("pm.vbat", "float"),), 10)


def packets(first, count):
    for k in range(first, first + count):
        yield Packet(0, 10 * k, 1.7e9 + 0.01 * k, (0.01 * k, 1.0, 0.5))
        yield Packet(1, 10 * k + 3, 1.7e9 + 0.01 * k + 0.003, (4.0 - 1e-4 * k,))


def record(path, first=0, count=60, *, every=15, append=False, blocks=(STATE, POWER), **metadata):
    """A recording with a chunk for every `every` pairs of packets."""
    with RecordingWriter(path, metadata, append=append) as writer:
        writer.blocks(blocks)
        for k, packet in enumerate(packets(first, count)):
            if packet.block < len(blocks):
                writer.packet(packet)
            if k % (2 * every) == 2 * every - 1:
                writer._put(writer._output.flush)
    assert writer.failure == ""


def small_fixture(tmp_path_factory):
    path = tmp_path_factory.mktemp("damage") / "small.mcap"
    record(path)
    return path.read_bytes()


def top_level(data):
    """(offset, end, opcode) of every record, by the format's description: opcode, 64-bit length, content."""
    at, found = len(MAGIC), []
    while data[at : at + 8] != MAGIC:
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((at, at + 9 + length, opcode))
        at += 9 + length
    return found


def chunks(data):
    return [(start, end) for start, end, opcode in top_level(data) if opcode == 6]


def stock_messages(path, reader=SeekingReader):
    """(topic, sequence, data) by a stock reader."""
    with open(path, "rb") as stream:
        messages = list(reader(stream, validate_crcs=True).iter_messages(log_time_order=False))
    return [(channel.topic, message.sequence, bytes(message.data)) for _, channel, message in messages]


def chunk_record(packed, size, crc=0, compression=b"zstd"):
    content = struct.pack("<QQQII", 0, 0, size, crc, len(compression)) + compression
    content += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(content)) + content
