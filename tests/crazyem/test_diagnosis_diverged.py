"""A fit that begins where the filter leaves the range of numbers is no fit, and says so."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, fly

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, refine
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming.select import Basis, fitted_trial
from crazyem.diagnosis.naming.trials import Trial
from crazyem.errors import DataError

DRAG = Candidate("quadratic_drag", (), ("x", "y", "z"))


@pytest.fixture
def wild() -> tuple[Data, Point]:
    """A model whose drag, against a wind that no air has, is beyond all numbers."""
    data = Data([flight_of(fly(seconds=5.0), DRONE)])
    effects = {"quadratic_drag": {"x": 1e200, "y": 1e200, "z": 1e200}}
    return data, Point(DRONE, effects, start_noise())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_it_is_a_sentence_and_no_traceback(wild: tuple[Data, Point]) -> None:
    data, point = wild
    with pytest.raises(DataError, match="leaves the range of numbers"):
        refine(data, point, [DRAG])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_next_model_is_not_spoiled(wild: tuple[Data, Point]) -> None:
    data, point = wild
    sound = Point(DRONE, {}, point.noise)
    before = data.loglik(sound, passes=3)
    assert not np.isfinite(data.loglik(point))
    assert data.loglik(sound, passes=3) == pytest.approx(before, abs=1e-3)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_candidate_that_diverges_is_no_explanation(wild: tuple[Data, Point], monkeypatch: pytest.MonkeyPatch) -> None:
    data, point = wild

    def diverges(*arguments: object, **more: object) -> None:
        raise DivergedError("too far")

    monkeypatch.setattr("crazyem.diagnosis.naming.select.refine_base", diverges)
    basis = Basis(data, None, Point(DRONE, {}, point.noise), (), 0.0, 0.0)
    linear = Trial(DRAG, 50.0, 50.0, 1.0, 49.0)
    solution: Any = SimpleNamespace(theta=np.array([0.1, 0.1, 0.1]))
    found = fitted_trial(basis, linear, solution, say=lambda text: None)
    assert found is linear
    assert not found.admissible
