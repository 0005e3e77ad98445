"""Firmware variables to signals: signs, units and quaternions against independent formulas and the real firmware."""

import csv
import gzip
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyem.recordings import open_recording
from crazyem.signals.sample import SIGNALS, Block, Packet, Variable
from crazyem.signals.vocabulary import (
    DUTY_SOURCES,
    IMU_BLOCK,
    MOTOR_BLOCK,
    REQUEST_SOURCES,
    SOURCES,
    STATE_BLOCK,
    BlockDecoder,
    compress_quaternion,
    decoders,
    decompress_quaternion,
    quaternion_from_euler,
    sampled_together,
    standard_variables,
)


def block(*names, identifier=0):
    return Block(identifier, tuple(Variable(n, "float") for n in names), 10)


def decode(values):
    """One packet with these variables -> signal -> value."""
    samples = BlockDecoder(block(*values)).decode(Packet(0, 12345, 1.0, tuple(values.values())))
    assert all(s.time == 12.345 for s in samples)
    return {s.signal: s.value for s in samples}


angles = st.floats(-3.1, 3.1)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_compression_round_trip_within_its_step(raw):
    q = np.array(raw) / math.hypot(*raw)
    back = np.array(decompress_quaternion(compress_quaternion(q)))
    assert np.linalg.norm(back) == pytest.approx(1.0, abs=1e-12)
    angle = 2.0 * math.acos(min(1.0, abs(float(q @ back))))
    assert angle < math.radians(0.3)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_compression_is_the_code_cflib_makes(raw):
    from cflib.utils.encoding import compress_quaternion as theirs

    q = np.array(raw) / math.hypot(*raw)
    ours, other = compress_quaternion(q), theirs(q)
    # the same code, except where two components tie or a magnitude sits on the edge of rounding
    a, b = np.array(decompress_quaternion(ours)), np.array(decompress_quaternion(other))
    assert abs(float(a @ b)) > math.cos(math.radians(0.25) / 2.0)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_against_scipy(roll, pitch, yaw):
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    assert abs(float(np.dot(expected, quaternion_from_euler(roll, pitch, yaw)))) == pytest.approx(1.0, abs=1e-12)


def test_units_and_signs():
    got = decode(
        {
            "stateEstimateZ.x": 1500, "stateEstimateZ.y": -20, "stateEstimateZ.z": 3, "stateEstimateZ.rateRoll": 100,
            "stateEstimateZ.ratePitch": 200, "stateEstimateZ.rateYaw": -300, "pm.vbatMV": 3987,
            "supervisor.info": 0x020E,
        }
    )  # fmt: skip
    assert got["position"] == (1.5, -0.02, 0.003)
    assert got["body_rate"] == (0.1, -0.2, -0.3)
    assert got["voltage"] == (3.9875,)  # the firmware cuts millivolts off: 3.987 to 3.988 V
    assert decode({"pm.vbatMV": 0})["voltage"] == (0.0,)  # nothing measured
    assert decode({"pm.vbat": 3.987})["voltage"] == (3.987,)
    assert got["flying"] == (0.0,)
    assert decode({"supervisor.info": 0x021E})["flying"] == (1.0,)
    got = decode({"gyro.x": 180.0, "gyro.y": -90.0, "gyro.z": 0.0, "acc.x": 0.0, "acc.y": 0.5, "acc.z": 1.0})
    assert got["body_rate"] == pytest.approx((math.pi, -math.pi / 2, 0.0))
    assert got["specific_force"] == pytest.approx((0.0, 4.905, 9.81))
    got = decode({f"motor.m{i}": v for i, v in zip((1, 2, 3, 4), (0, 65535, 13107, 1), strict=True)})
    assert got["motor_command"] == (0.0, 1.0, 0.2, 1 / 65535)
    got = decode({f"motor.m{i}_rpm": v for i, v in zip((1, 2, 3, 4), (65535, 60, 0, 30000), strict=True)})
    assert math.isnan(got["rotor_speed"][0])
    assert got["rotor_speed"][1:] == pytest.approx((2 * math.pi, 0.0, 1000 * math.pi))


def test_legacy_pitch_is_inverted():
    attitude = decode({"stateEstimate.roll": 10.0, "stateEstimate.pitch": 20.0, "stateEstimate.yaw": 30.0})["attitude"]
    expected = Rotation.from_euler("ZYX", [30.0, -20.0, 10.0], degrees=True).as_quat()
    assert attitude == pytest.approx(tuple(expected))


def test_a_signal_needs_all_its_variables_and_is_decoded_once():
    assert decode({"motor.m1": 1, "motor.m2": 2, "motor.m3": 3}) == {}
    state = block(*STATE_BLOCK, "stateEstimateZ.rateRoll", "stateEstimateZ.ratePitch", "stateEstimateZ.rateYaw")
    imu = block(*IMU_BLOCK, identifier=1)
    table = decoders([state, imu])
    assert table[0].signals == ("position", "velocity", "attitude")  # the gyro's rates are the better ones
    assert table[1].signals == ("body_rate", "specific_force")
    assert "body_rate" in decoders([state])[0].signals


def test_every_source_gives_what_the_vocabulary_promises():
    for source in SOURCES:
        values = source.convert.one(tuple(1.0 for _ in source.variables))
        assert len(values) == SIGNALS[source.signal][0], source
        assert all(type(v) is float for v in values), source


def test_whole_columns_convert_bit_for_bit_like_single_packets():
    """Replay reads columns where the live loop saw packets; the result has to be the same number."""
    rng = np.random.default_rng(7)
    for source in (*SOURCES, *DUTY_SOURCES, *REQUEST_SOURCES):
        columns = [np.append(rng.integers(0, 2**32, 300).astype(float), [math.nan, 65535.0]) for _ in source.variables]
        if "info" not in source.variables[0] and "quat" not in source.variables[0]:
            columns = [c * rng.uniform(1e-7, 1e-3) if c[-1] != 65535.0 else c for c in columns]
        many = source.convert.many(columns)
        one = [source.convert.one(row) for row in zip(*(c.tolist() for c in columns), strict=True)]
        assert many.shape == (302, SIGNALS[source.signal][0])
        assert many.tobytes() == np.array(one, float).tobytes() or np.array_equal(many, one, equal_nan=True), source


def test_nan_stays_nan():
    for source in SOURCES:
        assert any(math.isnan(v) for v in source.convert.one(tuple(math.nan for _ in source.variables))), source


def test_what_is_asked_for_when_nobody_says():
    names = standard_variables([*STATE_BLOCK, *IMU_BLOCK, *MOTOR_BLOCK, "other.thing"])
    assert set(names) == {*STATE_BLOCK, *IMU_BLOCK, *MOTOR_BLOCK}
    assert sampled_together(names) == (STATE_BLOCK, IMU_BLOCK, MOTOR_BLOCK)


# --- against the real firmware --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def truth_and_recording(shared_recordings):
    folder = shared_recordings / "real_firmware"
    recording = open_recording(folder / "lee_34g_mass_pushed_midflight.csv.gz")
    with gzip.open(folder / "lee_34g_mass_pushed_midflight.truth.csv.gz", "rt") as stream:
        rows = list(csv.reader(stream))
    truth = {name: np.array([float(r[i]) for r in rows[1:]]) for i, name in enumerate(rows[0])}
    return truth, recording


def at(truth, names, time):
    return np.column_stack([np.interp(time, truth["t"], truth[n]) for n in names])


def offset(truth, recording):
    """s between the firmware's clock and the truth's: the one that makes the gyro fit best."""
    gyro = recording.signals["body_rate"]
    lags = np.arange(-15.0, 15.0, 0.002)
    sample = slice(None, None, 4)
    time, rate = gyro.time[sample], gyro.value[sample, :2]
    inside = [
        np.mean((at(truth, ("wx", "wy"), time + lag) - rate) ** 2)
        if time[0] + lag > truth["t"][0] - 5.0 and time[-1] + lag < truth["t"][-1] + 5.0
        else np.inf
        for lag in lags
    ]
    return lags[int(np.argmin(inside))]


def test_real_firmware_signals_agree_with_the_truth(truth_and_recording):
    truth, recording = truth_and_recording
    lag = offset(truth, recording)
    checks = {
        "position": (("px", "py", "pz"), 0.05),
        "velocity": (("vx", "vy", "vz"), 0.15),
        "body_rate": (("wx", "wy", "wz"), 0.2),
    }
    for name, (columns, tolerance) in checks.items():
        array = recording.signals[name]
        error = array.value - at(truth, columns, array.time + lag)
        assert np.sqrt(np.mean(error**2, axis=0)) == pytest.approx(0.0, abs=tolerance), name
        moving = array.value[:, 0]
        assert np.corrcoef(moving, at(truth, columns[:1], array.time + lag)[:, 0])[0, 1] > 0.97
    attitude = recording.signals["attitude"]
    true = Rotation.from_quat(at(truth, ("qx", "qy", "qz", "qw"), attitude.time + lag))
    tilt = (true.inv() * Rotation.from_quat(attitude.value)).magnitude()
    assert np.median(tilt) < math.radians(1.5)
    motors = recording.signals["motor_command"]
    duty = at(truth, ("pwm1", "pwm2", "pwm3", "pwm4"), motors.time + lag) / 65535.0
    busy = duty.min(axis=1) > 0.1
    assert np.abs(np.median(motors.value[busy] - duty[busy], axis=0)).max() < 0.01


@pytest.mark.parametrize("name", ["lee_34g_mass_pushed_midflight.csv.gz", "lee_brushless_39g.csv.gz"])
def test_accelerometers_of_the_real_firmware_are_the_velocitys_derivative(shared_recordings, name):
    """Signs, axes and units; the other signals are held against the truth."""
    recording = open_recording(shared_recordings / "real_firmware" / name)
    attitude, velocity, force = (recording.signals[n] for n in ("attitude", "velocity", "specific_force"))
    body = np.column_stack([np.interp(attitude.time, force.time, f) for f in force.value.T])
    world = Rotation.from_quat(attitude.value).apply(body) - [0.0, 0.0, 9.81]
    change = np.column_stack([np.interp(attitude.time, velocity.time, v) for v in velocity.value.T])
    wide = 20
    acceleration = (change[wide:] - change[:-wide]) / (attitude.time[wide:] - attitude.time[:-wide])[:, None]
    smooth = np.column_stack([np.convolve(w, np.ones(wide) / wide, "valid")[:-1] for w in world.T])
    for axis in range(3):
        assert np.corrcoef(acceleration[:, axis], smooth[: len(acceleration), axis])[0, 1] > 0.8
