"""Lag and delay of measured rotors from their commands, on rotors made by a recursion that the code does not have."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from made_flight import array_of, changed
from scipy.special import expit

from crazyem.diagnosis import diagnose as diagnosing
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.diagnosis.naming.other_likelihoods import late_rotors
from crazyem.diagnosis.naming.rotor_response import (
    Answer,
    Response,
    answers,
    late_response,
    response,
    unresponsive_rotor,
)
from crazyem.diagnosis.settings import CONFIDENCE, ROTOR_RESPONSE, SELECTION
from crazyem.recordings.recording import Recording

NONE: Mapping[int, float] = {}
ROTORS = replace(DRONE, rotor_constant=2e-8, motor_time_constant=0.03)


@pytest.fixture(scope="module")
def flown() -> Recording:
    return fly(seconds=16.0)


def answering(
    flown: Recording,
    lag: float,
    late: float,
    *,
    seed: int = 0,
    noise: float = 0.0,
    sticks: Mapping[int, float] = NONE,
    drop: float = 0.0,
) -> Recording:
    """Commands of a controller at 500 Hz, of which every fifth is logged, and what rotors make of all of them.

    sticks: rotors (1 to 4) that heed no change of their command up to this.
    drop: V per N^1.5 of all rotors, by which a battery of 4 V drops at once; it is measured every 0.1 s.
    """
    rng = np.random.default_rng(seed)
    start, end = flown.signals["motor_command"].time[[0, -1]]
    step = 0.002
    time = np.arange(start, end, step)
    smooth = np.hanning(25) / np.hanning(25).sum()  # to some 20 Hz
    quick = np.stack([np.convolve(c, smooth, "same") for c in rng.normal(size=(4, time.size))], 1)
    command = np.clip(0.5 + 0.4 * quick + 0.01 * rng.normal(size=quick.shape), 0.1, 1.0)
    heeded = command.copy()
    for rotor, band in sticks.items():
        for k in range(1, len(heeded)):
            if abs(command[k, rotor - 1] - heeded[k - 1, rotor - 1]) < band:
                heeded[k, rotor - 1] = heeded[k - 1, rotor - 1]
    behind = round(late / step)
    acting = np.vstack([np.repeat(heeded[:1], behind, axis=0), heeded[: len(heeded) - behind]])
    thrust, volts = np.empty_like(acting), np.full(len(acting), 4.0)
    thrust[0] = 0.06 * acting[0] + 0.08 * acting[0] ** 2  # N
    for k in range(1, len(acting)):
        duty = acting[k - 1] * volts[k - 1] / 4.0
        goal = 0.06 * duty + 0.08 * duty**2
        thrust[k] = goal + (thrust[k - 1] - goal) * np.exp(-step / lag)
        volts[k] -= drop * np.sum(thrust[k] ** 1.5)
    speed = np.sqrt(thrust / 2e-8) * (1 + noise * rng.normal(size=thrust.shape))
    signals = {
        **flown.signals,
        "motor_command": array_of("motor_command", time[::5], command[::5], place=80),
        "rotor_speed": array_of("rotor_speed", time[::5], speed[::5], place=90),
        "voltage": array_of("voltage", time[::50], volts[::50], place=95),
    }
    return replace(flown, signals=signals)


@pytest.mark.parametrize(("lag", "late"), [(0.015, 0.0), (0.03, 0.006), (0.03, 0.0), (0.06, 0.01)])
def test_lag_and_delay_are_those_of_the_rotors(flown, lag, late):
    found = [response(answers([answering(flown, lag, late, seed=s)], ROTORS)) for s in range(5)]
    assert np.mean([f.lag for f in found if f]) == pytest.approx(lag, rel=0.03)
    assert np.mean([f.delay for f in found if f]) == pytest.approx(late, abs=1e-3)
    assert all(f is not None and abs(f.lag - lag) < 3.0 * f.covariance[0, 0] ** 0.5 for f in found)


@pytest.mark.parametrize("seed", [1, 2])
def test_noise_of_speeds_does_not_make_rotors_look_quick(flown, seed):
    found = response(answers([answering(flown, 0.05, 0.0, seed=seed, noise=0.01)], ROTORS))
    assert found.lag == pytest.approx(0.05, rel=0.06)


@pytest.mark.parametrize("lag", [0.03, 0.05])
def test_a_voltage_that_drops_under_the_load_does_not_make_rotors_look_quick(flown, lag):
    made = answering(flown, lag, 0.0, seed=1, drop=12.0)  # a hover takes a quarter of the voltage
    found = response(answers([made], ROTORS))
    assert found.lag == pytest.approx(lag, rel=0.06)
    assert found.delay == pytest.approx(0.0, abs=2e-3)


def test_without_a_voltage_a_rotor_that_sticks_is_found_and_no_lag(flown):
    made = [answering(flown, 0.03, 0.0, seed=s, sticks={2: 0.1}) for s in (0, 1)]
    bare = [replace(m, signals={n: a for n, a in m.signals.items() if n != "voltage"}) for m in made]
    assert response(answers(bare, ROTORS)) is None
    sticking = unresponsive_rotor(answers(bare, ROTORS))
    assert sticking.regime == "rotor 2 does not follow its command"


def test_what_does_not_answer_says_nothing(flown):
    assert response(answers([flown], ROTORS)) is None  # no speeds
    made = answering(flown, 0.03, 0.0)
    assert response(answers([made], DRONE)) is None  # no rotor constant
    other = answering(flown, 0.03, 0.0, seed=1)
    strange = other.signals["rotor_speed"].value
    for speed in (strange, np.full_like(strange, 2000.0)):  # of another flight, and stuck
        assert response(answers([changed(made, "rotor_speed", value=speed)], ROTORS)) is None


def found(lag, delay, sd=1.4e-3):
    return Response(lag, delay, np.diag([sd**2, ROTOR_RESPONSE.delay_sd**2]))


FAR = 6.0 * ROTOR_RESPONSE.delay_sd


@pytest.mark.parametrize(
    ("here", "apart", "named"),
    [
        ((0.031, 0.0005), None, None),
        ((0.045, 0.0), (0.044, 0.001), ["motor_lag"]),
        ((0.03, FAR), None, ["input_delay"]),
        ((0.045, FAR), None, ["motor_lag", "input_delay"]),
        ((0.03, -FAR), None, None),  # no rotor answers before it is told to
        ((0.044, -0.006), None, ["motor_lag"]),  # slow and seemingly early is slow
        ((0.045, 0.0), (0.03, 0.0), None),  # flights held out must agree
        ((0.06, 0.0), (0.05, 0.0), None),  # nearer than the file, not near
        ((0.045, 0.0), (0.045, 0.0), ["motor_lag"]),
    ],
)
def test_a_lag_or_a_delay_or_both_are_named(here, apart, named):
    said = late_response(found(*here), apart and found(*apart), ROTORS)
    assert (said and list(said.values)) == named
    assert not (said and said.alike)
    if named == ["motor_lag"]:
        lag = here[0]
        assert said.values["motor_lag"] == (pytest.approx(lag), pytest.approx(1.4e-3))
        assert here[1] or said.nats == pytest.approx(0.5 * ((lag - 0.03) / 1.4e-3) ** 2)
        assert here != apart or said.held_out > SELECTION.min_evidence


def test_where_one_is_as_good_as_the_other_both_are_said():
    """Estimates of which one is up where the other is down, both 3 standard deviations up: 18 nats by hand, of which
    either alone explains all but 4.5."""
    sd = np.array([1.5e-3, 1e-3])
    response = Response(0.0345, 0.003, np.outer(sd, sd) * [[1.0, -0.5], [-0.5, 1.0]])
    said = late_response(response, None, ROTORS)
    assert said.alike
    assert list(said.values) == ["motor_lag"]
    assert said.values["motor_lag"][0] == pytest.approx(0.03 + 1.5 * 4.5e-3)  # 3 + 3/2 deviations: the delay's share
    assert said.nats == pytest.approx(18.0 - 4.5)


def test_wild_and_slow_samples_are_refused(flown):
    made = answering(flown, 0.03, 0.0)
    speed, command = made.signals["rotor_speed"].value, made.signals["motor_command"]
    wild = np.where(np.arange(len(speed))[:, None] % 50, speed, 1e300)
    sound = response(answers([changed(made, "rotor_speed", value=wild)], ROTORS))
    assert sound.lag == pytest.approx(0.03, rel=0.06)
    slow = changed(made, "motor_command", time=300.0 * command.time)
    assert response(answers([slow], ROTORS)) is None


@pytest.mark.parametrize("rotor", [1, 4])
def test_a_rotor_that_sticks_is_told_by_what_it_leaves_of_its_command(flown, rotor):
    sticking = [answering(flown, 0.03, 0.0, seed=s, sticks={rotor: 0.1}) for s in (0, 1)]
    told = unresponsive_rotor(answers(sticking, ROTORS))
    assert told.regime == f"rotor {rotor} does not follow its command"
    assert (told.signal, told.axis, told.unit, told.variable) == ("force", "z", "N", "rotor")
    most = (0.06 + 2 * 0.08 * 0.5) * 0.1 / np.sqrt(3)  # N: errors within the band, were all as likely
    assert 0.4 * most < told.effect_size < most
    assert told.nats > 100
    assert told.interval[0] < told.interval[1]


def test_a_rotor_that_sticks_in_one_flight_only_or_as_all_do_is_not_told(flown):
    whole = answering(flown, 0.03, 0.0, seed=2, noise=1e-3)
    assert unresponsive_rotor(answers([whole], ROTORS)) is None
    assert unresponsive_rotor(answers([], ROTORS)) is None
    assert unresponsive_rotor(answers([flown], ROTORS)) is None  # no speeds
    assert unresponsive_rotor(answers([answering(flown, 0.03, 0.0, sticks={2: 0.05}), whole], ROTORS)) is None
    assert (
        unresponsive_rotor(answers([answering(flown, 0.03, 0.0, sticks=dict.fromkeys((1, 2, 3, 4), 0.03))], ROTORS))
        is None
    )


def behind(time, wanted, *, lag):
    """(n, 4) what a first-order lag makes of values (n, 4) that are held."""
    out = wanted.copy()
    for k in range(1, len(out)):
        out[k] = wanted[k - 1] + (out[k - 1] - wanted[k - 1]) * np.exp(-(time[k] - time[k - 1]) / lag)
    return out


@pytest.mark.parametrize(("lag", "unresponsive"), [(0.05, False), (0.08, False), (0.08, True)])
@pytest.mark.parametrize("held_out", [False, True])
def test_a_late_rotor_is_as_sure_as_what_speaks_for_it(lag, held_out, unresponsive):
    """One rotor of four that sticks makes all of them look late."""
    slow = Answer(np.array([lag, 0.0]), np.diag([1e-6, 1e-6]), np.ones((4, 1000)) * 1e-4, (1.0, 9.0))
    found, groups = late_rotors([slow], [slow] if held_out else [], ROTORS, (), {}, unresponsive=unresponsive)
    assert groups == ()
    assert [e.name for e in found] == ["motor_lag"]
    odds = found[0].log_odds
    assert odds is not None
    most = float(expit(odds))
    assert most <= CONFIDENCE.max_probability
    assert found[0].confidence == pytest.approx(min(most, CONFIDENCE.doubtful) if unresponsive else most)


@pytest.mark.slow
@pytest.mark.parametrize("sticks", [False, True])
def test_a_diagnosis_tells_of_a_rotor_that_does_not_follow_its_command(monkeypatch, sticks):
    """Speeds that carry the drone as its commands do; of what the commands say of them, only whether one sticks."""
    flown = fly(seconds=10.0, seed=4)
    command = flown.signals["motor_command"]
    thrust = behind(command.time, inputs_of(flown, DRONE).rotor.thrust, lag=DRONE.motor_time_constant)
    speed = array_of("rotor_speed", command.time, np.sqrt(thrust / 2e-8), place=90)
    measured = replace(flown, signals={**flown.signals, "rotor_speed": speed})
    left = np.ones((4, 1000)) * np.array([[1.0], [1.0], [30.0 if sticks else 1.0], [1.0]]) * 1e-4
    told = Answer(np.array([0.12 if sticks else 0.03, 0.0]), np.diag([1e-6, 1e-6]), left, (1.0, 9.0))
    monkeypatch.setattr(diagnosing, "answers", lambda recordings, vehicle: [told] * len(recordings))
    found = diagnosing.diagnose([measured], ROTORS, wanted=["linear_drag", "motor_lag"])
    regimes = [f.regime for f in found.unexplained.findings]
    assert ("rotor 3 does not follow its command" in regimes) == sticks
    assert found.mismatch or not sticks
    # one that sticks makes them look late
    assert [(e.name, e.confidence) for e in found.effects] == ([("motor_lag", CONFIDENCE.doubtful)] if sticks else [])
