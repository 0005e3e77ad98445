"""What is left out again because it is improbable beside the others, and what is too small for a finding."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, TORQUE, data_of, start_point

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import held_out_fit, refine_base
from crazyem.diagnosis.naming import prune
from crazyem.diagnosis.naming.select import at_linear_size, shortlist
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.diagnosis.workers import Workers

POINT = start_point()
TRIMMED = replace(DRONE, effects={"trim": dict.fromkeys("xyz", 0.0)})  # a drag is free in every fit with such a file


@pytest.mark.slow
@pytest.mark.parametrize(
    ("candidate", "hidden", "vehicle", "begin", "reach"),
    [
        # what is always free stays within its bounds
        (TORQUE, Hidden(torque=0.85), DRONE, {"scale": 0.95}, 0.2),
        (DRAG, Hidden(drag=(0.05, 0.05, 0.05)), TRIMMED, dict.fromkeys("xyz", 0.02), 0.5),
    ],
)
def test_what_is_expected_on_flights_held_out_is_what_their_likelihood_would_lose(
    candidate, hidden, vehicle, begin, reach
):
    """Against the curve of the likelihood held out over the size of the effect, what is always free fitted to each."""
    data, apart = (data_of(fly(hidden, seconds=s, seed=s), vehicle=vehicle) for s in (6, 14))
    point = nominal(data, Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, start_noise()))
    fitted = refine_base(data, point.with_effects({candidate.effect: begin}), [candidate], noise=False)
    here, neutral = (f(fitted.point) for f in (candidate.values, candidate.neutral))
    sizes = 1.0 + np.linspace(-reach, reach, 7)  # over that of the fit
    points = [
        fitted.point.with_effects({candidate.effect: {n: neutral[n] + s * (here[n] - neutral[n]) for n in begin}})
        for s in sizes
    ]
    fixed = apart.constraining(candidate.effect) if candidate is DRAG else apart  # as in the fit without it
    values = [held_out_fit(fixed, p, [candidate]).loglik for p in points]
    wanted = -0.5 * np.polynomial.Polynomial.fit(sizes, values, 2).deriv(2)(1.0)
    found = prune._expected(apart, fitted, [candidate], Trial(candidate, 0.0, 0.0, 1.0, 0.0))
    # Bounds of what is always free and terms of second order are left out. The value tells a flight that can answer
    # from one that cannot, for which a factor of two does.
    assert wanted / 2 < found < wanted * 2


def test_a_drag_is_expected_to_gain_against_none_of_it_not_against_a_usual_one(monkeypatch):
    """Free in every fit, it is held at none where it is the question; other nuisances are free without the effect."""
    apart = data_of(fly(seconds=6.0), vehicle=TRIMMED)
    drag = {"linear_drag": dict.fromkeys("xyz", 0.05)}
    fitted = SimpleNamespace(point=Point(TRIMMED, {**TRIMMED.effects, **drag}, start_noise()))
    drag = Trial(DRAG, 0.0, 0.0, 1.0, 0.0)
    found = prune._expected(apart, fitted, [DRAG], drag)
    assert found == pytest.approx(prune._expected(apart.constraining("linear_drag"), fitted, [DRAG], drag))
    assert not apart.constrained
    monkeypatch.setattr(prune, "can_be_finding", lambda candidate: False)
    assert prune._expected(apart, fitted, [DRAG], drag) < 0.9 * found
    rival = replace(drag, constrained=frozenset({"linear_drag"}))  # what took the place of this nuisance, likewise
    assert prune._expected(apart, fitted, [DRAG], rival) == pytest.approx(found, rel=1e-3)


def selection_of(*trials, point=POINT):
    steps = (*(Step((t,), t, (trial("wind"),)) for t in trials), Step((), None))
    return Selection(POINT, point, steps, tuple(t.candidate for t in trials), SimpleNamespace(point=point))


def trial(effect, free=("mass",), **more):
    """An effect of which flights said nothing when it was taken."""
    return Trial(Candidate(effect, (), free), 0.0, 0.0, 1.0, 0.0, **more)


@pytest.fixture
def pruned(monkeypatch):
    """`prune.pruned` with fits that are no more than log-likelihoods, and what it said.

    `lost(accepted, candidate)`: nats on fitted and on held-out flights that go with an effect. `expected`: of held-out
    flights. `without`: effect -> the model where it is left out.
    """

    def of(selection, lost, *, expected=0.0, held_out=True, without=None):
        def fit_without(data, held_out, fitted, accepted, trial):
            candidate = trial.candidate
            nats, held = lost(accepted, candidate)
            return SimpleNamespace(point=(without or {}).get(candidate.effect, POINT), loglik=-nats), -held

        said, settled = [], [selection.final]
        monkeypatch.setattr(prune, "_fit_without", fit_without)
        monkeypatch.setattr(prune, "_expected", lambda *a: expected)
        monkeypatch.setattr(prune, "dispersion_of", lambda *a, **k: 1.0)
        monkeypatch.setattr(prune, "held_out_twin", lambda held_out, point, accepted: held_out)
        monkeypatch.setattr(prune, "held_out_fit", lambda *a: SimpleNamespace(loglik=0.0))
        monkeypatch.setattr(
            prune, "refine_base", lambda data, point, accepted: settled.append(point) or SimpleNamespace(point=point)
        )
        data = SimpleNamespace(loglik=lambda point, passes: 0.0, settle=settled.append, workers=Workers(1))
        found = prune.pruned(data, selection, SimpleNamespace() if held_out else None, said.append)
        assert [s.taken.candidate for s in found.steps if s.taken] == list(found.accepted)
        assert found.fitted.point is found.final is settled[-1]
        gone = [c.effect for c in selection.accepted if c not in found.accepted]
        assert sorted(found.left_out) == sorted([*selection.left_out, *gone])
        assert all(text.startswith("not determined: the flights make it") for text in found.left_out.values())
        assert sorted(text.rpartition(": ")[2] for text in said) == sorted(gone)
        for before, after in zip(selection.steps, found.steps, strict=True):  # what a turn compared stays known
            assert after.trials is before.trials
            assert after.alike == (before.alike if after.taken else ())
        return found, [text.rpartition(": ")[2] for text in said]

    return of


@pytest.mark.parametrize(
    ("slope", "said", "left"),
    [
        (-0.9, ["linear_drag"], ["thrust_scale", "thrust_curve"]),
        (-0.5, ["thrust_scale", "linear_drag"], ["thrust_curve"]),
    ],
)
def test_what_holds_another_within_its_range_stays_and_the_next_is_asked(pruned, slope, said, left):
    """A thrust scale brings too little, but without it a thrust curve goes on to where commands are not heeded."""
    scale, curve = trial("thrust_scale", ("scale",)), trial("thrust_curve", ("slope_error",))
    drag = trial("linear_drag", ("x",))
    both = POINT.with_effects({"thrust_scale": {"scale": 0.8}, "thrust_curve": {"slope_error": -0.4}})
    alone = POINT.with_effects({"thrust_curve": {"slope_error": slope}})
    lost = {scale.candidate: 5.0, drag.candidate: 10.0, curve.candidate: 300.0}
    found, gone = pruned(
        selection_of(scale, drag, curve, point=both),
        lambda accepted, c: (lost[c], 0.0),
        held_out=False,
        without={"thrust_scale": alone, "linear_drag": both if slope == -0.9 else alone},
    )
    assert gone == said
    assert [c.effect for c in found.accepted] == left
    assert found.final is (both if slope == -0.9 else alone)


ALONE, SECOND = (  # nats from which an effect is more likely than not, as the first and as the second that was found
    np.exp((np.log(order) * CONFIDENCE.order_power - CONFIDENCE.intercept) / CONFIDENCE.gain_power) - 1.0
    for order in (1, 2)
)
BETWEEN = np.sqrt(ALONE * SECOND)


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (1.1 * ALONE, 1.1 * SECOND, []),
        (0.5 * ALONE, BETWEEN, ["payload"]),  # the second is the only one then
        (1.1 * BETWEEN, BETWEEN, ["linear_drag"]),
        (BETWEEN, 1.1 * BETWEEN, ["linear_drag"]),  # the first is likely enough for a first
        (0.5 * ALONE, 0.4 * ALONE, ["linear_drag", "payload"]),
        (0.4 * ALONE, 0.5 * ALONE, ["payload", "linear_drag"]),  # whatever was found first
    ],
)
def test_the_least_probable_goes_first_and_the_others_are_with_conditional_gains(pruned, first, second, said):
    load, drag = trial("payload"), trial("linear_drag", ("x",))
    lost = {load.candidate: first, drag.candidate: second}
    _, gone = pruned(selection_of(load, drag), lambda accepted, c: (lost[c], 0.0), held_out=False)
    assert gone == said


@pytest.mark.parametrize(
    ("expected", "held", "kept"),
    [(0.0, -25.0, True), (1.0, -25.0, True), (50.0, 50.0, True), (50.0, 0.0, False), (50.0, -50.0, False)],
)
def test_flights_held_out_are_asked_where_they_can_answer(pruned, expected, held, kept):
    """An effect that brings 100 nats where it was fitted, and `held` where a real one brings `expected`.

    A flight that cannot show it does not speak against it: hovers have biases of their own.
    """
    drag = trial("linear_drag", ("x", "y", "z"))
    found, _ = pruned(selection_of(drag), lambda accepted, c: (100.0, held), expected=expected)
    assert found.accepted == ((drag.candidate,) if kept else ())
    taken = found.steps[0].taken
    if kept:  # the probability of an effect is that in the final model
        assert (taken.gain, taken.held_out, taken.expected, taken.dispersion) == (100.0, held, expected, 1.0)


@pytest.mark.parametrize(("nats", "kept"), [(1.1 * ALONE, True), (0.9 * ALONE, False)])
@pytest.mark.parametrize("held", [-60.0, 60.0])
def test_without_flights_held_out_blocks_of_the_fitted_ones_say_nothing(pruned, nats, kept, held):
    drag = replace(trial("linear_drag", ("x",)), held_out=held)
    found, _ = pruned(selection_of(drag), lambda accepted, c: (nats, 7.0), held_out=False)
    assert found.steps[0].taken == (replace(drag, gain=nats) if kept else None)


def test_what_no_flight_needs_goes_before_what_one_speaks_against(pruned):
    """A payload of no mass beside a load on a string, which a hover does not confirm while the payload is there."""
    payload, load = trial("payload"), trial("suspended_load")

    def lost(accepted, candidate):
        return (2.0, 0.0) if candidate is payload.candidate else (200.0, 300.0 if len(accepted) == 1 else -280.0)

    found, said = pruned(selection_of(payload, load), lost, expected=280.0)
    assert found.accepted == (load.candidate,)
    assert said == ["payload"]


def test_reasons_of_an_earlier_search_stay_and_a_new_one_says_how_improbable_an_effect_is(pruned):
    drag = trial("linear_drag", ("x",))
    reason = "not determined: the flights make it probable with {:.2g} only"
    selection = replace(selection_of(drag), left_out={"wind": reason.format(0.1)})
    found, _ = pruned(selection, lambda accepted, c: (20.0, 0.0))
    odds = np.exp(CONFIDENCE.intercept) * 21.0**CONFIDENCE.gain_power
    assert found.left_out == {"wind": reason.format(0.1), "linear_drag": reason.format(odds / (1.0 + odds))}


def test_what_the_balance_decides_stays_and_so_does_a_trim(pruned):
    """Neither the filter's likelihood nor its odds count for them. The other effect is found after none or one."""
    for kept in (trial("rotor_fault", ("scale",), log_odds=-3.0), trial("trim", ("x",))):
        drag = trial("linear_drag", ("x",))
        for nats, left in ((3.0, (kept.candidate,)), (500.0, (kept.candidate, drag.candidate))):
            lost = {kept.candidate: 0.0, drag.candidate: nats}
            found, _ = pruned(selection_of(kept, drag), lambda accepted, c, lost=lost: (lost[c], 0.0))
            assert found.accepted == left


def test_an_effect_whose_onset_was_dated_later_is_left_out_of_the_fit_without_it(monkeypatch):
    tried = trial("rotor_fault", ("scale",))
    dated = replace(tried.candidate, fixed=(("onset_time", 3.0),))
    selection = replace(selection_of(tried), accepted=(dated,))
    fitted = SimpleNamespace(point=POINT)
    rests = []
    monkeypatch.setattr(
        prune, "refine_base", lambda data, point, rest, **k: rests.append(list(rest)) or SimpleNamespace(loglik=-5.0)
    )
    monkeypatch.setattr(prune, "dispersion_of", lambda *a, **k: 1.0)
    data = SimpleNamespace(loglik=lambda point, passes: 0.0, twin=lambda: None, workers=Workers(1))
    found, _ = prune.with_conditional_gains(data, None, replace(selection, fitted=fitted))
    assert rests == [[]]
    assert found.steps[0].taken.gain == 5.0


def test_each_effect_is_judged_beside_all_the_others(monkeypatch):
    """By the fit without it, and by the scatter of its own parameters."""
    drag, scale = trial("linear_drag", ("x", "y", "z")), trial("thrust_scale", ("scale",))
    bare = {c: (SimpleNamespace(loglik=-nats), -held) for c, nats, held in (
        (drag.candidate, 30.0, 20.0), (scale.candidate, 700.0, 90.0))}  # fmt: skip
    columns = []
    monkeypatch.setattr(prune, "_fit_without", lambda data, held_out, fitted, accepted, t: bare[t.candidate])
    monkeypatch.setattr(prune, "_expected", lambda held_out, fitted, accepted, t: 10.0 * len(t.candidate.free))
    monkeypatch.setattr(prune, "held_out_fit", lambda *a: SimpleNamespace(loglik=4.0))
    monkeypatch.setattr(
        prune, "dispersion_of", lambda fitted, count, *, offset: columns.append((count, offset)) or 1.0 + count
    )
    data = SimpleNamespace(loglik=lambda point, passes: 1.0, workers=Workers(1))
    found, without = prune.with_conditional_gains(data, SimpleNamespace(), selection_of(drag, scale))
    assert without == [bare[drag.candidate][0], bare[scale.candidate][0]]
    assert columns == [(3, 0), (1, 3)]
    judged = [(s.taken.gain, s.taken.held_out, s.taken.expected, s.taken.dispersion) for s in found.steps[:-1]]
    assert judged == [(31.0, 24.0, 30.0, 4.0), (701.0, 94.0, 10.0, 2.0)]
    assert found.steps[-1].taken is None
    assert found.accepted == (drag.candidate, scale.candidate)


def entry(effect, gain):
    free = ("inertia",) if effect == "rotor_inertia" else ("x",)
    return Trial(Candidate(effect, (), free), gain, 0.0, 1.0, gain - 1.0), None


def test_torques_and_inertias_are_fitted_together_or_not_at_all():
    linear = [entry("torque_scale", 100.0), entry("linear_drag", 50.0), entry("inertia", 3.0)]
    assert shortlist(linear) == linear
    assert shortlist(linear[1:]) == linear[1:2]


def test_heavy_rotors_are_fitted_beside_a_damping_from_where_they_are_heavy():
    damping, drag, rotors = entry("rate_damping", 200.0), entry("linear_drag", 50.0), entry("rotor_inertia", 0.0)
    *_, (trial, _) = shortlist([damping, drag, rotors])
    assert trial.candidate.effect == "rotor_inertia"
    begun = at_linear_size(POINT, trial.candidate, SimpleNamespace(theta=np.array([-1e-7])))
    assert begun.effects["rotor_inertia"]["inertia"] == 5e-8  # derivatives at none do not lead there
    assert shortlist([drag, rotors]) == [drag]
    found = [entry("rotor_inertia", 300.0), damping]  # by its derivative: once is enough
    assert sum(t.candidate.effect == "rotor_inertia" for t, _ in shortlist(found)) == 1
