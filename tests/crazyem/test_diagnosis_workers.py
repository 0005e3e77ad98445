"""Threads that share a diagnosis: the same result for any number of them, in order, and nobody waits for himself."""

import threading

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.fit import Data, starting_point
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import first_guess
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.workers import MOST, Workers
from crazyem.errors import UsageError


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_results_come_in_order(jobs):
    assert Workers(jobs).map(lambda x: x * x, range(50)) == [x * x for x in range(50)]


def test_two_items_are_worked_on_at_a_time():
    meet = threading.Barrier(2, timeout=20.0)
    assert sorted(Workers(2).map(lambda _: meet.wait(), range(2))) == [0, 1]


def test_a_worker_that_shares_work_does_it_himself():
    workers = Workers(2)
    inner = workers.map(lambda i: workers.map(lambda k: (i, k, threading.get_ident()), range(3)), range(4))
    assert [[entry[:2] for entry in row] for row in inner] == [[(i, k) for k in range(3)] for i in range(4)]
    assert all(len({thread for _, _, thread in row}) == 1 for row in inner)


def test_a_failure_comes_out():
    with pytest.raises(ZeroDivisionError):
        Workers(2).map(lambda x: 1 / x, [1, 0, 2])


@pytest.mark.parametrize("jobs", [0, -1, MOST + 1])
def test_a_number_of_threads_that_makes_no_sense(jobs):
    with pytest.raises(UsageError, match="--jobs"):
        Workers(jobs)


def test_what_is_done_to_a_twin_leaves_the_data_as_it_is():
    data = Data([flight_of(fly(seconds=5.0), DRONE)])
    point = Point(DRONE, {}, first_guess())
    data.settle(point)
    path = data.models[0].path
    kept = path.copy()
    other = starting_point(point).with_effects({"payload": {"mass": 0.01, "x": 0.0, "y": 0.0, "z": 0.0}})
    twin = data.twin()
    twin.settle(other)
    assert data.models[0].path is path
    np.testing.assert_array_equal(path, kept)
    assert not np.array_equal(twin.models[0].path, kept)


@pytest.mark.slow
def test_any_number_of_threads_finds_the_same():
    recording = fly(Hidden(thrust=(1, 1, 0.9, 1)), seconds=8.0)
    alone, shared = (
        diagnose([recording], DRONE, wanted=["rotor_fault", "linear_drag", "payload"], jobs=jobs) for jobs in (1, 3)
    )
    assert alone.effects == shared.effects
    assert alone.effects[0].name == "rotor_fault"
    assert alone.selection.fitted.loglik == shared.selection.fitted.loglik
