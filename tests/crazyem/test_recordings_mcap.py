"""Our MCAP files: bit for bit what was delivered, in order, readable after a kill, harmless when broken."""

import math
import time

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crazyem.control.trajectories import Reference
from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.estimation.result import Estimate, ParameterEstimate
from crazyem.links.base import LinkStatistics, ParameterWrite
from crazyem.recordings import open_recording
from crazyem.recordings.mcap.schemas import BlockCodec
from crazyem.recordings.mcap.writer import RecordingWriter
from crazyem.signals.sample import Block, Packet, Variable
from crazyem.signals.vocabulary import decoders


def block(identifier, *names, ctype="float"):
    return Block(identifier, tuple(Variable(n, ctype) for n in names), 10)


STATE = block(0, *(f"stateEstimate.{n}" for n in ("x", "y", "z")), *(f"stateEstimate.q{n}" for n in "xyzw"))
IMU = block(1, "gyro.x", "gyro.y", "gyro.z", "acc.x", "acc.y", "acc.z")
WIDE = block(2, "pm.vbat", *(f"g.v{i}" for i in range(25)), ctype="uint8_t")  # field numbers beyond one-byte tags
BLOCKS = (STATE, IMU, WIDE)


def flight(count):
    """Packets whose firmware times are not in order across blocks, as on a real link."""
    packets = []
    for k in range(count):
        for b, lag in ((1, 3), (0, 0), (2, 11)):
            values = tuple(math.sin(k * 7.1 + i + b) * 10.0 ** (i - 3) for i in range(len(BLOCKS[b].variables)))
            packets.append(Packet(b, 1000 + 10 * k - lag, 1.7e9 + 0.01 * k + lag * 1e-4, values))
    return packets


def write(path, packets, **metadata):
    with RecordingWriter(path, metadata) as writer:
        writer.blocks(BLOCKS)
        for packet in packets:
            writer.packet(packet)
    assert writer.failure == ""


def live(packets):
    table = decoders(BLOCKS)
    return [sample for packet in packets for sample in table[packet.block].decode(packet)]


def test_samples_come_back_bit_for_bit_and_in_order(tmp_path):
    packets = flight(50)
    path = tmp_path / "flight.mcap"
    write(path, packets, run={"seed": "1"}, vehicle={"toml": 'name = "cf2"\n'})
    recording = open_recording(path)
    assert list(recording.samples()) == live(packets)
    assert recording.metadata["run"] == {"seed": "1"}
    assert recording.metadata["vehicle"] == {"toml": 'name = "cf2"\n'}
    assert recording.metadata["crazyem"]["format"] == "1"
    assert recording.notices == ()
    assert recording.source == "mcap"
    assert recording.duration == pytest.approx(0.49 + 0.011)
    recording.check(["position", "body_rate", "voltage"])


numbers = st.floats(width=64, allow_nan=True, allow_infinity=True)


@given(st.integers(-(2**62), 2**62), st.floats(0, 2e9), st.lists(numbers, min_size=26, max_size=26).map(tuple))
def test_any_protobuf_decoder_reads_every_number_of_a_block(stamp, host_time, values):
    codec = BlockCodec(WIDE)
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(codec.schema_data()).file:
        pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(codec.schema_name))
    decoded = message.FromString(codec.encode(Packet(2, stamp, host_time, values)))
    found = [getattr(decoded, name) for name in ("pm_vbat", *(f"g_v{i}" for i in range(25)))]
    # repr: NaN equals itself, and -0.0 differs from 0.0
    assert repr([decoded.firmware_time_ms, decoded.host_time, *found]) == repr([stamp, host_time, *values])


def record_everything(path, *, append=False):
    """A flight with every kind of message."""
    parameters = {
        "mass": ParameterEstimate(0.034, 1e-4, (0.0338, 0.0342), "kg", True),
        "Ixx": ParameterEstimate(2e-5, 1.0, (-1.0, 1.0), "kg m^2", False, "no excitation"),
    }
    with RecordingWriter(path, {"run": {"seed": "1"}}, append=append) as writer:
        writer.blocks(BLOCKS)
        for packet in flight(200):
            writer.packet(packet)
        writer.setpoint(1.25, Reference((0.1, 0.2, 0.3), (1.0, 2.0, 3.0), (0.0, -0.0, 5e-324), yaw=0.4, yaw_rate=0.5))
        writer.parameter_write(ParameterWrite("ctrlLee.mass", 0.034, None, False, 1.7e9 + 1))
        writer.estimate(Estimate(2.5, parameters, samples=800, updates=7, converged=True))
        writer.residual(2.5, np.arange(12) / 8, np.full(12, 0.5))
        writer.link(LinkStatistics(100, 2, 1))
        time.sleep(0.002)
        writer.link(LinkStatistics(190, 12, 1), latency=0.003)
        writer.event("landed", "WARNING")
    assert writer.failure == ""


def test_events_come_back(tmp_path):
    path = tmp_path / "flight.mcap"
    record_everything(path)
    events = {event.kind: event.data for event in open_recording(path).events}
    assert events["setpoint"]["position_z"] == 0.3
    assert events["setpoint"]["acceleration_z"] == 5e-324
    assert events["setpoint"]["time"] == 1.25
    assert events["parameter_write"]["name"] == "ctrlLee.mass"
    assert math.isnan(events["parameter_write"]["echoed"])
    assert events["parameter_write"]["verified"] is False
    assert [p["name"] for p in events["estimate"]["parameters"]] == ["mass", "Ixx"]
    assert events["estimate"]["parameters"][1]["reason"] == "no excitation"
    assert events["log"]["message"] == "landed"


STARTS = (b"", b"\x89MCAP0\r\n", b"ULog\x01\x12\x35", b"\x1f\x8b", b"\x1f\x8b\x08\x00", b"t,px,")
STARTS += (b"host_t,block,fw_ms,name,value\n",)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(STARTS), st.binary(max_size=300))
def test_random_bytes_are_no_recording(tmp_path, start, rest):
    path = tmp_path / "noise"
    path.write_bytes(start + rest)
    with pytest.raises(CrazyemError) as caught:
        open_recording(path)
    assert "\n" not in str(caught.value)


def test_mcap_of_somebody_else(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("x.Y", "jsonschema", b"{}")
        channel = writer.register_channel("/x", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(FileFormatError, match="not a recording in a format known"):
        open_recording(path)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        open_recording(tmp_path / "nothing.mcap")
    with pytest.raises(UsageError, match="is a directory"):
        open_recording(tmp_path)
    with pytest.raises(UsageError, match="cannot be written"):
        RecordingWriter(tmp_path / "no" / "folder.mcap")


def test_a_full_disk_stops_the_recording_not_the_flight(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="No space left"):
        RecordingWriter("/dev/full")

    def full():
        raise OSError(28, "No space left on device")

    writer = RecordingWriter(tmp_path / "flight.mcap")
    monkeypatch.setattr(writer._output, "finish", full)
    writer.blocks(BLOCKS)
    for packet in flight(20):
        writer.packet(packet)
    writer.close()
    assert "recording stopped" in writer.failure
