"""What makes predictions worse is left out again: on made flights, with inertias that are right and that are not."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from diagnosis_parts import DRAG, INERTIA, data_of, start_point
from made_flight import without

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.naming.prediction_check import ratio, with_accepted_effects, without_worse_predictions
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.prediction.horizon import UNITS, HorizonErrors
from crazyem.diagnosis.settings import SELECTION


def selected(data: Data, found: dict[str, tuple[Candidate, dict[str, float]]]) -> Selection:
    """A selection with effects of these sizes, whatever the flights say."""
    point = nominal(data, start_point())
    begun = point.with_effects({name: values for name, (_, values) in found.items()})
    candidates = [c for c, _ in found.values()]
    fitted = refine_base(data, begun, candidates, rounds=1, noise=False)
    final = fitted.point.with_effects({name: values for name, (_, values) in found.items()})
    steps = tuple(Step((), Trial(c, 100.0, 100.0, 1.0, 100.0)) for c in candidates)
    return Selection(point, final, steps, tuple(candidates), replace(fitted, point=final))


@pytest.fixture(scope="module")
def heavy():
    """A drone a quarter heavier to turn than its file says, the data of its flight, and what was found by mistake.

    Inertias of 0.4 of the real ones, as a vibration had them.
    """
    recording = fly(vehicle=replace(DRONE, inertia=tuple(1.25 * i for i in DRONE.inertia)), seconds=8.0)
    data = data_of(recording)
    return recording, data, selected(data, {"inertia": (INERTIA, inertias(0.4))})


def inertias(factor: float) -> dict[str, float]:
    return dict(zip(INERTIA.free, (factor * i for i in DRONE.inertia), strict=True))


def test_what_is_right_stays(heavy):
    recording, data, _ = heavy
    selection = selected(data, {"inertia": (INERTIA, inertias(1.25))})
    assert without_worse_predictions(data, selection, DRONE, [recording]) is selection


def test_what_leads_astray_goes_and_what_does_not_stays(heavy):
    recording, data, _ = heavy
    harmless = dict.fromkeys(DRAG.free, 1e-6)
    selection = selected(data, {"linear_drag": (DRAG, harmless), "inertia": (INERTIA, inertias(0.4))})
    said = []
    left = without_worse_predictions(data, selection, DRONE, [recording], say=said.append)
    assert [c.effect for c in left.accepted] == ["linear_drag"]
    assert [s.taken.candidate.effect for s in left.steps if s.taken] == ["linear_drag"]
    (text,) = said
    assert "inertia" in text


def test_nothing_is_asked_where_turning_does_not_follow_commands_or_a_recording_has_no_whole_states(heavy):
    recording, data, selection = heavy
    coarse = Data([replace(m.flight, coarse=True) for m in data.models])
    assert without_worse_predictions(coarse, selection, DRONE, [recording]) is selection
    assert without_worse_predictions(data, selection, DRONE, [without(recording, "attitude")]) is selection


def test_the_vehicle_has_what_was_accepted_and_what_it_had(heavy):
    selection, filed = heavy[2], replace(DRONE, effects={"linear_drag": {"x": 0.01}})
    assert with_accepted_effects(filed, selection, ()).effects == filed.effects
    assert with_accepted_effects(filed, selection, selection.accepted).effects["inertia"] == inertias(0.4)


def errors(factor: float) -> HorizonErrors:
    rms = dict.fromkeys(UNITS, (1.0, 2.0 * factor, 3.0 * factor))
    return HorizonErrors((0.01, 0.1, 0.5), 10, rms, rms)


def test_the_ratio_is_a_geometric_mean_without_the_shortest_horizon():
    assert ratio([errors(1.0)], [errors(1.5)]) == pytest.approx(1.5)
    assert ratio([errors(1.0), errors(1.0)], [errors(2.0), errors(0.5)]) == pytest.approx(1.0)
    assert ratio([errors(1.0), None], [errors(2.0), errors(9.0)]) == pytest.approx(2.0)
    assert ratio([None], [None]) == 1.0
    assert ratio([errors(1.0)], [errors(np.inf)]) == np.inf > SELECTION.max_error_ratio
    assert ratio([errors(1.0)], [errors(np.nan)]) == 1.0
