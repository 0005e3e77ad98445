"""Probability that an effect is real, by its gains on fitted and on held-out flights."""

import math

from scipy import stats
from scipy.special import expit, logit

from crazyem.diagnosis.settings import CONFIDENCE


def presence(gain: float, held_out: float, expected: float, order: int = 1, *, dispersion: float = 1.0) -> float:
    """Probability that an effect is real, look-alikes aside.

    Args:
        gain: on the fitted flights, or on the held-out ones if it is larger there, over the dispersion [nats].
        held_out: gain on the held-out flights [nats].
        expected: mean of `held_out` for a real effect [nats].
        order: 1 for the first effect that was found, 2 for the next.
        dispersion: variance of the effect's scores over that of the model.
    """
    if gain <= 0.0:
        return 0.0
    odds = CONFIDENCE.intercept + CONFIDENCE.gain_power * math.log1p(gain) - CONFIDENCE.order_power * math.log(order)
    return min(CONFIDENCE.max_probability, float(expit(odds + held_out_evidence(held_out, expected, dispersion))))


def held_out_evidence(held_out: float, expected: float, dispersion: float = 1.0) -> float:
    """Log-odds of an effect by its gain on held-out flights.

    A log-likelihood ratio of mean m has a variance of 2 m. With m = 0 the flights say nothing. A gain beyond m or -m
    counts as m or -m.
    """
    expected = max(expected, 0.0)
    noise = 1.0 + 2.0 * dispersion * expected
    there, elsewhere = (
        math.sqrt(noise + (share * expected) ** 2) for share in (CONFIDENCE.real_sd, CONFIDENCE.other_sd)
    )
    held_out = min(max(held_out, -expected), expected)
    density = stats.t(CONFIDENCE.freedom).logpdf
    return float(density((held_out - expected) / there) - density(held_out / elsewhere) + math.log(elsewhere / there))


def presence_by_odds(nats: float) -> float:
    """Probability of an effect by a likelihood that contains the systematic errors of its model: nats are log-odds."""
    return min(CONFIDENCE.max_probability, float(expit(nats + logit(CONFIDENCE.file_lacks))))


def improbable(chance: float) -> str:
    """Reason why an effect of this probability is no finding; "" if it is one."""
    if chance >= CONFIDENCE.min_probability:
        return ""
    return f"not determined: the flights make it probable with {chance:.2g} only"
