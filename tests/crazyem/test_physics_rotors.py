"""Command and voltage to force and torque: the firmware's mixing undone, edge cases, and a real firmware's flight."""

import csv
import gzip
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from crazyem.physics import rotors
from crazyem.vehicle import load_vehicle

CF2 = load_vehicle("cf2")
ARM = 0.046 * np.sqrt(0.5)  # d of power_distribution_quadrotor.c [m]


def firmware_mixing(thrust, torque, *, arm=ARM, torque_per_thrust=CF2.torque_per_thrust):
    """Force of each rotor, as power_distribution_quadrotor.c has it (powerDistributionForceTorque)."""
    roll, pitch, yaw = torque[0] / (4 * arm), torque[1] / (4 * arm), torque[2] / (4 * torque_per_thrust)
    part = thrust / 4
    return np.array([part - roll - pitch - yaw, part - roll + pitch + yaw,
                     part + roll + pitch - yaw, part + roll - pitch + yaw])  # fmt: skip


finite = st.floats(-1e-2, 1e-2)


@given(st.floats(0, 0.5), st.tuples(finite, finite, finite))
def test_wrench_undoes_the_mixing_of_the_firmware(thrust, torque):
    each = firmware_mixing(thrust, torque)
    ours = rotors.wrench(each, arm=(ARM, ARM), torque_per_thrust=CF2.torque_per_thrust)
    np.testing.assert_allclose(ours, [thrust, *torque], atol=1e-14)


def test_front_rotors_pitch_up_and_the_signs_of_a_right_handed_frame():
    """Rotor 1 is front right: more thrust there rolls left (about -x) and pitches the nose up (about -y)."""
    force, *torque = rotors.wrench(np.array([1.0, 0, 0, 0]), arm=(0.1, 0.2), torque_per_thrust=0.01)
    position = np.array([0.1, -0.2, 0.0])  # x forward, y left
    np.testing.assert_allclose(np.cross(position, [0, 0, 1.0])[:2], torque[:2])
    assert force == 1.0
    assert torque[2] == -0.01


@given(st.floats(0.15, 1.0), st.floats(3.0, 4.2))
def test_thrust_is_the_polynomial_of_the_motor_voltage(duty, voltage):
    v = duty * voltage
    c = CF2.thrust_curve
    expected = max(0.0, c[0] + c[1] * v + c[2] * v**2 + c[3] * v**3)
    ours = rotors.thrust_from_command(np.full(4, duty), np.float64(voltage), thrust_curve=c)
    np.testing.assert_allclose(ours, np.full(4, expected), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", ["cf2", "cf2-legacy", "cf2-thrust-kit", "cf21bl"])
def test_a_rotor_commanded_to_zero_gives_none_and_none_pulls_down(name):
    curve = load_vehicle(name).thrust_curve
    thrust = rotors.thrust_from_command(np.array([[0.0, 1e-4, 0.05, 1.0]]), np.array([4.0]), thrust_curve=curve)[0]
    assert thrust[0] == 0.0
    assert np.all(thrust >= 0.0)
    assert thrust[3] > 0.05


def test_nan_stays_where_it_is():
    command = np.array([[0.5, np.nan, 0.0, 0.5], [0.5, 0.5, 0.5, 0.5]])
    thrust = rotors.thrust_from_command(command, np.array([4.0, np.nan]), thrust_curve=CF2.thrust_curve)
    assert np.array_equal(np.isnan(thrust), [[False, True, False, False], [True] * 4])
    assert thrust[0, 2] == 0.0
    wrench = rotors.wrench_from_command(command, np.array([4.0, np.nan]), CF2)
    assert np.all(np.isnan(wrench))


def test_rotor_speeds():
    bl = load_vehicle("cf21bl")
    speed = np.array([1600.0, 1700.0, 1500.0, 1650.0])  # rad/s
    wrench = rotors.wrench_from_speed(speed, bl)
    each = 3.72e-8 * speed**2
    assert wrench[0] == pytest.approx(each.sum())
    np.testing.assert_allclose(firmware_mixing(wrench[0], wrench[1:], arm=bl.arm[0],
                               torque_per_thrust=bl.torque_per_thrust), each)  # fmt: skip
    with pytest.raises(ValueError, match="no rotor_constant"):
        rotors.wrench_from_speed(speed, CF2)


# The real firmware -----------------------------------------------------------------------------------------------


def read_log(path):
    """Log of the real firmware: name -> (ms, value), in the order of the file."""
    columns: dict[str, list[tuple[int, float]]] = {}
    with gzip.open(path, "rt") as file:
        for row in csv.DictReader(file):
            columns.setdefault(row["name"], []).append((int(row["fw_ms"] or 0), float(row["value"])))
    return {name: np.array(rows) for name, rows in columns.items()}


@pytest.mark.parametrize(("flight", "preset", "mass"), [
    ("lee_34g_mass_pushed_midflight", "cf2", 0.034),
    ("lee_brushless_39g", "cf21bl", 0.0393),
])  # fmt: skip
def test_motor_log_of_the_real_firmware_gives_back_what_its_controller_asked_for(
    shared_recordings, flight, preset, mass
):
    """PWM and battery voltage -> F and M, against ctrlLee.thrustSi and torque* of the same packets and the weight."""
    log = read_log(shared_recordings / "real_firmware" / f"{flight}.csv.gz")
    motors = np.stack([log[f"motor.m{i}"][:, 1] for i in (1, 2, 3, 4)], 1) / 65535
    volts = log["pm.vbatMV"][:, 1] / 1000
    ours = rotors.wrench_from_command(motors, volts, load_vehicle(preset))
    ms = log["motor.m1"][:, 0]
    asked = np.stack([np.interp(ms, *log[f"ctrlLee.{n}"].T) for n in ("thrustSi", "torquex", "torquey", "torquez")], 1)
    flying = (asked[:, 0] > 0.6 * mass * 9.81) & (motors.min(1) > 0.15)  # the request stays after the motors stopped
    assert flying.sum() > 500
    assert ours[flying, 0].mean() == pytest.approx(asked[flying, 0].mean(), rel=0.005)
    assert ours[flying, 0].mean() == pytest.approx(mass * 9.81, rel=0.02)
    correlations = [np.corrcoef(ours[flying, i], asked[flying, i])[0, 1] for i in range(4)]
    assert min(correlations) > 0.985  # the two blocks are packed up to 2 ms apart
    slopes = [np.polyfit(asked[flying, i], ours[flying, i], 1)[0] for i in range(4)]
    np.testing.assert_allclose(slopes, 1.0, atol=0.03)


def test_motor_pwm_in_the_truth_file_gives_its_force_and_torque(shared_recordings):
    """Truth has PWM, voltage, and the force that acted, 30 ms of rotor lag later: our force through that lag is it."""
    path = shared_recordings / "real_firmware" / "lee_34g_mass_pushed_midflight.truth.csv.gz"
    with gzip.open(path, "rt") as file:
        names = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    column = {name: rows[:, i] for i, name in enumerate(names)}
    motors = np.stack([column[f"pwm{i}"] for i in (1, 2, 3, 4)], 1) / 65535
    static = rotors.wrench_from_command(motors, column["vbat"], CF2)
    lagged = static.copy()
    for k in range(1, len(rows)):
        decay = np.exp(-(column["t"][k] - column["t"][k - 1]) / 0.030)
        lagged[k] = static[k - 1] + (lagged[k - 1] - static[k - 1]) * decay
    truth = np.stack([column[n] for n in ("F", "Mx", "My", "Mz")], 1)
    flying = truth[:, 0] > 0.6 * 0.034 * 9.81
    assert flying.sum() > 500
    residual = (lagged - truth)[flying]
    assert abs(residual[:, 0].mean()) < 0.005 * truth[flying, 0].mean()
    assert np.all(residual.std(0) < 0.35 * truth[flying].std(0))
    slopes = [np.polyfit(truth[flying, i], lagged[flying, i], 1)[0] for i in range(4)]
    np.testing.assert_allclose(slopes, 1.0, atol=0.1)


@given(
    command=st.tuples(*[st.floats(0.0, 1.0) | st.just(0.0) | st.just(1)] * 4),
    voltage=st.floats(2.5, 4.3),
    preset=st.sampled_from(["cf2", "cf2-legacy", "cf21bl"]),
)
@example(command=(0.0, 0.0, 0.126953125, 0.0), voltage=3.59375, preset="cf2")
@example(command=(0.0, 0.0, 0.126953125, 0.0), voltage=3.59375, preset="cf21bl")
@example(command=(0.0, 0.0, 0.126953125, 0.0), voltage=3.59375, preset="cf2-legacy")
def test_one_command_gives_what_many_give(command, voltage, preset):
    vehicle = load_vehicle(preset)
    plain = rotors.wrench_from_command(np.array(command, float), np.float64(voltage), vehicle)
    # rounding is relative to the terms of the thrust curve, which cancel where a rotor hardly turns
    volts = voltage * np.array(command, float)
    terms = np.polyval(np.abs(vehicle.thrust_curve[::-1]), volts).sum()
    scale = terms * np.array([1.0, vehicle.arm[1], vehicle.arm[0], vehicle.torque_per_thrust])
    assert np.all(np.abs(rotors.wrench_from_one_command(command, voltage, vehicle) - plain) <= 1e-14 * scale)


def test_one_command_keeps_what_is_not_a_number():
    assert np.isnan(rotors.wrench_from_one_command((0.5, math.nan, 0.5, 0.5), 4.0, CF2)[0])
    assert np.isnan(rotors.wrench_from_one_command((0.5, 0.5, 0.5, 0.5), math.nan, CF2)[0])
