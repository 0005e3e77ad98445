"""Where a fit ends: at the maximum that a plain search finds, without looks at steps that promise nothing."""

from collections.abc import Sequence

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from scipy.optimize import minimize_scalar

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, refine
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Column, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.settings import FITTING

DRAG = Candidate("linear_drag", (), ("y",))


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


def begun(data: Data) -> Point:
    point = Point(DRONE, {"linear_drag": {"x": 0.0, "y": 0.0, "z": 0.0}}, start_noise())
    data.settle(point)
    return data.fit_noise(point)


def test_a_fit_ends_where_a_plain_search_does_and_a_second_one_takes_no_step():
    data = Counted([flight_of(fly(Hidden(drag=(0.0, 0.02, 0.0)), seconds=8.0, seed=4), DRONE)])
    point = begun(data)
    found = refine(data, point, [DRAG], noise=False)
    value = found.point.effects["linear_drag"]["y"]

    def lost(y: float) -> float:
        return -data.twin().loglik(point.with_effects({"linear_drag": {"y": y}}), passes=3)

    plain = minimize_scalar(lost, bracket=(value - 0.01, value + 0.01), tol=1e-4)
    sd = 1.0 / np.sqrt(found.gram.total([0])[1][0, 0])
    assert value == pytest.approx(plain.x, abs=0.2 * sd)
    assert found.loglik == pytest.approx(-plain.fun, abs=FITTING.min_round_gain)
    data.looks = 0
    again = refine(data, found.point, [DRAG], noise=False)
    assert data.looks == 1
    assert again.point == found.point


@pytest.mark.parametrize(("depth", "tries"), [(1e4, FITTING.tries), (0.3, 1)])
def test_a_step_that_fails_is_tried_smaller_only_where_something_is_to_be_gained(depth: float, tries: int) -> None:
    """The step is 0.1: of 1000 nats lost a third of it may be worth a look, of 0.03 not."""
    data = Falling(depth)
    point = Point(DRONE, {"linear_drag": {"x": 0.0, "y": 0.0, "z": 0.0}}, start_noise())
    found = refine(data, point, [DRAG], noise=False)
    assert data.asked == pytest.approx([0.0, *(0.1 / 3**k for k in range(tries))])
    assert found.point.effects["linear_drag"]["y"] == 0.0
