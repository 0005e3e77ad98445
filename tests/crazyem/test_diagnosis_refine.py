"""Where a fit ends: at the maximum that a plain search finds, or where the filter leaves the range of numbers."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, QUADRATIC_DRAG, data_of, silent
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from crazyem.diagnosis.fitting import fit
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, has_large_offset, refine
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Column, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming.select import Basis, fitted_trial
from crazyem.diagnosis.naming.trials import Trial
from crazyem.diagnosis.settings import FITTING
from crazyem.errors import DataError

ALONG_Y = Candidate("linear_drag", (), ("y",))
Array = NDArray[np.float64]


class Counted(Data):
    """Flights that count how often all columns are asked for."""

    looks = 0

    def gram_and_loglik(self, point: Point, columns: Sequence[Column]) -> tuple[Gram, float]:
        self.looks += 1
        return super().gram_and_loglik(point, columns)


class Falling(Data):
    """No flight: a slope that promises much, and a likelihood that only falls, by `depth` nats a unit of drag."""

    def __init__(self, depth: float) -> None:
        super().__init__(())
        self.depth, self.asked = depth, []

    def loglik(self, point: Point, passes: int = 1) -> float:
        return -self.depth * point.effects["linear_drag"]["y"]

    def gram_and_loglik(self, point: Point, columns: Sequence[Column]) -> tuple[Gram, float]:
        self.asked.append(point.effects["linear_drag"]["y"])
        return Gram(np.full((1, 1), 100.0), np.full((1, 1, 1), 1000.0), np.zeros(1, int)), self.loglik(point)


class Quadratic(Data):
    """No flight: a likelihood that is quadratic in a drag along x and y and a wind along x, with its top at `top`."""

    def __init__(self, information: Array, top: Array) -> None:
        super().__init__(())
        self.information, self.top, self.looks = information, top, 0

    @staticmethod
    def parameters(point: Point) -> Array:
        drag, wind = point.effects["linear_drag"], point.effects["wind"]
        return np.array([drag["x"], drag["y"], wind["x"]])

    def loglik(self, point: Point, passes: int = 1) -> float:
        away = self.parameters(point) - self.top
        return -0.5 * float(away @ self.information @ away)

    def gram_and_loglik(self, point: Point, columns: Sequence[Column]) -> tuple[Gram, float]:
        self.looks += 1
        score = self.information @ (self.top - self.parameters(point))
        return Gram(score[None], self.information[None], np.zeros(1, int)), self.loglik(point)


def begun(data: Data) -> Point:
    point = Point(DRONE, {"linear_drag": {"x": 0.0, "y": 0.0, "z": 0.0}}, start_noise())
    data.settle(point)
    return data.fit_noise(point)


def test_a_fit_ends_where_a_plain_search_does_and_a_second_one_looks_no_further():
    data = Counted([flight_of(fly(Hidden(drag=(0.0, 0.02, 0.0)), seconds=8.0, seed=4), DRONE)])
    point = begun(data)
    found = refine(data, point, [ALONG_Y], noise=False)
    value = found.point.effects["linear_drag"]["y"]

    def lost(y: float) -> float:
        return -data.twin().loglik(point.with_effects({"linear_drag": {"y": y}}), passes=3)

    plain = minimize_scalar(lost, bracket=(value - 0.01, value + 0.01), tol=1e-4)
    sd = 1.0 / np.sqrt(found.gram.total([0])[1][0, 0])
    assert value == pytest.approx(plain.x, abs=0.2 * sd)
    assert found.loglik == pytest.approx(-plain.fun, abs=FITTING.min_round_gain)
    data.looks = 0
    again = refine(data, found.point, [ALONG_Y], noise=False)
    assert data.looks == 1
    assert again.point.effects["linear_drag"]["y"] == pytest.approx(value, abs=0.1 * sd)


def test_the_last_step_ends_where_a_fit_does_that_looks_at_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flight_of(fly(Hidden(drag=(0.02, 0.02, 0.02)), seconds=8.0, seed=4), DRONE)
    drag, found, looks = DRAG, [], []
    for least in (FITTING.min_round_gain, 1e-9):
        monkeypatch.setattr(fit, "FITTING", replace(FITTING, min_round_gain=least))
        data = Counted([flight])
        found.append(refine(data, begun(data), [drag], rounds=20, noise=False))
        looks.append(data.looks)
    assert looks[0] < looks[1]
    here, there = (np.array([f.point.effects["linear_drag"][a] for a in "xyz"]) for f in found)
    sd = np.sqrt(np.diag(np.linalg.inv(found[1].gram.total(range(3))[1])))
    assert np.all(np.abs(here - there) < 0.1 * sd)
    assert found[0].loglik == pytest.approx(found[1].loglik, abs=0.005)  # half the square of a tenth
    assert np.all(np.abs(found[0].gram.total(range(3))[0]) < 0.1 / sd)


@pytest.mark.parametrize(("nats", "looks"), [(0.04, 1), (9.0, 2)])
def test_of_a_quadratic_the_last_step_is_exact(nats: float, looks: int) -> None:
    """`nats` below the top of the posterior; the wind is always free, with a normal prior about none."""
    root = np.random.default_rng(2).normal(size=(3, 5)) * np.array([[300.0], [200.0], [4.0]])
    information, top, precision = root @ root.T, np.array([0.05, 0.04, 0.5]), 25.0
    data, wind = Quadratic(information, top), Candidate("wind", (), ("x",), both_ways=True)
    prior = np.diag([0.0, 0.0, precision])
    best = np.linalg.solve(information + prior, information @ top)
    away = np.array([1e-3, -2e-3, 0.1])
    away *= np.sqrt(2.0 * nats / (away @ (information + prior) @ away))
    x, y, blown = best + away
    point = Point(DRONE, {"linear_drag": {"x": x, "y": y}, "wind": {"x": blown}}, start_noise())
    drag = Candidate("linear_drag", (), ("x", "y"))
    found = refine(data, point, [drag], nuisances=[(wind, (precision,))], noise=False)
    assert data.looks == looks
    assert data.parameters(found.point) == pytest.approx(best, rel=1e-6)
    assert found.loglik == pytest.approx(data.loglik(found.point) - 0.5 * precision * best[2] ** 2, abs=1e-9)
    slopes = found.gram.total(range(3))[0]  # of the likelihood alone
    assert slopes == pytest.approx([0.0, 0.0, precision * best[2]], abs=1e-6)


def test_a_large_offset_is_looked_at_after_passes_that_no_longer_change() -> None:
    """Velocities that are a third too large in the log: the first pass is far from the last."""
    data = data_of(fly(seconds=6.0))
    point = begun(data).with_effects({"velocity_scale": dict.fromkeys("xyz", 1.3)})
    assert has_large_offset("velocity_scale", point.effects["velocity_scale"])
    columns = Candidate("velocity_scale", (), ("x", "y", "z")).columns(point)
    _, first = data.twin().gram_and_loglik(point, columns)
    gram, loglik = data.twin().converged(point, columns)
    settled = data.twin()
    settled.loglik(point, passes=30)
    wanted, last = settled.gram_and_loglik(point, columns)
    assert abs(first - last) > 10.0
    assert loglik == pytest.approx(last, abs=FITTING.pass_change)
    sd = np.sqrt(np.diag(np.linalg.inv(wanted.total(range(3))[1])))
    assert np.all(np.abs(gram.total(range(3))[0] - wanted.total(range(3))[0]) < 0.1 / sd)


@pytest.mark.parametrize(("depth", "tries"), [(1e4, FITTING.tries), (0.3, 1)])
def test_a_step_that_fails_is_tried_smaller_only_where_something_is_to_be_gained(depth: float, tries: int) -> None:
    """The step is 0.1: of 1000 nats lost a third of it may be worth a look, of 0.03 not."""
    data = Falling(depth)
    point = Point(DRONE, {"linear_drag": {"x": 0.0, "y": 0.0, "z": 0.0}}, start_noise())
    found = refine(data, point, [ALONG_Y], noise=False)
    assert data.asked == pytest.approx([0.0, *(0.1 / 3**k for k in range(tries))])
    assert found.point.effects["linear_drag"]["y"] == 0.0


# -- where the filter leaves the range of numbers ----------------------------------------------------------------------


@pytest.fixture
def wild() -> tuple[Data, Point]:
    """A model whose drag, against a wind that no air has, is beyond all numbers."""
    data = data_of(fly(seconds=5.0))
    effects = {"quadratic_drag": {"x": 1e200, "y": 1e200, "z": 1e200}}
    return data, Point(DRONE, effects, start_noise())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_it_is_a_sentence_and_no_traceback(wild: tuple[Data, Point]) -> None:
    data, point = wild
    with pytest.raises(DataError, match="leaves the range of numbers"):
        refine(data, point, [QUADRATIC_DRAG])


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
    linear = Trial(QUADRATIC_DRAG, 50.0, 50.0, 1.0, 49.0)
    solution: Any = SimpleNamespace(theta=np.array([0.1, 0.1, 0.1]))
    found = fitted_trial(basis, linear, solution, say=silent)
    assert found is linear
    assert not found.admissible
