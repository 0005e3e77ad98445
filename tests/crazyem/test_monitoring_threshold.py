"""The threshold against simulation: white noise, windows of every length, the rate at which the statistic crosses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.monitoring.repetition import Pair, RunTest
from crazyem.monitoring.threshold import crossing_rate, threshold_for


def crossings(threshold: float, freedom: int, longest: int, samples: int, seed: int) -> float:
    """Crossings per sample in white noise, a crossing being followed by a fresh start."""
    noise = np.random.default_rng(seed).standard_normal((samples, freedom))
    sums = np.vstack([np.zeros(freedom), np.cumsum(noise, 0)])
    largest = np.zeros(samples)
    for length in range(1, longest + 1):
        statistic = ((sums[length:] - sums[:-length]) ** 2).sum(1) / length
        largest[length - 1 :] = np.maximum(largest[length - 1 :], statistic)
    count, free_from = 0, 0
    for k in np.flatnonzero(largest > threshold):
        if k >= free_from:
            count, free_from = count + 1, k + longest
    return count / samples


@pytest.mark.parametrize("freedom", [1, 3])
def test_the_rate_of_false_alarms_is_that_of_theory(freedom: int) -> None:
    """Where they are rare enough to count as apart: some 250 in 400,000 samples, within a third."""
    longest = 64
    threshold = 16.0 if freedom == 1 else 21.0
    theory = crossing_rate(threshold, freedom, 1, longest)
    found = crossings(threshold, freedom, longest, 400_000, seed=5)
    assert found > 50 / 400_000
    assert found == pytest.approx(theory, rel=0.35)


@given(per_hour=st.floats(1e-3, 100.0), freedom=st.integers(1, 6), rate=st.sampled_from((50.0, 100.0, 500.0)))
def test_the_threshold_gives_the_rate_that_was_asked_for(per_hour: float, freedom: int, rate: float) -> None:
    threshold = threshold_for(per_hour, freedom, shortest=1.0, longest=256.0, rate=rate)
    assert crossing_rate(threshold, freedom, 1.0, 256.0) * rate * 3600.0 == pytest.approx(per_hour, rel=1e-3)
    assert threshold_for(per_hour / 10, freedom, shortest=1.0, longest=256.0, rate=rate) > threshold


def test_a_signal_that_sticks_is_told_from_one_that_rests() -> None:
    random = np.random.default_rng(1)
    test, alarms = RunTest(0.01), 0
    for k in range(20_000):  # whole millimetres at rest: half of the samples repeat the one before
        alarms += test.add(0.01 * k, (float(random.integers(2)),))
    assert alarms == 0
    found = [k for k in range(200) if test.add(200.0 + 0.01 * k, (7.0,))]
    assert len(found) == 1
    assert 10 < found[0] < 60
    assert test.alarmed
    test.add(203.0, (8.0,))
    assert not test.alarmed


def test_a_drone_that_rests_now_and_then_is_not_stuck() -> None:
    """A Markov chain: one sample in fifty begins a run, and nineteen of twenty repetitions go on."""
    random = np.random.default_rng(2)
    test, alarms, value, resting = RunTest(0.01), [], 0.0, False
    for k in range(100_000):
        resting = random.random() < (0.95 if resting else 0.02)
        value += 0.0 if resting else 1.0
        alarms += [k] if test.add(0.01 * k, (value,)) else []
    assert len(alarms) <= 1
    assert all(k < 5_000 for k in alarms)  # before a rest was known
    found = [k for k in range(1000) if test.add(1000.0 + 0.01 * k, (value + 1.0,))]
    assert len(found) == 1
    # by the closed form of a run with so small a probability: 0.02 0.95^(n - 1) < 0.01 / 3600 s * 0.01 s
    assert found[0] == pytest.approx(np.log(0.01 / 3600.0 * 0.01 / 0.02) / np.log(0.95), rel=0.25)


def test_a_gap_is_no_repetition() -> None:
    test = RunTest(0.01)
    assert not any(test.add(float(k), (1.0, 2.0)) for k in range(200))


@given(
    speed=st.floats(0.0, 2.0),
    quantum=st.sampled_from((1e-3, 1e-4)),
    stuck=st.sampled_from(("", "value", "rate")),
    rate_known=st.booleans(),
)
def test_a_signal_is_stuck_only_where_its_pair_has_moved(
    speed: float, quantum: float, stuck: str, rate_known: bool
) -> None:
    """A position along a line and its velocity, in whole quanta, for 1 s; one of them is stuck from 0.5 s on."""

    def rounded(x: float) -> tuple[float, ...]:
        return (round(x / quantum) * quantum,)

    pair, value_moves, rate_misses = Pair(1.0), False, False
    last = {"value": rounded(0.0), "rate": rounded(0.0)}
    for k in range(100):
        time, begins = 0.01 * k, k == 50
        velocity = speed * (1.0 if k < 50 else 2.0)  # so that a stuck velocity is wrong, too
        true = {"value": rounded(0.01 * speed * (min(k, 50) + 2.0 * max(k - 50, 0))), "rate": rounded(velocity)}
        last = {n: last[n] if n == stuck and k > 50 else v for n, v in true.items()}
        if begins and stuck == "rate":
            last["rate"] = rounded(speed)
        value_moves = pair.add_value(last["value"], begun=begins)
        if rate_known:
            rate_misses = pair.add_rate(time, last["rate"], begun=begins)
    if not rate_known:
        assert value_moves  # nothing says that it rests
        return
    moved = speed * 0.49 > 4.0 * quantum
    rests = speed * 2.0 < 0.4 * quantum
    if stuck == "value" and (moved or rests):
        assert value_moves == moved
    if stuck == "rate" and (moved or rests):
        assert rate_misses == moved
    if not stuck:
        assert not rate_misses
