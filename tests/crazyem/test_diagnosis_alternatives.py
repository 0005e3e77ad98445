"""Names asked again beside the rest: exchanged where a rival is better, or as good with fewer parameters."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_parts import LOAD, THRUST, start_point
from unknown_effects import unknown

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.naming import alternatives
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import SELECTION
from crazyem.diagnosis.workers import Workers

FLAPPING = Candidate("velocity_moment", (), ("roll_per_vy", "pitch_per_vx"))
BESIDE = {"velocity_moment": {"roll_per_vy": 1e-5, "pitch_per_vx": 1e-5}}
BARE = start_point()
SLOPE = Candidate("thrust_curve", (), ("slope_error",))
LOADED = BARE.with_effects({"payload": {**LOAD.neutral(BARE), "mass": 0.004}, **BESIDE})
WEAK = BARE.with_effects({"thrust_scale": {"scale": 0.9}})
DATA = SimpleNamespace(flights=[], workers=Workers(1))
BLOCKS = np.linspace(-1.0, 1.0, 20)


def trial(candidate, value, point):
    return Trial(candidate, value, 0.0, 1.0, value, SimpleNamespace(point=point), True, BLOCKS, value)


def asked(monkeypatch, *, now, weaker, name=LOAD, point=LOADED, was=100.0, other=70.0):
    """The selection after a name beside the flapping, worth `now` nats, was held against weaker rotors of `weaker`.

    When the name was taken they were worth `was` and `other`.
    """
    taken, rival = trial(name, was, point), trial(THRUST, other, WEAK)
    steps = (Step((taken, rival), taken), Step((), trial(FLAPPING, 20.0, point)))
    selection = Selection(BARE, point, steps, (name, FLAPPING), SimpleNamespace())

    def judged(data, held_out, start, candidates):
        assert [c.effect for c in candidates][1] == "velocity_moment"
        if candidates[0] is not name:
            assert name.effect not in start.effects
            assert start.effects["thrust_scale"]["scale"] == 0.9
        value = now if candidates[0] is name else weaker
        return value, BLOCKS + value / 20, unknown(candidates)

    monkeypatch.setattr(alternatives, "refitted", judged)
    monkeypatch.setattr(alternatives, "refine_with_memory", lambda data, point, accepted: SimpleNamespace(point=point))
    return alternatives.with_better_rivals(DATA, None, selection)


def names(selection):
    taken = [s.taken.candidate.effect for s in selection.steps if s.taken]
    assert [c.effect for c in selection.accepted] == taken
    assert set(taken) <= set(selection.final.effects)
    return taken


def test_a_rival_that_is_better_beside_the_rest_takes_the_place(monkeypatch):
    found = asked(monkeypatch, now=100.0, weaker=130.0)
    assert names(found) == ["thrust_scale", "velocity_moment"]
    assert "payload" not in found.final.effects
    assert found.steps[0].alike == ()
    assert {t.candidate: t.value for t in found.steps[0].trials} == {LOAD: 100.0, THRUST: 130.0}  # as they are now


@pytest.mark.parametrize(
    ("load", "name", "alike"),
    [
        (102.0, "thrust_scale", [LOAD]),  # as good: the one with fewer parameters
        (104.0, "payload", [THRUST]),
        (105.5, "payload", [THRUST]),
        (106.5, "payload", []),
    ],
)
def test_what_is_worth_less_takes_no_name_however_simple(monkeypatch, load, name, alike):
    """Worse by 1, by 2.5 and by 3.5 nats, steadily. Below 2.9, the odds of one in twenty, it is not told apart."""
    found = asked(monkeypatch, now=load, weaker=100.0)
    assert names(found) == [name, "velocity_moment"]
    assert [t.candidate for t in found.steps[0].alike] == alike  # and it is said


def test_a_name_that_is_still_the_best_stays(monkeypatch):
    found = asked(monkeypatch, now=130.0, weaker=100.0)
    assert names(found) == ["payload", "velocity_moment"]
    assert found.final is LOADED
    assert found.steps[0].alike == ()


def test_what_was_far_worse_is_not_asked(monkeypatch):
    monkeypatch.setattr(alternatives, "SELECTION", replace(SELECTION, rival_difference=20.0))
    assert names(asked(monkeypatch, now=100.0, weaker=130.0)) == ["payload", "velocity_moment"]


def test_one_effect_alone_is_not_asked_again(monkeypatch):
    monkeypatch.setattr(alternatives, "refitted", lambda *a: pytest.fail("nothing is new"))
    taken = trial(LOAD, 100.0, LOADED)
    step = Step((taken, trial(THRUST, 99.0, WEAK)), taken)
    alone = Selection(BARE, LOADED, (step,), (LOAD,), SimpleNamespace())
    assert alternatives.with_better_rivals(DATA, None, alone) is alone


@pytest.mark.parametrize(("above", "name"), [(0.0, "thrust_scale"), (1e-3, "thrust_curve")])
def test_what_ended_where_its_range_ends_gives_way_to_whatever_is_next(monkeypatch, above, name):
    """A thrust curve of -0.9 beside a drag, in real flights, stood for weaker rotors; worse by 900 nats or not."""
    point = BARE.with_effects({"thrust_curve": {"slope_error": SLOPE.range_of("slope_error")[0] + above}, **BESIDE})
    found = asked(monkeypatch, now=1000.0, weaker=100.0, name=SLOPE, point=point, was=1000.0, other=100.0)
    assert names(found) == [name, "velocity_moment"]
    assert (SLOPE in [t.candidate for t in found.steps[0].trials]) == (name == "thrust_curve")
