"""Bags written with mcap-ros2-support: exact values, two clocks, robots, log blocks, definitions that lie, damage."""

import contextlib
import io
import re
import sqlite3
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    DEFINITIONS,
    LINE,
    START,
    Message,
    bag,
    log_block,
    odometry,
    pose,
    pose_message,
    pose_messages,
    quaternion,
    random_poses,
    raw_bag,
    stamp,
    status,
    vector,
)
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording
from crazyem.recordings.ros.ros2_messages import message_type, rows_of
from crazyem.recordings.ros.rosbag2_file import read, recognises, recognises_folder


def save(folder: Path, content: bytes, name: str = "flight.mcap") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def opened(folder: Path, content: bytes, mapping: str = "", motor: str | None = None) -> Recording:
    options = ReadOptions(motor=motor)
    if mapping:
        file = folder / "map.toml"
        file.write_text(mapping)
        options = ReadOptions(mapping=str(file), motor=motor)
    return read(save(folder, content), options)


def test_a_bag_is_recognised_and_opened(tmp_path: Path) -> None:
    content = bag(pose_messages(random_poses(20)))
    assert recognises(content[:65536])
    assert not recognises(b"\x89MCAP0\r\n")
    assert not recognises(content.replace(b"\x04\0\0\0ros2", b"\x04\0\0\0none").replace(b"ros2msg", b"protobu"))
    recording = open_recording(save(tmp_path, content))
    assert recording.source == "rosbag2"
    assert recording.metadata["rosbag2"]["robot"] == "cf1"
    assert not recording.findings


def test_poses_come_back_exactly(tmp_path: Path) -> None:
    values = random_poses(50)
    times = START + 123_456_789 + np.arange(50) * 10_000_001
    recording = opened(tmp_path, bag(pose_messages(values, START + 123_456_789, 10_000_001)))
    signals = recording.signals
    np.testing.assert_array_equal(signals["position"].value, values[:, :3])
    np.testing.assert_array_equal(signals["attitude"].value, values[:, 3:])
    assert recording.origin == START // 10**9
    assert (np.round(signals["position"].time * 1e9).astype(int) + int(recording.origin) * 10**9 == times).all()
    np.testing.assert_allclose(signals["position"].host_time, (times + 700_000) / 1e9, rtol=0, atol=3e-7)
    assert signals["position"].clock == "ros"
    assert signals["position"].stream == "cf1/pose"
    assert signals["position"].source[0] == "cf1/pose.pose.position.x"


@pytest.mark.parametrize("mapping", ["", 'twist = "world"', 'twist = "body"'])
@pytest.mark.parametrize("child", ["", "cf1"])
def test_twists_in_either_frame(tmp_path: Path, child: str, mapping: str) -> None:
    values = random_poses(30, seed=3)
    linear = np.random.default_rng(4).normal(size=(30, 3))
    content = bag(odometry("/cf1/odom", START + i * 10**7, v, linear[i], child=child) for i, v in enumerate(values))
    recording = opened(tmp_path, content, mapping)
    body = "body" in mapping if mapping else bool(child)
    expected = Rotation.from_quat(values[:, 3:]).apply(linear) if body else linear
    np.testing.assert_allclose(recording.signals["velocity"].value, expected, atol=1e-14)
    assert "body_rate" not in recording.signals  # all zeros: crazyswarm2 leaves them out
    assert f"in the {'body' if body else 'world'} frame" in recording.findings[0].text


def test_odometry_of_the_python_server_is_not_trusted(tmp_path: Path) -> None:
    for child in ("", "cf1"):
        odom = odometry("/cf1/odom", START, [0, 0, 1, 0, 0, 0, 1], [1, 0, 0], [57, 0, 0], child)
        recording = opened(tmp_path, bag([odom, status("/cf1/status", START, 0, 4.0)]))
        assert any("deg/s" in f.text for f in recording.findings) == bool(child)
        assert recording.signals["body_rate"].value.tolist() == [[57, 0, 0]]  # as published


def test_status_imu_and_setpoints(tmp_path: Path) -> None:
    values = random_poses(5, seed=8)
    messages: list[Message] = []
    for i, v in enumerate(values):
        t = START + i * 10**7
        messages.append(status("/cf2/status", t, 16 if i > 1 else 2, 3.75))
        imu = {"header": stamp(t), "orientation": quaternion([0] * 4), "orientation_covariance": [-1.0] + [0.0] * 8}
        imu |= {"angular_velocity": vector(v[:3]), "linear_acceleration": vector(v[1:4])}
        imu |= {f"{n}_covariance": [0.0] * 9 for n in ("angular_velocity", "linear_acceleration")}
        messages.append(("/cf2/imu", "sensor_msgs/msg/Imu", t, imu))
        twist = {"linear": vector(v[2:5]), "angular": vector(v[3:6])}
        full = {"header": stamp(t), "pose": pose(v), "twist": twist, "acc": vector(v[4:7])}
        messages.append(("/cf2/cmd_full_state", "crazyflie_interfaces/msg/FullState", t, full))
        messages.append(("/rosout", "std_msgs/msg/String", t, {"data": "hello"}))
    signals = opened(tmp_path, bag(messages)).signals
    assert signals["voltage"].value[:, 0].tolist() == [3.75] * 5
    assert signals["flying"].value[:, 0].tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_array_equal(signals["body_rate"].value, values[:, :3])
    np.testing.assert_array_equal(signals["specific_force"].value, values[:, 1:4])
    assert "attitude" not in signals  # the IMU says that it has none
    np.testing.assert_array_equal(signals["setpoint_position"].value, values[:, :3])
    np.testing.assert_array_equal(signals["setpoint_velocity"].value, values[:, 2:5])
    np.testing.assert_array_equal(signals["setpoint_acceleration"].value, values[:, 4:7])
    np.testing.assert_array_equal(signals["setpoint_rate"].value, values[:, 3:6])
    angles = signals["setpoint_euler"].value
    rebuilt = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    np.testing.assert_allclose(rebuilt, Rotation.from_quat(values[:, 3:]).as_matrix(), atol=1e-12)


MOTORS = '[topics."/cf1/motors"]\nvariables = ["motor.m1", "motor.m2", "motor.m3", "motor.m4", "pm.vbat"]\n'


def motors(n: int = 20, first: int = 5000, drift: int = 0) -> tuple[list[Message], np.ndarray]:
    values = np.random.default_rng(6).integers(0, 65536, (n, 5)).astype(float)
    values[:, 4] = 3.5
    messages = []
    for i in range(n):
        ms = (first + 10 * i) % (1 << 24)
        messages.append(log_block("/cf1/motors", START + i * (10**7 + drift), ms, values[i], late=2_000_000))
    return messages, values


def test_log_blocks_speak_the_firmwares_vocabulary_on_its_clock(tmp_path: Path) -> None:
    messages, values = motors()
    recording = opened(tmp_path, bag(messages), MOTORS, motor="duty")
    command = recording.signals["motor_command"]
    np.testing.assert_array_equal(command.value, values[:, :4] / 65535.0)
    np.testing.assert_array_equal(command.time, 5.0 + np.arange(20) / 100)
    assert command.clock == "firmware"
    assert command.stream == "cf1/motors"
    assert recording.signals["voltage"].value[:, 0].tolist() == [3.5] * 20
    assert recording.origin == 0.0
    request = opened(tmp_path, bag(messages), MOTORS, motor="request")
    assert "motor_request" in request.signals
    asked = opened(tmp_path, bag(messages), MOTORS)
    assert asked.signals["motor.m1"].value[:, 0].tolist() == values[:, 0].tolist()
    assert any(f.check == "motor_meaning" for f in asked.findings)


def test_log_blocks_without_names_say_what_is_missing(tmp_path: Path) -> None:
    messages, values = motors()
    recording = opened(tmp_path, bag(messages))
    assert recording.signals["cf1/motors.values[2]"].value[:, 0].tolist() == values[:, 2].tolist()
    finding = next(f for f in recording.findings if f.check == "mapping")
    assert '[topics."/cf1/motors"]' in finding.advice
    assert finding.evidence["variables"] == 5


def test_the_firmware_clock_is_unwrapped(tmp_path: Path) -> None:
    messages, _ = motors(first=(1 << 24) - 100)
    time = opened(tmp_path, bag(messages), MOTORS).signals["voltage"].time
    np.testing.assert_allclose(np.diff(time), 0.01, atol=1e-9)


def test_host_stamps_are_put_beside_the_firmwares(tmp_path: Path) -> None:
    messages, _ = motors()
    messages += pose_messages(random_poses(20), START + 2_000_000)
    recording = opened(tmp_path, bag(messages), MOTORS, motor="duty")
    position = recording.signals["position"]
    np.testing.assert_allclose(position.time, recording.signals["motor_command"].time, atol=1e-9)
    assert (position.clock, recording.signals["motor_command"].clock) == ("ros", "firmware")
    # the stamps of the file come back
    offset = int(recording.metadata["rosbag2"]["host_minus_firmware_ns"])
    stamps = START + np.arange(20) * 10**7 + 2_000_000
    assert (np.round(position.time * 1e9).astype(int) + offset == stamps).all()
    orders = np.concatenate([s.order for s in recording.signals.values()])
    assert np.unique(orders).size == orders.size
    assert {s.signal for s in recording.samples()} >= {"position", "attitude", "motor_command", "voltage"}


def test_a_log_block_and_a_topic_may_measure_the_same(tmp_path: Path) -> None:
    mapping = '[topics."/cf1/state"]\nvariables = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"]\n'
    messages = [log_block("/cf1/state", START + i * 10**7, 10 * i, [i, 0, 1]) for i in range(5)]
    messages += pose_messages([[9, 9, 9, 0, 0, 0, 1]] * 5)
    signals = opened(tmp_path, bag(messages), mapping).signals
    assert signals["position"].value[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert signals["position@cf1/pose"].value[:, 0].tolist() == [9] * 5


def test_motion_capture_and_tf_of_one_robot(tmp_path: Path) -> None:
    values = random_poses(6, seed=12)
    messages: list[Message] = []
    for i, v in enumerate(values):
        t = START + i * 10**7
        named = [{"name": "cf2", "pose": pose(v + 1)}, {"name": "cf1", "pose": pose(v)}]
        messages.append(
            ("/poses", "motion_capture_tracking_interfaces/msg/NamedPoseArray", t, {"header": stamp(t), "poses": named})
        )
        transform = {"translation": vector(v[:3] + 2), "rotation": quaternion(v[3:])}
        entry = {"header": stamp(t), "child_frame_id": "cf1", "transform": transform}
        messages.append(("/tf", "tf2_msgs/msg/TFMessage", t, {"transforms": [entry]}))
        messages.append(status("/cf1/status", t, 0, 4.0))
    signals = opened(tmp_path, bag(messages)).signals
    np.testing.assert_array_equal(signals["position"].value, values[:, :3])  # nothing else gives one
    np.testing.assert_array_equal(signals["position@tf"].value, values[:, :3] + 2)
    messages += pose_messages(values - 1)
    signals = opened(tmp_path, bag(messages)).signals
    np.testing.assert_array_equal(signals["position"].value, values[:, :3] - 1)
    np.testing.assert_array_equal(signals["position@mocap"].value, values[:, :3])
    np.testing.assert_array_equal(signals["position@tf"].value, values[:, :3] + 2)


def test_several_robots_need_a_word(tmp_path: Path) -> None:
    messages = [pose_message(f"/cf{k}/pose", START + i, [k, 0, 0, 0, 0, 0, 1]) for i in range(3) for k in (1, 7)]
    with pytest.raises(UsageError, match=r"cf1, cf7.*robot = "):
        opened(tmp_path, bag(messages))
    recording = opened(tmp_path, bag(messages), 'robot = "cf7"')
    assert recording.signals["position"].value[:, 0].tolist() == [7, 7, 7]
    with pytest.raises(UsageError, match="no robot"):
        opened(tmp_path, bag(messages), 'robot = "cf3"')


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ("robot = 3", "robot"),
        ('name = "x"', "name is not"),
        ('twist = "sideways"', "twist must be"),
        ('[topics."/cf1/motors"]\nvariables = "motor.m1"', "list of names"),
        ('[topics."/cf1/motors"]\nvariables = ["motor.m1", "motor.m1"]', "twice"),
        ('[topics."/cf1/motors"]\nvariables = ["motor.m1"]', "1 names, but the messages hold 5"),
        ("robot = ", "TOML"),
    ],
)
def test_mappings_that_do_not_fit(tmp_path: Path, mapping: str, words: str) -> None:
    with pytest.raises(FileFormatError, match=re.escape(words)):
        opened(tmp_path, bag(motors()[0]), mapping)


def test_a_folder_of_split_files_is_one_recording(tmp_path: Path) -> None:
    values = random_poses(24)
    messages = pose_messages(values)
    folder = tmp_path / "bag"
    folder.mkdir()
    assert not recognises_folder(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 8\n")
    for k in range(12):
        save(folder, bag(messages[2 * k : 2 * k + 2]), f"bag_{k}.mcap")
    assert recognises_folder(folder)
    recording = open_recording(folder)
    np.testing.assert_array_equal(recording.signals["position"].value, values[:, :3])


def in_sqlite(folder: Path, messages: list[Any], *, definitions: bool = True) -> Path:
    """The folder of a bag in SQLite storage, written by rosbags; older ones carry no definitions."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for kind in {message[1] for message in messages}:
        types |= get_types_from_msg(DEFINITIONS[kind], kind)
    store.register({kind: fields for kind, fields in types.items() if kind not in store.fielddefs})
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        channels: dict[str, Any] = {}
        for topic, kind, log, message in messages:
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=store)
            (content,) = payloads(bag([(topic, kind, log, message)]))
            writer.write(channels[topic], log, content)
    if not definitions:
        with contextlib.closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
            database.execute("DROP TABLE message_definitions")
            database.execute("DROP TABLE schema")
            database.commit()
    return folder


def payloads(content: bytes) -> list[bytes]:
    return [message.data for _, _, message in make_reader(io.BytesIO(content)).iter_messages()]


def some_messages() -> list[Any]:
    messages = pose_messages(random_poses(12))
    messages += [log_block("/cf1/log", START + i * 10**7, 100 + 10 * i, [i, 2.5]) for i in range(12)]
    messages += [status("/cf1/status", START + i * 10**7, 16, 4.0) for i in range(12)]
    return sorted(messages, key=itemgetter(2))


@pytest.mark.parametrize("definitions", [True, False])
@pytest.mark.parametrize("whole", [True, False])
def test_bags_in_sqlite_are_read_as_those_in_mcap(tmp_path: Path, definitions: bool, whole: bool) -> None:
    folder = in_sqlite(tmp_path / "bag", some_messages(), definitions=definitions)
    found = open_recording(folder if whole else next(folder.glob("*.db3")))
    expected = opened(tmp_path, bag(some_messages()))
    assert list(found.signals) == list(expected.signals)
    for name, array in expected.signals.items():
        np.testing.assert_array_equal(found.signals[name].value, array.value)
        np.testing.assert_array_equal(found.signals[name].time, array.time)
        np.testing.assert_array_equal(found.signals[name].order, array.order)
    assert found.notices == expected.notices


def test_bags_in_sqlite_that_are_none_or_of_unknown_types_say_so(tmp_path: Path) -> None:
    head = b"SQLite format 3\0" + bytes(100) + b"CREATE TABLE topics CREATE TABLE messages"
    assert recognises(head)
    with pytest.raises(FileFormatError, match="cannot be read"):
        read(save(tmp_path, head, "bag.db3"), ReadOptions())
    with pytest.raises(FileFormatError, match="its name ends in"):
        read(save(tmp_path, head, "bag.sqlite"), ReadOptions())
    folder = in_sqlite(tmp_path / "bag", some_messages(), definitions=False)
    with contextlib.closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
        database.execute("UPDATE topics SET type = 'x/msg/Y' WHERE name = '/cf1/log'")
        database.commit()
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("crazyflie_interfaces/msg/LogDataGeneric", "x/msg/Y"))
    assert any("no definition of x/msg/Y" in notice for notice in open_recording(folder).notices)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    (tmp_path / "bag.db3").unlink()
    with pytest.raises(FileFormatError, match="neither an MCAP nor an SQLite"):
        read(tmp_path, ReadOptions())


def test_a_damaged_bag_in_sqlite_never_ends_in_anything_but_our_error(tmp_path: Path) -> None:
    file = next(in_sqlite(tmp_path / "bag", some_messages()).glob("*.db3"))
    content = file.read_bytes()
    rng = np.random.default_rng(3)
    for k in range(60):
        damaged = bytearray(content[: rng.integers(200, len(content))] if k % 3 == 0 else content)
        place = int(rng.integers(16, len(damaged)))
        damaged[place : place + 40] = rng.bytes(min(40, len(damaged) - place))
        path = save(tmp_path, bytes(damaged), f"d{k}.db3")
        with contextlib.suppress(CrazyemError):
            assert len(read(path, ReadOptions())) > 0


def test_simulated_time_is_not_mixed_with_real_time(tmp_path: Path) -> None:
    messages = []
    for i in range(5):
        topic, kind, _, message = pose_message("/cf1/pose", i * 10**7, [i, 0, 0, 0, 0, 0, 1])
        messages.append((topic, kind, START + i * 10**7, message))
        messages.append(status("/cf1/status", START + i * 10**7, 0, 4.0))
    signals = opened(tmp_path, bag(messages)).signals
    np.testing.assert_allclose(signals["position"].time, signals["voltage"].time)


def test_a_message_without_a_stamp_among_others_is_placed_by_its_arrival(tmp_path: Path) -> None:
    messages = pose_messages([i, 0, 0, 0, 0, 0, 1] for i in range(20))
    messages[7][3]["header"] = stamp(0)
    recording = opened(tmp_path, bag(messages))
    time = recording.signals["position"].time
    np.testing.assert_allclose(time - time[0], 0.01 * np.arange(20), atol=1e-6)
    (finding,) = [f for f in recording.findings if f.check == "stamps"]
    assert "1 of 20 records of cf1/pose" in finding.text


def test_damage_is_named_by_its_place(tmp_path: Path) -> None:
    values = random_poses(60)
    content = bytearray(bag(pose_messages(values, step=1), chunk=1000))
    content[len(content) // 3] ^= 0xFF
    del content[-8:]  # and not closed
    recording = opened(tmp_path, bytes(content))
    kept = {tuple(v) for v in recording.signals["position"].value}
    assert kept < {tuple(v) for v in values[:, :3]}
    assert len(kept) > 30
    finding, unclosed = (f for f in recording.findings if f.check == "integrity")
    assert "was not closed" in unclosed.text
    assert finding.evidence["offset"] <= len(content) // 3 <= finding.evidence["offset"] + finding.evidence["bytes"]


LIES = {
    "itself": "A a",
    "each other": f"B b\n{LINE}\nMSG: x/B\nA a",
    "nothing for ever": f"B[] b\n{LINE}\nMSG: x/B\nuint8[1] c",
    "hardly anything": f"B[] b\n{LINE}\nMSG: x/B\nuint8 d\n" + "\n".join(f"uint8[1] c{i}" for i in range(50)),
    "long": "B[1000000000] b\n" + f"{LINE}\nMSG: x/B\nuint8 c",
    "exponential": "B[9] b\n" + "".join(f"{LINE}\nMSG: x/{chr(66 + i)}\n{chr(67 + i)}[9] z\n" for i in range(12)),
    "unknown": "std_msgs/Strange b",
    "name": "uint8 " + "A" * 40 + "-=1\nuint8 b",
    "no field": "uint8",
    "path": "../../x b",
}


@pytest.mark.parametrize("name", LIES)
def test_definitions_that_lie_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="definition"):
        message_type("x/msg/A", LIES[name])
    with pytest.raises(FileFormatError, match="/cf1/a"):
        opened(tmp_path, raw_bag("x/msg/A", LIES[name], [b"\0\1\0\0" + b"\xff" * 1000]))


@given(kind=st.sampled_from(sorted(DEFINITIONS)), data=st.binary(max_size=300))
def test_any_bytes_as_any_message(tmp_path_factory: pytest.TempPathFactory, kind: str, data: bytes) -> None:
    content = raw_bag(kind, DEFINITIONS[kind], (data, b"\0\1\0\0" + data))
    path = save(tmp_path_factory.mktemp("any"), content)
    recording, said = None, ""
    try:
        recording = read(path, ReadOptions())
    except CrazyemError as error:
        said = str(error)
    assert recording is not None or str(path) in said


def test_a_claimed_sequence_length_costs_nothing() -> None:
    name = "crazyflie_interfaces/msg/LogDataGeneric"
    kind = message_type(name, DEFINITIONS[name])
    head = b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0\0\0\0" + bytes(4)
    rows = rows_of(kind, [(START, head + b"\xff\xff\xff\xff" + bytes(64))])
    assert (rows.broken, rows.log.size) == (1, 0)


def test_a_chunk_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    content = raw_bag("std_msgs/msg/String", "string data", [bytes(20 << 20)] * 5, chunk=1 << 27)
    with pytest.raises(FileFormatError, match="claims"):
        opened(tmp_path, content)
