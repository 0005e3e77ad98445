"""Names asked again beside the rest: exchanged where a rival is better, or as good with fewer parameters."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE
from unknown_effects import unknown

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.naming import alternatives
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import SELECTION
from crazyem.diagnosis.workers import Workers

LOAD = Candidate("payload", (), ("mass", "x", "y", "z"))
WEAKER = Candidate("thrust_scale", (), ("scale",))
FLAPPING = Candidate("velocity_moment", (), ("roll_per_vy", "pitch_per_vx"))
BARE = Point(DRONE, {}, start_noise())
POINT = BARE.with_effects({"payload": {**LOAD.neutral(BARE), "mass": 0.004},
                           "velocity_moment": {"roll_per_vy": 1e-5, "pitch_per_vx": 1e-5}})  # fmt: skip
THERE = BARE.with_effects({"thrust_scale": {"scale": 0.9}})
BLOCKS = np.linspace(-1.0, 1.0, 20)


def trial(candidate: Candidate, value: float, point: Point) -> Trial:
    return Trial(candidate, value, 0.0, 1.0, value, SimpleNamespace(point=point), True, BLOCKS, value)  # type: ignore[arg-type]


def asked(monkeypatch: pytest.MonkeyPatch, *, load: float, weaker: float, was: float = 30.0) -> Selection:
    """The selection after the load (`load` nats beside the flapping) was held against weaker rotors (`weaker`), which
    were worse by `was` nats when it was taken."""
    taken, other = trial(LOAD, 100.0, POINT), trial(WEAKER, 100.0 - was, THERE)
    steps = (Step((taken, other), taken), Step((), trial(FLAPPING, 20.0, POINT)))
    selection = Selection(BARE, POINT, steps, (LOAD, FLAPPING), SimpleNamespace())  # type: ignore[arg-type]

    def judged(data, held_out, start, candidates):
        assert [c.effect for c in candidates][1] == "velocity_moment"
        if candidates[0] is LOAD:
            return load, BLOCKS + load / 20, unknown(candidates)
        assert "payload" not in start.effects
        assert start.effects["thrust_scale"]["scale"] == 0.9
        return weaker, BLOCKS + weaker / 20, unknown(candidates)

    monkeypatch.setattr(alternatives, "refitted", judged)
    monkeypatch.setattr(alternatives, "refine_with_memory", lambda data, point, accepted: SimpleNamespace(point=point))
    return alternatives.with_better_rivals(SimpleNamespace(flights=[], workers=Workers(1)), None, selection)  # type: ignore[arg-type]


def names(selection: Selection) -> list[str]:
    taken = [s.taken.candidate.effect for s in selection.steps if s.taken]
    assert [c.effect for c in selection.accepted] == taken
    assert set(taken) <= set(selection.final.effects)
    return taken


def test_a_rival_that_is_better_beside_the_rest_takes_the_place(monkeypatch):
    found = asked(monkeypatch, load=100.0, weaker=130.0)
    assert names(found) == ["thrust_scale", "velocity_moment"]
    assert "payload" not in found.final.effects
    assert found.steps[0].alike == ()
    assert {t.candidate: t.value for t in found.steps[0].trials} == {LOAD: 100.0, WEAKER: 130.0}  # as they are now


def test_of_two_that_are_as_good_the_one_with_fewer_parameters(monkeypatch):
    found = asked(monkeypatch, load=102.0, weaker=100.0)
    assert names(found) == ["thrust_scale", "velocity_moment"]
    assert [t.candidate for t in found.steps[0].alike] == [LOAD]  # and it is said


@pytest.mark.parametrize(("load", "alike"), [(104.0, [WEAKER]), (105.5, [WEAKER]), (106.5, [])])
def test_what_is_worth_less_takes_no_name_however_simple(monkeypatch, load: float, alike: list[Candidate]) -> None:
    """Worse by 1, by 2.5 and by 3.5 nats, steadily. Below 2.9, the odds of one in twenty, it is not told apart."""
    found = asked(monkeypatch, load=load, weaker=100.0)
    assert names(found) == ["payload", "velocity_moment"]
    assert [t.candidate for t in found.steps[0].alike] == alike  # and it is said


def test_a_name_that_is_still_the_best_stays(monkeypatch):
    found = asked(monkeypatch, load=130.0, weaker=100.0)
    assert names(found) == ["payload", "velocity_moment"]
    assert found.final is POINT
    assert found.steps[0].alike == ()


def test_what_was_far_worse_is_not_asked(monkeypatch):
    monkeypatch.setattr(alternatives, "SELECTION", replace(SELECTION, rival_difference=20.0))
    assert names(asked(monkeypatch, load=100.0, weaker=130.0)) == ["payload", "velocity_moment"]


def test_one_effect_alone_is_not_asked_again(monkeypatch):
    monkeypatch.setattr(alternatives, "refitted", lambda *a: pytest.fail("nothing is new"))
    taken = trial(LOAD, 100.0, POINT)
    alone = Selection(BARE, POINT, (Step((taken, trial(WEAKER, 99.0, THERE)), taken),), (LOAD,), SimpleNamespace())  # type: ignore[arg-type]
    assert alternatives.with_better_rivals(SimpleNamespace(flights=[], workers=Workers(1)), None, alone) is alone  # type: ignore[arg-type]
    assert replace(alone) == alone


def test_what_ended_where_its_range_ends_gives_way_to_whatever_is_next(monkeypatch):
    """A thrust curve of -0.9 beside a drag, in real flights, stood for weaker rotors; worse by 900 nats or not."""
    slope = Candidate("thrust_curve", (), ("slope_error",))
    low = slope.range_of("slope_error")[0]
    for end, name in ((low, "thrust_scale"), (low + 1e-3, "thrust_curve")):
        point = BARE.with_effects({"thrust_curve": {"slope_error": end},
                                   "velocity_moment": {"roll_per_vy": 1e-5, "pitch_per_vx": 1e-5}})  # fmt: skip
        taken, other = trial(slope, 1000.0, point), trial(WEAKER, 100.0, THERE)
        steps = (Step((taken, other), taken), Step((), trial(FLAPPING, 20.0, point)))
        selection = Selection(BARE, point, steps, (slope, FLAPPING), SimpleNamespace())  # type: ignore[arg-type]
        monkeypatch.setattr(alternatives, "refitted", lambda data, held_out, start, candidates: (
            (1000.0 if candidates[0] is slope else 100.0), BLOCKS, unknown(candidates)))  # fmt: skip
        monkeypatch.setattr(
            alternatives, "refine_with_memory", lambda data, point, accepted: SimpleNamespace(point=point)
        )
        found = alternatives.with_better_rivals(SimpleNamespace(flights=[], workers=Workers(1)), None, selection)  # type: ignore[arg-type]
        assert names(found) == [name, "velocity_moment"]
        assert (slope in [t.candidate for t in found.steps[0].trials]) == (name == "thrust_curve")
