"""Our MCAP in the hands of others: stock readers without crazyem decode every channel, in order, after any end."""

import json
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from test_mcap_signals import flight
from test_recordings_mcap import BLOCKS, record_everything
from test_recordings_mcap import flight as packets

from crazyem.errors import FileFormatError
from crazyem.recordings import open_recording
from crazyem.recordings.mcap.recover import recover
from crazyem.recordings.mcap.signals import write_recording
from crazyem.recordings.mcap.writer import FLUSH_PERIOD

ROOT = Path(__file__).resolve().parents[2]

# A reader that cannot import crazyem: the mcap library and its protobuf decoder only.
READER = """
import json, math, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("crazyem", "firmware_sim"):
            raise ImportError("blocked: " + name)

sys.meta_path.insert(0, Blocked())
from google.protobuf import descriptor_pb2, descriptor_pool
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

topics, times, sequences = {}, [], []
with open(sys.argv[1], "rb") as stream:
    reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
    for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
        assert schema.encoding == channel.message_encoding == "protobuf"
        pool = descriptor_pool.DescriptorPool()  # the schema alone must do
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        pool.FindMessageTypeByName(schema.name)
        times.append(message.log_time)
        sequences.append(message.sequence)
        entry = topics.setdefault(channel.topic, {"schema": schema.name, "messages": []})
        fields = MessageToDict(decoded, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
        entry["messages"].append(fields)
    statistics = reader.get_summary().statistics
print(json.dumps({"topics": topics, "times": times, "sequences": sequences, "count": statistics.message_count}))
assert not [name for name in sys.modules if name.startswith("crazyem")]
"""


def read_elsewhere(path, tmp_path):
    """What the stock reader makes of a file, in a process that cannot import crazyem."""
    program = tmp_path / "reader.py"
    program.write_text(READER)
    done = subprocess.run([sys.executable, "-I", str(program), str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


LIVE = {
    "/log/0": "crazyem.log.Block0", "/log/1": "crazyem.log.Block1", "/log/2": "crazyem.log.Block2",
    "/pose": "foxglove.PoseInFrame", "/tf": "foxglove.FrameTransform", "/setpoint": "crazyem.Setpoint",
    "/parameter_write": "crazyem.ParameterWrite",
    "/estimate": "crazyem.Estimate", "/residual": "crazyem.Residual", "/link": "crazyem.Link",
    "/events": "foxglove.Log",
}  # fmt: skip


def test_a_flight_is_decoded_without_crazyem(tmp_path):
    path = tmp_path / "flight.mcap"
    record_everything(path)
    found = read_elsewhere(path, tmp_path)
    topics = found["topics"]
    assert {topic: entry["schema"] for topic, entry in topics.items()} == LIVE
    assert found["times"] == sorted(found["times"])
    assert found["sequences"] == list(range(1, found["count"] + 1))
    sent = [p for p in packets(200) if p.block == 1]
    got = topics["/log/1"]["messages"]
    names = [v.name.replace(".", "_") for v in BLOCKS[1].variables]
    assert [tuple(m[n] for n in names) for m in got] == [p.values for p in sent]
    assert [int(m["firmware_time_ms"]) for m in got] == [p.firmware_time_ms for p in sent]
    assert topics["/residual"]["messages"][0]["velocity_z"] == 5 / 8
    assert topics["/residual"]["messages"][0]["body_rate_z_sd"] == 0.5
    health = topics["/link"]["messages"][1]
    assert (health["received"], health["lost"], health["latency"]) == ("190", "12", 0.003)
    assert health["loss"] == pytest.approx(0.1)
    assert health["rate"] > 0
    assert topics["/events"]["messages"][0]["level"] == "WARNING"
    assert topics["/tf"]["messages"][0]["parent_frame_id"] == "world"


def test_an_imported_recording_is_decoded_without_crazyem(tmp_path):
    path = tmp_path / "f.mcap"
    recording = flight()
    write_recording(recording, path)
    found = read_elsewhere(path, tmp_path)
    topics = found["topics"]
    assert found["times"] == sorted(found["times"])
    assert found["sequences"] == list(range(1, found["count"] + 1))
    state = topics["/signals/state"]["messages"]
    for name, axes in (("position", "xyz"), ("attitude", "xyzw")):
        values = [[m[f"{name}_{a}"] for a in axes] for m in state]
        assert values == recording.signals[name].value.tolist()
    assert [m["time"] for m in state] == recording.signals["position"].time.tolist()
    voltage = recording.signals["voltage"].value[:, 0].tolist()
    assert [m["voltage"] for m in topics["/signals/power"]["messages"]] == voltage
    pose = topics["/pose"]["messages"]
    assert 70 <= len(pose) <= 76  # 25 a second for three seconds
    assert pose[0]["pose"]["position"] == dict(zip("xyz", recording.signals["position"].value[0].tolist(), strict=True))


def packets_in(path):
    try:
        return open_recording(path).signals["voltage"].time.size
    except (FileFormatError, KeyError):  # nothing was flushed yet
        return 0


def test_kill_9_loses_only_what_was_not_flushed(tmp_path):
    """A process records, waits for the writer's own flush, records more and is killed, however slow the machine is."""
    assert FLUSH_PERIOD <= 1.0
    path = tmp_path / "killed.mcap"
    program = textwrap.dedent(f"""
        import sys, time
        sys.path.insert(0, {str(ROOT)!r})
        from crazyem.recordings.mcap.writer import RecordingWriter
        from crazyem.signals.sample import Block, Packet, Variable
        writer = RecordingWriter({str(path)!r})
        writer.blocks((Block(0, (Variable("pm.vbat", "float"),), 10),))
        for k in range(300):
            writer.packet(Packet(0, 10 * k, 1.7e9 + 0.01 * k, (4.0,)))
            if k == 199:
                print("written", flush=True)
                sys.stdin.readline()
        print("more", flush=True)
        time.sleep(3600.0)
    """)
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "written\n"
    patience = time.monotonic() + 60.0
    while packets_in(path) < 200:
        assert time.monotonic() < patience, "what was written is not flushed"
        time.sleep(0.05)
    process.stdin.write("\n")
    process.stdin.flush()
    assert process.stdout.readline() == "more\n"
    process.kill()
    process.communicate()
    recording = open_recording(path)
    assert 200 <= recording.signals["voltage"].time.size <= 300
    assert recording.notices
    mended = tmp_path / "mended.mcap"
    report = recover(path, mended)
    assert report.lost_messages == 0
    assert packets_in(mended) == packets_in(path)
