"""A load against weaker rotors: what is compared, and what a shipped flight says of it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, LOAD, nominal_of, start_point
from unknown_effects import unknown

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.naming import load_or_rotors
from crazyem.diagnosis.naming.answer import answer_of
from crazyem.diagnosis.naming.trials import Selection, Step, Trial, distinguishable, margin
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.physics.effects.catalogue import CATALOGUE


def selection_of(point: Point, accepted: tuple[Candidate, ...], fitted: Any = None) -> Selection:
    steps = tuple(Step((), Trial(c, 50.0, 0.0, 1.0, 46.0)) for c in accepted)
    return Selection(point, point, steps, accepted, fitted)


@pytest.mark.parametrize(("trim", "alone"), [(False, 60.0), (True, 104.0), (False, 103.0)])
def test_what_stands_in_the_place_of_a_load_pays_for_its_parameters_and_for_being_two(
    monkeypatch: pytest.MonkeyPatch, trim: bool, alone: float
) -> None:
    """Weaker rotors `alone` [nats] or, where they do not explain the torque of a load, with a shifted centre (104)."""
    vehicle = DRONE if not trim else SimpleNamespace(**{**vars(DRONE), "effects": {TRIM: {"x": 0.0}}})
    effects = {"payload": LOAD.neutral(start_point()), "linear_drag": dict.fromkeys("xyz", 0.01)}
    point = Point(vehicle, effects, start_noise())
    asked = []

    def judged(data: Any, held_out: Any, start: Point, candidates: Any) -> tuple[float, Any, Any]:
        names = [c.effect for c in candidates]
        asked.append((names, sorted(start.effects)))
        value = 110.0 if "payload" in names else 104.0 if "center_of_mass" in names else alone
        return value, np.zeros(5), unknown(candidates)

    monkeypatch.setattr(load_or_rotors, "refitted", judged)
    found = load_or_rotors.load_against_rotors(SimpleNamespace(), None, selection_of(point, (LOAD, DRAG)))
    assert found is not None
    both = ["thrust_scale"] if trim else ["thrust_scale", "center_of_mass"]
    assert asked[0][0] == ["payload", "linear_drag"]
    assert [c.effect for c in load_or_rotors.load_substitutes(point.vehicle)] == both
    assert asked[1] == (["linear_drag", "thrust_scale"], ["linear_drag", "thrust_scale"])
    if not trim:
        assert asked[2] == (["linear_drag", *both], sorted(["linear_drag", *both]))
    assert len(asked) == 1 + len(both)
    one, two = 110.0 - 4 - (alone - 1), 6.0 - 4 + 4 + np.log(len(CATALOGUE))
    assert margin(*found)[0] == pytest.approx(one if trim else min(one, two))


def test_without_a_load_nothing_is_asked() -> None:
    point = Point(DRONE, {"linear_drag": dict.fromkeys("xyz", 0.01)}, start_noise())
    assert load_or_rotors.load_against_rotors(SimpleNamespace(), None, selection_of(point, (DRAG,))) is None


@pytest.mark.parametrize(("scale", "tried", "asked_for"), [(0.8, False, True), (1.1, False, False), (0.8, True, False)])
def test_a_load_in_the_place_of_weaker_rotors_weighs_what_they_lack(
    monkeypatch: pytest.MonkeyPatch, scale: float, tried: bool, asked_for: bool
) -> None:
    point = Point(DRONE, {"thrust_scale": {"scale": scale}, "linear_drag": dict.fromkeys("xyz", 0.01)}, start_noise())
    asked = []

    def judged(data: Any, held_out: Any, start: Point, candidates: Any) -> tuple[float, Any, Any]:
        asked.append(([c.effect for c in candidates], start.effects))
        return (110.0 if len(asked) == 1 else 104.0), np.zeros(5), unknown(candidates)

    monkeypatch.setattr(load_or_rotors, "refitted", judged)
    chosen = selection_of(point, (load_or_rotors.WEAKER, DRAG))
    beside = Trial(LOAD, 1.0, 1.0, 1.0, 1.0, fitted=SimpleNamespace() if tried else None)
    chosen = replace(chosen, steps=(replace(chosen.steps[0], trials=(beside,)), *chosen.steps[1:]))
    found = load_or_rotors.rotors_against_load(SimpleNamespace(), None, chosen)
    assert (found is not None) == asked_for == bool(asked)
    if found is not None:
        assert [names for names, _ in asked] == [["thrust_scale", "linear_drag"], ["linear_drag", "payload"]]
        assert asked[1][1]["payload"]["mass"] == pytest.approx(DRONE.mass * (1 / scale - 1))
        assert "thrust_scale" not in asked[1][1]
        assert margin(*found)[0] == pytest.approx(6.0 - 1 + 4)


def test_weighing_is_asked_for_whether_a_load_is_told_apart_or_not() -> None:
    data, point = nominal_of(fly(Hidden(thrust=(0.9, 0.9, 0.9, 0.9)), seconds=8.0))
    begun = point.with_effects({"payload": {**LOAD.neutral(point), "mass": 0.0039}})
    fitted = refine_base(data, begun, [LOAD], rounds=1, noise=False)
    trial = Trial(LOAD, 50.0, 0.0, 1.0, 46.0, fitted, True, np.zeros(8), 50.0)
    weaker = replace(trial, candidate=load_or_rotors.WEAKER, parameter_cost=4.0)
    selection = Selection(point, fitted.point, (Step((trial,), trial),), (LOAD,), fitted)
    for value, group in ((30.0, ()), (49.0, (("payload", "thrust_scale", "center_of_mass"),))):
        pair = (trial, replace(weaker, value=value))
        told = answer_of(data, selection, Unexplained((), 50.0), corroborated=frozenset(), in_place={"payload": pair})
        assert told.groups == group
        assert CATALOGUE["payload"].separates in told.separate


@pytest.mark.slow
def test_rotors_that_are_all_weaker_are_not_told_from_a_load() -> None:
    """A tenth less thrust: a load of 3.9 g in the middle explains it but for the torque, which the two get right."""
    data, point = nominal_of(fly(Hidden(thrust=(0.9, 0.9, 0.9, 0.9)), seconds=12.0))
    begun = point.with_effects({"payload": {**LOAD.neutral(point), "mass": 0.0039}})
    fitted = refine_base(data, begun, [LOAD])
    found = load_or_rotors.load_against_rotors(data, None, selection_of(fitted.point, (LOAD,), fitted))
    assert found is not None
    assert not distinguishable(*found)
