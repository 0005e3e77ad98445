"""How far the logged commands can be trusted between their stamps.

A controller runs at 500 Hz and feeds the noise of its sensors straight into the command; a log at 100 Hz catches single
values of that, each standing in for the 10 ms around it. What is noise in these values is not torque that acted. An
estimate that takes it for such finds the drone too sluggish (errors in variables): inertia too large, and the time
constant and delay, which are told from the same commands, wrong with it. The bias is computed here from the noise and
counted as uncertainty: the data cannot remove it.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.lag import CAUSAL, hold_predictor, lagged_means

_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])  # third difference: blind to what is smooth, 20 times white variance
_STEPS = 1000


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


def lagged_noise(*, period: float, tau: float) -> tuple[float, float, float]:
    """What white command samples of unit variance leave in a step's mean torque, and how it leans on its derivatives.

    Args:
        period: between samples [s].
        tau: rotor time constant [s].

    Returns:
        E[m^2], E[m dm/dtau] [1/s], E[m dm/ddelay] [1/s] for the mean m of the lagged noise over a step.
    """
    # quantised, so that a slowly moving time constant does not ask for it anew each time
    return _lagged_noise(float(f"{period:.2g}"), float(f"{max(tau, 1e-3):.2g}"))


@lru_cache(maxsize=256)
def _lagged_noise(period: float, tau: float) -> tuple[float, float, float]:
    times = np.arange(_STEPS) * period
    noise = np.random.default_rng(0).standard_normal((_STEPS, 4))
    mean, by_tau, by_delay = np.zeros((_STEPS, 4)), np.zeros((_STEPS, 4)), np.zeros((_STEPS, 4))
    state = np.zeros(13)
    lagged_means(
        times, noise, 0, _STEPS, hold_predictor(), times, 1, _STEPS, CAUSAL, tau, 0.0, state, mean, by_tau, by_delay
    )
    settled = slice(_STEPS // 10, None)
    m = mean[settled]
    return float(np.mean(m * m)), float(np.mean(m * by_tau[settled])), float(np.mean(m * by_delay[settled]))
