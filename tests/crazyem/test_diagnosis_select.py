"""Turns of the selection: onsets in mid-flight, what is taken, and noise of flights; in closed loop made elsewhere."""

from dataclasses import astuple, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, INERTIA, LAG, TORQUE, WIND, data_of, nominal_of, rotor, silent, start_point

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted, nominal, with_torque_memory, with_torque_memory_refit
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import held_out_fit, held_out_twin, nuisances, refine_base, with_nuisances
from crazyem.diagnosis.locating.random_torques import peaks
from crazyem.diagnosis.naming import prune, starting_points
from crazyem.diagnosis.naming import select as selecting
from crazyem.diagnosis.naming.evidence import joint_gain
from crazyem.diagnosis.naming.select import (
    Basis,
    compared,
    constrained_step,
    hid_another,
    linear_trials,
    select,
    step_of,
    with_held_out_by,
)
from crazyem.diagnosis.naming.starting_points import ONSET, date, onset_of
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.workers import Workers

ONSET_TIME = 4.37  # s


@pytest.fixture(scope="module")
def failing() -> tuple[Data, Point]:
    """A rotor loses a tenth in flight, and the nominal model of it."""
    data = data_of(fly(Hidden(thrust=(1, 1, 0.9, 1), onset=ONSET_TIME), seconds=8.0))
    return data, nominal(data, start_point())


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
    """What is steady the balance tells (`balance.py`)."""
    trimmed = replace(DRONE, effects={"trim": {"x": 1e-4, "y": -2e-4, "z": 3e-4}})
    data = data_of(fly(Hidden(thrust=(1, 1, 0.9, 1), onset=ONSET_TIME), seconds=8.0), vehicle=trimmed)
    point = nominal(data, Point(trimmed, {n: dict(v) for n, v in trimmed.effects.items()}, start_noise()))
    candidates = [Candidate("rotor_fault", (("rotor", r), (ONSET, None)), ("scale",)) for r in (1, 2, 3, 4)]
    asked = [t.candidate for t, _ in linear_trials(data, point, (), candidates)]
    assert all(dict(c.fixed)[ONSET] is not None for c in asked)
    assert dict(asked[0].fixed)["rotor"] == 3


def test_an_effect_from_the_start_is_not_dated(failing: tuple[Data, Point]) -> None:
    data, point = failing
    candidate = TORQUE
    fitted = Fitted(point, (candidate,), 0.0, None, np.zeros(0))
    assert date(data, fitted, candidate) == (fitted, candidate)


def test_noise_is_chosen_anew_as_for_a_flight_seen_first() -> None:
    data = data_of(fly(seconds=5.0))
    data.settle(start_point())
    white = data.fit_noise(start_point())
    first = with_torque_memory(data, white)
    again = with_torque_memory_refit(data, first)
    assert again.noise.memory == first.noise.memory
    assert data.loglik(again) == pytest.approx(data.loglik(first), abs=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("torque", [0.8, 0.74, 0.66])  # of the flight held out; with the last there is a bound
def test_what_an_effect_would_gain_fitted_to_both_flights_is_the_top_of_their_likelihood(torque: float) -> None:
    """Against the likelihood of both at a number of sizes, what is always free fitted to each flight alone."""
    candidate = TORQUE
    flown = fly(Hidden(torque=0.8), seconds=5, seed=5), fly(Hidden(torque=torque), seconds=10, seed=15)
    data, apart = (data_of(f) for f in flown)
    point = nominal(data, start_point())
    begun = point.with_effects({"torque_scale": {"scale": 0.95}})
    fitted = refine_base(data, begun, [candidate], noise=False)
    here = fitted.point.effects["torque_scale"]["scale"]

    def both(scale: float) -> float:
        there = fitted.point.with_effects({"torque_scale": {"scale": scale}})
        return sum(held_out_fit(d, there, [candidate]).loglik for d in (data, apart))

    wanted = max(both(here + d) for d in np.linspace(-0.14, 0.05, 20)) - both(here)
    there = held_out_fit(apart, fitted.point, [candidate])
    assert joint_gain(fitted, apart, there, [candidate]).gain == pytest.approx(wanted, rel=0.1, abs=0.1)


def test_noise_belongs_to_a_flight_and_does_not_decide_between_two_names() -> None:
    """One explanation under two noises, as two fits end with: on flights held out it is one."""
    candidate = TORQUE
    data, apart = (data_of(fly(Hidden(torque=0.8), seconds=6, seed=seed)) for seed in (5, 7))
    point = nominal(data, start_point())
    begun = point.with_effects({"torque_scale": {"scale": 0.9}})
    fitted = refine_base(data, begun, [candidate], rounds=3)
    noise = fitted.point.noise
    louder = replace(fitted, point=replace(fitted.point, noise=replace(noise, impulse=1.3 * noise.impulse)))
    trial = Trial(candidate, 0.0, 0.0, 1.0, 0.0, fitted=fitted)
    fits, basis = (fitted, louder), Basis(data, apart, point, (), 0.0, 0.0)
    shared = [compared(basis, trial, data, f) for f in fits]
    assert abs(shared[0].held_out - shared[1].held_out) > 3.0
    basis = with_held_out_by(basis, trial)
    own = [compared(basis, trial, data, f) for f in fits]
    assert own[0].held_out == pytest.approx(own[1].held_out, abs=0.3)
    assert own[0].value == pytest.approx(own[1].value, abs=0.3)
    assert basis.held_value == pytest.approx(held_out_fit(basis.held_out, point, ()).loglik)
    assert own[0].held_out > 10.0  # 20 % of torque in six seconds


def test_a_fitted_trial_is_admissible_from_its_detection_limit_on_and_blocks_of_its_flight_confirm_nothing() -> None:
    candidate = TORQUE
    data, point = nominal_of(fly(Hidden(torque=0.8), seconds=5))
    fitted = refine_base(data, point.with_effects({"torque_scale": {"scale": 0.9}}), [candidate], noise=False)
    small = replace(fitted, point=fitted.point.with_effects({"torque_scale": {"scale": 0.999}}))
    basis, linear = Basis(data, None, point, (), 0.0, 0.0), Trial(candidate, 40.0, 33.0, 1.0, 39.0)
    for fit, admissible in ((fitted, True), (small, False)):
        found = compared(basis, linear, data, fit)
        assert found.admissible is admissible
        assert (found.held_out, found.expected) == (33.0, 0.0)


@pytest.mark.parametrize(
    ("changed", "held_out", "taken"),
    [
        ({}, False, True),  # improbable with 9 nats; `prune` judges that in the end, beside all others
        ({"gain": 8.5}, False, False),
        ({"gain": 45.0, "dispersion": 5.5}, False, False),
        ({"gain": 500.0, "admissible": False}, False, False),
        ({"gain": 500.0, "fitted": None, "admissible": False}, False, False),  # a fit that diverged
        ({"gain": 500.0, "held_out": -495.0}, False, True),  # blocks of the fitted flights do not count again
        ({"gain": 500.0, "held_out": -495.0}, True, False),
        ({"gain": 5.0, "held_out": 5.0}, True, True),
    ],
)
def test_the_best_is_taken_if_it_exceeds_its_limit_and_has_eight_nats(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], held_out: bool, taken: bool
) -> None:
    """Less a nat for its parameter."""
    fitted: Any = SimpleNamespace()
    best = replace(Trial(LAG, 10.0, 0.0, 1.0, 99.0, fitted, True), **changed)
    monkeypatch.setattr(selecting, "fitted_trial", lambda basis, trial, solution, *, say: trial)
    data: Any = SimpleNamespace(workers=Workers(1))
    apart: Any = SimpleNamespace() if held_out else None
    basis = Basis(data, apart, start_point(), (), 0.0, 0.0)
    linear: Any = [(best, None), (Trial(INERTIA, 1.0, 0.0, 1.0, -2.0), None)]
    step = step_of(basis, linear, say=silent)
    assert (step.taken and step.taken.candidate) == (LAG if taken else None)
    assert [t.candidate for t in step.trials] == [LAG, INERTIA]
    assert step.alike == ()


# Nats of sets of effects on fitted and on held-out flights. A drag and a lag are real. A wind takes up both on the
# fitted flights, but not on the others, and beside it the lag brings nothing.
HIDING = {
    (): (0.0, 0.0),
    ("wind",): (400.0, 100.0),
    ("linear_drag",): (300.0, 150.0),
    ("motor_lag",): (150.0, 140.0),
    ("linear_drag", "wind"): (440.0, 150.0),
    ("motor_lag", "wind"): (404.0, 90.0),
    ("linear_drag", "motor_lag"): (430.0, 280.0),
    ("linear_drag", "motor_lag", "wind"): (444.0, 140.0),
}
EXPECTED = {"wind": 140.0, "linear_drag": 50.0, "motor_lag": 130.0}  # of real effects of these sizes, on the latter


@pytest.mark.parametrize("before", [{}, {"gyro_bias": "not determined: as it was"}])
def test_after_a_wrong_effect_is_left_out_what_it_had_hidden_is_found(
    monkeypatch: pytest.MonkeyPatch, before: dict[str, str]
) -> None:
    """Fits that are no more than log-likelihoods; turns, the end of the search and elimination are the real ones."""

    def nats(point: Point) -> Any:
        return np.array(HIDING[tuple(sorted(point.effects))])

    def fit(data: Any, point: Point, accepted: Any, **more: Any) -> Any:
        point = replace(point, effects={c.effect: point.effects.get(c.effect, {}) for c in accepted})
        return SimpleNamespace(point=point, loglik=nats(point)[0], candidates=tuple(accepted))

    def linear(data: Any, point: Point, accepted: Any, candidates: Any) -> Any:
        asked.append([c.effect for c in candidates])
        gains = [nats(point.with_effects({c.effect: {}}))[0] - nats(point)[0] for c in candidates]
        return sorted(
            ((Trial(c, g, 0.0, 1.0, g - 1.0), None) for c, g in zip(candidates, gains, strict=True)),
            key=lambda entry: -entry[0].evidence,
        )

    def fitted_trial(basis: Basis, trial: Trial, solution: Any, *, say: Any) -> Trial:
        fitted = fit(basis.data, basis.point, [*basis.accepted, trial.candidate])
        gain, held = nats(fitted.point) - nats(basis.point)
        return replace(trial, gain=gain, held_out=held, fitted=fitted, admissible=True, value=gain, blocks=np.zeros(9))

    def held_without(data: Any, held_out: Any, fitted: Any, accepted: Any, trial: Trial) -> tuple[Any, float]:
        less = fit(data, fitted.point, [c for c in accepted if c is not trial.candidate])
        return less, nats(less.point)[1]

    asked: list[list[str]] = []
    monkeypatch.setattr(selecting, "linear_trials", linear)
    monkeypatch.setattr(selecting, "best_starting_points", lambda data, point, accepted, candidates: candidates)
    monkeypatch.setattr(selecting, "fitted_trial", fitted_trial)
    monkeypatch.setattr(selecting, "constrained_basis", lambda basis, candidate: basis)
    for module in (selecting, starting_points):
        monkeypatch.setattr(module, "held_out_value", lambda held_out, point, accepted: (held_out, nats(point)[1]))
        monkeypatch.setattr(module, "refine_with_memory", fit)
    monkeypatch.setattr(starting_points, "date", lambda data, fitted, candidate: (fitted, candidate))
    monkeypatch.setattr(prune, "refine_base", fit)
    monkeypatch.setattr(prune, "held_out_twin", lambda held_out, point, accepted: held_out)
    monkeypatch.setattr(prune, "held_out_fit", lambda held, point, accepted: SimpleNamespace(loglik=nats(point)[1]))
    monkeypatch.setattr(prune, "_fit_without", held_without)
    monkeypatch.setattr(prune, "_expected", lambda held_out, fitted, accepted, t: EXPECTED[t.candidate.effect])
    monkeypatch.setattr(prune, "dispersion_of", lambda fitted, count, *, offset: 1.0)
    data: Any = SimpleNamespace(workers=Workers(1), loglik=lambda point, passes: nats(point)[0])
    apart: Any = SimpleNamespace()
    point = start_point()
    begun = Selection(point, point, (), (), fit(data, point, ()), before)
    said: list[str] = []
    found = select(data, point, [LAG, DRAG, WIND], held_out=apart, begun=begun if before else None, say=said.append)
    assert [text.split()[1] for text in said if "  found" in text] == ["wind:", "linear_drag:", "motor_lag:"]
    assert found.accepted == (DRAG, LAG)
    assert found.left_out.keys() == {*before, "wind"}
    assert found.left_out["wind"].startswith("not determined: the flights make it probable with")
    assert found.left_out | before == found.left_out
    assert asked == [
        ["motor_lag", "linear_drag", "wind"],
        ["motor_lag", "linear_drag"],
        ["motor_lag"],
        ["motor_lag"],  # without the wind
        [],
    ]
    # the turns of both searches: that in which the wind was taken, and the end of the first, took nothing in the end
    assert [s.taken and s.taken.candidate.effect for s in found.steps] == [
        None,
        "linear_drag",
        None,
        "motor_lag",
        None,
    ]
    assert found.orders() == [1, 2]
    judged = [(s.taken.gain, s.taken.held_out) for s in found.steps if s.taken]
    assert judged == [(280.0, 140.0), (130.0, 130.0)]  # beside each other


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.08, 0.1])
def test_a_lag_that_makes_its_loop_swing_is_as_long_as_it_is(lag: float) -> None:
    """Twice as slow as the file says, and more: humps at 2 Hz, and nothing that vibrates."""
    data, point = nominal_of(fly(vehicle=replace(DRONE, motor_time_constant=lag), seconds=20.0))
    assert peaks(data.models[0], point)
    fitted = refine_base(data, point.with_effects({"motor_lag": LAG.neutral(point)}), [LAG], rounds=3)
    assert fitted.point.effects["motor_lag"]["time_constant"] == pytest.approx(lag, rel=0.1)


def test_noise_stays_where_a_file_has_a_trim() -> None:
    vehicle = replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}})
    point = Point(vehicle, dict(vehicle.effects), start_noise())
    data = data_of(fly(seconds=5.0))
    assert same_noise(held_out_twin(data, point, ()), point)
    plain = start_point()
    assert not same_noise(held_out_twin(data, plain, ()), plain)
    assert data.own is None


def same_noise(data: Data, point: Point) -> bool:
    assert data.own is not None
    return all(np.array_equal(a, b) for a, b in zip(*(astuple(x.noise) for x in (data.own, point)), strict=True))


def test_the_search_goes_on_only_if_an_effect_that_is_gone_may_have_hidden_another() -> None:
    """Nothing can come to light where the last effect goes and had no rival."""
    drag, lag, wind = (
        Trial(Candidate(name, (), ("x",)), 50.0, 20.0, 1.0, 69.0, admissible=True)
        for name in ("linear_drag", "motor_lag", "wind")
    )
    weak = replace(wind, gain=3.0, held_out=0.0)
    first, last, end = Step((drag, weak), drag), Step((lag, weak), lag), Step((weak,), None)
    assert not hid_another((first, last, end), set(), counted=True)
    assert not hid_another((first, last, end), {"motor_lag"}, counted=True)
    assert not hid_another((first, last, end), {"linear_drag", "motor_lag"}, counted=True)
    assert hid_another((first, last, end), {"linear_drag"}, counted=True)  # the lag was found beside it
    assert hid_another((first, replace(last, trials=(lag, wind)), end), {"motor_lag"}, counted=True)


def test_rivals_of_an_effect_that_is_a_nuisance_too_are_tried_without_this_nuisance() -> None:
    """A drag of 0.05 N s/m, with a file of one drone, in which a usual drag is free: a quadratic one explains most."""
    vehicle = replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}})
    data = data_of(fly(Hidden(drag=(0.05, 0.05, 0.05)), seconds=8.0), vehicle=vehicle)
    point = nominal(data, Point(vehicle, dict(vehicle.effects), start_noise()))
    fitted = refine_base(data, point, ())
    basis = Basis(data, None, fitted.point, (), fitted.loglik, 0.0)
    asked = [Candidate(name, (), ("x", "y", "z")) for name in ("linear_drag", "quadratic_drag")]
    linear = linear_trials(data, fitted.point, (), asked)
    alone = {t.candidate.effect: t for t in step_of(basis, linear, say=silent).trials}
    step = constrained_step(basis, linear, asked, say=silent)
    found = {t.candidate.effect: t for t in step.trials}
    assert step.taken is found["linear_drag"]
    assert {t.constrained for t in found.values()} == {frozenset({"linear_drag"})}
    assert alone["quadratic_drag"].gain < 0.2 * alone["linear_drag"].gain
    assert 0.5 * found["linear_drag"].gain < found["quadratic_drag"].gain < found["linear_drag"].gain


def test_a_candidate_in_the_place_of_another_is_fitted_where_the_other_is_neutral() -> None:
    """By the linear approximation: there the likelihood has no slope, to what two passes of the filter differ by."""
    data = data_of(fly(Hidden(torque=0.8), seconds=6.0))
    scale, wind = TORQUE, WIND
    point = nominal(data, start_point()).with_effects({"torque_scale": {"scale": 0.8}})
    data.settle(point)
    ((_, solution),) = linear_trials(data, point, (scale,), [wind], instead_of=scale)
    free = nuisances(data, point, (scale,))
    at = with_nuisances(point, free)
    columns = [x for c in (scale, *(c for c, _ in free), wind) for x in c.columns(at)]
    score, information = data.gram(at, columns).total(range(len(columns)))
    assert solution.theta[0] == pytest.approx(0.2)
    np.testing.assert_allclose((score - information @ solution.theta)[-3:], 0.0, atol=1e-3 * np.abs(score[-3:]).max())


# -- since when an effect is there -------------------------------------------------------------------------------------


def onset_found(hidden: Hidden) -> Candidate | None:
    data, point = nominal_of(fly(hidden, seconds=9.0, seed=5))
    return onset_of(data, point, rotor(2), data.gram(point, rotor(2).columns(point)), [0])


@pytest.mark.parametrize("onset", [5.3, 5.7, 5.9])
def test_a_rotor_that_weakens_within_a_block(onset: float) -> None:
    late = onset_found(Hidden(thrust=(1.0, 0.88, 1.0, 1.0), onset=onset))
    assert dict(late.fixed)["rotor"] == 2
    assert dict(late.fixed)[ONSET] == pytest.approx(onset, abs=0.1)


def test_a_rotor_that_is_weak_from_the_start() -> None:
    assert onset_found(Hidden(thrust=(1.0, 0.88, 1.0, 1.0))) is None
