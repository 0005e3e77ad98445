"""Attitudes made on board of a late gyro: against the differential equation, and where there is nothing to lead."""

from dataclasses import replace

import numpy as np
import pytest
from effects_cases import CF2, still
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from crazyem.physics.effects.effect import Effects
from crazyem.physics.effects.onboard_estimate import CORRECTION_SECONDS, attitude_error, disturbs_attitude
from crazyem.physics.motion import measured

TURNING = 9.0  # rad/s: of the rates that turn to and fro


def rate(time):
    """(..., 3) rad/s."""
    t = np.asarray(time)[..., None] * TURNING
    return np.concatenate([2.0 * np.sin(t), 1.5 * np.cos(1.3 * t), 0.5 * np.sin(0.4 * t)], axis=-1)


def accelerated(time, step):
    """(..., 3) rad/s^2, mean over the step that ends there."""
    return (rate(time) - rate(time - step)) / step


def solved(times, error):
    """e' = error(t) - e / T from 0 at the first of the times."""
    found = solve_ivp(
        lambda t, e: error(t) - e / CORRECTION_SECONDS,
        (times[0], times[-1]), np.zeros(3), t_eval=times, rtol=1e-9, atol=1e-11,
        max_step=1e-3,
    )  # fmt: skip
    return found.y.T


def flown(n=120, step=0.01, **changes):
    time = step * np.arange(n)
    return still(n, time=time, step=np.where(np.arange(n) > 0, step, 0.0), body_rate=rate(time), fused=True, **changes)


@pytest.mark.parametrize("delay", [0.002, 0.004, 0.012])
def test_a_late_gyro_disturbs_the_attitude_by_the_differential_equation(delay: float) -> None:
    situation = flown()
    effects: Effects = {"measurement_delay": {"delay": delay, "streams": ["gyro"]}}
    wanted = solved(situation.time, lambda t: rate(t - delay) - rate(t))
    found = measured(situation, vehicle=CF2, effects=effects).state
    later = situation.time > 0.25  # the first row was held before it
    assert np.abs(wanted[later]).max() > 0.6 * delay  # not a comparison of nothings
    np.testing.assert_allclose(found[later, 6:9], wanted[later], atol=0.03 * np.abs(wanted).max())
    assert not found[:, :6].any()
    apart = measured(replace(situation, fused=False), vehicle=CF2, effects=effects).state
    assert not apart[:, :9].any()
    np.testing.assert_array_equal(apart[:, 9:], found[:, 9:])


def test_so_does_the_low_pass_of_a_gyro_that_is_logged() -> None:
    step = 0.01
    time = step * np.arange(120)
    situation = flown(angular_acceleration=accelerated(time, step))
    lag = 2e-3
    shown = lambda t: rate(t) - lag * (rate(t + 5e-4) - rate(t - 5e-4)) / 1e-3  # noqa: E731
    wanted = solved(time, lambda t: shown(t) - rate(t))
    found = measured(situation, vehicle=CF2, effects={"onboard_filter": {"rate_lag": lag}}).state
    later = time > 0.25
    np.testing.assert_allclose(found[later, 6:9], wanted[later], atol=0.02 * np.abs(wanted).max())


@given(st.integers(0, 1000), st.floats(0.001, 0.03), st.integers(5, 60))
def test_a_stretch_begins_without_an_error_and_knows_nothing_of_the_one_before(seed: int, delay: float, cut: int):
    rng = np.random.default_rng(seed)
    n = 80
    step = np.where((np.arange(n) > 0) & (np.arange(n) != cut), 0.01, 0.0)
    situation = still(n, step=step, fused=True)
    error = rng.standard_normal((n, 3))
    whole = attitude_error(situation, error, delay=delay)
    assert not whole[[0, cut]].any()
    alone = still(n - cut, step=step[cut:], fused=True)
    np.testing.assert_allclose(attitude_error(alone, error[cut:], delay=delay)[1:], whole[cut + 1 :], rtol=1e-9)
    assert np.abs(whole).max() <= CORRECTION_SECONDS * np.abs(error).max()  # a filter that is drawn back stays near


def test_a_steady_error_is_held_where_the_filter_is_drawn_back() -> None:
    situation = still(200, fused=True)
    error = np.tile([0.1, -0.2, 0.05], (200, 1))
    np.testing.assert_allclose(
        attitude_error(situation, error, delay=0.0)[-1], CORRECTION_SECONDS * error[0], rtol=1e-9
    )
    assert attitude_error(still(0, fused=True), np.zeros((0, 3)), delay=0.01).shape == (0, 3)


@pytest.mark.parametrize(
    ("values", "leads"),
    [
        ({"delay": 0.003, "streams": ("gyro",)}, True),
        ({"delay": 0.003, "streams": ["state"]}, False),
        ({"rate_lag": 0.001}, True),
        ({"rate_lag": 0.0, "velocity_lag": 0.001}, False),
        ({"x": 0.1}, False),
    ],
)
def test_which_effects_disturb_attitudes(values, leads) -> None:
    assert disturbs_attitude(values) is leads
