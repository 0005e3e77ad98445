"""How far the logged commands can be trusted between their stamps.

A controller runs at 500 Hz and feeds the noise of its gyro straight into the command; a log at 100 Hz catches
single values of that, each standing in for the 10 ms around it. What is noise in these values is not torque
that acted, and an estimate that takes it for such finds the drone too sluggish: inertia too large, by up to the
share of noise in the torque's variance. The share is estimated here and counted as uncertainty: it is a bias
that the data cannot remove."""

import numpy as np
from numpy.typing import NDArray

_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])  # third difference: blind to what is smooth, 20 times white variance


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


def noise_share(white: float, *, period: float, tau: float, torque_variance: float) -> float:
    """Share of the lagged torque's variance that is noise of the samples.

    A lag tau lets h / (2 tau + h) of the variance of white samples, h apart, through.
    """
    if torque_variance <= 0:
        return 1.0
    return float(min(white * period / (2 * tau + period) / torque_variance, 1.0))


def log_inertia_bias(share: float) -> float:
    """Bias of log inertia for a noise share: the slope of acceleration on torque is attenuated by 1 - share."""
    return float(-np.log(1.0 - min(share, 0.99)))
