"""Filters, sensor noise and battery against textbook results."""

import numpy as np
import pytest
from scipy import signal

from firmware_sim.plant import layout as at
from firmware_sim.plant.rotors import battery_step, open_circuit
from firmware_sim.plant.sensors import low_pass, sensors_step, settle
from firmware_sim.scenario import parse_scenario


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
