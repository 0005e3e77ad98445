"""The age of a state that is held between predictions: drawn motions, a slow forward algorithm, other filters."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crazyem.monitoring import state_age
from crazyem.monitoring.state_age import PERIOD, PHASES, StateAge, StateAges
from crazyem.physics.rotations import quaternion_from_rotation_vector, quaternion_product


def motion(time: float) -> NDArray[np.float64]:
    """State (13,) on a circle, turning about z."""
    turn = 2.0 * time
    circle = np.array([math.cos(turn), math.sin(turn), 0.0])
    tangent = 2.0 * np.array([-math.sin(turn), math.cos(turn), 0.0])
    attitude = [0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2)]
    return np.concatenate([circle, tangent, attitude, [0.0, 0.0, 2.0]])


def ages(stamps: NDArray[np.float64], phase: float, found: StateAge, *, noise: float = 1e-3) -> NDArray[np.float64]:
    """(n, 2) s, true and found ages of states that were predicted at `phase` [s] after multiples of the period."""
    random, out = np.random.default_rng(5), []
    for time in stamps:
        age = (time - phase + 1e-6) % PERIOD
        state = motion(time - age)
        state[:3] += noise * random.standard_normal(3)
        out.append((age, found.add(float(time), state)))
    return np.array(out)


@settings(max_examples=20, deadline=None)
@given(phase=st.integers(0, 9), step=st.sampled_from([4, 7, 11, 13, 20.5]))
def test_ages_are_found_within_a_millisecond(phase: int, step: float) -> None:
    stamps = np.round(np.arange(1.0, 9.0, 1e-3 * step), 3)
    table = ages(stamps, 1e-3 * phase, StateAge())[len(stamps) // 2 :]
    error = table[:, 1] - table[:, 0]
    assert error.std() < 1e-3
    assert table[:, 0].std() > 2e-3


def test_a_state_that_is_not_held_has_no_age() -> None:
    found, random = StateAge(), np.random.default_rng(2)
    for time in np.arange(1.0, 4.0, 0.011):
        state = motion(time)
        state[:3] += 1e-3 * random.standard_normal(3)
        found.add(float(time), state)
    assert found.probability[PHASES] > 0.99
    assert abs(found.age) < 0.1 * PERIOD / 2


def test_hover_says_nothing_of_the_phase() -> None:
    found, random = StateAge(), np.random.default_rng(3)
    state = np.zeros(13)
    state[9] = 1.0
    for time in np.arange(1.0, 2.0, 0.011):
        state[:3] = 1e-3 * random.standard_normal(3)
        found.add(float(time), state)
    assert found.probability[:PHASES].max() < 0.5


def test_the_change_is_seen_where_the_period_of_the_log_is_that_of_the_predictions() -> None:
    """A late prediction moves the phase past that of the log: the age jumps from 0 to 9 ms."""
    found = StateAge()
    before = ages(np.round(np.arange(1.0, 3.0, 0.01), 3), 0.0, found)
    after = ages(np.round(np.arange(3.0, 3.1, 0.01), 3), 0.001, found)
    np.testing.assert_allclose(before[10:, 1], 0.0, atol=1e-3)
    assert after[0, 1] - before[-1, 1] == pytest.approx(0.009, abs=2e-3)


def test_probabilities_are_those_of_a_slow_forward_algorithm() -> None:
    """Transition matrix and likelihoods written out; the variances are constant within one step."""
    random = np.random.default_rng(4)
    probability = random.dirichlet(np.ones(PHASES + 1))
    before, now = 1.0043, 1.0153
    last, state, variance = random.standard_normal(13), random.standard_normal(13), np.array([1e-5, 4e-5])
    last[6:10] /= np.linalg.norm(last[6:10])
    state[:3] = last[:3] + 5e-3 * random.standard_normal(3)
    moved = np.stack([state[:3] - last[:3], 5e-3 * random.standard_normal(3)])
    state[6:10] = -quaternion_product(last[6:10], quaternion_from_rotation_vector(moved[1]))  # the same attitude as +
    expected = 0.5 * np.stack([last[3:6] + state[3:6], last[10:] + state[10:]])
    slip = state_age.SLIP * (now - before) / PERIOD
    joint, change = np.zeros((PHASES + 1, PHASES + 1)), np.zeros((PHASES + 1, PHASES + 1))

    def likelihood(passed: float) -> float:
        squares = ((moved - passed * expected) ** 2).mean(1) / variance
        return float(np.exp(-1.5 * np.minimum(squares, state_age.CLIPPED**2).sum()))

    other = state_age.ANEW / (2 * PHASES + 1)
    for j in range(PHASES):
        for late in (0, 1):
            to = (j + late) % PHASES
            old = (before * 1e3 - j + 1e-3) % 10 * 1e-3
            new = (now * 1e3 - to + 1e-3) % 10 * 1e-3
            change[j, to] = new - old
            prior = (1 - state_age.ANEW) * probability[j] * (slip if late else 1 - slip) + other
            joint[j, to] = prior * likelihood(now - before - change[j, to])
    joint[-1, -1] = ((1 - state_age.ANEW) * probability[-1] + other) * likelihood(now - before)
    joint /= joint.sum()
    got = probability.copy()
    mean = state_age.advance(got, variance.copy(), np.full(1, 20.0), before, last, now, state)
    np.testing.assert_allclose(got, joint.sum(0), rtol=1e-3)  # rotations to first order
    assert mean == pytest.approx((joint * change).sum(), rel=1e-3)


def test_a_gap_and_an_outlier() -> None:
    found = StateAge()
    ages(np.round(np.arange(1.0, 3.0, 0.011), 3), 0.003, found)
    before = found.probability.copy()
    state = motion(3.0)
    state[:3] += 100.0
    found.add(3.0, state)
    assert found.probability.argmax() == before.argmax()
    assert found.add(9.0, motion(9.0)) == 0.0


def test_a_stream_gives_ages_to_complete_states_only() -> None:
    found = StateAges()
    np.testing.assert_array_equal(found.at(np.array([1.0])), [0.0])
    for time in np.round(np.arange(1.0, 5.0, 0.011), 3):
        state = motion(time - (time - 0.003 + 1e-6) % PERIOD)
        for name, columns in (("position", slice(0, 3)), ("velocity", slice(3, 6)), ("attitude", slice(6, 10)),
                              ("body_rate", slice(10, 13))):  # fmt: skip
            found.add(name, float(time), tuple(state[columns]))
        found.add("position", float(time) + 0.004, (0.0, 0.0, 0.0))
        found.add("voltage", float(time), (4.0,))
    got = found.at(np.array([4.0, 4.003, 4.007, 99.0]))  # 4.003 is a stamp of a state, 4.007 one of a lone position
    assert abs(got[1]) > 0.0
    assert got[[0, 2, 3]].tolist() == [0.0, 0.0, 0.0]
