"""Why the information alone claims too much: noise in sampled commands, and disturbances with memory.

A controller runs at 500 Hz and feeds the noise of its sensors straight into the command. A log at 100 Hz catches single
values of that, each standing in for the 10 ms around it. What is noise in these values is not torque that acted. An
estimate that takes it for such finds the drone too sluggish (errors in variables): inertia too large, and the time
constant and delay, which come from the same commands, wrong with it. The bias is computed here from the noise and
counted as uncertainty: the data cannot remove it. Terms of the score that are correlated in time have a sum whose
variance is larger than the sum of their variances: the long-run variance.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.compiled import compiled
from crazyem.physics.lag import CAUSAL, hold_predictor, lagged_means

_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])  # third difference: blind to what is smooth, 20 times white variance
_STEPS, _BEGIN = 1000, 10  # rows of an impulse response, and where the impulse is


def white_variance(command: NDArray, rate: NDArray, *, rate_variance: float) -> float:
    """Variance of the part of command samples that does not persist to the next sample.

    Args:
        command: (n,) torque about one axis at its stamps [N m].
        rate: (n,) measured body rate about that axis at (nearly) the same instants [rad/s], NaN where missing.
        rate_variance: of the measurement noise of the rate [(rad/s)^2].

    Returns:
        The command's response to rate noise, plus whatever in it no rate explains [(N m)^2].
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
    """What white command samples of unit variance leave in the innovations, and how it leans on their derivatives.

    A filter that trusts its model remembers: the torque of one step is in the innovations of the steps after it, until
    measurements have corrected the rate. With the steady gain K of the rate, the innovations' share of the means m is
    x[k] = (1 - K) x[k-1] + m[k], and likewise that of their derivatives.

    Args:
        period: between samples [s].
        tau: rotor time constant [s].
        gain: K, from 0 to 1.

    Returns:
        E[x^2], E[x dx/dtau] [1/s], E[x dx/ddelay] [1/s].
    """
    # quantised, so that a slowly moving time constant does not ask for it anew each time
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
    """Kalman gain of a random walk measured at every step, and the variance of its innovations.

    Args:
        process, measurement: variances of a step of the walk and of a measurement, in the same unit.
    """
    predicted = 0.5 * (process + math.sqrt(process**2 + 4.0 * process * measurement))
    innovation = predicted + measurement
    return predicted / innovation, innovation


FEWEST_ROWS = 32  # fewer say nothing about correlation in time
LONGEST_LAG = 100


@compiled
def long_run(terms):
    """Variance of the column sums of terms (n, p), Bartlett kernel (Newey and West 1987). Returns (p,).

    The weights 1 - lag/length of the kernel are those of a running sum of that length, of which this is the mean
    square: a few additions a term, however many lags.
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
