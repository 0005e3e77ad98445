"""Noise scales come back from data drawn with them, and what nothing measures stays as it was."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, turned
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import coloured, fit_noise, logs_of, noise_of, sample_rows, without_negligible
from crazyem.diagnosis.fitting.sweeps import Noise, run_sweep, scored_sweep
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE
from crazyem.physics.motion import RotorInput

Array = NDArray[np.float64]
G = 9.81
TRUE = Noise(np.array([0.05, 0.1, 0.2, 1.0, 0.5, 2.0]), np.array([1e-3, 8e-3, 3e-3, 1.5e-2]))
START = Noise(np.array([0.3, 0.3, 0.5, 5.0, 5.0, 5.0]), np.array([3e-3, 3e-2, 1e-2, 3e-2]))


def drawn(seed: int, noise: Noise, *, rows: int = 900, dt: float = 0.01) -> tuple[Flight, Array, Array]:
    """A flight near hover of which every step is disturbed by ten impulses, and its accelerations (n, 6), offsets."""
    rng = np.random.default_rng(seed)
    acceleration = np.zeros((rows, 6))
    time = dt * np.arange(rows)
    acceleration[:, 2] = G
    acceleration[:, 3:] = 3 * np.cos(4 * time[:, None] + np.arange(3))
    p, v, turn, w = np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3)
    disturbance = rng.normal(size=6) * noise.disturbance
    y, turns, errors = np.zeros((rows, 13)), np.zeros((rows, 3, 3)), np.zeros((rows, 12))
    sd, lasting, kept = (np.repeat(v, 3) for v in (noise.measurement, noise.coloured, np.exp(-dt / noise.recall)))
    other = np.random.default_rng([seed, 1])
    last = other.normal(size=12) * lasting
    h = dt / 10
    down = np.array([0, 0, G * h])
    for k in range(rows):
        if k:
            for _ in range(10):
                impulse = rng.normal(size=6) * noise.impulse * np.sqrt(h) + disturbance * h
                dv = turn @ (acceleration[k, :3] * h + impulse[:3]) - down
                dw = acceleration[k, 3:] * h + impulse[3:]
                p = p + h * (v + dv / 2)
                v = v + dv
                turn = turned(turn, h * (w + dw / 2))
                w = w + dw
            decay = np.exp(-dt / noise.memory)
            disturbance = decay * disturbance + np.sqrt(1 - decay**2) * noise.disturbance * rng.normal(size=6)
            before, last = last, kept * last + np.sqrt(1 - kept**2) * lasting * other.normal(size=12)
            last[:3] += dt * before[3:6] * (noise.coloured[0] > 0)
        errors[k] = rng.normal(size=12) * sd + last
        y[k, :3], y[k, 3:6], y[k, 10:], turns[k] = p, v, w, turn
    y[:, :6] += errors[:, :6]
    y[:, 10:] += errors[:, 9:]
    y[:, 6:10] = (Rotation.from_matrix(turns) * Rotation.from_rotvec(errors[:, 6:9])).as_quat()
    starts = np.zeros(rows, bool)
    starts[0] = True
    nothing = np.full(rows, np.nan)
    inputs = RotorInput(time, np.zeros((rows, 4)), nothing, time, True)
    flight = Flight("drawn", time, starts, starts, y, np.full((rows, 3), np.nan), nothing, time, 0.0,
                    (time // 1.0).astype(np.int64), inputs,
                    frozenset({"position", "velocity", "attitude", "body_rate"}))  # fmt: skip
    return flight, acceleration, np.zeros((rows, 12))


def test_scales_come_back() -> None:
    """900 rows of 10 ms, seed 1, from three to ten times too large at the start.

    900 samples know a scale of measurement or impulse to some 3 to 6 % where it alone shows; within 20 % here, and 30 %
    for angular impulses of 0.5 rad/s^2 sqrt(s), which are a third of the rate's noise in a step.
    """
    found = fit_noise([drawn(1, TRUE)], START)
    np.testing.assert_allclose(found.measurement, TRUE.measurement, rtol=0.2)
    np.testing.assert_allclose(found.impulse, TRUE.impulse, rtol=0.3)
    assert not found.disturbance.any()


def test_two_flights_know_more_than_one() -> None:
    """Scales are common to flights: the fit lies between those of both alone."""
    one, two = drawn(2, TRUE), drawn(3, TRUE)
    logs = [logs_of(fit_noise(parts, TRUE))[:10] for parts in ([one], [two], [one, two])]
    low, high = np.minimum(logs[0], logs[1]), np.maximum(logs[0], logs[1])
    assert np.all(logs[2] > low - 0.03)
    assert np.all(logs[2] < high + 0.03)


def test_disturbances_with_memory_come_back_where_they_are_asked_for() -> None:
    """Within a factor of 1.7: 9 s hold nine memories of 0.5 s twice over, so a standard deviation is known to 17 %."""
    with_memory = Noise(TRUE.impulse, TRUE.measurement, np.array([0.5, 0.4, 0.3, 4.0, 3.0, 5.0]), 0.5)
    start = Noise(START.impulse, START.measurement, np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]), 0.5)
    found = fit_noise([drawn(4, with_memory)], start)
    assert np.all(np.abs(np.log(found.disturbance / with_memory.disturbance)) < np.log(1.7))
    np.testing.assert_allclose(found.measurement, TRUE.measurement, rtol=0.25)


def test_coloured_errors_come_back_with_their_memory() -> None:
    """Of position, velocity and attitude, at once: 9 s hold 90 memories of 0.1 s, so one is known to a third."""
    there = replace(TRUE, coloured=2.0 * TRUE.measurement * [1, 1, 1, 0], recall=np.array([0.05, 0.1, 0.08, 1.0]))
    part = drawn(8, there)
    begun = coloured(replace(START, measurement=2.0 * TRUE.measurement), [part[0]])
    assert begun.coloured[:3].all()
    assert not begun.coloured[3]  # a gyro has a shorter memory
    found = fit_noise([part], replace(begun, coloured=begun.measurement * [1, 1, 1, 0]))
    np.testing.assert_allclose(found.coloured[:3], there.coloured[:3], rtol=0.25)
    assert np.all(np.abs(np.log(found.recall / there.recall))[:3] < np.log(1.5))
    np.testing.assert_allclose(found.measurement, TRUE.measurement, rtol=0.25)
    faint = replace(there, coloured=there.coloured * [1e-6, 1, 1e-6, 0])
    kept = without_negligible(faint, [part[0]]).coloured > 0
    assert kept.tolist() == [True, True, False, False]  # a position errs with its velocity
    white = without_negligible(fit_noise([drawn(1, TRUE)], coloured(TRUE, [part[0]])), [part[0]])
    assert not white.coloured.any()


def test_a_scale_that_nothing_measures_stays() -> None:
    flight, acceleration, offset = drawn(5, TRUE, rows=300)
    flight.y[:, 3:6] = np.nan
    found = fit_noise([(flight, acceleration, offset)], START)
    assert found.measurement[1] == pytest.approx(START.measurement[1], rel=1e-12)
    assert found.measurement[0] == pytest.approx(TRUE.measurement[0], rel=0.3)


def test_no_attitude_made_from_an_acceleration_is_very_good() -> None:
    """A motion capture's may be."""
    better = Noise(TRUE.impulse, np.array([1e-3, 8e-3, 1e-3, 1.5e-2]))
    flight, acceleration, offset = drawn(7, better)
    leaning = replace(flight, signals=flight.signals - {"attitude"})
    found, floored = (fit_noise([(f, acceleration, offset)], START).measurement[2] for f in (flight, leaning))
    assert found == pytest.approx(1e-3, rel=0.2)
    assert floored == pytest.approx(NOISE.min_attitude)


def test_long_flights_are_judged_by_stretches_all_over() -> None:
    flight, _, _ = drawn(6, TRUE, rows=1000)
    keep = sample_rows(flight, rows=500, stretch=100)
    assert keep.sum() == pytest.approx(500, rel=0.01)
    assert keep[0]
    assert keep[-1]
    assert sample_rows(flight.rows(np.arange(1000) < 500), rows=500, stretch=100).all()


@pytest.mark.parametrize(
    ("memories", "lasting", "onboard"),
    [((), (), False), ((3, 4, 5), (), False), ((0, 1, 2, 3, 4, 5), (), False), ((), (2,), False),
     ((3, 4, 5), (0, 1, 2, 3), False), ((0, 1, 2), (1, 3), True), ((0, 1, 2, 3, 4, 5), (0, 1, 2), True)],
)  # fmt: skip
def test_the_score_is_the_slope_of_the_likelihood(
    memories: tuple[int, ...], lasting: tuple[int, ...], onboard: bool
) -> None:
    """By central differences; measurements missing and starts within. The filter is linear but for its attitude."""
    flight, acceleration, offset = drawn(7, TRUE, rows=300)
    y, starts = flight.y.copy(), flight.starts.copy()
    y[::3, 6:10], y[1::4, 3:6] = np.nan, np.nan
    starts[[100, 101, 200]] = True
    flight = replace(flight, y=y, starts=starts, fused=onboard)
    disturbance = np.where(np.isin(np.arange(6), memories), [0.1, 0.1, 0.2, 1.0, 2.0, 0.5], 0.0)
    errors = np.where(np.isin(np.arange(4), lasting), 1.5 * TRUE.measurement, 0.0)
    recall = np.array([0.03, 0.1, 0.05, 0.01])
    noise = replace(TRUE, disturbance=disturbance, memory=0.3, coloured=errors, recall=recall)
    score = scored_sweep(flight, acceleration, offset, noise)[1]
    nothing = np.zeros((300, 6, 0)), np.zeros((300, 12, 0))
    for i in np.flatnonzero(np.isfinite(logs_of(noise))):
        up, down = (
            run_sweep(
                flight, acceleration, offset, *nothing, noise_of(logs_of(noise) + d * np.eye(24)[i], noise)
            ).loglik
            for d in (1e-4, -1e-4)
        )
        assert score[i] == pytest.approx((up - down) / 2e-4, rel=2e-3, abs=0.05)
    assert not score[np.isinf(logs_of(noise))].any()


@pytest.mark.parametrize("thrust_only", [True, False])
def test_the_nominal_model_takes_the_likelier_kind_of_onboard_filter(
    thrust_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = replace(drawn(1, TRUE, rows=300)[0], fused=True)
    data = Data([flight])
    monkeypatch.setattr(data, "fit_noise", lambda point, near=False: point)
    monkeypatch.setattr(data, "loglik", lambda point, passes=1: -abs(point.noise.thrust_only - thrust_only))
    assert nominal(data, Point(DRONE, {}, TRUE)).noise.thrust_only is thrust_only
