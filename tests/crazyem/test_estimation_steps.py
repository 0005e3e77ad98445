"""Payloads attached and released in flight are found, and told from gusts; attitudes of an onboard filter."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hovering import INERTIA, hover
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyem.estimation.model import Noise, setup_for
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.steps import (
    LARGEST_INCREMENT,
    MEAN_TOLERANCE,
    STEP_THRESHOLD,
    CumulativeSum,
    StepAwareEstimator,
)
from crazyem.vehicle import Vehicle

VEHICLE = Vehicle("hovering", 0.029, INERTIA, motor_time_constant=0.05)
AT = 4.0  # s


@cache
def flown(before, after, seed, *, gust=0.0, aware=True, duration=6.0):
    """Estimates (time, mass, sd) and the estimator of a hover whose mass changes at AT; `gust` N for 0.15 s there."""
    samples = hover([(0.0, before), (AT, after)], seed=seed, duration=duration, gust=(AT, AT + 0.15, gust))
    estimator = OnlineEstimator(VEHICLE)
    estimator = StepAwareEstimator(estimator) if aware else estimator
    estimates = [e for e in map(estimator.feed, samples) if e is not None]
    return [(e.time, e["mass"].value, e["mass"].sd) for e in estimates], estimator


@pytest.mark.parametrize(("before", "after", "seed"), [(0.029, 0.034, 0), (0.034, 0.029, 1), (0.029, 0.0315, 2)])
def test_a_step_is_found_and_the_mass_is_right_within_a_second(before, after, seed):
    rows, estimator = flown(before, after, seed)
    (step,) = estimator.steps
    assert step.real
    assert step.time == pytest.approx(AT, abs=0.1)
    assert AT < step.found < AT + 0.8
    assert step.before == pytest.approx(before, rel=0.02)
    assert step.after == pytest.approx(after, rel=0.02)
    assert all(abs(m / after - 1) < 0.02 for t, m, _ in rows if t > AT + 1.0)


def test_after_a_step_the_window_grows_again():
    _, estimator = flown(0.029, 0.034, 0)
    samples = 100 * (6.0 - estimator.steps[0].found)
    assert estimator.inner.window == pytest.approx(samples, abs=6)
    assert estimator.adapting


def test_inertia_lag_and_noise_stay_known_beyond_a_step_and_mass_does_not():
    """Eight rows alone would give an inertia that is wrong by half, the first second any lag, four rows any noise."""
    estimator, before, noise = StepAwareEstimator(OnlineEstimator(VEHICLE)), None, None
    names = ("Ixx", "Iyy", "Izz", "motor_time_constant")
    for sample in hover([(0.0, 0.029), (AT, 0.034)], seed=0, duration=6.0):
        estimate = estimator.feed(sample)
        if estimate is None:
            continue
        if not estimator.steps:
            before, noise = estimate, estimator.inner._em.parameters.noise
            continue
        for name in names:
            assert abs(math.log(estimate[name].value / before[name].value)) < 0.3
        assert np.abs(estimator.inner._em.parameters.noise.logs - noise.logs).max() < 0.4
    setup, at_start = estimator.inner._em.setup, estimator.inner._setup
    assert list(setup.prior.sd[[0, 6, 7, 8]]) == list(at_start.prior.sd[[0, 6, 7, 8]])
    assert all(setup.prior.sd[1:5] < at_start.prior.sd[1:5])


@given(st.lists(st.floats(1e-6, 10.0), min_size=9, max_size=9))
def test_a_prior_after_a_step_is_never_wider_than_the_first_one(sd):
    first = setup_for(VEHICLE)
    theta = first.start.theta * 1.1
    noise = Noise.from_logs(first.prior.noise.logs - 1.0)
    found = first.after_step(theta, np.array(sd) * np.append(theta[:5], first.unit[5:]), noise)
    assert found.prior.noise is noise
    assert found.prior.noise_sd < first.prior.noise_sd
    assert np.all(found.prior.sd <= first.prior.sd)
    same = found.prior.sd == first.prior.sd
    assert np.all(found.prior.centre[same] == first.prior.centre[same])
    assert np.all(found.prior.sd[~same] >= np.array(sd)[~same] * (1.0 - 1e-12))  # up to rounding


def test_where_nothing_steps_nothing_changes():
    plain, _ = flown(0.029, 0.029, 5, aware=False)
    rows, estimator = flown(0.029, 0.029, 5)
    assert rows == plain  # bit for bit
    assert estimator.steps == []
    assert not estimator.adapting


def test_a_gust_is_noticed_and_dismissed():
    rows, estimator = flown(0.029, 0.029, 4, gust=-0.08)
    assert [s.real for s in estimator.steps] == [False]
    assert estimator.inner.window == estimator.window
    assert estimator.inner._em.setup is estimator.inner._setup
    assert abs(rows[-1][1] / 0.029 - 1) < 0.02


# --- the cumulative sum ---------------------------------------------------------------------------------------------


def plainly(values):
    """Where and when it must alarm: the largest sum of any tail, minus drift, on either side."""
    for k in range(len(values)):
        for sign in (1, -1):
            tails = [
                (
                    sum(
                        min(max(sign * v, -LARGEST_INCREMENT), LARGEST_INCREMENT) - MEAN_TOLERANCE
                        for v in values[j : k + 1]
                    ),
                    j,
                )
                for j in range(k + 1)
            ]
            if max(tails)[0] > STEP_THRESHOLD:
                return k
    return None


@given(st.lists(st.integers(-8, 8), max_size=40))
def test_it_alarms_when_some_tail_sums_up(values):
    detector, found = CumulativeSum(), None
    for k, value in enumerate(values):
        if detector.add(float(k), value) is not None:
            found = k
            break
    assert found == plainly(values)


def test_when_it_began():
    detector = CumulativeSum()
    for k in range(50):
        assert detector.add(0.04 * k, 0.4) is None
    alarms = [detector.add(2.0 + 0.04 * k, -4.0) for k in range(6)]
    assert alarms[:5] == [None] * 5  # 2.6 each: six of them are beyond 14
    assert alarms[5] == pytest.approx(2.0)
    detector.reset()
    assert detector.add(3.0, math.nan) is None
    assert detector.add(3.0, 100.0) is None  # one outlier is no step


# -- attitudes of an onboard filter ------------------------------------------------------------------------------------


SAMPLES = hover([(0.0, 0.029)], seed=3, duration=3.0)
START = SAMPLES[0].time


ALL = 1e-9  # s, a period that leaves out none of an onboard filter's attitudes


def estimate(samples, *, attitude_period=ALL):
    estimator = OnlineEstimator(VEHICLE, every=50, window=200, attitude_period=attitude_period)
    for sample in samples:
        estimator.feed(sample)
    return estimator.finish()


def number(sample):
    return round(100 * (sample.time - START))


def without(samples, unwanted):
    return [s for s in samples if not unwanted(s)]


def with_attitudes(samples, change):
    """The same with every attitude changed: change(sample, Rotation) -> Rotation."""
    return [
        replace(s, value=tuple(change(s, Rotation.from_quat(s.value)).as_quat())) if s.signal == "attitude" else s
        for s in samples
    ]


def test_the_others_are_as_if_they_had_not_come():
    thinned = without(SAMPLES, lambda s: s.signal == "attitude" and number(s) % 5)
    assert estimate(SAMPLES, attitude_period=0.05) == estimate(thinned)
    assert estimate(SAMPLES, attitude_period=0.05) != estimate(SAMPLES)


def test_nothing_is_left_out_of_what_comes_no_faster_and_by_default():
    assert estimate(SAMPLES, attitude_period=0.01) == estimate(SAMPLES)
    by_default = OnlineEstimator(VEHICLE, every=50, window=200)
    for sample in SAMPLES:
        by_default.feed(sample)
    assert by_default.finish() == estimate(SAMPLES, attitude_period=0.0)


def test_without_rates_every_attitude_counts():
    samples = without(SAMPLES, lambda s: s.signal == "body_rate")
    assert estimate(samples, attitude_period=0.05) == estimate(samples)


def test_an_attitude_that_was_due_and_lost_is_made_up_for_by_the_next():
    lost = without(SAMPLES, lambda s: s.signal == "attitude" and number(s) in (100, 101))
    wanted = {*range(0, 100, 5), *range(102, 400, 5)}
    assert estimate(lost, attitude_period=0.05) == estimate(
        without(lost, lambda s: s.signal == "attitude" and number(s) not in wanted)
    )


def test_after_a_gap_the_state_starts_at_the_attitude_that_came_with_it():
    """Else a drone that looks south would be taken to look north."""
    gap = without(SAMPLES, lambda s: 102 <= number(s) < 125)
    turned = with_attitudes(gap, lambda _, attitude: Rotation.from_euler("z", 3.0) * attitude)
    wanted = {*range(0, 102, 5), *range(125, 400, 5)}
    expected = without(turned, lambda s: s.signal == "attitude" and number(s) not in wanted)
    assert estimate(turned, attitude_period=0.05) == estimate(expected)
