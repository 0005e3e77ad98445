"""ULog files made byte by byte here: exact values, frames against scipy, damage of every kind."""

import gzip
import math
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import assert_cut_anywhere
from scipy.spatial.transform import Rotation

from crazyem.cli import main
from crazyem.errors import FileFormatError
from crazyem.recordings.autopilots.ulog_file import read, recognises
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording
from crazyem.recordings.topics import MOST_RAW_SIGNALS

FLIP = np.diag([1.0, -1.0, -1.0])


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def text_format(text: str) -> bytes:
    return message("F", text.encode())


def announce(number: int, name: str, instance: int = 0) -> bytes:
    return message("A", struct.pack("<BH", instance, number) + name.encode())


def row(number: int, layout: str, *values: float) -> bytes:
    return message("D", struct.pack("<H" + layout, number, *values))


def info(key: str, value: bytes, kind: str = "I") -> bytes:
    return message(kind, bytes([len(key)]) + key.encode() + value)


def header(start: int = 1000) -> bytes:
    return b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start) + message("B", bytes(40))


FORMATS = {
    "vehicle_local_position": "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float vx;float vy;"
    "float vz;float ax;float ay;float az;bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;"
    "uint8_t[2] _padding0;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "actuator_motors": "uint64_t timestamp;float[12] control;",
    "esc_report": "uint64_t timestamp;int32_t esc_rpm;float esc_voltage;",
    "esc_status": "uint64_t timestamp;uint8_t esc_count;esc_report[8] esc;",
    "battery_status": "uint64_t timestamp;float voltage_v;float current_a;",
    "vehicle_land_detected": "uint64_t timestamp;bool landed;",
    "vehicle_local_position_setpoint": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;"
    "float[3] acceleration;",
    "vehicle_attitude_setpoint": "uint64_t timestamp;float[4] q_d;",
    "vehicle_rates_setpoint": "uint64_t timestamp;float roll;float pitch;float yaw;",
    "vehicle_mocap_odometry": "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;",
}
LAYOUTS = {
    "vehicle_local_position": "QQ9f4?", "vehicle_attitude": "Q4f", "vehicle_angular_velocity": "Q3f",
    "sensor_combined": "Q6f", "actuator_motors": "Q12f", "esc_status": "QB" + "Qif" * 8, "battery_status": "Q2f",
    "vehicle_land_detected": "Q?", "vehicle_local_position_setpoint": "Q9f", "vehicle_attitude_setpoint": "Q4f",
    "vehicle_rates_setpoint": "Q3f", "vehicle_mocap_odometry": "QB7f",
}  # fmt: skip
NUMBERS = {name: i for i, name in enumerate(LAYOUTS)}


def definitions(*names: str) -> bytes:
    wanted = names or tuple(FORMATS)
    parts = [text_format(f"{name}:{FORMATS[name]}") for name in FORMATS if name in wanted or name == "esc_report"]
    parts.append(info("char[3] sys_name", b"PX4"))
    parts.append(info("int32_t MC_PITCHRATE_MAX", struct.pack("<i", 220), "P"))
    parts += [announce(NUMBERS[name], name) for name in LAYOUTS if name in wanted]
    return b"".join(parts)


def data(name: str, *values: float) -> bytes:
    return row(NUMBERS[name], LAYOUTS[name], *values)


def save(folder: Path, content: bytes, name: str = "log.ulg") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def opened(folder: Path, content: bytes) -> Recording:
    return read(save(folder, content), ReadOptions())


def single(values: np.ndarray) -> np.ndarray:
    """What a 4-byte float keeps of it."""
    return np.asarray(values, np.float32).astype(float)


def flight(rows: int = 40, seed: int = 1) -> tuple[bytes, dict[str, np.ndarray]]:
    """A log with every topic of the table, and the values that went in (source frames)."""
    rng = np.random.default_rng(seed)
    t = 2_000_000 + np.arange(rows) * 4000
    truth = {
        "t": t, "local": rng.normal(size=(rows, 9)),
        "q": Rotation.random(rows, random_state=seed).as_quat()[:, [3, 0, 1, 2]],
        "rate": rng.normal(size=(rows, 3)), "imu": rng.normal(size=(rows, 6)), "motors": rng.uniform(size=(rows, 12)),
        "rpm": rng.integers(0, 30000, (rows, 8)),
        "voltage": rng.uniform(3.0, 4.2, (rows, 2)),
        "target": rng.normal(size=(rows, 9)),
        "q_d": Rotation.random(rows, random_state=seed + 1).as_quat()[:, [3, 0, 1, 2]],
        "rates": rng.normal(size=(rows, 3)), "mocap": rng.normal(size=(rows, 7)),
    }  # fmt: skip
    parts = [header(), definitions()]
    for i in range(rows):
        at = int(t[i])
        esc = [x for rpm in truth["rpm"][i] for x in (at, int(rpm), 11.5)]
        parts += [
            data("vehicle_local_position", at + 900, at, *truth["local"][i], True, True, True, True),
            data("vehicle_attitude", at, *truth["q"][i]),
            data("vehicle_angular_velocity", at, *truth["rate"][i]),
            data("sensor_combined", at, *truth["imu"][i]),
            data("actuator_motors", at, *truth["motors"][i]),
            data("esc_status", at, 4, *esc),
            data("battery_status", at, *truth["voltage"][i]),
            data("vehicle_land_detected", at, i < 3),
            data("vehicle_local_position_setpoint", at, *truth["target"][i]),
            data("vehicle_attitude_setpoint", at, *truth["q_d"][i]),
            data("vehicle_rates_setpoint", at, *truth["rates"][i]),
            data("vehicle_mocap_odometry", at, 1, *truth["mocap"][i]),
        ]
    return b"".join(parts), truth


def test_a_log_is_recognised_and_opened(tmp_path: Path) -> None:
    content, truth = flight()
    assert recognises(content[:64])
    assert not recognises(b"ULogger")
    recording = open_recording(save(tmp_path, content))
    assert recording.source == "ulog"
    assert recording.duration == pytest.approx(np.ptp(truth["t"]) * 1e-6, abs=1e-9)
    packed = save(tmp_path, gzip.compress(content), "log.ulg.gz")
    assert set(open_recording(packed).signals) == set(recording.signals)


def test_vectors_and_attitudes_are_turned_to_flu_and_north_west_up(tmp_path: Path) -> None:
    content, truth = flight()
    signals = opened(tmp_path, content).signals
    vectors = {
        "position": truth["local"][:, :3], "velocity": truth["local"][:, 3:6], "acceleration": truth["local"][:, 6:],
        "body_rate": truth["rate"], "body_rate@sensor_combined": truth["imu"][:, :3],
        "specific_force": truth["imu"][:, 3:], "setpoint_position": truth["target"][:, :3],
        "setpoint_rate": truth["rates"], "position@mocap": truth["mocap"][:, :3],
    }  # fmt: skip
    for name, expected in vectors.items():
        np.testing.assert_array_equal(signals[name].value, single(expected) @ FLIP)
    attitude = Rotation.from_quat(signals["attitude"].value)
    setpoint = Rotation.from_euler("ZYX", signals["setpoint_euler"].value[:, ::-1])
    for ours, key, tolerance in ((attitude, "q", 1e-12), (setpoint, "q_d", 1e-6)):
        theirs = Rotation.from_quat(single(truth[key])[:, [1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(ours.as_matrix(), FLIP @ theirs @ FLIP, atol=tolerance)


def test_scalars_units_and_sources(tmp_path: Path) -> None:
    content, truth = flight()
    recording = opened(tmp_path, content)
    signals = recording.signals
    np.testing.assert_allclose(signals["rotor_speed"].value, truth["rpm"][:, :4] * math.pi / 30, rtol=1e-15)
    np.testing.assert_array_equal(signals["voltage"].value[:, 0], single(truth["voltage"])[:, 0])
    np.testing.assert_array_equal(signals["motor_request"].value, single(truth["motors"])[:, :4])
    np.testing.assert_array_equal(signals["flying"].value[:, 0], np.arange(40) >= 3)
    assert "motor_command" not in signals
    assert signals["voltage"].source == ("battery_status.voltage_v",)
    assert signals["attitude"].source == tuple(f"vehicle_attitude.q[{i}]" for i in range(4))
    assert {s.clock for s in signals.values()} == {"autopilot"}
    np.testing.assert_array_equal(signals["battery_status.current_a"].value[:, 0], single(truth["voltage"])[:, 1])
    np.testing.assert_array_equal(signals["actuator_motors.control[7]"].value[:, 0], single(truth["motors"])[:, 7])
    assert signals["battery_status.current_a"].unit == ""
    assert recording.metadata["ulog"]["sys_name"] == "PX4"
    assert recording.metadata["parameters"]["MC_PITCHRATE_MAX"] == "220"
    assert [f.check for f in recording.findings] == ["motor_meaning"]


def test_the_time_is_that_of_the_sample_and_the_publication_is_kept(tmp_path: Path) -> None:
    content, truth = flight()
    signals = opened(tmp_path, content).signals
    assert (np.round(signals["position"].time * 1e6) == truth["t"]).all()
    published = signals["vehicle_local_position.timestamp"]
    assert (published.value[:, 0] == truth["t"] + 900).all()
    assert published.unit == "us"
    # a sample stamp that cannot be one is not believed, and stays visible
    content = header() + definitions("vehicle_local_position")
    content += data("vehicle_local_position", 5000, 0, *range(9), 1, 1, 1, 1)
    content += data("vehicle_local_position", 9000, 8000, *range(9), 1, 1, 1, 1)
    signals = opened(tmp_path, content).signals
    np.testing.assert_allclose(signals["position"].time, [0.005, 0.009])
    assert signals["vehicle_local_position.timestamp_sample"].value[:, 0].tolist() == [0, 8000]


def test_what_the_estimator_calls_invalid_is_missing_and_marked(tmp_path: Path) -> None:
    content = header() + definitions("vehicle_local_position", "vehicle_local_position_setpoint")
    content += data("vehicle_local_position", 5000, 5000, *range(9), 0, 1, 1, 1)
    content += data("vehicle_local_position", 6000, 6000, *range(9), 1, 1, 1, 0)
    content += data("vehicle_local_position", 7000, 7000, math.nan, *range(8), 1, 1, 1, 1)
    content += data("vehicle_local_position_setpoint", 7000, *([math.nan] * 3), *range(6))
    signals = opened(tmp_path, content).signals
    assert np.isnan(signals["position"].value[0]).all()
    assert signals["position"].marked.tolist() == [True, False, False]  # the NaN of the file is the file's
    assert signals["velocity"].marked.tolist() == [False, True, False]
    assert signals["setpoint_position"].marked.tolist() == [True]


def test_instances_are_topics_of_their_own(tmp_path: Path) -> None:
    content = header() + text_format(f"battery_status:{FORMATS['battery_status']}")
    content += announce(1, "battery_status") + announce(2, "battery_status", 1)
    content += row(1, "Q2f", 10, 4.0, 1.0) + row(2, "Q2f", 11, 3.5, 2.0)
    signals = opened(tmp_path, content).signals
    assert signals["voltage"].value.tolist() == [[4.0]]
    assert signals["battery_status_1.voltage_v"].value.tolist() == [[3.5]]


def test_padding_at_the_end_of_a_message_does_no_harm(tmp_path: Path) -> None:
    content = header() + definitions("vehicle_local_position")
    content += row(0, "QQ9f4?2x", 5000, 5000, *range(9), 1, 1, 1, 1)
    content += row(0, "QQ9f4?", 6000, 6000, *range(9), 1, 1, 1, 1)
    recording = opened(tmp_path, content)
    assert recording.signals["position"].value.tolist() == [[0, -1, -2]] * 2
    assert not recording.findings


def test_dropouts_are_found_with_their_place(tmp_path: Path) -> None:
    content = header() + definitions("battery_status")
    content += data("battery_status", 1_000_000, 4, 1) + message("O", struct.pack("<H", 250))
    content += data("battery_status", 1_300_000, 4, 1)
    finding = next(f for f in opened(tmp_path, content).findings if f.check == "gaps")
    np.testing.assert_allclose(finding.intervals, [(1.0, 1.25)])
    assert finding.evidence["total_s"] == 0.25


def test_messages_and_changed_parameters_are_kept(tmp_path: Path) -> None:
    content = header() + definitions("battery_status") + data("battery_status", 1_000_000, 4, 1)
    content += message("L", b"6" + struct.pack("<Q", 1_500_000) + b"Takeoff detected")
    content += info("float MPC_Z_P", struct.pack("<f", 1.5), "P")
    metadata = opened(tmp_path, content).metadata
    assert metadata["messages"] == {"0 1.500000 s INFO": "Takeoff detected"}
    assert metadata["changed_parameters"] == {"0 1.000000 s MPC_Z_P": "1.5"}


def test_appended_data_is_read(tmp_path: Path) -> None:
    """After a crash the logger appends to the log: an offset in the header says where; a cut message lies before."""
    start = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    body = definitions("battery_status") + data("battery_status", 1_000_000, 4, 1)
    cut = data("battery_status", 2_000_000, 3.5, 1)[:-5]
    offset = len(start) + 43 + len(body) + len(cut)
    flags = message("B", bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", offset, 0, 0))
    content = start + flags + body + cut + data("battery_status", 3_000_000, 3.0, 1)
    recording = opened(tmp_path, content)
    assert recording.signals["voltage"].value[:, 0].tolist() == [4.0, 3.0]
    assert recording.findings[0].evidence["offset"] == offset - len(cut)


def test_truncation_at_any_byte(tmp_path: Path) -> None:
    content = header() + definitions("vehicle_attitude", "battery_status", "esc_status")
    first = len(content + data("vehicle_attitude", 1000, 1, 0, 1, 0))
    for i in range(1, 5):
        content += data("vehicle_attitude", 1000 * i, 1, 0, i, 0) + data("battery_status", 1000 * i + 5, 4, i)
        content += data("esc_status", 1000 * i + 9, 4, *[i] * 24)
    starts = [16]
    while starts[-1] < len(content):
        starts.append(starts[-1] + 3 + int.from_bytes(content[starts[-1] : starts[-1] + 2], "little"))
    assert_cut_anywhere(lambda part: opened(tmp_path, part), content, starts, first=first)


def test_garbage_in_the_middle_costs_only_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    messages = [data("battery_status", 1000 * i, 4, i) for i in range(100)]
    first = header() + definitions("battery_status") + b"".join(messages[:50])
    for junk in (b"\xff" * 5000, bytes(5000), rng.bytes(20000), b"D" * 3001):
        recording = opened(tmp_path, first + junk + b"".join(messages[50:]))
        amounts = recording.signals["battery_status.current_a"].value[:, 0]
        assert set(amounts) <= set(range(100))
        assert amounts.size >= 99  # what follows the junk is found again; at most one message is swallowed by it
        finding = next(f for f in recording.findings if f.check == "integrity")
        assert abs(finding.evidence["offset"] - len(first)) <= 3


BOMBS = {
    "array": ["a:uint64_t timestamp;uint8_t[999999] x;"],
    "long array": ["a:uint64_t timestamp;uint8_t[1000000000] x;"],
    "itself": ["a:uint64_t timestamp;a x;"],
    "each other": ["a:uint64_t timestamp;b x;", "b:a y;"],
    "exponential": ["a:uint64_t timestamp;b[9] x;"] + [f"{chr(97 + i)}:{chr(98 + i)}[9] x;" for i in range(1, 20)],
    "no timestamp": ["a:float x;"],
    "unknown type": ["a:uint64_t timestamp;quaternion x;"],
}


@pytest.mark.parametrize("name", BOMBS)
def test_formats_that_lie_are_refused(tmp_path: Path, name: str) -> None:
    content = header() + b"".join(text_format(f) for f in BOMBS[name])
    content += text_format(f"battery_status:{FORMATS['battery_status']}")
    content += announce(9, "a") + announce(6, "battery_status") + row(6, "Q2f", 10, 4.0, 1.0)
    content += row(9, "Q", 11)
    recording = opened(tmp_path, content)
    assert recording.signals["voltage"].value.tolist() == [[4.0]]
    assert any(f.check == "integrity" for f in recording.findings)


def test_a_thousand_large_topics_are_bounded(tmp_path: Path) -> None:
    content = header() + text_format("a:uint64_t timestamp;uint8_t[60000] x;")
    content += b"".join(announce(i, "a", i % 250) for i in range(1000))
    content += b"".join(row(i, "Q60000s", 10, b"") for i in range(5))
    recording = opened(tmp_path, content)
    assert len(recording.signals) <= MOST_RAW_SIGNALS
    assert any("left out" in f.text for f in recording.findings)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"ULog\x01\x12\x35", "header"),
        (header(), "not a single message"),
        (header() + definitions(), "not a single message"),
        (b"ULog\x01\x12\x35\x01" + bytes(8) + message("B", bytes(8) + b"\x02" + bytes(31)), "marked"),
    ],
)
def test_unusable_logs_say_why(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        opened(tmp_path, content)


TOPICS = ("vehicle_attitude", "vehicle_angular_velocity", "battery_status")


def with_stamps(change: Callable[[str, int, int], int], bad: Mapping[int, int]) -> bytes:
    """A log of 60 instants of `TOPICS` from 2 s on; `change` of (topic, row, stamp), `bad`: more attitudes by row."""
    content = header() + definitions(*TOPICS)
    for k in range(60):
        at = 2_000_000 + 20_000 * k
        content += data(TOPICS[0], change(TOPICS[0], k, at), 1, 0, 0.01 * k, 0)
        content += data(TOPICS[0], bad[k], 1, 0, 9, 0) if k in bad else b""
        content += data(TOPICS[1], change(TOPICS[1], k, at), k, 2, 3)
        content += data(TOPICS[2], change(TOPICS[2], k, at), 4.0, k)
    return content


def as_stamped(topic: str, row: int, stamp: int) -> int:
    return stamp


@given(bad=st.dictionaries(st.integers(0, 59), st.sampled_from([0, 4 * 10**18, 2**64 - 1, 10**15]), max_size=9))
def test_messages_with_stamps_that_cannot_be_cost_only_themselves(
    tmp_path_factory: pytest.TempPathFactory, bad: dict[int, int]
) -> None:
    folder = tmp_path_factory.mktemp("stamps")
    good = opened(folder, with_stamps(as_stamped, {}))
    odd = opened(folder, with_stamps(as_stamped, bad))
    for name, array in good.signals.items():
        np.testing.assert_array_equal(odd.signals[name].time, array.time)
        np.testing.assert_array_equal(odd.signals[name].value, array.value)
    assert [f.evidence["records"] for f in odd.findings if f.check == "stamps"] == [len(bad)] * bool(bad)


@given(topic=st.sampled_from(TOPICS), ahead=st.sampled_from([1_700_000_000_000_000, 10**12]))
def test_a_topic_of_another_clock_comes_back(tmp_path_factory: pytest.TempPathFactory, topic: str, ahead: int) -> None:
    folder = tmp_path_factory.mktemp("clock")
    good = opened(folder, with_stamps(as_stamped, {}))
    odd = opened(folder, with_stamps(lambda name, row, at: at + ahead * (name == topic), {}))
    for name, array in good.signals.items():
        np.testing.assert_allclose(odd.signals[name].time, array.time, atol=0.021)  # by the file's order, to one step
        np.testing.assert_array_equal(odd.signals[name].value, array.value)
    (finding,) = [f for f in odd.findings if f.check == "stamps"]
    assert topic in finding.text


def test_a_topic_without_any_stamps_says_so(tmp_path: Path) -> None:
    content = with_stamps(lambda name, row, at: at * (name != TOPICS[2]), {})
    recording = opened(tmp_path, content)
    assert "voltage" not in recording.signals
    (finding,) = [f for f in recording.findings if f.check == "stamps"]
    assert "battery_status has no stamps" in finding.text


def test_what_was_read_without_wild_stamps_is_written_without_them(tmp_path: Path) -> None:
    path, fixed = save(tmp_path, with_stamps(as_stamped, {20: 10**15})), tmp_path / "fixed.mcap"
    assert main(["doctor", str(path), "--fix", "-o", str(fixed)]) == 0
    again = open_recording(fixed)
    np.testing.assert_array_equal(again.signals["body_rate"].time, open_recording(path).signals["body_rate"].time)
    assert not [f for f in again.findings if f.check == "stamps"]
