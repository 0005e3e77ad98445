"""Sets of parameters reach a drone whole or not at all: the order of writes, losses inside a set, the way back."""

import itertools
import math
import time
from dataclasses import replace

import fake_drone as fake
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_guard import NOMINAL, ORIGINALS

from crazyem.errors import LinkError
from crazyem.links.base import ParameterWrite
from crazyem.live.controllers import EQUAL_WITHIN, LEE, writes_back, writes_for
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History
from crazyem.live.push import WRITE_ATTEMPTS, Pusher

NEW = {"mass": 0.033, "Ixx": 1.9e-5, "Iyy": 1.9e-5, "Izz": 3.3e-5}


class Drone:
    """Parameters that can be written; `deaf(n)` says whether the n-th attempt goes unanswered; `applied`: it counts."""

    uri = "fake://0"

    def __init__(self, deaf=lambda n: False, applied=False):
        self.values, self.deaf, self.applied = dict(ORIGINALS), deaf, applied
        self.log, self.attempts = [], 0

    def write_parameter(self, name, value, timeout=1.0):
        self.attempts += 1
        lost = self.deaf(self.attempts)
        if not lost or self.applied:
            self.values[name] = value
            self.log.append((name, value))
        return ParameterWrite(name, value, None if lost else value, not lost, time.time())


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr("crazyem.live.push.RETRY_PAUSE", 0.001)


def a_set(changed=None):
    return Decision(1.0, writes=writes_for(LEE, changed or NEW, beliefs=NOMINAL, originals=ORIGINALS))


def run(drone, *decisions, guard=None, known=ORIGINALS, **kw):
    guard, history = guard or Guard(LEE, nominal=NOMINAL, originals=ORIGINALS), History()
    done = []
    pusher = Pusher(drone, guard, gate=fake.OPEN, history=history, timeout=0.01, known=known,
                    on_done=lambda d, why: done.append((d.kind, not why)), **kw)  # fmt: skip
    for decision in decisions:
        pusher.submit(decision)
    pusher.close()
    assert not pusher.busy
    return guard, history, done, pusher


def test_a_whole_set():
    drone = Drone()
    guard, history, done, pusher = run(drone, a_set())
    assert drone.log == list(a_set().writes)
    assert done == [("push", True)]
    assert not guard.stopped
    assert pusher.known == drone.values
    assert {p.purpose for p in history.pushes} == {"push"}


@pytest.mark.parametrize("applied", [False, True])
@pytest.mark.parametrize("at", range(10))
def test_a_set_that_breaks_anywhere_is_undone_completely(at, applied):
    """All attempts at write `at` go unanswered, whether it arrived or not; then the drone answers again."""
    drone = Drone(lambda n: at < n <= at + WRITE_ATTEMPTS, applied)
    attempts = []
    guard, history, done, pusher = run(drone, a_set(), a_set(), on_write=attempts.append)
    assert drone.values == ORIGINALS
    assert pusher.known == ORIGINALS
    assert len(attempts) == drone.attempts
    assert done == [("push", False), ("push", False)]
    assert "not confirmed" in guard.stopped
    assert any("undone" in n for n in history.notices)
    assert [p for p in history.pushes if not p.verified] == [history.pushes[at]]  # and no write went unaccounted
    assert sum(p.verified for p in history.pushes) == len(drone.log) - (WRITE_ATTEMPTS if applied else 0)


@pytest.mark.parametrize(
    ("lost", "outage"), [((3,), False), ((5, 6, 7), True)], ids=["one echo", "three, with the link"]
)
def test_lost_echoes_are_asked_for_again(lost, outage):
    """The link goes in the third attempt at the fifth write, is noticed to be gone only then, and comes back.

    An attempt during which the link was lost counts for nothing.
    """
    drone = Drone(lambda n: n in lost)
    guard, _, done, _ = run(drone, a_set(), outages=lambda: int(outage and drone.attempts >= lost[-1]))
    assert done == [("push", True)]
    assert not guard.stopped
    assert drone.attempts == len(a_set().writes) + len(lost)


def test_a_link_that_keeps_going_does_not_keep_a_write_for_ever():
    drone = Drone(lambda n: True)
    guard, _, _, _ = run(drone, a_set(), outages=lambda: drone.attempts)
    assert guard.stopped
    assert drone.attempts == 2 * 2 * WRITE_ATTEMPTS  # the write, and its undoing


def test_what_cannot_be_undone_is_said():
    drone = Drone(lambda n: n > 4)
    guard, history, _, pusher = run(drone, a_set())
    assert guard.stopped
    assert any("could not be written back" in n for n in history.notices)
    assert math.isnan(pusher.known["ctrlLee.mass"])
    assert drone.attempts == 4 + 2 * WRITE_ATTEMPTS


def test_what_was_not_known_before_is_not_undone():
    guard, history, _, _ = run(Drone(lambda n: True), a_set(), known={})
    assert guard.stopped
    assert [(p.purpose, p.verified) for p in history.pushes] == [("push", False)]


@pytest.mark.parametrize("error", [LinkError("gone."), RuntimeError("a fault nobody foresaw")])
def test_an_attempt_that_fails_is_named_recorded_and_ends_the_pushing(error):
    """Without a link: one attempt at the write, and one at its undoing."""

    def fails(name, value, timeout=1.0):
        raise error

    drone, kept = Drone(), []
    drone.write_parameter = fails
    guard, history, _, _ = run(drone, a_set(), wait_for_link=lambda: False, on_write=kept.append)
    assert [(p.parameter, p.purpose) for p in history.pushes] == [("ctrlLee.mass", "push"), ("ctrlLee.mass", "undo")]
    assert [(w.name, w.value, w.echoed, w.verified) for w in kept] == [
        ("ctrlLee.mass", value, None, False) for value in (NEW["mass"], NOMINAL["mass"])
    ]
    assert str(error) in guard.stopped


def test_a_stop_before_a_set_drops_it_and_one_within_completes_it():
    drone = Drone()
    guard = Guard(LEE, nominal=NOMINAL, originals=ORIGINALS)
    write = drone.write_parameter

    def stop_in_the_middle(name, value, timeout=1.0):
        guard.stop("somebody said so")
        return write(name, value, timeout)

    drone.write_parameter = stop_in_the_middle
    _, _, done, _ = run(drone, a_set(), a_set({"mass": 0.036}), guard=guard)
    assert done == [("push", True), ("push", False)]
    assert drone.log == list(a_set().writes)


def test_a_revert_passes_a_guard_that_has_stopped_and_writes_only_what_differs():
    drone = Drone()
    guard, history, _, _ = run(
        drone, a_set({"mass": 0.033}), Decision(2.0, writes=tuple(ORIGINALS.items()), kind="revert")
    )
    assert drone.values == ORIGINALS
    assert drone.log == [("ctrlLee.mass", 0.033), ("ctrlLee.mass", 0.029)]
    assert [p.purpose for p in history.pushes] == ["push", "revert"]
    guard, *_ = run(Drone(lambda n: n == 99), Decision(2.0, writes=tuple(ORIGINALS.items()), kind="restore"))
    assert not guard.stopped


def test_a_fault_of_ours_in_the_account_ends_the_pushing():
    drone = Drone()

    def broken(write):
        raise OSError("disk full")

    guard, _, done, _ = run(drone, a_set(), a_set({"mass": 0.036}), on_write=broken)
    assert done == [("push", True), ("push", False)]  # not left half written, and nothing after it
    assert "disk full" in guard.stopped


# --- safe at every step ---------------------------------------------------------------------------------------------

factor = st.floats(0.4, 2.5)


def damping(values, axis):
    """Of the attitude loop J x'' + Kw x' + KR x = 0, times 2 sqrt(J): only its ratio between states matters."""
    return values[f"ctrlLee.Kw_{axis}"] / math.sqrt(values[f"ctrlLee.KR_{axis}"])


def states(start, writes):
    values = dict(start)
    yield dict(values)
    for name, value in writes:
        values[name] = value
        yield dict(values)


@given(st.tuples(factor, factor, factor), st.tuples(factor, factor, factor), factor)
def test_no_step_of_a_set_or_of_its_way_back_is_less_damped_than_both_ends(first, second, mass):
    believed = dict(NOMINAL)
    values = dict(ORIGINALS)
    for factors in (first, second):
        changed = {n: NOMINAL[n] * f for n, f in zip(("Ixx", "Iyy", "Izz"), factors)} | {"mass": 0.029 * mass}
        writes = writes_for(LEE, changed, beliefs=believed, originals=ORIGINALS)
        passed = list(states(values, writes))
        end = passed[-1]
        back = writes_back(LEE, values, now=end)
        for course in (passed, list(states(end, back))):
            for axis, state in itertools.product("xyz", course):
                least = min(damping(course[0], axis), damping(course[-1], axis))
                assert damping(state, axis) >= least * (1 - 1e-9)
        assert list(states(end, back))[-1] == pytest.approx(values, rel=1.01 * EQUAL_WITHIN)
        believed, values = {**believed, **changed}, end


@given(st.tuples(factor, factor, factor), st.integers(0, 9), st.booleans())
def test_undoing_half_a_set_is_as_damped_whether_the_lost_write_arrived_or_not(factors, at, arrived):
    changed = {n: NOMINAL[n] * f for n, f in zip(("Ixx", "Iyy", "Izz"), factors)} | {"mass": 0.033}
    writes = writes_for(LEE, changed, beliefs=NOMINAL, originals=ORIGINALS)
    at = min(at, len(writes) - 1)
    drone = Drone(lambda n: at < n <= at + WRITE_ATTEMPTS, arrived)
    run(drone, replace(a_set(), writes=writes))
    assert drone.values == pytest.approx(ORIGINALS, rel=1.01 * EQUAL_WITHIN)
    full = list(states(ORIGINALS, writes))[-1]
    for axis, state in itertools.product("xyz", states(ORIGINALS, drone.log)):
        assert damping(state, axis) >= min(damping(ORIGINALS, axis), damping(full, axis)) * (1 - 1e-9)
