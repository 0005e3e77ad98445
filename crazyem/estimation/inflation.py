"""Corrections to the information for noise in sampled commands and for disturbances with memory.

A controller runs at 500 Hz and passes sensor noise on to the command. A log at 100 Hz holds single values of the
command, each standing for 10 ms. The noise in these values is not a torque that acted. So the inertia comes out too
large (errors in variables), and the time constant and the delay, which use the same commands, are wrong, too. This
module computes the bias from the noise. The bias counts as uncertainty, because the data cannot remove it. Where terms
of the score are correlated in time, the variance of their sum is the long-run variance, not the sum of their variances.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import chndtrix, ndtri

from crazyem.compiled import compiled
from crazyem.physics.lag import CAUSAL, hold_predictor, lagged_means

_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])  # third difference: removes smooth parts, white variance times 20
_STEPS, _BEGIN = 1000, 10  # rows of an impulse response, and row of the impulse
LARGE_BIAS = 10.0  # standard deviations, beyond which the other tail is less than 1e-23


def white_variance(command: NDArray, rate: NDArray, *, rate_variance: float) -> float:
    """Variance of the white part of command samples: the part that does not persist to the next sample.

    Args:
        command: (n,) torque about one axis at its stamps [N m].
        rate: (n,) measured body rate about that axis at (nearly) the same instants [rad/s], NaN where missing.
        rate_variance: of the measurement noise of the rate [(rad/s)^2].

    Returns:
        Variance of the command's response to rate noise, plus the variance that no rate explains [(N m)^2].
    """
    du = np.convolve(command, _DIFFERENCE, "valid")
    dw = np.convolve(rate, _DIFFERENCE, "valid")
    seen = np.isfinite(dw) & np.isfinite(du)
    if seen.sum() < 10:
        return float(np.mean(du[np.isfinite(du)] ** 2) / 20) if np.isfinite(du).any() else 0.0
    du, dw = du[seen], dw[seen]
    power = float(dw @ dw)
    gain = float(du @ dw) / power if power > 0 else 0.0
    unexplained = float(np.mean((du - gain * dw) ** 2)) / 20
    return gain**2 * rate_variance + unexplained


def innovation_noise(*, period: float, tau: float, gain: float) -> tuple[float, float, float]:
    """Effect x on the innovations of white command samples of unit variance, and its products with dx/dtau, dx/ddelay.

    The torque of one step stays in the innovations of later steps until measurements have corrected the rate. With the
    steady gain K of the rate and the mean torques m, x[k] = (1 - K) x[k-1] + m[k]; the same holds for the derivatives.

    Args:
        period: between samples [s].
        tau: rotor time constant [s].
        gain: K, from 0 to 1.

    Returns:
        E[x^2], E[x dx/dtau] [1/s], E[x dx/ddelay] [1/s].
    """
    # quantised, so that a slowly changing time constant finds its value in the cache
    return _innovation_noise(float(f"{period:.2g}"), float(f"{max(tau, 1e-3):.2g}"), float(f"{gain:.2g}"))


@lru_cache(maxsize=1024)
def _innovation_noise(period: float, tau: float, gain: float) -> tuple[float, float, float]:
    times = np.arange(_STEPS) * period
    impulse = np.zeros((_STEPS, 4))
    impulse[_BEGIN] = 1.0
    responses = np.zeros((3, _STEPS, 4))
    lagged_means(
        times, impulse, 0, _STEPS, hold_predictor(), times, 1, _STEPS, CAUSAL, tau, 0.0, np.zeros(13), *responses
    )
    x, by_tau, by_delay = lfilter([1.0], [1.0, gain - 1.0], responses[:, :, 0])
    return float(x @ x), float(x @ by_tau), float(x @ by_delay)


def steady_gain(process: float, measurement: float) -> tuple[float, float]:
    """Steady Kalman gain of a random walk that is measured at every step, and the variance of its innovations.

    Args:
        process, measurement: variances of a step of the walk and of a measurement, in the same unit.
    """
    predicted = 0.5 * (process + math.sqrt(process**2 + 4.0 * process * measurement))
    innovation = predicted + measurement
    return predicted / innovation, innovation


def variance_with_bias(variance: NDArray, bias: NDArray) -> NDArray:
    """Variance of the normal error whose central 95 % is as wide as the interval for `variance` and a possible bias.

    A bias of known size and unknown sign is no second random error. The shortest interval about the estimate that holds
    the truth in 95 % of all cases ends at a quantile of the folded normal distribution (Armstrong and Kolesar 2018).

    Args:
        variance: (n,) of the error without bias.
        bias: (n,) largest bias, in the unit of the error.
    """
    out = np.array(variance)
    biased = (bias != 0) & (out > 0)
    ratio = np.abs(bias[biased]) / np.sqrt(out[biased])
    # far from zero only one tail counts
    quantile = np.where(
        ratio < LARGE_BIAS, np.sqrt(chndtrix(0.95, 1.0, np.minimum(ratio, LARGE_BIAS) ** 2)), ratio + ndtri(0.95)
    )
    out[biased] *= (quantile / ndtri(0.975)) ** 2
    return out


FEWEST_ROWS = 32  # with fewer rows, correlation in time cannot be estimated
LONGEST_LAG = 100  # rows


@compiled
def long_run(terms):
    """Long-run variance (p,) of the column sums of terms (n, p), with the Bartlett kernel (Newey and West 1987).

    The mean square of a running sum has the weights 1 - lag/length of this kernel. So the cost does not grow with the
    number of lags.
    """
    n, p = terms.shape
    length = (min(n // 8, LONGEST_LAG) if n >= FEWEST_ROWS else 0) + 1
    out = np.zeros(p)
    running = np.zeros(p)
    for k in range(n + length - 1):
        for c in range(p):
            if k < n:
                running[c] += terms[k, c]
            if k >= length:
                running[c] -= terms[k - length, c]
            out[c] += running[c] * running[c]
    return out / length
