"""Threshold of window-limited generalised likelihood ratios for a given rate of false alarms, by theory.

A generalised likelihood ratio uses all windows of n0 to n1 samples that end now. Without a change, the largest
statistic crosses b^2 at the rate b^2 f(b^2) I per sample. f is the density of chi-square with as many degrees of
freedom as the change has sizes; I is the integral of x nu(x)^2 from b / sqrt(n1) to b / sqrt(n0) (Siegmund and
Venkatraman 1995). With only some window lengths, the rate is a bound (Lai 1995). nu corrects for discrete time.
"""

import math
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

HOUR = 3600.0  # s
LARGEST = 1e4  # largest threshold of the statistic


def crossing_rate(threshold: float, freedom: int, shortest: float, longest: float) -> float:
    """Rate per sample at which the statistic (chi-square) crosses a threshold without a change.

    Args:
        threshold: of the statistic. freedom: number of sizes of the change. shortest, longest: window [samples].
    """
    b = math.sqrt(threshold)
    x = np.linspace(b / math.sqrt(longest), b / math.sqrt(shortest), 400)
    integral = float(np.trapezoid(x * np.exp(-2 * 0.583 * x), x))  # nu(x) = exp(-0.583 x), Siegmund 1985
    return threshold * float(chi2.pdf(threshold, freedom)) * integral


@lru_cache(maxsize=256)
def threshold_for(per_hour: float, freedom: int, *, shortest: float, longest: float, rate: float) -> float:
    """Threshold of the statistic for a rate of false alarms per hour.

    Args:
        per_hour: false alarms per hour. freedom: number of sizes of the change.
        shortest, longest: window [samples]. rate: samples per second.
    """
    wanted = math.log(per_hour / (HOUR * rate))

    def excess(threshold: float) -> float:
        return math.log(max(crossing_rate(threshold, freedom, shortest, longest), 1e-300)) - wanted

    low = 2.0 * freedom + 8.0  # above the maximum of the rate
    if excess(low) <= 0.0:
        return low
    return float(brentq(excess, low, LARGEST))
