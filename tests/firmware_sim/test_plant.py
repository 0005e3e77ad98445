"""The plant alone: rigid body and noise, floor and contact, gyro and battery."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from firmware_sim.commander.decode import decompress_quaternion
from firmware_sim.controllers.tick import plant_step
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import compress
from firmware_sim.plant.rotors import battery_step, lag, open_circuit, wrench
from firmware_sim.plant.sensors import NoiseSource, low_pass, sensors_step, settle
from firmware_sim.scenario import Scenario, parse_scenario

QUIET = {"noise": {"thrust": 0.0, "torque": 0.0}, "ground": {"height": -1000.0}}
STILL = np.zeros(at.NOISE_WIDTH)


def airborne(table: dict | None = None) -> tuple[np.ndarray, np.ndarray, Scenario]:
    """Constants and start state of a drone that hangs in the air without noise."""
    scenario = parse_scenario({**QUIET, **(table or {})}, "test")
    return scenario.truth(), scenario.start_state(), scenario


def advance(truth: np.ndarray, x: np.ndarray, milliseconds: int) -> None:
    """Let the plant move without noise."""
    for _ in range(milliseconds):
        plant_step(truth, x, STILL, 1e-3)


def rotation(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of q = w, x, y, z by the sandwich product, written out independently of the package."""
    w, v = q[0], q[1:4]
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


def test_free_fall_is_a_parabola() -> None:
    truth, x, _ = airborne()
    x[at.VEL : at.VEL + 3] = 1.0, -2.0, 3.0
    advance(truth, x, 1000)
    assert x[at.POS : at.POS + 3] == pytest.approx([1.0, -2.0, 3.0 - 0.5 * 9.81], abs=1e-9)
    assert x[at.ACC : at.ACC + 3] == pytest.approx([0, 0, 0], abs=1e-9)


def test_free_rotation_conserves_energy_and_angular_momentum() -> None:
    truth, x, scenario = airborne({"vehicle": {"inertia": [2e-5, 1.5e-5, 3e-5, 2e-6, -1e-6, 3e-6]}})
    J = scenario.inertia()
    x[at.OMEGA : at.OMEGA + 3] = 8.0, -5.0, 3.0
    omega = x[at.OMEGA : at.OMEGA + 3]
    energy, momentum = omega @ J @ omega, rotation(x[at.QUAT : at.QUAT + 4]) @ J @ omega
    advance(truth, x, 3000)
    assert omega @ J @ omega == pytest.approx(energy, rel=1e-6)
    assert rotation(x[at.QUAT : at.QUAT + 4]) @ J @ omega == pytest.approx(momentum, rel=1e-6)
    assert np.linalg.norm(x[at.QUAT : at.QUAT + 4]) == pytest.approx(1.0, abs=1e-12)


def test_rotor_lag_is_exact_whatever_the_step() -> None:
    truth, x, _ = airborne({"vehicle": {"thrust_curve": [0.05], "motor_time_constant": 0.06}})
    x[at.PWM : at.PWM + 4] = 30000
    mean, impulse = np.empty(4), 0.0
    for _ in range(60):
        lag(truth, x, 1e-3, mean)
        impulse += 1e-3 * mean[0]
    assert x[at.ROTOR] == pytest.approx(0.05 * (1 - np.exp(-1.0)), rel=1e-12)
    assert impulse == pytest.approx(0.05 * 0.06 * np.exp(-1.0), rel=1e-12)  # integral of 1 - exp(-t/tau) up to tau


def test_no_thrust_without_command_and_none_beyond_the_rotor_limit() -> None:
    truth, x, _ = airborne({"vehicle": {"motor_time_constant": 0.0, "thrust_max": 0.1}})
    mean = np.empty(4)
    x[at.PWM : at.PWM + 4] = 0, 1, 30000, 65535
    lag(truth, x, 1e-3, mean)
    v = 30000 / 65535 * 4.2
    curve = (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145)
    assert mean == pytest.approx([0.0, 0.0, np.polynomial.polynomial.polyval(v, curve), 0.1], rel=1e-12)


def test_wrench_of_each_rotor() -> None:
    truth, _, _ = airborne({"vehicle": {"arm": 0.03, "torque_per_thrust": 0.006}})
    positions = [(0.03, -0.03), (-0.03, -0.03), (-0.03, 0.03), (0.03, 0.03)]  # M1 front right, ..., M4 front left
    spin = [-1, 1, -1, 1]
    for i in range(4):
        f, u = np.zeros(4), np.empty(4)
        f[i] = 0.2
        wrench(truth, f, 0, u)
        x, y = positions[i]
        assert u == pytest.approx([0.2, y * 0.2, -x * 0.2, spin[i] * 0.006 * 0.2])


def test_process_noise_has_the_stated_intensity() -> None:
    truth, x, _ = airborne({"noise": {"thrust": 2e-3, "torque": [1e-6, 2e-6, 3e-6]}})
    rng, seconds, runs = np.random.default_rng(1), 0.02, 800
    end = np.empty((runs, 4))
    for n in range(runs):
        y = x.copy()
        for _ in range(int(seconds * 1000)):
            plant_step(truth, y, rng.standard_normal(at.NOISE_WIDTH), 1e-3)
        end[n] = [y[at.VEL + 2], *y[at.OMEGA : at.OMEGA + 3]]
    J = truth[[at.INERTIA, at.INERTIA + 4, at.INERTIA + 8]]
    sd = np.array([2e-3 / truth[at.MASS], *(np.array([1e-6, 2e-6, 3e-6]) / J)]) * np.sqrt(seconds)
    assert end.std(axis=0) == pytest.approx(sd, rel=0.1)  # standard error 2.5 %
    assert np.abs(end.mean(axis=0) - [-9.81 * seconds, 0, 0, 0]).max() < 4 * sd.max() / np.sqrt(runs)


def test_noise_depends_on_seed_and_tick_only() -> None:
    a, b, other = NoiseSource(7), NoiseSource(7), NoiseSource(8)
    forward = [a.rows[a.prepare(t)].copy() for t in range(3000)]
    for t in (2999, 17, 1024, 0):  # any order
        assert np.array_equal(b.rows[b.prepare(t)], forward[t])
    assert not np.array_equal(other.rows[other.prepare(0)], forward[0])
    assert not np.array_equal(forward[0], forward[1024])
    assert np.std(forward) == pytest.approx(1.0, abs=0.01)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: sum(v * v for v in q) > 0.01))
def test_compressed_quaternion_comes_back(values: list[float]) -> None:
    q = np.array(values) / np.linalg.norm(values)  # x, y, z, w
    packed = int(compress(q[3], q[0], q[1], q[2]))
    assert 0 <= packed < 2**32
    out = np.array(decompress_quaternion(packed))  # cflib is its oracle, in test_commander_supervisor.py
    assert abs(out @ q) == pytest.approx(1.0, abs=3e-6)  # 0.16 degrees and no axis mixed up
    assert min(np.abs(out - q).max(), np.abs(out + q).max()) < 2.5e-3


# the floor: stands still, leaves when thrust exceeds weight, lands without bouncing off


def drone(thrust: float, start: dict | None = None, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Constants and state with rotors that give `thrust` N each whatever the command (unless it is 0)."""
    table = {
        "vehicle": {"thrust_curve": [thrust], "thrust_max": 1.0, "motor_time_constant": 0.0},
        "start": start or {"position": [0.0, 0.0, height]},
        "ground": {"height": height},
    }
    scenario = parse_scenario(table, "test")
    x = scenario.start_state()
    x[at.PWM : at.PWM + 4] = 1000 if thrust > 0 else 0
    return scenario.truth(), x


@pytest.mark.parametrize(("fraction", "leaves"), [(0.0, False), (0.25, False), (0.95, False), (1.05, True)])
def test_leaves_the_floor_when_thrust_exceeds_weight(fraction: float, leaves: bool) -> None:
    truth, x = drone(fraction * 0.029 * 9.81 / 4, height=1.5)
    rng = np.random.default_rng(0)
    for _ in range(1000):
        plant_step(truth, x, rng.standard_normal(at.NOISE_WIDTH), 1e-3)
    if leaves:
        assert x[at.POS + 2] - 1.5 == pytest.approx(0.5 * 0.05 * 9.81, rel=0.2)
    else:
        assert abs(x[at.POS + 2] - 1.5) < 1e-3
        assert np.abs(x[at.VEL : at.VEL + 3]).max() < 1e-3
        assert np.abs(x[[at.POS, at.POS + 1]]).max() < 1e-3


def test_resting_reads_one_g() -> None:
    truth, x = drone(0.0)
    advance(truth, x, 10)
    assert x[at.ASLEEP] == 1.0
    assert x[at.ACC : at.ACC + 3] == pytest.approx([0, 0, 9.81])


@pytest.mark.parametrize("speed", [0.0, 0.5, 3.0])
def test_a_fall_ends_at_rest_on_the_floor(speed: float) -> None:
    truth, x = drone(0.0, {"position": [0.0, 0.0, 0.5], "velocity": [speed, 0.0, -speed]})
    advance(truth, x, 4000)
    assert x[at.ASLEEP] == 1.0
    assert abs(x[at.POS + 2]) < 1e-3
    up = 1 - 2 * (x[at.QUAT + 1] ** 2 + x[at.QUAT + 2] ** 2)
    assert abs(abs(up) - 1.0) < 1e-2  # on its feet or on its back, nothing between


def test_gentle_landing_stays_below_four_g() -> None:
    truth, x = drone(0.0, {"position": [0.0, 0.0, 0.001], "velocity": [0.0, 0.0, -0.3]})
    peak = 0.0
    for _ in range(500):
        plant_step(truth, x, STILL, 1e-3)
        peak = max(peak, x[at.ACC + 2] / 9.81)
    assert 1.0 < peak < 6.0


# filters, sensor noise and battery against textbook results


@pytest.mark.parametrize("cutoff", [30.0, 80.0])
def test_filter_is_the_butterworth_of_scipy(cutoff: float) -> None:
    data = np.random.default_rng(0).standard_normal(500)
    memory = np.zeros(2)
    ours = [low_pass(memory, 0, v, cutoff) for v in data]
    b, a = signal.butter(2, cutoff, fs=1000.0)
    assert ours == pytest.approx(signal.lfilter(b, a, data), abs=1e-12)


def test_settled_filter_holds_its_value() -> None:
    memory = np.zeros(2)
    settle(memory, 0, 9.81, 30.0)
    assert low_pass(memory, 0, 9.81, 30.0) == pytest.approx(9.81, rel=1e-12)


def test_gyro_noise_density() -> None:
    density = 3e-4
    scenario = parse_scenario({"sensors": {"gyro_noise": density, "gyro_bias_walk": 0.0}}, "test")
    truth, state, sensor = scenario.truth(), scenario.start_state(), np.zeros(at.SENSOR_SIZE)
    rng = np.random.default_rng(0)
    samples = np.empty((20000, 3))
    for n in range(len(samples)):
        sensors_step(truth, state, sensor, rng.standard_normal(at.NOISE_WIDTH), n)
        samples[n] = sensor[at.GYRO : at.GYRO + 3]
    frequency, power = signal.welch(samples[100:], fs=1000.0, nperseg=1000, axis=0)
    flat = power[(frequency > 2) & (frequency < 30)].mean()  # one-sided, below the 80 Hz cut-off
    assert np.sqrt(flat) == pytest.approx(density, rel=0.05)


def test_battery_voltage_is_measured_ten_times_a_second() -> None:
    scenario = parse_scenario({"battery": {"noise": 0.01}}, "test")
    truth, state, sensor = scenario.truth(), scenario.start_state(), np.zeros(at.SENSOR_SIZE)
    rng = np.random.default_rng(0)
    seen = []
    for n in range(1000):
        sensors_step(truth, state, sensor, rng.standard_normal(at.NOISE_WIDTH), n)
        seen.append(sensor[at.VBAT])
    assert len(set(seen)) == 10
    assert np.flatnonzero(np.diff(seen)).tolist() == [99 + 100 * k for k in range(9)]


def test_battery_sags_and_empties_as_charge_and_power_say() -> None:
    table = {"battery": {"capacity": 0.1, "resistance": 0.1, "power_coefficient": 100.0, "electronics_power": 0.5}}
    scenario = parse_scenario(table, "test")
    truth, state = scenario.truth(), scenario.start_state()
    state[at.ROTOR : at.ROTOR + 4] = 0.07
    for _ in range(100):
        battery_step(truth, state, 1e-3)
    power = 0.5 + 4 * 100.0 * 0.07**1.5
    current = power / state[at.VOLTS]
    assert state[at.VOLTS] == pytest.approx(4.2 - 0.1 * current, abs=2e-3)
    assert 360.0 - state[at.CHARGE] == pytest.approx(current * 0.1, rel=0.02)
    for _ in range(200_000):
        battery_step(truth, state, 1e-3)
    assert state[at.CHARGE] == 0.0
    assert 0.5 <= state[at.VOLTS] < 3.0


def test_open_circuit_voltage_rises_with_charge() -> None:
    volts = [open_circuit(s) for s in np.linspace(0, 1, 101)]
    assert np.all(np.diff(volts) > 0)
    assert (volts[0], volts[-1]) == pytest.approx((3.0, 4.2))
