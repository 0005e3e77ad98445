"""The contact gate: samples on the ground never enter the window, however the flight begins and ends."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.estimation.contact import CLEARANCE_HEIGHT, CONFIRMING_HEIGHTS, CONTACT_HEIGHT, OFF_FRACTION, ContactGate

MAX = 0.48  # N, four rotors of 0.12 N
HOVER = 0.28
IDLE = 0.9 * OFF_FRACTION * MAX
nan = math.nan


def run(*samples, thrust_max=MAX):
    """Verdicts for (height, thrust) or (height, thrust, flying) one after the other."""
    gate = ContactGate(thrust_max)
    return [gate.update(height=s[0], thrust=s[1], flying=s[2] if len(s) > 2 else None) for s in samples]


Y, N = True, False
FLIGHTS = {
    "from the ground and back": (
        (0.0, 0.0), (0.0, 0.2), (0.01, 0.3), (0.05, HOVER), (0.09, HOVER), (0.5, HOVER), (1.0, HOVER), (0.5, HOVER),
        (0.09, HOVER), (0.06, HOVER), (0.04, HOVER), (0.0, 0.2), (0.0, 0.0), [N, N, N, N, N, Y, Y, Y, Y, Y, N, N, N],
    ),
    "from a table": ((0.75, 0.0), (0.78, HOVER), (0.92, HOVER), (0.79, HOVER), [N, N, Y, N]),
    "a second rest on a higher place": (
        (0.0, 0.0), (0.5, HOVER), (0.4, 0.0), (0.42, HOVER), (0.57, HOVER), [N, Y, N, N, Y],
    ),
    "far above the ground at once": ((0.0, 0.0), (2 * CLEARANCE_HEIGHT, HOVER), [N, Y]),
    "a recording that begins in flight": ((1.0, HOVER), (1.01, HOVER), (0.02, HOVER), [Y, Y, Y]),
    "after its landing the ground is known": ((1.0, HOVER), (0.0, 0.0), (0.03, HOVER), (0.2, HOVER), [Y, N, N, Y]),
    "no height at all": ((nan, 0.0), (nan, HOVER), (nan, 0.01), [N, Y, N]),
    "a lost height keeps the verdict": (
        (0.0, 0.0), (nan, HOVER), (0.5, HOVER), (nan, HOVER), (0.01, HOVER), (nan, HOVER), [N, N, Y, Y, N, N],
    ),
    "the firmware says not flying": (
        (0.0, 0.0), (0.5, HOVER, False), (0.5, HOVER, True), (0.02, HOVER, True), [N, N, N, N],
    ),
    "the firmware says flying": ((0.0, 0.0, False), (0.5, HOVER, True), [N, Y]),
    "idling rotors are off": ((0.0, IDLE), (1.0, IDLE), [N, N]),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIGHTS)
def test_verdicts_of_a_flight(name):
    *samples, expected = FLIGHTS[name]
    assert run(*samples) == expected


def test_a_slow_take_off_is_believed_when_it_is_seen_again_and_again():
    low = [(CLEARANCE_HEIGHT + 0.001, HOVER)]
    assert run((0.0, 0.0), *low * (CONFIRMING_HEIGHTS + 1)) == [False] * CONFIRMING_HEIGHTS + [True, True]
    # one reading below starts the count anew, one that is missing does not
    interrupted = [*low * (CONFIRMING_HEIGHTS - 1), (0.07, HOVER), *low * (CONFIRMING_HEIGHTS - 1), (nan, HOVER), *low]
    assert run((0.0, 0.0), *interrupted) == [False] * (1 + len(interrupted) - 1) + [True]
    # what was counted before a touch-down does not count after it
    down = [(0.5, HOVER), (0.0, HOVER), *low * CONFIRMING_HEIGHTS]
    assert run((0.0, 0.0), *low * CONFIRMING_HEIGHTS, *down)[CONFIRMING_HEIGHTS + 1 :] == [
        True, False, *[False] * (CONFIRMING_HEIGHTS - 1), True,
    ]  # fmt: skip


def test_the_gap_between_clearance_and_contact_keeps_noise_from_toggling():
    between = (CLEARANCE_HEIGHT + CONTACT_HEIGHT) / 2
    rising = run((0.0, 0.0), *[(between + 0.01 * (-1) ** k, HOVER) for k in range(10)])
    assert not any(rising)
    falling = run((0.0, 0.0), (0.5, HOVER), *[(between + 0.01 * (-1) ** k, HOVER) for k in range(10)])
    assert all(falling[1:])


def test_unknown_largest_thrust_takes_only_zero_for_off():
    assert run((0.0, 0.0), (0.0, 1e-6), (0.5, 1e-6), thrust_max=math.inf) == [False, False, True]


def test_the_reason_is_always_there_when_it_does_not_fly():
    gate = ContactGate(MAX)
    assert not gate.airborne
    assert gate.reason
    gate.update(height=0.0, thrust=0.0, flying=None)
    assert "rotors off" in gate.reason
    gate.update(height=0.01, thrust=HOVER, flying=None)
    assert gate.reason == "on the ground"
    gate.update(height=1.0, thrust=HOVER, flying=None)
    assert gate.reason == ""


@given(st.lists(st.tuples(st.floats(-0.02, 0.045) | st.just(nan), st.floats(0, MAX)), min_size=1, max_size=50))
def test_no_ground_sample_is_ever_let_through(samples):
    """Whatever the rotors do and whatever is measured: below the contact height after a rest nothing is flight."""
    assert not any(run((0.0, 0.0), *((h + 0.0, f) for h, f in samples)))


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.014))
def test_a_noisy_height_lets_no_sample_on_the_floor_through(seed, noise):
    """The paper's take-off: one reading at rest, then a second on the floor under rising thrust."""
    heights = noise * np.random.default_rng(seed).normal(size=200)
    assert not any(run(*((h, 0.01 * k) for k, h in enumerate(heights)), thrust_max=math.inf))


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.014), st.floats(0.2, 3.0))
def test_a_noisy_height_hides_no_flight_for_long(seed, noise, scoring_steps):
    """Climbing at 0.2 m/s and more, the drone is known to fly before it is a quarter of a metre up, and remains so."""
    rng = np.random.default_rng(seed)
    heights = np.concatenate([[0.0], scoring_steps * 0.005 * np.arange(400)])
    verdicts = run(*((h + noise * rng.normal(), float(k > 0)) for k, h in enumerate(heights)), thrust_max=math.inf)
    flies = heights > 0.25
    assert all(v for v, f in zip(verdicts, flies) if f)


@given(st.integers(0, 2**32 - 1))
def test_touch_downs_are_taken_out_again(seed):
    """Up, down to the floor with the rotors turning, and up again, with noise: no sample on the floor is ever used."""
    rng = np.random.default_rng(seed)
    up = np.linspace(0.0, 0.5, 60)
    heights = np.concatenate([[0.0], up, up[::-1], np.zeros(40), up])
    verdicts = run(*((h + 0.01 * rng.normal(), float(k > 0)) for k, h in enumerate(heights)), thrust_max=math.inf)
    assert not any(verdicts[121:161])
    assert verdicts[60]
    assert verdicts[-1]


@given(st.lists(st.tuples(st.floats(-1, 3) | st.just(nan), st.floats(0, 1), st.none() | st.booleans()), max_size=50))
def test_rotors_off_is_never_flight(samples):
    for (_, thrust, flying), verdict in zip(samples, run(*samples)):
        if thrust <= OFF_FRACTION * MAX or flying is False:
            assert not verdict
