"""What effects do to what is seen: rotations against SciPy, delays against interpolation, logs against the estimate."""

import numpy as np
import pytest
from flights import boot, read
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_sim.commander import setpoint as sp
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.sensing import delay_sensors, delayed_sample, fix_pose, store_sample
from firmware_sim.plant.effects.step import set_accelerometer
from firmware_sim.scenario import parse_scenario

ANGLES = st.floats(-3.0, 3.0)


def constants(effects: dict, hidden: dict | None = None) -> tuple[np.ndarray, np.ndarray]:
    scenario = parse_scenario({"effects": effects, "hidden": hidden or {}}, "test")
    return scenario.truth(), scenario.start_state()


def turned(roll: float, pitch: float, yaw: float) -> Rotation:
    return Rotation.from_euler("ZYX", [yaw, pitch, roll])


@given(ANGLES, st.floats(-1.5, 1.5), ANGLES, st.floats(-1, 1), st.floats(-1, 1))
def test_misalignments_are_rotations_of_the_sensor_in_the_body(roll, pitch, yaw, tilt, heading) -> None:
    angles = {"roll": roll, "pitch": pitch, "yaw": yaw}
    truth, x = constants({"attitude_misalignment": angles, "accelerometer_misalignment": angles})
    body = Rotation.from_rotvec([tilt, 0.3, heading])
    x[at.QUAT : at.QUAT + 4] = np.roll(body.as_quat(), 1)
    p, q = np.empty(3), np.empty(4)
    fix_pose(truth, x, np.zeros(at.SENSOR_SIZE), 0, p, q)
    expected = body * turned(roll, pitch, yaw)
    assert (Rotation.from_quat(np.roll(q, -1)) * expected.inv()).magnitude() == pytest.approx(0, abs=1e-7)
    set_accelerometer(truth, x, np.eye(3), np.array([1.0, -2.0, 9.0]))
    assert x[at.ACC : at.ACC + 3] == pytest.approx(turned(roll, pitch, yaw).inv().apply([1.0, -2.0, 9.0]), abs=1e-12)


def test_a_fix_shows_the_geometric_origin() -> None:
    truth, x = constants({"center_of_mass": {"x": 0.01, "y": 0.02, "z": -0.03}})
    body = turned(0.5, -0.4, 1.0)
    x[at.QUAT : at.QUAT + 4] = np.roll(body.as_quat(), 1)
    x[at.POS : at.POS + 3] = np.array([1.0, 2.0, 3.0]) + body.apply([0.01, 0.02, -0.03])
    p, q = np.empty(3), np.empty(4)
    fix_pose(truth, x, np.zeros(at.SENSOR_SIZE), 0, p, q)
    assert p == pytest.approx([1.0, 2.0, 3.0], abs=1e-12)


def test_magnetic_yaw_depends_on_the_place() -> None:
    truth, x = constants({}, {"magnetic_yaw": {"amplitude": 0.3, "wavelength": 2.0}})
    x[at.QUAT : at.QUAT + 4] = np.roll(turned(0.2, 0.1, 0.5).as_quat(), 1)
    for place, extra in ((0.0, 0.0), (0.5, 0.3), (1.0, 0.0), (1.5, -0.3)):
        x[at.POS] = place
        p, q = np.empty(3), np.empty(4)
        fix_pose(truth, x, np.zeros(at.SENSOR_SIZE), 0, p, q)
        yaw, pitch, roll = Rotation.from_quat(np.roll(q, -1)).as_euler("ZYX")
        assert (yaw, pitch, roll) == pytest.approx((0.5 + extra, 0.1, 0.2), abs=1e-12)


@given(delay=st.floats(0.0, 100.0), seed=st.integers(0, 99))
def test_delay_is_linear_interpolation_of_the_past(delay: float, seed: int) -> None:
    series = np.random.default_rng(seed).standard_normal((300, 3))
    sensor, out = np.zeros(at.SENSOR_SIZE), np.empty((300, 3))
    for tick, row in enumerate(series):
        values = row.copy()
        store_sample(sensor, at.PAST_GYRO, 3, tick, values)
        delayed_sample(sensor, at.PAST_GYRO, 3, tick, delay, values, -1)
        out[tick] = values
    t = np.arange(300)
    expected = np.column_stack([np.interp(t - delay, t, series[:, i]) for i in range(3)])
    assert out == pytest.approx(expected, abs=1e-9)


def test_a_delayed_pose_is_where_the_drone_was_whatever_the_sign_of_its_quaternion() -> None:
    truth, x = constants({"measurement_delay": {"delay": 0.0125}})
    sensor, p, q = np.zeros(at.SENSOR_SIZE), np.empty(3), np.empty(4)
    for tick in range(400):
        x[at.POS] = 0.002 * tick
        now = np.roll(turned(0.0, 0.0, 0.01 * tick).as_quat(), 1)
        x[at.QUAT : at.QUAT + 4] = now if tick % 2 else -now
        delay_sensors(truth, x, sensor, tick)
        fix_pose(truth, x, sensor, tick, p, q)
    assert p[0] == pytest.approx(0.002 * (399 - 12.5))
    yaw = Rotation.from_quat(np.roll(q, -1)).as_euler("ZYX")[0]
    assert yaw == pytest.approx(0.01 * (399 - 12.5), abs=1e-6) or yaw == pytest.approx(3.865 - 2 * np.pi, abs=1e-6)


def fly(
    effects: dict, names: list[str], milliseconds: int = 3000, platform: str = "cf2", motors: bool = True
) -> np.ndarray:
    """Log variables of every millisecond of a flight that weaves, Lee's controller."""
    flight = boot({"platform": platform, "effects": effects}, 1, stabilizer__controller=5)
    flight.armed = flight.motors_allowed = motors
    s = flight.setpoint
    s[sp.MODE_X : sp.MODE_Z + 1] = s[sp.MODE_YAW] = sp.ABSOLUTE
    rows = np.empty((milliseconds, len(names)))
    for n in range(milliseconds):
        t = 1e-3 * n
        s[sp.X], s[sp.Y], s[sp.Z] = 0.3 * np.sin(3 * t), 0.2 * np.sin(2 * t), min(1.0, t)
        flight.step()
        rows[n] = [read(flight, name) for name in names]
    return rows


STATE = [f"stateEstimate.{k}" for k in ("x", "vx", "vy", "vz", "qx", "qw", "ax")]
SENSORS = ["gyro.x", "gyro.y", "acc.z", "motor.m1"]


def test_a_late_state_delays_its_variables_in_the_log_and_no_others() -> None:
    effects = {"measurement_delay": {"delay": 0.02, "streams": ["state"]}}
    plain, late = (fly(e, STATE + SENSORS) for e in ({}, effects))
    assert np.array_equal(plain[:, 7:], late[:, 7:])
    assert late[1000:, :6] == pytest.approx(plain[980:-20, :6], abs=1e-12)
    assert late[1000:, 6] == pytest.approx(plain[980:-20, 6], abs=1e-9)


def test_late_sensors_are_late_for_the_controller_too() -> None:
    effects = {"measurement_delay": {"delay": 0.01, "streams": ["gyro", "accelerometer"]}}
    plain, late = (fly(e, SENSORS, 300, motors=False) for e in ({}, effects))  # at rest: the same noise, later
    assert late[100:, :3] == pytest.approx(plain[90:-10, :3], rel=1e-9)
    plain, late = fly({}, SENSORS, 600), fly(effects, SENSORS, 600)
    assert not np.array_equal(late[-1, 3], plain[-1, 3])


def test_velocity_scale_is_what_is_reported_per_world_axis() -> None:
    names = [f"stateEstimate.v{k}" for k in "xyz"] + ["stateEstimate.x", "stateEstimateZ.vx"]
    plain, scaled = fly({}, names), fly({"velocity_scale": {"x": 1.2, "y": 0.9}}, names)
    # the estimate steps 100 times a second and at fixes: compare over a fifth of a second
    rate = (scaled[1200:, 3] - scaled[1000:-200, 3]) / 0.2
    speed = np.convolve(scaled[1000:, 0], np.full(200, 1 / 200), "valid")[: len(rate)]
    assert (speed @ rate) / (rate @ rate) == pytest.approx(1.2, rel=0.02)
    assert scaled[1500, 4] == int(1000 * scaled[1500, 0])
    assert not np.array_equal(plain[:, 0], scaled[:, 0])


def test_gyro_bias_is_on_top_of_what_calibration_leaves() -> None:
    names = ["gyro.x", "gyro.y", "gyro.z"]
    effects = {"gyro_bias": {"x": 0.02, "z": -0.03}}
    plain, biased = (fly(e, names, 300, motors=False)[-1] for e in ({}, effects))
    # one sample counts in steps of 2000/32768 degrees a second
    assert np.radians(biased - plain) == pytest.approx([0.02, 0.0, -0.03], abs=np.radians(2000 / 32768))


def test_a_rotor_sensor_that_counts_wrong() -> None:
    names = [f"motor.m{i}_rpm" for i in range(1, 5)] + ["stateEstimate.z"]
    plain = fly({}, names, 2500, "cf21bl")
    wrong = fly({"rotor_sensor": {"rotor": 2, "scale": 0.9}}, names, 2500, "cf21bl")
    assert wrong[:, [0, 2, 3, 4]] == pytest.approx(plain[:, [0, 2, 3, 4]])  # the flight itself is untouched
    assert wrong[2000:, 1] == pytest.approx(0.9 * plain[2000:, 1], abs=2)
