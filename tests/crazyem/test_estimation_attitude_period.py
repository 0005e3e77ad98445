"""Attitudes of an onboard filter, used now and then: the same as if only these had come, and none is lost with them."""

from dataclasses import replace

from hovering import INERTIA, hover
from scipy.spatial.transform import Rotation

from crazyem.estimation.online import OnlineEstimator
from crazyem.vehicle import Vehicle

BARE = Vehicle("bare", 0.029, INERTIA, motor_time_constant=0.05)
SAMPLES = hover([(0.0, 0.029)], seed=3, duration=3.0)
START = SAMPLES[0].time


ALL = 1e-9  # s, a period that leaves out none of an onboard filter's attitudes


def estimate(samples, *, attitude_period=ALL):
    estimator = OnlineEstimator(BARE, every=50, window=200, attitude_period=attitude_period)
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
    by_default = OnlineEstimator(BARE, every=50, window=200)
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
