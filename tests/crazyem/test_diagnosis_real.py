"""What real recordings need: streams with clocks of their own, flights without a pose, signals by other names."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import array_of, changed
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.diagnosis.fitting import specific_force
from crazyem.diagnosis.flights.alignment import Alignment
from crazyem.diagnosis.flights.flight import Flight, controlled_rates, flight_of, without
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.diagnosis.flights.recording_nuisances import nuisances_of_recordings
from crazyem.diagnosis.prediction.predict import predict, recorded
from crazyem.errors import DataError
from crazyem.physics.motion import RotorInput
from crazyem.recordings import open_recording
from crazyem.recordings.recording import Recording
from crazyem.vehicle import load_vehicle

VEHICLE = load_vehicle("cf21bl-busetto")
FINE = 1e-3  # s
MIXING = np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0


def shaken(*, delay: float, seconds: float = 16.0, seed: int = 0, related: bool = True) -> Recording:
    """A hovering drone whose rates answer to torques of 2 to 6 Hz; rotor speeds are stamped `delay` too early."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, FINE)
    wave = [sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 7)) for f in rng.uniform(2, 6, 5)) for _ in range(2)]
    torque = 1e-4 * np.stack([*wave, np.zeros(t.size)], 1)
    rate = np.cumsum(torque / np.array(VEHICLE.inertia), axis=0) * FINE
    rate -= rate.mean(0)
    if not related:
        torque = rng.permutation(torque)
    lift = np.full(t.size, VEHICLE.mass * 9.81)
    arm = np.array([1.0, VEHICLE.arm[1], VEHICLE.arm[0], VEHICLE.torque_per_thrust])
    wrench = np.concatenate([lift[:, None], torque], axis=1)
    speed = np.sqrt(np.maximum(np.linalg.solve((4 * MIXING) * arm[:, None], wrench.T).T, 0) / VEHICLE.rotor_constant)
    grid = np.arange(0.3, seconds - 0.3, 0.01)

    def at(values: NDArray, when: NDArray) -> NDArray:
        return np.stack([np.interp(when, t, c) for c in values.T], 1)

    noise = 0.01 * rng.standard_normal((grid.size, 3))
    signals = {
        "position": np.tile([0.0, 0.0, 1.0], (grid.size, 1)),
        "velocity": np.zeros((grid.size, 3)),
        "attitude": np.tile([0.0, 0.0, 0.0, 1.0], (grid.size, 1)),
        "body_rate": at(rate, grid) + noise,
        "rotor_speed": at(speed, grid + delay),
    }
    return Recording("made", "csv", {n: array_of(n, grid, v, place=k) for k, (n, v) in enumerate(signals.items())})


def found(recording: Recording) -> Alignment:
    alignment = inputs_of(recording, VEHICLE).alignment
    assert alignment is not None
    return alignment


@settings(max_examples=4)
@given(delay=st.floats(-0.06, 0.06), seed=st.integers(0, 5))
def test_the_delay_of_rotor_speeds_is_found_whatever_its_sign(delay: float, seed: int) -> None:
    alignment = found(shaken(delay=delay, seed=seed))
    assert alignment.delay == pytest.approx(delay, abs=1e-3)
    assert alignment.roll == pytest.approx(alignment.pitch, abs=2e-3)
    assert alignment.running[-1] == pytest.approx(delay, abs=2e-3)


def test_speeds_that_no_rotor_has_are_errors_of_transmission() -> None:
    """One sample of a million rpm is 400 N, and outweighs the flight."""
    sound = shaken(delay=0.02)
    speed = sound.signals["rotor_speed"].value.copy()
    speed[700, 3], speed[900, 0] = 104720.0, 33036.0
    spoiled = changed(sound, "rotor_speed", value=speed)
    used = inputs_of(spoiled, VEHICLE).rotor
    assert used.time.size == inputs_of(sound, VEHICLE).rotor.time.size - 2
    assert used.thrust.max() < 1.0
    assert found(spoiled).delay == pytest.approx(found(sound).delay, abs=2e-4)


def test_a_blow_is_no_answer_to_the_rotors() -> None:
    """A drone that is thrown about at its landing, thrice by 30 rad/s within some hundredths of a second: nine
    tenths of its acceleration are nothing that rotors do."""
    sound = shaken(delay=-0.03)
    rate = sound.signals["body_rate"].value.copy()
    for begin in (-120, -111, -102):
        rate[begin : begin + 4, :2] += np.array([[-16.0, 13.0], [32.0, 27.0], [-11.0, 2.0], [0.0, -7.0]])
    hit = found(changed(sound, "body_rate", value=rate))
    assert hit.delay == pytest.approx(found(sound).delay, abs=5e-4)
    assert hit.running[-1] == pytest.approx(hit.delay, abs=2e-3)


def test_without_a_relation_nothing_is_said() -> None:
    inputs = inputs_of(shaken(delay=0.01, related=False), VEHICLE)
    assert inputs.alignment is None
    assert inputs.rotor.delay == 0.0


def test_it_is_used_and_said() -> None:
    inputs = inputs_of(shaken(delay=-0.02), VEHICLE)
    assert inputs.rotor.delay == pytest.approx(-0.02, abs=1e-3)
    assert any("after their stamps" in notice for notice in inputs.notices)


def test_a_diagnosis_tells_it_of_each_recording() -> None:
    late, unknown = (flight_of(shaken(delay=0.02, related=r), VEHICLE) for r in (True, False))
    one, other = nuisances_of_recordings([late], [unknown])
    assert one.to_json()["rotor_clock"]["delay"] == pytest.approx(0.02, abs=1e-3)
    assert any("after their stamps" in text for text in one.notices)
    assert (one.held_out, other.held_out) == (False, True)
    assert other.to_json()["rotor_clock"] is None


def test_a_prediction_knows_of_the_delay_what_came_before_its_start() -> None:
    first = shaken(delay=0.03)
    late = first.signals["rotor_speed"]
    other = shaken(delay=-0.03, seed=1).signals["rotor_speed"].value
    second = changed(first, "rotor_speed", value=np.where(late.time[:, None] > 10.0, other, late.value))
    one, two = (predict(recorded(r, VEHICLE), horizon=10) for r in (first, second))
    before = one.time[:, -1] < 9.9
    assert before.sum() > 500
    assert np.allclose(one.prediction[before], two.prediction[before], rtol=0, atol=1e-9)


def test_rates_of_the_controllers_log_are_turned_into_body_axes() -> None:
    time = np.arange(0.0, 1.0, 0.01)
    parts = {}
    for place, (name, value) in enumerate([("roll", 1.0), ("pitch", 2.0), ("yaw", 3.0)]):
        one = array_of("voltage", time, np.full((100, 1), value), place=place)
        parts[f"controller.r_{name}"] = replace(one, quantity="")
    when, rate = controlled_rates(Recording("made", "usd:2", parts))
    assert np.array_equal(when, time)
    assert np.allclose(rate, [1.0, -2.0, 3.0])


def test_a_signal_may_be_withheld_by_the_name_that_the_firmware_has_for_it() -> None:
    volts = replace(array_of("voltage", np.arange(5.0), np.full((5, 1), 3.8), place=0), source=("pwr_pm_vbat",))
    made = Recording("made", "csv", {"voltage": volts})
    for name in ("pm.vbat", "voltage", "pwr_pm_vbat"):
        assert "voltage" not in without(made, [name]).signals
    with pytest.raises(DataError, match=r"no signal .m\.vbat. to withhold"):
        without(made, ["m.vbat"])


# -- the accelerometer as evidence -------------------------------------------------------------------------------------


def felt_flight(force: NDArray, *, position: bool = False, fused: bool = False) -> Flight:
    n = len(force)
    time = np.arange(n) * 0.01
    y = np.full((n, 13), np.nan)
    y[:, 10:13] = 0.0
    if position:
        y[:, 0:3] = 0.0
    starts = np.arange(n) == 0
    rotor = RotorInput(time, np.zeros((n, 4)), np.full(n, np.nan), time, measured=False)
    block = (np.arange(n) // 100).astype(np.int64)
    return Flight("made", time, starts, starts, y, force, np.full(n, np.nan), time, 0.0, block, rotor,
                  frozenset({"body_rate", "specific_force"}), fused=fused)  # fmt: skip


def test_the_accelerometer_counts_only_where_nothing_else_shows_forces() -> None:
    force = np.zeros((300, 3))
    assert specific_force.axes_needed(felt_flight(force)) == (0, 1, 2)
    assert specific_force.axes_needed(felt_flight(force, position=True)) == ()
    assert specific_force.axes_needed(felt_flight(force, position=True, fused=True)) == (0, 1)
    assert specific_force.axes_needed(felt_flight(np.full((300, 3), np.nan))) == ()


@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 1)])
def test_score_and_information_are_derivatives_of_its_likelihood(axes: tuple[int, ...]) -> None:
    """Of the likelihood of the same noise: the noise that suits a model best moves with the model by little."""
    rng = np.random.default_rng(2)
    force = lfilter([1.0], [1.0, -0.9], rng.normal(size=(3500, 3)), axis=0)
    force[40] = np.nan
    flight = felt_flight(force)
    model, acting = np.zeros((3500, 3)), 0.1 * rng.normal(size=(3500, 3, 4))
    errors = rng.normal(size=(3500, 2, 9))

    def loglik(theta: NDArray) -> float:
        moved = model + acting @ theta
        return float(specific_force.evidence(flight, moved, acting[:, :, :0], errors, axes)[0].sum())

    _, score, information = specific_force.evidence(flight, model, acting, errors, axes)
    h = 0.3
    for i in range(4):
        e = np.eye(4)[i] * h
        assert score.sum(0)[i] == pytest.approx((loglik(e) - loglik(-e)) / (2 * h), rel=0.05, abs=0.2)
        bend = (loglik(e) - 2 * loglik(0 * e) + loglik(-e)) / h**2
        assert information.sum(0)[i, i] == pytest.approx(-bend, rel=0.1)


def test_a_badly_mounted_accelerometer_shows_no_lateral_force() -> None:
    """By kinematics: a sensor at r, tilted by a rotation, biased and late, on a body that turns. Only a force along x
    that none of these makes is evidence."""
    rng = np.random.default_rng(4)
    time = np.arange(3000) * 0.01
    waves = [np.sum([np.sin(f * time + rng.uniform(0, 6)) for f in rng.uniform(0.5, 8.0, 4)], 0) for _ in range(6)]
    rate, force = np.stack(waves[:3], 1), np.stack([0.3 * waves[3], 0.3 * waves[4], 9.8 + waves[5]], 1)
    turning = np.gradient(rate, time, axis=0)
    place, tilt, lag = np.array([0.004, -0.003, 0.006]), np.array([0.02, -0.015]), 0.006
    shown = force + np.cross(turning, place) + np.cross(rate, np.cross(rate, place)) + 0.1 * rng.normal(size=(3000, 3))
    shown[:, :2] += tilt * force[:, 2:] + [0.1, -0.2] - lag * np.gradient(force[:, :2], time, axis=0)
    flight = felt_flight(shown, position=True, fused=True)
    errors = specific_force.sensor_errors(flight, force, rate)
    drag = np.zeros((3000, 3, 1))
    drag[:, 0, 0] = np.sin(0.7 * time)
    _, score, information = specific_force.evidence(flight, force, drag, errors, (0, 1))
    sd = information.sum() ** -0.5
    assert sd == pytest.approx(0.1 * np.sqrt(2.0 / 3000), rel=0.2)
    assert abs(score.sum() / information.sum()) < 3.0 * sd
    less = force - 0.05 * drag[:, :, 0]
    _, score, information = specific_force.evidence(flight, less, drag, errors, (0, 1))
    assert score.sum() / information.sum() == pytest.approx(0.05, abs=3.0 * sd)
    assert information.sum() ** -0.5 < 0.05 / 3.0


@pytest.mark.parametrize("memory", [0.0, 0.3, 1.5])
def test_the_noise_of_an_accelerometer_is_found(memory: float) -> None:
    """White noise of 0.1 m/s^2, and a force of 0.4 m/s^2 with a memory, simulated exactly."""
    rng = np.random.default_rng(5)
    decay = np.exp(-0.01 / memory) if memory else 0.0
    start = 0.4 * rng.standard_normal()
    slow = lfilter([1.0], [1.0, -decay], 0.4 * np.sqrt(1.0 - decay**2) * rng.standard_normal(12000), zi=[decay * start])
    residual = 0.1 * rng.standard_normal(12000) + (slow[0] if memory else 0.0)
    found, white = specific_force.noise_of(residual), specific_force.noise_of(residual, decay=0.0)
    if memory:
        assert -0.01 / np.log(found.decay) == pytest.approx(memory, rel=0.4)
        assert found.spread(residual) == pytest.approx(0.4, rel=0.2)
        assert found.loglik - white.loglik > 1000.0
        known = specific_force.noise_of(residual, decay=float(decay))
        assert known.loglik == pytest.approx(found.loglik, abs=5.0)
    else:
        assert found.loglik - white.loglik < 5.0
        assert np.std(found.white(residual)) == pytest.approx(0.1, rel=0.05)


# -- real recordings ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "run", ["raw/square_run1", "raw/square_run2", "raw/chirp_run1", "raw/chirp_run4", "processed/square_run4"]
)
def test_roll_and_pitch_agree_on_the_delay_of_a_real_run(shared_recordings, run: str) -> None:
    alignment = found(open_recording(shared_recordings / "nanodrone" / f"{run}.csv.gz"))
    assert abs(alignment.roll - alignment.pitch) < 2e-3
    assert alignment.explained > 0.7
    assert alignment.sd < 2e-3


def test_controller_tables_become_flights(shared_recordings) -> None:
    path = shared_recordings / "crazypad" / "controller__normal_flight__E8_log00"
    flight = flight_of(open_recording(path), load_vehicle("cf2-legacy"))
    assert {"position", "body_rate", "mixer_command"} <= flight.signals
    assert flight.duration > 14
