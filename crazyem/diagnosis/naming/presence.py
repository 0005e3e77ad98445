"""Probability that an effect is real, by its gains on fitted and on held-out flights."""

import math

from scipy import stats
from scipy.special import expit, logit

# Log-odds of the k-th effect found: INTERCEPT + GAIN_POWER log(1 + gain over dispersion) - ORDER_POWER log(k) + that of
# held-out flights (`held_out_evidence`); the probability is at most `MOST_PROBABLE`. Models are approximate: wrong
# effects gain tens of nats, with a heavy tail. So the odds grow with a power of the gain, not with its exponential. A
# file lacks one thing rather than three.
# Posterior mode from 38 names in 45 worlds, home, random and foreign (seeds 12501, 12602, 12703, 13602). The prior is
# normal about -7.5, 1.65, 1.1, from 79 names of other seeds with another dispersion; its sd 1.5, 0.4, 0.5 is assumed.
INTERCEPT, GAIN_POWER, ORDER_POWER, MOST_PROBABLE = -6.8, 1.7, 1.2, 0.95
# Standard deviation of the gain on held-out flights as a share of its expected value m: about m for a real effect,
# whose model is approximate; about 0 for another cause, which may act in both flights. Student's t, because flights
# have unexpected errors of their own. All three are assumed: the 38 names do not determine them.
REAL_SD, OTHER_SD, FREEDOM = 0.4, 0.6, 4.0
MISSING = 0.05  # prior probability that a vehicle file lacks an effect: one drone of 20
LEAST_PROBABILITY = 0.5  # least probability of a finding


def presence(fitted: float, held_out: float, expected: float, order: int = 1, *, dispersion: float = 1.0) -> float:
    """Probability that an effect is real, look-alikes aside.

    Args:
        fitted: gain on the fitted flights over the dispersion [nats].
        held_out: gain on the held-out flights [nats].
        expected: mean of `held_out` for a real effect [nats].
        order: 1 for the first effect that was found, 2 for the next.
        dispersion: variance of the effect's scores over that of the model.
    """
    if fitted <= 0.0:
        return 0.0
    odds = INTERCEPT + GAIN_POWER * math.log1p(fitted) - ORDER_POWER * math.log(order)
    return min(MOST_PROBABLE, float(expit(odds + held_out_evidence(held_out, expected, dispersion))))


def held_out_evidence(held_out: float, expected: float, dispersion: float = 1.0) -> float:
    """Log-odds of an effect by its gain on held-out flights.

    A log-likelihood ratio of mean m has a variance of 2 m. With m = 0 the flights say nothing. A gain beyond m or -m
    counts as m or -m.
    """
    expected = max(expected, 0.0)
    noise = 1.0 + 2.0 * dispersion * expected
    there, elsewhere = (math.sqrt(noise + (share * expected) ** 2) for share in (REAL_SD, OTHER_SD))
    held_out = min(max(held_out, -expected), expected)
    density = stats.t(FREEDOM).logpdf
    return float(density((held_out - expected) / there) - density(held_out / elsewhere) + math.log(elsewhere / there))


def presence_by_odds(nats: float) -> float:
    """Probability of an effect by a likelihood that contains the systematic errors of its model: nats are log-odds."""
    return min(MOST_PROBABLE, float(expit(nats + logit(MISSING))))
