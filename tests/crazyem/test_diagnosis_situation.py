"""Between two passes: compiled pieces against plain numpy and scipy; what a pass remembers is that of the last path."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from diagnosis_parts import start_point
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.fitting.model import Model, Point, filter_corrections, under_relaxed
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.situation import (
    causal_middle,
    impulses,
    initial_path,
    unmeasured,
    with_interpolated_states,
)
from crazyem.diagnosis.flights.flight import flight_of

seeds = st.integers(0, 2**32 - 1)


def states(seed, n=20):
    """Filtered and predicted states (n, 19) that differ a little, with quaternions of either sign, and starts (n,)."""
    rng = np.random.default_rng(seed)
    filtered = rng.normal(size=(n, 19))
    filtered[:, 6:10] = Rotation.random(n, random_state=seed).as_quat()
    predicted = filtered + 0.1 * rng.normal(size=(n, 19))
    turned = Rotation.from_rotvec(0.1 * rng.normal(size=(n, 3))) * Rotation.from_quat(np.roll(filtered, 1, 0)[:, 6:10])
    predicted[:, 6:10] = turned.as_quat() * rng.choice([-1.0, 1.0], size=(n, 1))
    return filtered, predicted, rng.random(n) < 0.2


@given(seeds)
def test_middle_of_a_step(seed):
    filtered, predicted, starts = states(seed)
    middle = causal_middle(filtered, predicted, starts)
    for k in range(len(middle)):
        if k == 0 or starts[k]:
            np.testing.assert_array_equal(middle[k], predicted[k])
            continue
        rest = np.r_[0:6, 10:19]
        np.testing.assert_allclose(middle[k, rest], 0.5 * (filtered[k - 1, rest] + predicted[k, rest]), atol=1e-14)
        begin, end = Rotation.from_quat(filtered[k - 1, 6:10]), Rotation.from_quat(predicted[k, 6:10])
        half = begin * Rotation.from_rotvec(0.5 * (begin.inv() * end).as_rotvec())
        assert (Rotation.from_quat(middle[k, 6:10]).inv() * half).magnitude() < 1e-7
        assert abs(np.linalg.norm(middle[k, 6:10]) - 1.0) < 1e-14


@given(seeds)
def test_what_measurements_brought(seed):
    filtered, predicted, starts = states(seed)
    step = np.random.default_rng(seed).uniform(0.0, 0.02, len(starts))
    found = np.zeros((len(starts), 6))
    impulses(predicted, filtered, step, ~starts, found)
    body = Rotation.from_quat(filtered[:, 6:10]).inv().apply(filtered[:, 3:6] - predicted[:, 3:6])
    expected = np.concatenate([body, filtered[:, 10:13] - predicted[:, 10:13]], 1) + step[:, None] * filtered[:, 13:19]
    np.testing.assert_allclose(found, np.where(starts[:, None], 0.0, expected), atol=1e-13)


def restarting(seed: int = 1):
    """A flight, and the same as a log of mixed rates in which the filter restarts."""
    whole = flight_of(fly(seconds=5.0), DRONE)
    rng, y = np.random.default_rng(seed), whole.y.copy()
    for columns in (slice(0, 6), slice(6, 10)):
        y[rng.random(len(y)) < 0.7, columns] = np.nan
    return whole, replace(whole, y=y, starts=whole.starts | (rng.random(len(y)) < 0.05))


def test_states_that_nothing_measured_since_a_restart_are_interpolated():
    """Against a loop over the rows."""
    _, flight = restarting()
    found, seen = unmeasured(flight), np.zeros(4, bool)
    for k, row in enumerate(flight.y):
        seen = (seen & (not flight.starts[k])) | np.isfinite(row[[0, 3, 6, 10]])
        np.testing.assert_array_equal(found[k], ~seen)
    filled, other = with_interpolated_states(flight, np.full((len(found), 19), 7.0), np.full((len(found), 19), 8.0))
    path = initial_path(flight)
    for states, known in ((filled, 7.0), (other, 8.0)):
        np.testing.assert_array_equal(states[:, 0], np.where(found[:, 0], path[:, 0], known))
        np.testing.assert_array_equal(states[:, 9], np.where(found[:, 2], path[:, 9], known))
        assert (states[:, 13:] == known).all()


def test_the_first_measurement_after_a_restart_is_no_force():
    """It moves the filter from a guess to the drone. Other corrections are those of a flight that has no restart."""
    whole, flight = restarting()
    model, point = Model(flight), start_point()
    impulse, _, known = filter_corrections(model.settle(point), flight)
    guessed = np.roll(unmeasured(flight).any(axis=1), 1) & ~flight.starts
    assert guessed.sum() > 20
    assert not known[guessed].any()
    assert not impulse[guessed].any()
    usual, _, _ = filter_corrections(Model(whole).settle(point), whole)
    assert np.abs(impulse[:, :3]).max() < 5.0 * np.abs(usual[:, :3]).max()
    assert np.abs(model.rows_path[:, :3] - whole.y[:, :3])[flight.starts].max() < 0.05  # m; without it as far as zero


def test_what_is_remembered_is_of_the_last_path():
    """A model that was elsewhere before, and was asked there, says the same as one that remembers nothing."""
    model = Model(flight_of(fly(seconds=5.0), DRONE))
    lags = {
        "onboard_filter": {"rate_lag": 0.003, "velocity_lag": 0.004},
        "velocity_scale": {"x": 1.1, "y": 0.9, "z": 1.0},
    }
    there = []
    for mass in (0.0, 0.01):
        point = Point(DRONE, {**lags, "payload": {"mass": mass, "x": 0.0, "y": 0.0, "z": 0.0}}, start_noise())
        model.settle(point)
        forgetful = replace(model, _thrusts={}, _path_situation=None, _row_situation=None, _offsets={})
        expected, _ = forgetful.accelerations(point)
        for _ in range(2):
            found, _ = model.accelerations(point)
            np.testing.assert_array_equal(found, expected)
            np.testing.assert_array_equal(model.offsets(point, found), forgetful.offsets(point, expected))
        there.append(model.offsets(point, found))
    assert not np.array_equal(*there)  # or nothing was asked


def test_what_a_filter_shows_is_remembered_by_the_tilt_before_it():
    """Two tilts of the pose in turns, under one model: each time as from a model that remembers nothing."""
    model = Model(replace(flight_of(fly(seconds=5.0), DRONE), fused=True))
    effects = {"onboard_filter": {"lateral_time_constant": 0.2}, "linear_drag": {"x": 0.01, "y": 0.01}}
    point = Point(DRONE, effects, start_noise())
    model.settle(point)
    acceleration, _ = model.accelerations(point)
    shown = []
    for roll in (0.0, 0.02, 0.0, 0.02):
        tilted = {**effects, "attitude_misalignment": {"roll": roll, "pitch": 0.0}}
        shown.append(model.offsets(point, acceleration, tilted))
        plain = replace(model, _offsets={}).offsets(point, acceleration, tilted)
        np.testing.assert_array_equal(shown[-1], plain)
    assert np.abs(shown[1][:, 3:6] - shown[0][:, 3:6]).max() > 1e-3  # m/s, or nothing was asked


def test_an_innovation_does_not_contain_its_own_measurements():
    """Another velocity and rate at one row change the offsets of later rows only: the likelihood is one of predictions.

    With a velocity scale of 1.1 and lags of some ms, the filtered states of the row itself would change its offset by a
    tenth of the change, and each row would seem better predicted than it is.
    """
    flight, at = flight_of(fly(seconds=5.0), DRONE), 200
    effects = {
        "velocity_scale": {"x": 1.1, "y": 1.1, "z": 1.1},
        "onboard_filter": {"rate_lag": 2e-3, "velocity_lag": 4e-3, "attitude_lag": 0.0, "lateral_time_constant": 0.2},
    }
    point = Point(DRONE, effects, start_noise())

    def offsets(change):
        y = flight.y.copy()
        y[at, 3:6] += change
        y[at, 10:13] += 10.0 * change
        model = Model(replace(flight, y=y))
        model.settle(point, passes=12)
        return model.offsets(point, model.accelerations(point)[0])

    change = np.abs(offsets(0.02) - offsets(0.0)).max(axis=1)
    assert change[at + 1 : at + 3].max() > 1e-4
    assert change[: at + 1].max() < 1e-9


# -- where a velocity is shown far too large ---------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.3, 1.9, 3.0])
@pytest.mark.parametrize("believed", [1.0, 0.7])
def test_a_velocity_shown_too_large_is_found_in_few_passes(scale: float, believed: float) -> None:
    """A filter that takes the offset of the pass before off what is shown, and believes that to a share."""
    random = np.random.default_rng(1)
    truth = random.normal(size=(200, 3))
    shown = scale * truth
    states = np.zeros((200, 19))
    states[:, 3:6] = shown
    for _ in range(12):
        offset = np.zeros((200, 12))
        offset[:, 3:6] = (scale - 1.0) * states[:, 3:6]
        filtered = states.copy()
        filtered[:, 3:6] = believed * (shown - offset[:, 3:6]) + (1.0 - believed) * truth
        states = under_relaxed(filtered, states, offset)
    assert states[:, 3:6] == pytest.approx(truth, abs=2e-3)


def test_without_an_offset_of_velocity_nothing_is_kept() -> None:
    filtered = np.ones((5, 19))
    assert under_relaxed(filtered, np.zeros((5, 19)), np.zeros((5, 12))) is filtered
    assert under_relaxed(filtered, None, np.ones((5, 12))) is filtered
