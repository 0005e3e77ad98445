"""From messages to signals: frames against rotations written out by hand, the reader of tlogs, motors, batteries."""

import io
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from crazyem.links.mavlink import streams
from crazyem.links.mavlink.frames import FrameParser, definitions
from crazyem.links.mavlink.streams import ARDUPILOT, PX4, Outputs
from crazyem.recordings import open_recording
from crazyem.signals.mavlink import MAPPINGS, mapping
from crazyem.signals.sample import Packet
from crazyem.signals.vocabulary import MAVLINK_SOURCES, BlockDecoder

# half a turn about x, written out
D = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
numbers = st.floats(-100.0, 100.0, width=32)
three = st.tuples(numbers, numbers, numbers)


def signals(message, kind=PX4, outputs=None):
    """Signals of one message, all the way a live one goes."""
    parser = FrameParser()
    (frame,) = parser.feed(bytes(message.pack(mavlink.MAVLink(io.BytesIO(), 1, 1))))
    known = streams.Streams(outputs)
    found = known.values(frame.name, frame.fields())
    if found is None:
        return None
    blocks = streams.blocks_of({found[0]}, 100.0)
    packet = Packet(blocks[found[0]].identifier, 1000, 0.0, tuple(map(float, found[1])))
    return {s.signal: s.value for s in BlockDecoder(blocks[found[0]]).decode(packet)}


@given(position=three, velocity=three)
def test_position_and_velocity_turn_half_about_x(position, velocity):
    found = signals(mavlink.MAVLink_local_position_ned_message(1000, *position, *velocity))
    assert found["position"] == pytest.approx(D @ position)
    assert found["velocity"] == pytest.approx(D @ velocity)


@given(angles=st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)), rates=three)
def test_attitudes_are_the_rotation_matrix_turned_on_both_sides(angles, rates):
    """R_flu_to_nwu = D R_frd_to_ned D; by quaternion and by angles alike."""
    roll, pitch, yaw = angles
    ned = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    wanted = D @ ned.as_matrix() @ D
    x, y, z, w = ned.as_quat()
    for message in (
        mavlink.MAVLink_attitude_quaternion_message(1000, w, x, y, z, *rates),
        mavlink.MAVLink_attitude_message(1000, roll, pitch, yaw, *rates),
    ):
        found = signals(message)
        assert Rotation.from_quat(found["attitude"]).as_matrix() == pytest.approx(wanted, abs=1e-6)
        assert found["body_rate"] == pytest.approx(D @ rates)


def test_nose_up_and_right_wing_down_keep_their_meaning():
    """Pitch up in FRD: the nose points up, in our world to +z. Roll right: the left wing points up."""
    up = signals(mavlink.MAVLink_attitude_message(1000, 0, 0.5, 0, 0, 0, 0))
    assert Rotation.from_quat(up["attitude"]).apply([1, 0, 0])[2] == pytest.approx(math.sin(0.5), abs=1e-6)
    right = signals(mavlink.MAVLink_attitude_message(1000, 0.5, 0, 0, 0, 0, 0))
    assert Rotation.from_quat(right["attitude"]).apply([0, 1, 0])[2] == pytest.approx(math.sin(0.5), abs=1e-6)


def test_resting_accelerometers_point_up_in_every_message():
    rest = {
        "HIGHRES_IMU": mavlink.MAVLink_highres_imu_message(1000, 0, 0, -9.80665, 0.1, 0.2, 0.3, *[0] * 7, 63),
        "SCALED_IMU": mavlink.MAVLink_scaled_imu_message(1, 0, 0, -1000, 100, 200, 300, 0, 0, 0),
        "RAW_IMU": mavlink.MAVLink_raw_imu_message(1000, 0, 0, -1000, 100, 200, 300, 0, 0, 0),
    }
    for message in rest.values():
        found = signals(message)
        assert found["specific_force"] == pytest.approx((0.0, 0.0, 9.80665))
        assert found["body_rate"] == pytest.approx((0.1, -0.2, -0.3))


def test_messages_that_say_nothing_are_no_values():
    nan = math.nan
    assert signals(mavlink.MAVLink_local_position_ned_message(1000, nan, 0, 0, 0, 0, 0)) is None
    assert signals(mavlink.MAVLink_attitude_message(1000, 0, math.inf, 0, 0, 0, 0)) is None
    assert signals(mavlink.MAVLink_attitude_quaternion_message(1000, 0, 0, 0, 0, 0, 0, 0)) is None
    assert signals(mavlink.MAVLink_highres_imu_message(1000, *[0] * 13, 63, 1)) is None  # a second sensor
    masked = (1000, 1, 0x007, *[0] * 11)
    assert signals(mavlink.MAVLink_position_target_local_ned_message(*masked)) is None
    other = (1000, 8, 0, *[0] * 11)
    assert signals(mavlink.MAVLink_position_target_local_ned_message(*other)) is None  # body frame
    assert signals(mavlink.MAVLink_battery_status_message(0, 0, 0, 0, [65535] * 10, 0, 0, 0, 0)) is None


@given(data=st.data())
def test_columns_of_a_recording_and_live_packets_agree_bit_for_bit(data):
    """A replay converts whole columns; the live loop one packet at a time."""
    for source in MAVLINK_SOURCES:
        rows = [tuple(data.draw(numbers) for _ in source.variables) for _ in range(3)]
        many = source.convert.many([np.array(c, float) for c in zip(*rows, strict=True)])
        assert [tuple(row) for row in many.tolist()] == [source.convert.one(row) for row in rows]


def test_the_reader_of_tlogs_says_the_same(tmp_path):
    """The same messages as a tlog: position, attitude, rates, force, setpoint as the live link has them."""
    rng = np.random.default_rng(3)
    packer, written, live = mavlink.MAVLink(None, 1, 1), b"", {}
    for k in range(30):
        v = rng.normal(size=20).tolist()
        x, y, z, w = Rotation.random(rng=rng).as_quat()
        ms = 5000 + 10 * k
        for message in (
            mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3),
            mavlink.MAVLink_local_position_ned_message(ms, *v[:6]),
            mavlink.MAVLink_attitude_quaternion_message(ms, w, x, y, z, *v[6:9]),
            mavlink.MAVLink_highres_imu_message(1000 * ms, *v[9:15], *[0] * 7, 63),
            mavlink.MAVLink_position_target_local_ned_message(ms, 1, 0, *v[:11]),
        ):
            written += struct.pack(">Q", 1_700_000_000_000_000 + 1000 * ms) + bytes(message.pack(packer))
            for name, value in (signals(message) or {}).items():
                live.setdefault((name, message.get_type()), []).append(value)
    path = tmp_path / "a.tlog"
    path.write_bytes(written)
    read = open_recording(str(path)).signals
    for name, message in (
        *(("position", "LOCAL_POSITION_NED"), ("velocity", "LOCAL_POSITION_NED")),
        *(("attitude", "ATTITUDE_QUATERNION"), ("specific_force", "HIGHRES_IMU")),
        ("setpoint_position", "POSITION_TARGET_LOCAL_NED"),
    ):
        assert np.array_equal(read[name].value, np.array(live[name, message])), name
        assert set(mapping(name, message).fields) <= {c.rpartition(".")[2] for c in read[name].source}


def test_the_table_names_fields_that_there_are():
    fields = {d.name: {n for n, _ in d.fields} for d in definitions().values()}
    for m in MAPPINGS:
        if m.message in fields:
            assert set(m.fields) <= fields[m.message]


# --- motors ---

# PX4's "Quadrotor x" as its airframe reference draws it: forward, right of each motor; ours as the Crazyflie's drawing
PX4_PLACES = {1: (1, 1), 2: (-1, -1), 3: (1, -1), 4: (-1, 1)}
OUR_PLACES = {1: (1, 1), 2: (-1, 1), 3: (-1, -1), 4: (1, -1)}  # forward, right


def test_rotors_of_an_x_quad_are_matched_by_their_places():
    outputs = Outputs.of(PX4, {})
    for ours, index in enumerate(outputs.motors, start=1):
        assert PX4_PLACES[index + 1] == OUR_PLACES[ours]
    assert len(outputs.assumed) == 3


@given(order=st.permutations([1, 2, 3, 4]), functions=st.permutations([101, 102, 103, 104]))
def test_places_and_functions_are_taken_from_parameters(order, functions):
    parameters = {f"PWM_MAIN_FUNC{n}": float(f) for n, f in enumerate(functions, start=1)}
    for n, place in enumerate(order):
        x, y = PX4_PLACES[place]
        parameters |= {f"CA_ROTOR{n}_PX": 0.1 * x, f"CA_ROTOR{n}_PY": 0.1 * y}
    outputs = Outputs.of(PX4, parameters)
    # each channel is given a number that names the place of the motor behind it
    sent = [float(order[int(f) - 101]) / 10.0 for f in functions]
    duty = outputs.duty(sent)
    for ours in range(4):
        assert PX4_PLACES[round(10 * duty[ours])] == OUR_PLACES[ours + 1]
    rpm = outputs.speeds([1000.0 * place for place in order])
    assert [PX4_PLACES[round(v / 1000)] for v in rpm] == [OUR_PLACES[n] for n in range(1, 5)]


def test_pulses_become_shares_of_their_range():
    outputs = Outputs.of(ARDUPILOT, {"MOT_PWM_MIN": 1100.0, "MOT_PWM_MAX": 1900.0})
    assert outputs.duty([1100, 1500, 1900, 900]) == (0.0, 0.0, 0.5, 1.0)  # channels 1, 4, 2, 3
    assert outputs.duty([0.0, 0.25, 1.0, -0.5]) == (0.0, 0.0, 0.25, 1.0)
    assert outputs.duty([math.nan] * 4) is None
    assert outputs.duty([5000.0] * 4) is None


def test_senseless_ranges_are_not_believed():
    outputs = Outputs.of(ARDUPILOT, {"MOT_PWM_MIN": 0.0, "MOT_PWM_MAX": 0.0})
    assert outputs.least == (1000.0,) * 4
    assert any("1000 to 2000" in text for text in outputs.assumed)


def test_two_motors_in_one_corner_are_not_an_x_quad():
    parameters = {f"CA_ROTOR{n}_P{a}": 0.1 for n in range(4) for a in "XY"}
    assert "motors are where an X quad has them" in Outputs.of(PX4, parameters).assumed


def test_servo_outputs_and_speeds():
    servo = mavlink.MAVLink_servo_output_raw_message(1000, 0, 1000, 1250, 1500, 2000, 0, 0, 0, 0)
    assert signals(servo)["motor_command"] == (0.0, 1.0, 0.25, 0.5)
    other = mavlink.MAVLink_servo_output_raw_message(1000, 1, *[1500] * 8)
    assert signals(other) is None
    esc = mavlink.MAVLink_esc_telemetry_1_to_4_message(*([[0] * 4] * 4), [600, 1200, 1800, 2400], [0] * 4)
    assert signals(esc)["rotor_speed"] == pytest.approx([v * 2 * math.pi / 60 for v in (600, 2400, 1200, 1800)])


# --- battery and state ---


def battery(*cells):
    return mavlink.MAVLink_battery_status_message(0, 0, 0, 0, [*cells, *[65535] * (10 - len(cells))], 0, 0, 0, 50)


def test_cells_are_added_and_counted():
    known = streams.Streams()
    for message, volts, cells in ((battery(3700), 3.7, 1), (battery(14800), 14.8, 4), (battery(*[4000] * 6), 24.0, 6)):
        known = streams.Streams()
        (frame,) = FrameParser().feed(bytes(message.pack(mavlink.MAVLink(None, 1, 1))))
        assert known.values(frame.name, frame.fields()) == ("battery", (1000.0 * volts,))
        assert known.cells == cells
        assert signals(message)["voltage"] == (volts,)


@pytest.mark.parametrize(
    ("mode", "state", "landed", "flying", "ill"),
    [
        (128, 4, 2, True, False),
        (128, 4, 1, False, False),
        (128, 4, None, True, False),  # no EXTENDED_SYS_STATE: active is all there is
        (128, 3, None, False, False),
        (0, 3, 1, False, False),
        (128, 4, 3, True, False),
        (128, 6, 2, True, True),  # emergency
        (128, 8, 2, True, True),  # termination
    ],
)
def test_heartbeat_and_landed_state_become_the_supervisors_bits(mode, state, landed, flying, ill):
    known = streams.Streams()
    if landed is not None:
        known.values("EXTENDED_SYS_STATE", {"landed_state": landed})
    name, (info,) = known.values("HEARTBEAT", {"base_mode": mode, "system_status": state})
    assert name == "supervisor"
    assert bool(int(info) & streams.FLYING) == flying
    assert bool(int(info) & streams.CRASHED) == ill
    assert bool(int(info) & streams.ARMED) == bool(mode)


def test_one_message_serves_where_several_could():
    known = streams.Streams()
    seen = {"ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "SERVO_OUTPUT_RAW", "RAW_IMU", "SYS_STATUS"}
    blocks = known.choose(seen, raw_imu=False)
    assert blocks == {
        *("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "outputs", "battery", "supervisor"),
        "POSITION_TARGET_LOCAL_NED",
    }
    assert not known.uses("ATTITUDE")
    assert not known.uses("RAW_IMU")
    assert known.uses("SERVO_OUTPUT_RAW")
    assert known.uses("SYS_STATUS")
    assert not known.uses("BATTERY_STATUS")
    assert "RAW_IMU" in streams.Streams().choose(seen, raw_imu=True)
