"""Onsets in mid-flight, and names that a vibration alone speaks for; flights in closed loop made elsewhere."""

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.fitting import conditions as facts
from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted, nominal, with_torque_memory, with_torque_memory_refit
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import held_out_fit, held_out_twin, refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.locating.random_torques import peaks
from crazyem.diagnosis.naming.evidence import joint_gain
from crazyem.diagnosis.naming.onset import ONSET, date
from crazyem.diagnosis.naming.prune import vibration_look_alikes
from crazyem.diagnosis.naming.select import Basis, compared, linear_trials, with_held_out_by
from crazyem.diagnosis.naming.trials import Trial

ONSET_TIME = 4.37  # s


@pytest.fixture(scope="module")
def failing() -> tuple[Data, Point]:
    """A rotor loses a tenth in flight, and the nominal model of it."""
    data = Data([flight_of(fly(Hidden(thrust=(1, 1, 0.9, 1), onset=ONSET_TIME), seconds=8.0), DRONE)])
    return data, nominal(data, Point(DRONE, {}, start_noise()))


def test_a_failure_hides_its_moment_in_the_noise_until_it_is_fitted_again(failing: tuple[Data, Point]) -> None:
    data, point = failing
    guess = ONSET_TIME - 0.9
    candidate = Candidate("rotor_fault", (("rotor", 3), (ONSET, guess)), ("scale",))
    begun = point.with_effects({"rotor_fault": {"rotor": 3, "scale": 0.95, ONSET: guess}})
    rough: Fitted = refine_base(data, begun, [candidate], rounds=2)
    fitted, dated = date(data, rough, candidate)
    found: Any = dict(dated.fixed)[ONSET]
    assert abs(found - ONSET_TIME) < 0.05
    assert fitted.candidates == (dated,)
    assert fitted.point.effects["rotor_fault"]["scale"] == pytest.approx(0.9, abs=0.01)
    assert np.all(fitted.point.noise.disturbance[3:5] < 0.3 * point.noise.disturbance[3:5])  # what hid it is gone
    assert fitted.loglik > rough.loglik + 50.0


def test_where_a_trim_is_known_only_what_sets_in_later_is_asked_of_rotors() -> None:
    """What is steady the balance tells (`steady_odds.py`)."""
    trimmed = replace(DRONE, effects={"trim": {"x": 1e-4, "y": -2e-4, "z": 3e-4}})
    data = Data([flight_of(fly(Hidden(thrust=(1, 1, 0.9, 1), onset=ONSET_TIME), seconds=8.0), trimmed)])
    point = nominal(data, Point(trimmed, {n: dict(v) for n, v in trimmed.effects.items()}, start_noise()))
    candidates = [Candidate("rotor_fault", (("rotor", r), (ONSET, None)), ("scale",)) for r in (1, 2, 3, 4)]
    asked = [t.candidate for t, _ in linear_trials(data, point, (), candidates)]
    assert all(dict(c.fixed)[ONSET] is not None for c in asked)
    assert dict(asked[0].fixed)["rotor"] == 3


def test_an_effect_from_the_start_is_not_dated(failing: tuple[Data, Point]) -> None:
    data, point = failing
    candidate = Candidate("torque_scale", (), ("scale",))
    fitted = Fitted(point, (candidate,), 0.0, None, np.zeros(0))  # type: ignore[arg-type]
    assert date(data, fitted, candidate) == (fitted, candidate)


def test_noise_is_chosen_anew_as_for_a_flight_seen_first() -> None:
    data = Data([flight_of(fly(seconds=5.0), DRONE)])
    data.settle(Point(DRONE, {}, start_noise()))
    white = data.fit_noise(Point(DRONE, {}, start_noise()))
    first = with_torque_memory(data, white)
    again = with_torque_memory_refit(data, first)
    assert again.noise.memory == first.noise.memory
    assert data.loglik(again) == pytest.approx(data.loglik(first), abs=3.0)


INERTIA = Candidate("inertia", (), ("xx", "yy", "zz"))
LAG = Candidate("motor_lag", (), ("time_constant",))


def with_free(data: Data, candidate: Candidate) -> tuple[Point, Fitted]:
    """The nominal model and one with an effect fitted."""
    point = nominal(data, Point(DRONE, {}, start_noise()))
    begun = point.with_effects({candidate.effect: candidate.neutral(point)})
    return point, refine_base(data, begun, [candidate], rounds=3)


@pytest.mark.slow
def test_an_inertia_that_a_vibration_speaks_for_is_another_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts, "unlogged_share", lambda flights, vehicle: 0.0)  # else the inertia is doubted before
    monkeypatch.setattr(facts, "interval", lambda flight: 2e-3)  # as if all commands of the loop were logged
    data = Data([flight_of(fly(vibration=4.0, seconds=20.0), DRONE)])
    point, fitted = with_free(data, INERTIA)
    assert peaks(data.models[0], point)
    said: list[str] = []
    assert vibration_look_alikes(data, point, fitted, [INERTIA], said.append) == {"inertia"}
    assert "inertia" in said[0]


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.08, 0.1])
def test_a_lag_that_makes_its_loop_swing_is_the_same_beside_the_hump(lag: float) -> None:
    """Twice as slow as the file says, and more: humps at 2 Hz, and nothing that vibrates."""
    slow = fly(vehicle=replace(DRONE, motor_time_constant=lag), seconds=20.0)
    data = Data([flight_of(slow, DRONE)])
    point, fitted = with_free(data, LAG)
    assert peaks(data.models[0], point)
    assert fitted.point.effects["motor_lag"]["time_constant"] == pytest.approx(lag, rel=0.1)
    assert not vibration_look_alikes(data, point, fitted, [LAG], lambda text: None)


@pytest.mark.slow
@pytest.mark.parametrize("torque", [0.8, 0.74, 0.66])  # of the flight held out; with the last there is a bound
def test_what_an_effect_would_gain_fitted_to_both_flights_is_the_top_of_their_likelihood(torque: float) -> None:
    """Against the likelihood of both at a number of sizes, what is always free fitted to each flight alone."""
    candidate = Candidate("torque_scale", (), ("scale",))
    flown = fly(Hidden(torque=0.8), seconds=5, seed=5), fly(Hidden(torque=torque), seconds=10, seed=15)
    data, apart = (Data([flight_of(f, DRONE)]) for f in flown)
    point = nominal(data, Point(DRONE, {}, start_noise()))
    begun = point.with_effects({"torque_scale": {"scale": 0.95}})
    fitted = refine_base(data, begun, [candidate], noise=False)
    here = fitted.point.effects["torque_scale"]["scale"]

    def both(scale: float) -> float:
        there = fitted.point.with_effects({"torque_scale": {"scale": scale}})
        return sum(held_out_fit(d, there, [candidate]).loglik for d in (data, apart))

    wanted = max(both(here + d) for d in np.linspace(-0.14, 0.05, 20)) - both(here)
    there = held_out_fit(apart, fitted.point, [candidate])
    assert joint_gain(fitted, apart, there, [candidate])[0] == pytest.approx(wanted, rel=0.1, abs=0.1)


def test_noise_belongs_to_a_flight_and_does_not_decide_between_two_names() -> None:
    """One explanation under two noises, as two fits end with: on flights held out it is one."""
    candidate = Candidate("torque_scale", (), ("scale",))
    data, apart = (Data([flight_of(fly(Hidden(torque=0.8), seconds=6, seed=seed), DRONE)]) for seed in (5, 7))
    point = nominal(data, Point(DRONE, {}, start_noise()))
    begun = point.with_effects({"torque_scale": {"scale": 0.9}})
    fitted = refine_base(data, begun, [candidate], rounds=3)
    noise = fitted.point.noise
    louder = replace(fitted, point=replace(fitted.point, noise=replace(noise, impulse=1.3 * noise.impulse)))
    trial = Trial(candidate, 0.0, 0.0, 1.0, 0.0, 0.0, fitted=fitted)
    fits, basis = (fitted, louder), Basis(data, apart, point, (), 0.0, 0.0)
    shared = [compared(basis, trial, data, f) for f in fits]
    assert abs(shared[0].held_out - shared[1].held_out) > 3.0
    basis = with_held_out_by(basis, trial)
    own = [compared(basis, trial, data, f) for f in fits]
    assert own[0].held_out == pytest.approx(own[1].held_out, abs=0.3)
    assert own[0].value == pytest.approx(own[1].value, abs=0.3)
    assert basis.held_value == pytest.approx(held_out_fit(basis.held_out, point, ()).loglik)
    assert own[0].held_out > 10.0  # 20 % of torque in six seconds


def test_noise_stays_where_a_file_has_a_trim() -> None:
    vehicle = replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}})
    point = Point(vehicle, dict(vehicle.effects), start_noise())
    data = Data([flight_of(fly(seconds=5.0), DRONE)])
    assert same_noise(held_out_twin(data, point, ()), point)
    plain = Point(DRONE, {}, start_noise())
    assert not same_noise(held_out_twin(data, plain, ()), plain)
    assert data.own is None


def same_noise(data: Data, point: Point) -> bool:
    assert data.own is not None
    return all(np.array_equal(a, b) for a, b in zip(*(astuple(x.noise) for x in (data.own, point)), strict=True))
