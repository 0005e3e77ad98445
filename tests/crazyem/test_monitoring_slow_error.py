"""The slow error against Riccati's equation and a simulation: what is left of the innovations is white."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from crazyem.monitoring import kernels
from crazyem.monitoring.slow_error import LAGS, slow_error


@pytest.mark.parametrize(("phi", "slow", "white"), [(0.98, 0.4, 1.2), (0.9, 2.0, 1.0)])
def test_the_predictor_is_the_kalman_filter_of_the_slow_error(phi: float, slow: float, white: float) -> None:
    covariances = np.array([slow + white, *(slow * phi**LAGS)])
    decay, gain, weight = slow_error(np.tile(covariances[:, None], 12))[:, 0]
    variance = solve_discrete_are([[phi]], [[1.0]], [[slow * (1 - phi**2)]], [[white]])[0, 0]
    assert decay == pytest.approx(phi, rel=2e-3)
    assert gain == pytest.approx(variance / (variance + white), rel=0.05)
    assert weight == pytest.approx((variance + white) ** -0.5, rel=0.01)


def test_what_is_left_of_simulated_innovations_is_white() -> None:
    random = np.random.default_rng(4)
    n, phi, share = 20_000, 0.98, 0.4
    error = np.zeros((n, 12))
    for k in range(1, n):
        error[k] = phi * error[k - 1] + np.sqrt(share * (1 - phi**2)) * random.standard_normal(12)
    e = error + np.sqrt(1.2) * random.standard_normal((n, 12))
    covariances, past = np.zeros((1 + len(LAGS), 12)), np.zeros((LAGS[-1] + 1, 12))
    covariances[0] = 1.0
    kernels.correlate(
        1, n, 0.01 * np.arange(n), np.ones((n, 12)), e, 1e4, 10.0, LAGS, past, np.zeros(12, np.int64), covariances
    )
    decay, gain, weight = slow_error(covariances)
    predicted, left = np.zeros(12), np.zeros((n, 12))
    for k in range(n):
        left[k] = weight * (e[k] - predicted)
        predicted = decay * (predicted + gain * (e[k] - predicted))
    assert left.var(0) == pytest.approx(np.ones(12), abs=0.08)
    for lag in (1, 5, 30):
        assert np.mean(left[lag:] * left[:-lag]) == pytest.approx(0.0, abs=0.02)


def test_no_signal_is_taken_as_surer_than_the_estimator_takes_it() -> None:
    covariances = np.zeros((1 + len(LAGS), 12))
    covariances[0] = 0.01
    assert (slow_error(covariances)[2] == 1.0).all()
