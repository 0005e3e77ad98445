"""What widens an interval: correlation in time (Newey and West) and noise in sampled commands, against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from crazyem.estimation.inflation import (
    FEWEST_ROWS,
    LARGE_BIAS,
    innovation_noise,
    long_run,
    steady_gain,
    variance_with_bias,
    white_variance,
)


def bartlett(terms, lags):
    """Long-run variance of column sums, written out."""
    total = (terms**2).sum(0)
    for lag in range(1, lags + 1):
        total = total + 2 * (1 - lag / (lags + 1)) * (terms[lag:] * terms[:-lag]).sum(0)
    return total


@given(st.integers(0, 2**32 - 1), st.integers(1, 900))
def test_long_run_is_the_bartlett_estimate(seed, n):
    terms = np.random.default_rng(seed).normal(size=(n, 3)).cumsum(0)
    lags = min(n // 8, 100) if n >= FEWEST_ROWS else 0
    np.testing.assert_allclose(long_run(terms), bartlett(terms, lags), rtol=1e-9)


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_long_run_of_an_autoregressive_process(memory):
    """The variance of a sum of n terms of an AR(1) process is n s^2 (1 + a) / (1 - a), for n large."""
    rng = np.random.default_rng(1)
    n = 4000
    x = np.zeros((n, 8))
    for k in range(1, n):
        x[k] = memory * x[k - 1] + rng.normal(size=8)
    expected = n / (1 - memory) ** 2
    assert np.mean(long_run(x)) == pytest.approx(expected, rel=0.25)


def test_white_part_of_a_command_is_found():
    """Smooth command plus gain times measured rate: the noise of the rate comes through with the gain squared."""
    rng = np.random.default_rng(0)
    t = np.arange(3000) * 0.01
    rate_noise = 2e-3 * rng.normal(size=len(t))
    rate = 0.4 * np.sin(2 * np.pi * 0.5 * t) + rate_noise
    command = 1e-4 * np.sin(2 * np.pi * 0.5 * t) - 1e-3 * rate
    found = white_variance(command, rate, rate_variance=4e-6)
    assert found == pytest.approx((1e-3 * 2e-3) ** 2, rel=0.1)
    # what no rate explains counts in full
    extra = 3e-6 * rng.normal(size=len(t))
    assert white_variance(command + extra, rate, rate_variance=4e-6) == pytest.approx(4e-12 + 9e-12, rel=0.1)


def test_a_smooth_command_has_no_white_part():
    t = np.arange(1000) * 0.01
    command = 1e-4 * np.sin(2 * np.pi * 1.0 * t)
    assert white_variance(command, np.full(1000, np.nan), rate_variance=4e-6) < 1e-3 * np.var(command)
    assert white_variance(np.zeros(1000), np.zeros(1000), rate_variance=4e-6) == 0.0


def test_missing_rates_are_left_out():
    rng = np.random.default_rng(0)
    rate = 2e-3 * rng.normal(size=2000)
    command = -1e-3 * rate
    rate[rng.uniform(size=2000) < 0.3] = np.nan
    assert white_variance(command, rate, rate_variance=4e-6) == pytest.approx(4e-12, rel=0.2)


def test_lagged_white_samples_keep_the_variance_of_theory():
    """White samples h apart, each held for h, through a lag: variance h / (2 tau + h)."""
    mean_square, _, _ = innovation_noise(period=0.01, tau=0.06, gain=1.0)
    assert mean_square == pytest.approx(0.01 / 0.13, rel=0.3)  # held for the step, joined by lines before it


def test_noise_leans_on_its_own_derivative_by_the_time_constant():
    """E[m dm/dtau] is half the derivative of E[m^2]."""
    period = 0.01
    low, high = (innovation_noise(period=period, tau=tau, gain=1.0)[0] for tau in (0.055, 0.065))
    _, by_tau, by_delay = innovation_noise(period=period, tau=0.06, gain=1.0)
    assert by_tau == pytest.approx(0.5 * (high - low) / 0.010, rel=0.1)
    assert by_tau < 0  # more lag lets less through
    assert abs(by_delay) > 0


def test_the_gain_of_a_random_walk_is_that_of_its_filter_run_to_the_end():
    process, measurement, variance = 3e-4, 2e-3, 1.0
    for _ in range(2000):
        predicted = variance + process
        gain = predicted / (predicted + measurement)
        variance = (1.0 - gain) * predicted
    assert steady_gain(process, measurement) == pytest.approx((gain, predicted + measurement), rel=1e-9)


@pytest.mark.parametrize("gain", [1.0, 0.3, 0.05])
def test_noise_of_commands_stays_in_the_innovations_until_measurements_correct_it(gain):
    """Simulated: white samples, held, through the lag, then through a filter that forgets by its gain only."""
    rng = np.random.default_rng(5)
    period, tau, fine = 0.01, 0.05, 10
    y, x, out = 0.0, 0.0, []
    decay = np.exp(-period / fine / tau)
    for value in rng.normal(size=60000):
        mean = 0.0
        for _ in range(fine):
            y = value + (y - value) * decay
            mean += y / fine
        x = (1.0 - gain) * x + mean
        out.append(x)
    found, _, _ = innovation_noise(period=period, tau=tau, gain=gain)
    assert found == pytest.approx(np.var(out[1000:]), rel=0.35)  # there joined by lines before the step


@given(st.floats(0.1, 10.0), st.floats(-3.0 * LARGE_BIAS, 3.0 * LARGE_BIAS))
def test_an_interval_holds_the_truth_in_95_percent_with_the_largest_bias_of_either_sign(sd, ratio):
    variance = np.array([sd**2])
    for bias in (ratio * sd, -ratio * sd):
        half = norm.ppf(0.975) * np.sqrt(variance_with_bias(variance, np.array([bias])))[0]
        assert norm.cdf((half - bias) / sd) - norm.cdf((-half - bias) / sd) == pytest.approx(0.95, abs=1e-9)


def test_without_a_bias_or_a_random_error_a_variance_stays():
    assert np.array_equal(variance_with_bias(np.array([4.0, 0.0]), np.array([0.0, 1.0])), [4.0, 0.0])
