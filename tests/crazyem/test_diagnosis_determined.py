"""No impossible answer: whatever a fit says, what is told lies in its interval and that in what is possible; and what
belongs to a recording is in no vehicle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, LOAD, WIND, data_of, silent, start_point
from hypothesis import given
from hypothesis import strategies as st

from crazyem.diagnosis.diagnose import Diagnosis, diagnose
from crazyem.diagnosis.document import document_of
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.naming import prune
from crazyem.diagnosis.naming.answer import Named, Value
from crazyem.diagnosis.naming.determined import determined, without_undetermined
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.recording import Recording

POINT = start_point()
OWN = dict(zip(("xx", "yy", "zz", "time_constant"), (*DRONE.inertia, DRONE.motor_time_constant), strict=True))


def named(effect: str, values: dict[str, Value], **chosen: object) -> Named:
    return Named(effect, effect, values, dict(chosen), 50.0, 0.95)


def value(number: float, sd: float, ends: tuple[float, float] | None = None) -> Value:
    return Value(number, "", sd, ends or Value.normal(number, "", sd).ci95)


def neutral_of(effect: str, name: str) -> float:
    """By the vehicle, not by the code that is tested: of inertia products and other effects it is none."""
    own = OWN.get(name, 0.0) if effect in ("inertia", "motor_lag") else 0.0
    found = next(p.neutral for p in CATALOGUE[effect].parameters if p.name == name)
    return own if math.isnan(found) else float(found)


def impossible(effect: str, parameters: dict[str, tuple[float, float, float]]) -> list[str]:
    """What is wrong with told numbers: (value, low, high) by parameter."""
    ranges = {p.name: (p.low, p.high) for p in CATALOGUE[effect].parameters}
    wrong = []
    for name, (told, low, high) in parameters.items():
        least, most = ranges[name]
        if not least <= low <= told <= high <= most:
            wrong.append(f"{name} is not in its interval in its range")
        if told in (least, most) and told != neutral_of(effect, name):
            wrong.append(f"{name} is at its end")
    if parameters and all(low <= neutral_of(effect, n) <= high for n, (_, low, high) in parameters.items()):
        wrong.append("every interval holds none of it")
    return wrong


CONTINUOUS = {
    name: [p for p in effect.parameters if not p.chosen and not p.among and p.neutral is not None and p.scale > 0]
    for name, effect in CATALOGUE.items()
}


@st.composite
def anything(draw: st.DrawFn) -> Named:
    """An effect with numbers about its range, well beyond it, at its ends, and with any interval."""
    effect = draw(st.sampled_from(sorted(CONTINUOUS)))
    values = {}
    for p in CONTINUOUS[effect]:
        wide = p.high - p.low
        number = draw(
            st.floats(p.low - 0.5 * wide, p.high + 0.5 * wide)
            | st.floats(-20 * p.scale, 20 * p.scale)
            | st.sampled_from([p.low, p.high, neutral_of(effect, p.name), math.nan, math.inf])
        )
        sd = p.scale * draw(st.floats(1e-3, 100.0))
        ends = draw(st.none() | st.tuples(st.floats(-wide, wide), st.floats(-wide, wide)))
        values[p.name] = value(number, sd, ends)
    return named(effect, values)


@given(anything())
def test_nothing_impossible_is_told(found: Named) -> None:
    kept, gone = determined([found], POINT)
    assert len(kept) + len(gone) == 1
    for one in kept:
        assert impossible(one.name, {n: (v.value, *v.ci95) for n, v in one.parameters.items()}) == []
    assert all(reason.startswith("not determined: ") for reason in gone.values())


@given(st.sampled_from(sorted(CONTINUOUS)), st.floats(0.3, 0.9), st.floats(0.01, 0.2))
def test_what_is_clearly_there_and_possible_is_told(effect: str, share: float, relative: float) -> None:
    values = {}
    for p in CONTINUOUS[effect]:
        none = neutral_of(effect, p.name)
        there = none + share * ((min(p.high, 1e3) if p.name == "scale" else p.high) - none) / 30.0
        values[p.name] = value(there, relative * abs(there - none) / 2.0)
    kept, gone = determined([named(effect, values)], POINT)
    assert gone == {}
    assert kept[0].parameters.keys() == values.keys()


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (named("gusts", {"standard_deviation": value(17.0, 1.0), "correlation_time": value(1.0, 0.3)}), "would be 17"),
        (named("rotor_fault", {"scale": value(1.7623, 0.02, (1.714, 1.1))}, rotor=2, onset_time=None), "0 to 1.1 is"),
        (named("ground_effect", {"strength": value(2.0, 0.5), "height": value(0.02, 0.01)}), "at the end"),
        (named("ground_effect", {"strength": value(0.5, 0.4), "height": value(0.5, 0.01)}), "that there is none of it"),
        (named("linear_drag", {a: value(1e-3, 1e-3) for a in "xyz"}), "none of it (95 %: x -0.00096 to 0.00296"),
        (named("inertia", {a: value(OWN[a], 1e-7) for a in ("xx", "yy", "zz")}), "none of it"),
        (named("motor_lag", {"time_constant": value(0.05, 0.003, (0.051, 0.06))}), "outside of its own interval"),
        (named("wind", {"x": value(1.0, math.nan), "y": value(0.0, 0.1)}), "no finite size"),
    ],
)
def test_answers_that_were_printed_once_are_not_determined(found: Named, reason: str) -> None:
    kept, gone = determined([found], POINT)
    assert kept == ()
    assert reason in gone[found.name]


def test_an_axis_without_any_is_no_reason_and_intervals_end_where_the_range_does() -> None:
    drag = named("linear_drag", {"x": value(0.02, 1e-3), "y": value(0.001, 1e-3), "z": value(0.0, 1e-3)})
    (kept,), _ = determined([drag], POINT)
    assert kept.parameters["z"].ci95 == (0.0, pytest.approx(1.96e-3))
    assert kept.parameters["y"].ci95[0] == 0.0
    filed = replace(POINT, vehicle=replace(DRONE, effects={"linear_drag": {"x": 0.02, "y": 0.001}}))
    assert determined([drag], filed)[0] == ()  # all of that is in the file


# -- in a selection -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dragged() -> Data:
    return data_of(fly(Hidden(drag=(0.02, 0.02, 0.02)), seconds=6.0))


def selected(data: Data, *candidates: Candidate, **values: dict[str, float]) -> Selection:
    """A selection of these effects, fitted from these values, the first the weakest."""
    point = nominal(data, POINT)
    fitted = refine_base(data, point.with_effects(values), candidates, rounds=4, noise=False)
    steps = tuple(Step((), Trial(c, 900.0 + k, 900.0, 1.0, 9.0 + k)) for k, c in enumerate(candidates))
    steps = tuple(replace(s, taken=s.trials[0]) if s.trials else Step((), s.taken) for s in steps)
    return Selection(point, fitted.point, steps, candidates, fitted)


def test_what_is_not_determined_is_left_out_and_the_rest_fitted_again(dragged: Data) -> None:
    wind = WIND
    selection = selected(dragged, wind, DRAG, wind={"x": 0.01}, linear_drag=dict.fromkeys("xyz", 0.02))
    said: list[str] = []
    left, balance, gone = without_undetermined(dragged, selection, None, said.append)
    assert [c.effect for c in left.accepted] == ["linear_drag"]
    assert [s.taken.candidate.effect for s in left.steps if s.taken] == ["linear_drag"]
    assert "wind" not in left.final.effects
    assert left.final.effects["linear_drag"]["x"] == pytest.approx(0.02, abs=0.004)
    assert gone.keys() == {"wind"}
    assert "none of it" in gone["wind"]
    assert len(said) == 1
    assert balance is None


def test_a_number_at_its_end_is_held_at_none_and_the_others_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A load 40 mm above the rotors; its weight and where it draws the drone are determined."""
    monkeypatch.setattr(prune, "improbable", lambda chance: "")  # however sure it is
    load = LOAD
    flown = data_of(fly(Hidden(thrust=(0.9,) * 4), seconds=6.0))
    selection = selected(flown, load, payload={"mass": 0.004, "x": 0.0, "y": 0.0, "z": 0.04})
    values = {**selection.final.effects["payload"], "z": 0.04}
    selection = replace(selection, final=selection.final.with_effects({"payload": values}))
    left, _, gone = without_undetermined(flown, selection, None, silent)
    assert gone == {}
    assert [c.free for c in left.accepted] == [("mass", "x", "y")]
    assert left.final.effects["payload"]["z"] == 0.0
    assert left.final.effects["payload"]["mass"] > 0.003


def test_an_effect_that_is_found_and_improbable_is_said_with_the_reason() -> None:
    """A small drag in a short flight: enough for the search, too little for a finding."""
    flown = fly(Hidden(drag=(0.015, 0.015, 0.0)), seconds=6.0, seed=5)
    said: list[str] = []
    found = diagnose([flown], DRONE, wanted=["linear_drag"], say=said.append)
    assert sum("found linear_drag" in text for text in said) == 1
    assert sum("left out again" in text for text in said) == 1
    assert sum("looking for effect" in text for text in said) == 2  # and not again: it cannot have hidden anything
    assert found.effects == ()
    assert found.fitted_vehicle == DRONE
    assert not found.mismatch
    assert found.left_out == found.selection.left_out
    assert found.left_out.keys() == {"linear_drag"}
    reason = found.left_out["linear_drag"]
    assert reason.startswith("not determined: the flights make it probable with 0.")
    document, _ = document_of(found, [flown])
    assert {"name": "linear_drag", "reason": reason} in document["not_identifiable"]
    assert [tried["name"] for tried in document["ranking"]] == ["linear_drag"]  # what was compared stays known


# -- what belongs to a recording ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scaled() -> tuple[Recording, Diagnosis]:
    """A flight whose estimate of velocity is a fifth too large, and what is said of it."""
    flown = fly(seconds=6.0)
    velocity = flown.signals["velocity"]
    flown = replace(flown, signals={**flown.signals, "velocity": replace(velocity, value=velocity.value * 1.2)})
    filed = replace(DRONE, effects={"linear_drag": {"x": 1e-4}})
    return flown, diagnose([flown], filed, wanted=["velocity_scale"])


def test_what_belongs_to_a_recording_is_told_and_not_written(scaled: tuple[Recording, Diagnosis]) -> None:
    flown, found = scaled
    assert [e.name for e in found.effects] == ["velocity_scale"]
    assert found.fitted_vehicle == found.vehicle
    assert found.as_flown.effects["velocity_scale"]["x"] == pytest.approx(1.2, abs=0.05)
    assert found.as_flown.effects["linear_drag"] == {"x": 1e-4}
    document, _ = document_of(found, [flown])
    assert any("velocity scale of the onboard estimate: of the recording" in n for n in document["notices"])
    train = document["fit"]["train"]
    before, after, alone = (train[k]["position"]["rms"][-1] for k in ("before", "after", "vehicle"))
    assert after < 0.9 * before == pytest.approx(0.9 * alone)  # what the scale brings is not the drone's
    document, _ = document_of(found, [flown], [flown])  # one that was held out has sensors of its own
    apart = document["fit"]["held_out"]
    assert apart["after"] == apart["before"]
    assert "vehicle" not in apart


def test_effects_of_sensors_belong_to_recordings_and_all_others_to_vehicles() -> None:
    of_recordings = {n for n, e in CATALOGUE.items() if e.belongs_to == "recording"}
    assert of_recordings == {"velocity_scale", "gyro_bias", "measurement_delay", "onboard_filter", "sampled_commands"}
    assert {n for n, e in CATALOGUE.items() if e.belongs_to == "day"} == {"input_delay", "wind", "gusts"}
    assert {e.belongs_to for e in CATALOGUE.values()} == {"vehicle", "recording", "day"}


def test_what_was_left_free_is_told_with_its_error(scaled: tuple[Recording, Diagnosis]) -> None:
    free = {(f.name, f.parameter): f for f in scaled[1].free}
    assert {n for n, _ in free} >= {"input_delay", "inertia", "torque_scale", "center_of_mass", "motor_lag"}
    inertia = free["inertia", "xx"]
    assert inertia.expected == DRONE.inertia[0]
    assert 0.01 * DRONE.inertia[0] < inertia.usual < 0.05 * DRONE.inertia[0]  # commands that were not logged
    assert 0.0 < inertia.sd <= 2.0 * inertia.usual  # by the scatter of its blocks
    assert np.abs(inertia.value - inertia.expected) < 3 * inertia.usual
    assert inertia.unit == "kg m^2"
