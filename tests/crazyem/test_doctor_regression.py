"""What the physical checks stand on: tracks, windows, slopes, choices and delays, against scipy and closed forms."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import Motion, array_of
from scipy.spatial.transform import Rotation

from crazyem.doctor import kinematics, regression
from crazyem.doctor.kinematics import Grid, Track, Window, delay, spread
from crazyem.physics.rotations import euler_from_quaternion, rotate


def test_a_track_follows_a_smooth_signal_and_stops_at_gaps() -> None:
    time = np.sort(np.arange(800) * 0.01 + np.random.default_rng(1).uniform(0.0, 0.008, 800))
    time = time[(time < 3.0) | (time > 3.5)]
    array = array_of("velocity", time, np.column_stack([np.sin(2 * time), np.cos(3 * time), time]))
    light = kinematics.light(array, "velocity")
    grid = kinematics.grid_of(light)
    got = kinematics.track(light, grid)
    truth = np.column_stack([np.sin(2 * grid.time), np.cos(3 * grid.time), grid.time])
    assert np.abs(got.value - truth)[got.valid].max() < 2e-4
    inside = (grid.time > 3.02) & (grid.time < 3.48)
    assert inside.any()
    assert not got.valid[inside].any()
    assert got.valid[~((grid.time > 2.9) & (grid.time < 3.6))].mean() > 0.95


def test_a_fast_signal_is_averaged_and_a_stamp_far_away_makes_no_huge_grid() -> None:
    time = np.arange(0.0, 10.0, 0.001)
    time[5] = 4.0e9
    value = np.random.default_rng(0).normal(size=(time.size, 3))
    light = kinematics.light(array_of("body_rate", time, value), "body_rate")
    assert light.time.size <= 1001
    assert kinematics.grid_of(light).size <= 1001
    assert np.abs(light.value).std() < 0.5  # ten samples each


@given(seed=st.integers(0, 10_000))
def test_rotations_agree_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_quat(rng.normal(size=(20, 4)))
    vector = rng.normal(size=(20, 3))
    q = turn.as_quat()
    assert np.allclose(rotate(q, vector), turn.apply(vector))
    assert np.allclose(rotate(q, vector, inverse=True), turn.inv().apply(vector))
    assert np.allclose(euler_from_quaternion(q), turn.as_euler("ZYX")[:, ::-1])


def test_the_rate_of_an_attitude_is_the_rate_it_turns_with() -> None:
    motion = Motion(seconds=20.0, seed=4)
    grid = Grid(0.0, 2000)
    got = kinematics.rate_of_attitude(Track(motion.attitude(grid.time).as_quat(), np.ones(2000, bool)))
    truth = motion.body_rate(grid.time)
    assert np.abs(got.value - truth)[got.valid].max() < 2e-4
    moved = kinematics.difference(Track(motion.position(grid.time), np.ones(2000, bool)))
    assert np.abs(moved.value - motion.velocity(grid.time))[moved.valid].max() < 1e-4


def test_smoothing_both_sides_keeps_a_derivative_a_derivative() -> None:
    grid = Grid(0.0, 1000)
    x = np.column_stack([np.sin(5 * grid.time), grid.time])
    y = np.column_stack([5 * np.cos(5 * grid.time), np.ones(1000)])
    window, whole = Window(0.2), np.ones(1000, bool)
    left, right = window.mean(kinematics.difference(Track(x, whole))), window.mean(Track(y, whole))
    assert np.abs(left.value - right.value)[left.valid].max() < 5e-3
    holes = np.ones(1000, bool)
    holes[500] = False
    assert not window.mean(Track(x, holes)).valid[495:506].any()


@given(factor=st.floats(0.3, 3.0), noise_x=st.floats(0.0, 0.4), noise_y=st.floats(0.0, 0.4), seed=st.integers(0, 999))
def test_the_interval_of_a_slope_holds_the_truth_whatever_is_noisy(
    factor: float, noise_x: float, noise_y: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 90.0, 0.05)
    truth = np.column_stack([np.sin(0.7 * time + k) + np.sin(1.9 * time - k) for k in range(3)])
    x = truth + noise_x * rng.normal(size=truth.shape)
    y = factor * (truth + noise_y * rng.normal(size=truth.shape)) + 1.0
    got = regression.slope(x, y, regression.blocks(time))
    assert got.far_low <= factor * 1.01
    assert got.far_high >= factor * 0.99
    assert got.low <= got.value <= got.high


def test_a_slope_is_not_moved_by_stray_rows_nor_blind_to_rare_manoeuvres() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 60.0, 0.02)
    x = np.sin(time)[:, None] * np.ones(3)
    y = 1.3 * x + 0.01 * rng.normal(size=x.shape)
    stray = rng.random(time.size) < 0.02
    y[stray] += 50.0
    got = regression.slope(x, y, regression.blocks(time))
    assert abs(got.value - 1.3) < 0.01
    x = 0.001 * rng.normal(size=x.shape) + x * (time > 40.0)[:, None]
    y = 1.3 * x + 0.003 * rng.normal(size=x.shape)
    got = regression.slope(x, y, regression.blocks(time))
    assert abs(got.value - 1.3) < 0.01


def test_hypotheses_that_data_do_not_separate_are_left_standing() -> None:
    time = np.arange(0.0, 60.0, 0.05)
    rng = np.random.default_rng(0)
    x = np.column_stack([np.sin(time), np.cos(time), np.zeros_like(time)])
    block = regression.blocks(time)
    y = x * np.array([1.0, -1.0, 1.0]) + 0.01 * rng.normal(size=x.shape)
    ways = {"plain": (0, x), "y": (1, x * [1, -1, 1]), "y and z": (2, x * [1, -1, -1])}
    choice = regression.choose(y, ways, block)
    assert (choice.denied, choice.name) == (True, "y")
    ways = {"plain": (0, x), "z": (1, x * [1, 1, -1])}
    choice = regression.choose(x + 0.3 * rng.normal(size=x.shape), ways, block)
    assert (choice.denied, choice.name) == (False, "plain")


@given(late=st.floats(-0.2, 0.2), seed=st.integers(0, 99))
@settings(max_examples=8)
def test_a_delay_is_found_to_a_millisecond(late: float, seed: int) -> None:
    grid = Grid(0.0, 4000)
    motion = Motion(seconds=40.0, seed=seed)
    rng = np.random.default_rng(seed)
    window = Window(0.2)
    valid = np.ones(4000, bool)
    first = window.mean(Track(motion.velocity(grid.time) + 0.02 * rng.normal(size=(4000, 3)), valid))
    second = window.mean(Track(3.0 * motion.velocity(grid.time - late)[:, [1, 2, 0]], valid))
    got = delay(first, second)
    assert abs(got.value - late) < 1e-3
    error, blocks = spread(first, Track(second.value[:, [2, 0, 1]], second.valid), got, 300)
    assert error < 2e-3
    assert blocks > 10
