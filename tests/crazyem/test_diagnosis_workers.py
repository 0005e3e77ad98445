"""Threads that share a diagnosis: the same result for any number of them, in order, and nobody waits for himself."""

import threading
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import data_of, start_point

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.workers import MOST, Workers
from crazyem.errors import UsageError


def test_two_items_are_worked_on_at_a_time():
    meet = threading.Barrier(2, timeout=60.0)
    assert sorted(Workers(2).map(lambda _: meet.wait(), range(2))) == [0, 1]


def test_who_is_idle_helps_a_worker_that_shares_work():
    meet = threading.Barrier(2, timeout=60.0)
    workers = Workers(2)
    done = workers.map(lambda shares: workers.map(lambda _: meet.wait(), range(2)) if shares else [], [False, True])
    assert [sorted(row) for row in done] == [[], [0, 1]]


@pytest.mark.parametrize("jobs", [1, 2, 3, 8])
def test_results_come_in_order_and_nobody_waits_for_work_that_is_not_begun(jobs):
    workers = Workers(jobs)

    def shared(depth, name):
        return [name] if depth == 0 else list(chain(*workers.map(lambda i: shared(depth - 1, f"{name}{i}"), range(3))))

    assert shared(4, "") == [f"{a}{b}{c}{d}" for a in range(3) for b in range(3) for c in range(3) for d in range(3)]


def test_helpers_say_of_overflow_what_the_asker_says():
    meet = threading.Barrier(2, timeout=60.0)
    with np.errstate(over="ignore"):
        there = Workers(2).map(lambda _: (meet.wait(), np.geterr()["over"])[1], range(2))
    assert there == ["ignore", "ignore"]
    assert np.geterr()["over"] != "ignore"


def test_of_several_failures_the_first_comes_out():
    meet = threading.Barrier(2, timeout=60.0)

    def fail(number):
        meet.wait()
        raise ValueError(number)

    with pytest.raises(ValueError, match=r"^7$"):
        Workers(2).map(fail, [7, 8])


def test_after_an_interruption_nobody_goes_on():
    taken, begun = [], threading.Event()

    def interrupted(number):
        taken.append(number)
        if threading.current_thread() is threading.main_thread():
            begun.set()
            raise KeyboardInterrupt
        begun.wait(60.0)

    with pytest.raises(KeyboardInterrupt):
        Workers(2).map(interrupted, range(1_000_000))
    assert len(taken) < 1_000_000


@pytest.mark.parametrize("jobs", [0, -1, MOST + 1])
def test_a_number_of_threads_that_makes_no_sense(jobs):
    with pytest.raises(UsageError, match="--jobs"):
        Workers(jobs)


def test_what_is_done_to_a_twin_leaves_the_data_as_it_is():
    data = data_of(fly(seconds=5.0))
    point = start_point()
    data.settle(point)
    path = data.models[0].path
    kept = path.copy()
    other = replace(point, noise=start_noise()).with_effects({"payload": {"mass": 0.01, "x": 0.0, "y": 0.0, "z": 0.0}})
    twin = data.twin()
    twin.settle(other)
    assert data.models[0].path is path
    np.testing.assert_array_equal(path, kept)
    assert not np.array_equal(twin.models[0].path, kept)


@pytest.mark.slow
def test_any_number_of_threads_finds_the_same():
    recording = fly(Hidden(thrust=(1, 1, 0.9, 1)), seconds=8.0)
    alone, shared = (diagnose([recording], DRONE, wanted=["rotor_fault", "linear_drag"], jobs=jobs) for jobs in (1, 3))
    assert alone.effects == shared.effects
    assert alone.effects[0].name == "rotor_fault"
    assert alone.selection.fitted.loglik == shared.selection.fitted.loglik
