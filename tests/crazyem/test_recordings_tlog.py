"""Telemetry logs written with pymavlink: its own parser and scipy as oracles, clocks, damage of every kind."""

import io
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc
from recording_files import assert_cut_anywhere
from scipy.spatial.transform import Rotation

from crazyem.doctor import Grade, examine
from crazyem.errors import CrazyemError, FileFormatError
from crazyem.recordings.autopilots.tlog_file import read, recognises
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording

START = 1_700_000_000_000_000  # us since 1970
BOOT = START - 100_000_000  # when the autopilot booted
FLIP = np.diag([1.0, -1.0, -1.0])
PX4 = 12


class Log:
    """A tlog in memory, as a ground station writes it."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.bytes = b""
        self.links: dict[tuple[int, int], Any] = {}
        self.sender = (system, component)

    def add(self, stamp: int, message: Any, sender: tuple[int, int] | None = None, *, old: bool = False) -> None:
        sender = sender or self.sender
        link = self.links.setdefault(sender, mavlink.MAVLink(io.BytesIO(), *sender))
        self.bytes += struct.pack(">Q", stamp) + message.pack(link, force_mavlink1=old)
        link.seq = (link.seq + 1) % 256

    def beat(self, stamp: int, *, autopilot: int = PX4, kind: int = 2, armed: bool = True, **more: Any) -> None:
        self.add(stamp, mavlink.MAVLink_heartbeat_message(kind, autopilot, 128 if armed else 0, 0, 4, 3), **more)


def boot_ms(stamp: int) -> int:
    return (stamp - BOOT) // 1000


def single(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32).astype(float)


def flight(rows: int = 30, seed: int = 2, *, old: bool = False) -> tuple[bytes, dict[str, np.ndarray]]:
    """A log and what went in (source frames); messages arrive 3 ms after they were stamped."""
    rng = np.random.default_rng(seed)
    truth = {
        "t": START + np.arange(rows) * 20_000, "local": rng.normal(size=(rows, 6)),
        "q": Rotation.random(rows, random_state=seed).as_quat()[:, [3, 0, 1, 2]],
        "angles": rng.uniform(-1.2, 1.2, (rows, 3)),
        "rate": rng.normal(size=(rows, 6)), "imu": rng.normal(size=(rows, 6)),
        "milli": rng.integers(-4000, 4000, (rows, 9)),
        "rpm": rng.integers(0, 20000, (rows, 4)), "target": rng.normal(size=(rows, 9)),
        "cells": rng.integers(3000, 4200, (rows, 2)),
    }  # fmt: skip
    log = Log()
    for i in range(rows):
        t = int(truth["t"][i])
        ms, at = boot_ms(t), t + 3000

        def send(message: Any, at: int = at) -> None:
            log.add(at, message, old=old)

        log.beat(at, old=old)
        send(mavlink.MAVLink_local_position_ned_message(ms, *truth["local"][i]))
        send(mavlink.MAVLink_attitude_quaternion_message(ms, *truth["q"][i], *truth["rate"][i, :3]))
        send(mavlink.MAVLink_attitude_message(ms, *truth["angles"][i], *truth["rate"][i, 3:]))
        send(mavlink.MAVLink_highres_imu_message(t - BOOT, *truth["imu"][i], *[0.5] * 7, 63))
        send(mavlink.MAVLink_scaled_imu_message(ms, *truth["milli"][i]))
        send(mavlink.MAVLink_raw_imu_message(t - BOOT, *truth["milli"][i]))
        if not old:  # a number that MAVLink 1 cannot send
            rest = ([20] * 4, [1600] * 4, [0] * 4, [0] * 4)
            send(mavlink.MAVLink_esc_telemetry_1_to_4_message(*rest, truth["rpm"][i], [0] * 4))
        send(mavlink.MAVLink_battery_status_message(0, 0, 0, 2500, [*truth["cells"][i], *[65535] * 8], 100, 0, 0, 50))
        send(mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 65535 if i == 2 else 7600 + i, 0, 50, 0, 0, 0, 0, 0, 0))
        mask = 0x7 if i == 1 else 0x38 if i == 2 else 0
        send(mavlink.MAVLink_position_target_local_ned_message(ms, 1, mask, *truth["target"][i], 0, 0))
        send(mavlink.MAVLink_attitude_target_message(ms, 0, truth["q"][i], *truth["rate"][i, :3], 0.5))
        send(mavlink.MAVLink_servo_output_raw_message((t - BOOT) % (1 << 32), 0, *range(1000, 1008)))
        send(mavlink.MAVLink_extended_sys_state_message(0, [0, 1, 2, 3, 4][i % 5]))
    return log.bytes, truth


def save(folder: Path, content: bytes) -> Path:
    path = folder / "flight.tlog"
    path.write_bytes(content)
    return path


def opened(folder: Path, content: bytes) -> Recording:
    return read(save(folder, content), ReadOptions())


def test_a_log_is_recognised_and_opened(tmp_path: Path) -> None:
    content, _ = flight()
    assert recognises(content[:65536])
    assert recognises(b"\x01" * 100 + content)
    assert not recognises(b"".join(frames(content)))  # frames without stamps: a plain MAVLink stream
    assert not recognises(b"")
    assert not recognises(b"a,b,c\n1,2,3\n")
    assert not recognises(bytes(70000))
    recording = open_recording(save(tmp_path, content))
    assert recording.source == "tlog"
    assert recording.origin == 0.0


@pytest.mark.parametrize("old", [False, True], ids=["MAVLink 2", "MAVLink 1"])
def test_vectors_and_attitudes_are_turned_to_flu_and_north_west_up(tmp_path: Path, old: bool) -> None:
    content, truth = flight(old=old)
    signals = opened(tmp_path, content).signals
    vectors = {
        "position": truth["local"][:, :3], "velocity": truth["local"][:, 3:], "specific_force": truth["imu"][:, :3],
        "body_rate": truth["imu"][:, 3:], "body_rate@ATTITUDE": truth["rate"][:, 3:],
        "setpoint_rate": truth["rate"][:, :3],
    }  # fmt: skip
    for name, expected in vectors.items():
        np.testing.assert_array_equal(signals[name].value, single(expected) @ FLIP)
    milli = truth["milli"].astype(float) * 1e-3
    np.testing.assert_allclose(signals["specific_force@SCALED_IMU"].value, milli[:, :3] @ FLIP * 9.80665, rtol=1e-15)
    np.testing.assert_allclose(signals["body_rate@SCALED_IMU"].value, milli[:, 3:6] @ FLIP, rtol=1e-15)
    angles = Rotation.from_euler("ZYX", single(truth["angles"])[:, ::-1])
    for ours, theirs in (
        (Rotation.from_quat(signals["attitude"].value), Rotation.from_quat(single(truth["q"])[:, [1, 2, 3, 0]])),
        (Rotation.from_quat(signals["attitude@ATTITUDE"].value), angles),
        (Rotation.from_euler("ZYX", signals["euler"].value[:, ::-1]), angles),
    ):
        np.testing.assert_allclose(ours.as_matrix(), FLIP @ theirs.as_matrix() @ FLIP, atol=1e-12)


def test_scalars_and_what_is_missing(tmp_path: Path) -> None:
    content, truth = flight()
    signals = opened(tmp_path, content).signals
    np.testing.assert_allclose(signals["rotor_speed"].value, truth["rpm"] * math.pi / 30, rtol=1e-14)
    np.testing.assert_allclose(signals["voltage"].value[:, 0], truth["cells"].sum(axis=1) / 1000, rtol=1e-14)
    system = signals["voltage@SYS_STATUS"]
    assert np.isnan(system.value[2, 0])
    assert np.flatnonzero(system.marked).tolist() == [2]
    np.testing.assert_allclose(np.delete(system.value[:, 0], 2), np.delete(7.6 + np.arange(30) / 1000, 2), rtol=1e-14)
    assert np.flatnonzero(signals["setpoint_position"].marked).tolist() == [1]
    assert np.flatnonzero(signals["setpoint_velocity"].marked).tolist() == [2]
    flying = signals["flying"]
    assert np.nan_to_num(flying.value[:5, 0], nan=-1).tolist() == [-1, 0, 1, 1, 1]
    assert flying.marked[:5].tolist() == [True, False, False, False, False]
    assert (signals["flying@HEARTBEAT"].value == 1).all()
    assert signals["SERVO_OUTPUT_RAW.servo3_raw"].value[:, 0].tolist() == [1002.0] * 30
    assert signals["SERVO_OUTPUT_RAW.servo3_raw"].unit == "us"
    assert "motor_command" not in signals
    assert signals["position"].source == tuple(f"LOCAL_POSITION_NED.{c}" for c in "xyz")


def test_times_are_the_autopilots_own_and_the_hosts_is_kept(tmp_path: Path) -> None:
    content, truth = flight()
    signals = opened(tmp_path, content).signals
    np.testing.assert_array_equal(signals["position"].time, (truth["t"] - BOOT) // 1000 / 1000)
    np.testing.assert_array_equal(signals["specific_force"].time, (truth["t"] - BOOT) / 1e6)
    assert signals["position"].clock == signals["specific_force"].clock == "autopilot"
    np.testing.assert_allclose(signals["position"].host_time, (truth["t"] + 3000) / 1e6, rtol=0, atol=3e-7)
    # arrival less the usual delay: here the delay is always the same
    assert signals["voltage"].clock == "host"
    np.testing.assert_allclose(signals["voltage"].time, (truth["t"] - BOOT) / 1e6, rtol=0, atol=1e-6)


def test_a_short_microsecond_counter_is_unwrapped(tmp_path: Path) -> None:
    log = Log()
    stamps = (1 << 32) - 30_000 + np.arange(5) * 20_000
    for k, stamp in enumerate(stamps):
        log.beat(START + k * 20_000)
        log.add(START + k * 20_000, mavlink.MAVLink_servo_output_raw_message(int(stamp) % (1 << 32), 0, *range(8)))
    signals = opened(tmp_path, log.bytes).signals
    np.testing.assert_array_equal(signals["SERVO_OUTPUT_RAW.servo1_raw"].time, stamps / 1e6)


def test_utc_stamps_are_placed_beside_boot_times(tmp_path: Path) -> None:
    log = Log()
    for k in range(20):
        t = START + 10_000 * k
        log.beat(t + 2000)
        log.add(t + 2000, mavlink.MAVLink_attitude_message(boot_ms(t), *[0] * 6))
        log.add(t + 2000, mavlink.MAVLink_highres_imu_message(t, *[0] * 13, 63))
    signals = opened(tmp_path, log.bytes).signals
    assert signals["specific_force"].clock == "UTC of component 1"
    np.testing.assert_allclose(signals["specific_force"].time, signals["euler"].time, atol=1e-6)


def test_without_any_own_time_the_host_is_the_clock(tmp_path: Path) -> None:
    log = Log()
    for k in range(3):
        log.beat(START + k * 500_000)
    recording = opened(tmp_path, log.bytes)
    flying = recording.signals["flying"]
    np.testing.assert_array_equal(recording.origin + flying.time, (START + np.arange(3) * 500_000) / 1e6)
    assert flying.clock == "host"
    assert any("time of arrival" in f.text or "arrival" in f.text for f in recording.findings)


def test_raw_imu_has_units_from_ardupilot_only(tmp_path: Path) -> None:
    def log(autopilot: int) -> bytes:
        made = Log()
        for k in range(3):
            made.beat(START + k, autopilot=autopilot)
            made.add(START + k, mavlink.MAVLink_raw_imu_message(1000 * (k + 1), 0, 0, -1000, 100, 200, 300, 0, 0, 0))
        return made.bytes

    signals = opened(tmp_path, log(3)).signals
    np.testing.assert_allclose(signals["specific_force"].value[0], [0, 0, 9.80665])
    np.testing.assert_allclose(signals["body_rate"].value[0], [0.1, -0.2, -0.3])
    assert "specific_force" not in opened(tmp_path, log(PX4)).signals


def test_one_vehicle_of_several_is_read_and_the_choice_is_said(tmp_path: Path) -> None:
    log = Log()
    for k in range(40):
        t = START + 10_000 * k
        log.beat(t, autopilot=8, kind=6, sender=(255, 190))  # the ground station
        for system in (7, 9) if k % 4 == 0 else (9,):
            log.beat(t, sender=(system, 1))
            log.add(t, mavlink.MAVLink_local_position_ned_message(boot_ms(t), system, *[0] * 5), (system, 1))
        log.add(t, mavlink.MAVLink_attitude_message(5, *[1] * 6), (9, 158))
    recording = opened(tmp_path, log.bytes)
    assert (recording.signals["position"].value[:, 0] == 9).all()
    assert recording.metadata["tlog"]["system"] == "9"
    assert "158/ATTITUDE.roll" in recording.signals
    assert "euler" not in recording.signals
    assert any("systems 7, 9" in f.text for f in recording.findings)


def test_instances_are_kept_apart(tmp_path: Path) -> None:
    log = Log()
    for k in range(4):
        log.beat(START + k)
        for battery in (0, 1):
            cells = [4000 - 100 * battery, *[65535] * 9]
            log.add(START + k, mavlink.MAVLink_battery_status_message(battery, 0, 0, 0, cells, 0, 0, 0, 0))
        log.add(START + k, mavlink.MAVLink_named_value_float_message(1000 + k, b"drag", 0.5 * k))
    signals = opened(tmp_path, log.bytes).signals
    assert signals["voltage"].value[:, 0].tolist() == [4.0] * 4
    assert signals["BATTERY_STATUS_1.voltages[0]"].value[:, 0].tolist() == [3900.0] * 4
    assert signals["NAMED_VALUE_FLOAT_drag.value"].value[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5]


def test_texts_and_parameters_are_kept(tmp_path: Path) -> None:
    log = Log()
    log.beat(START)
    log.add(START + 1, mavlink.MAVLink_statustext_message(6, b"Takeoff"))
    log.add(START + 2, mavlink.MAVLink_param_value_message(b"MPC_Z_P", 1.5, 9, 2, 0))
    recording = opened(tmp_path, log.bytes)
    assert [(e.time, e.kind, e.data["text"]) for e in recording.events] == [((START + 1) / 1e6, "log", "Takeoff")]
    assert recording.metadata["parameters"] == {"MPC_Z_P": "1.5"}


def frames(content: bytes) -> list[bytes]:
    """The frames of a sound log, without their stamps."""
    found, at = [], 0
    while at < len(content):
        size = content[at + 9] + (12 if content[at + 8] == 0xFD else 8)
        found.append(content[at + 8 : at + 8 + size])
        at += 8 + size
    return found


def parsed(content: bytes) -> dict[str, list[Any]]:
    """pymavlink's own view of a sound log; elements of arrays as "name[0]"."""
    messages: dict[str, list[Any]] = {}
    parser = mavlink.MAVLink(None)
    for frame in frames(content):
        message = parser.decode(bytearray(frame))
        fields = message.to_dict()
        fields |= {f"{k}[{i}]": x for k, v in fields.items() if isinstance(v, list) for i, x in enumerate(v)}
        messages.setdefault(message.get_type(), []).append(fields)
    return messages


@pytest.mark.parametrize("old", [False, True])
def test_the_same_numbers_as_pymavlink(tmp_path: Path, old: bool) -> None:
    content, _ = flight(seed=4, old=old)
    signals = opened(tmp_path, content).signals
    compared = 0
    for name, messages in parsed(content).items():
        for column, raw in ((c, signals.get(f"{name}.{c}")) for c in messages[0]):
            if raw is not None:
                np.testing.assert_array_equal(raw.value[:, 0], [float(m[column]) for m in messages])
                compared += 1
    assert compared > 80


def test_signed_frames_are_read(tmp_path: Path) -> None:
    log = Log()
    link = log.links[1, 1] = mavlink.MAVLink(io.BytesIO(), 1, 1)
    link.signing.secret_key, link.signing.sign_outgoing = bytes(32), True
    for k in range(5):
        log.add(START + k, mavlink.MAVLink_attitude_message(1000 + k, 0.1 * k, 0, 0, 0, 0, 0))
    assert log.bytes[10] == 1  # the flag that says so
    recording = opened(tmp_path, log.bytes)
    np.testing.assert_array_equal(recording.signals["euler"].value[:, 0], single(0.1 * np.arange(5)))
    assert not [f for f in recording.findings if f.check == "integrity"]


def test_truncation_at_any_byte(tmp_path: Path) -> None:
    content, _ = flight(rows=1)
    ends = [0]
    while ends[-1] < len(content):
        ends.append(ends[-1] + 8 + content[ends[-1] + 9] + 12)
    assert_cut_anywhere(lambda part: opened(tmp_path, part), content, ends, first=ends[1])


def test_garbage_between_frames_costs_only_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    log, first = Log(), b""
    for k in range(40):
        first = log.bytes if k == 20 else first
        log.add(START + k, mavlink.MAVLink_attitude_message(1000 + k, k, 0, 0, 0, 0, 0))
    for junk in (b"\xfd" * 3000, bytes(3000), rng.bytes(30000), first[3:40]):
        recording = opened(tmp_path, first + junk + log.bytes[len(first) :])
        assert recording.signals["euler"].value[:, 0].tolist() == list(range(40))
        finding = next(f for f in recording.findings if f.check == "integrity")
        assert finding.evidence == {"offset": len(first), "bytes": len(junk), "places": 1}


def test_a_flipped_bit_costs_one_frame(tmp_path: Path) -> None:
    content, _ = flight(rows=6)
    whole = opened(tmp_path, content)
    for place in range(0, len(content), 97):
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        recording = opened(tmp_path, bytes(damaged))
        said = any(f.check == "integrity" or "of kinds not known" in f.text for f in recording.findings)
        assert said or len(recording) == len(whole)  # a flipped bit of a stamp cannot be seen
        assert len(recording) > 0.8 * len(whole)


@given(
    identifier=st.sampled_from(sorted(mavlink.mavlink_map)),
    payload=st.binary(max_size=255),
    stamp=st.integers(946_684_800_000_001, 4_102_444_799_999_999),
)
def test_every_message_with_any_payload_is_read(
    tmp_path_factory: pytest.TempPathFactory, identifier: int, payload: bytes, stamp: int
) -> None:
    body = struct.pack("<BBBBBB", len(payload), 0, 0, 0, 1, 1) + identifier.to_bytes(3, "little") + payload
    crc = x25crc(body + bytes([mavlink.mavlink_map[identifier].crc_extra])).crc
    frame = struct.pack(">Q", stamp) + b"\xfd" + body + struct.pack("<H", crc)
    path = save(tmp_path_factory.mktemp("any"), 3 * frame)
    assert recognises(3 * frame)
    recording, said = None, ""
    try:
        recording = read(path, ReadOptions())
    except CrazyemError as error:
        said = str(error)
    assert recording is not None or "no numbers" in said


def test_nothing_sound_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="sound checksum"):
        opened(tmp_path, b"\xfd" * 1000)


def test_messages_that_come_twice_or_late_are_not_lost(tmp_path: Path) -> None:
    log = Log()
    for k in range(600):
        log.beat(START + k)
    whole = [struct.pack(">Q", START + k) + frame for k, frame in enumerate(frames(log.bytes))]
    sent = [*whole[:100], whole[99], *whole[100:200], whole[201], whole[200], *whole[202:300], *whole[310:]]
    recording = opened(tmp_path, b"".join(sent))
    finding = next(f for f in recording.findings if f.check == "gaps")
    assert finding.evidence["lost"] == 10
    assert finding.evidence["received"] == 590
    start, end = finding.intervals[0]
    assert end - start == pytest.approx(11e-6, abs=1e-6)  # between the 300th and the 311th
    assert recording.metadata["lost_records"] == {"HEARTBEAT": "10"}


@pytest.mark.parametrize(("kind", "words"), [(1, "fixed wing aircraft"), (2, "quadrotor"), (13, "hexarotor")])
def test_the_kind_of_vehicle_is_kept(tmp_path: Path, kind: int, words: str) -> None:
    log = Log()
    for k in range(5):
        log.beat(START + k, kind=kind)
    assert opened(tmp_path, log.bytes).metadata["vehicle"] == {"kind": words, "mav_type": str(kind)}


def test_a_battery_monitor_that_reads_zero_is_not_connected(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.beat(START + 1000 * k)
        log.add(START + 1000 * k + 1, mavlink.MAVLink_sys_status_message(*[0] * 13))
    recording = opened(tmp_path, log.bytes)
    assert "voltage" not in recording.signals
    assert "no battery monitor" in recording.metadata["not_measured"]["voltage"]
    (about,) = [f for f in examine(recording) if f.signal == "voltage" or "voltage" in f.text]
    assert about.grade is Grade.HARMLESS
    assert "no battery monitor is connected" in about.text


def test_an_autopilot_that_was_started_again_makes_two_parts_on_one_axis(tmp_path: Path) -> None:
    log = Log()
    for k in range(400):
        if k == 250:
            log.links[1, 1].seq = 0  # numbers begin anew, too
        boot = START - 50_000_000 if k < 250 else START + 4_000_000  # started again after 50 s and 5 s of flight
        stamp = START + 20_000 * k
        milliseconds = (stamp - boot) // 1000
        if k % 10 == 0:  # another message is the first of the second start, and a third has a time of its own
            log.add(stamp + 1000, mavlink.MAVLink_local_position_ned_message(milliseconds, 0.01 * k, 0, 0, 0, 0, 0))
            log.add(stamp + 2000, mavlink.MAVLink_scaled_imu_message(milliseconds + 900_000, *[0] * 9))
        log.add(stamp + 3000, mavlink.MAVLink_attitude_message(milliseconds, 0, 0, 0.001 * k, 0, 0, 0))
    recording = opened(tmp_path, log.bytes)
    position = recording.signals["position"]
    np.testing.assert_allclose(np.diff(position.time), 0.2, atol=1e-6)
    time = recording.signals["attitude"].time
    np.testing.assert_allclose(np.diff(time), 0.02, atol=1e-6)
    assert time[0] == pytest.approx(50.0)
    (finding,) = [f for f in recording.findings if f.check == "stamps"]
    assert finding.evidence["starts"] == 2
    (first, second) = finding.intervals
    assert first == pytest.approx((50.0, 55.0), abs=5e-3)
    assert second == pytest.approx((55.0, 57.98), abs=5e-3)
    assert not [f for f in recording.findings if f.check == "gaps"]
    last = open_recording(tmp_path / "flight.tlog", ReadOptions(start=second[0]))
    assert last.signals["attitude"].time.size == 150


@given(rows=st.sets(st.integers(1, 28), max_size=8), wild=st.sampled_from([0, 0xFFFFFFFF]))
def test_boot_times_that_cannot_be_are_placed_by_arrival(
    tmp_path_factory: pytest.TempPathFactory, rows: set[int], wild: int
) -> None:
    logs = Log(), Log()
    for k in range(30):
        stamp = START + 20_000 * k
        for log, bad in zip(logs, (set(), rows), strict=True):
            milliseconds = wild if k in bad else boot_ms(stamp)
            log.add(stamp + 3000, mavlink.MAVLink_attitude_message(milliseconds, 0, 0, 0.001 * k, 0, 0, 0))
    folder = tmp_path_factory.mktemp("boot")
    good, odd = (opened(folder, log.bytes) for log in logs)
    np.testing.assert_allclose(odd.signals["euler"].time, good.signals["euler"].time, atol=1e-6)
    np.testing.assert_array_equal(odd.signals["euler"].value, good.signals["euler"].value)
    assert [f.evidence["records"] for f in odd.findings if f.check == "stamps"] == [len(rows)] * bool(rows)
