"""How probable it is that an effect is there, by what it explains of flight it was fitted to and of other flight."""

import math

from scipy import stats
from scipy.special import expit, logit

# Log-odds that a name is right: CONSTANT + FITTED log(1 + nats on the flight it was fitted to, over how much more
# scores scatter than the model says) - ORDER log(k) of the k-th effect found + `held_out_evidence`; the probability is
# at most `CALIBRATED`. Models are approximate: wrong names gain tens of nats, with a heavy tail, so odds grow with a
# power of what is gained and not with the nats. A file lacks one thing rather than three.
# By the posterior mode from 38 names in 45 worlds, home, random and foreign (seeds 12501, 12602, 12703, 13602). The
# prior is from 79 names in 71 others (seeds 11501, 11602, 11703, 10501, 10602).
CONSTANT, FITTED, ORDER, CALIBRATED = -6.8, 1.7, 1.2, 0.95
# How far what an effect brings on flight held out is from what is expected, as a share of that, where it is there (its
# model is approximate), and how far from 0 where something else is (it may be that in both flights); Student's t, as
# flights have surprises of their own.
THERE, ELSEWHERE, FREEDOM = 0.4, 0.6, 4.0
MISSING = 0.05  # prior probability that one effect is missing from a vehicle file: of 20 drones one
LEAST_PROBABILITY = 0.5  # probability below which an effect is no finding


def presence(fitted: float, held_out: float, expected: float, order: int = 1, *, dispersion: float = 1.0) -> float:
    """Probability that an effect is there, whatever its look-alikes.

    Args:
        fitted: nats that it brings on the flight that it was fitted to, over the dispersion of its scores.
        held_out: nats that it brings on flight that it was not fitted to.
        expected: nats that are to be expected there if it is there.
        order: 1 for the first effect that was found, 2 for the next.
        dispersion: by how much its scores scatter more than the model says.
    """
    if fitted <= 0.0:
        return 0.0
    odds = CONSTANT + FITTED * math.log1p(fitted) - ORDER * math.log(order)
    return min(CALIBRATED, float(expit(odds + held_out_evidence(held_out, expected, dispersion))))


def held_out_evidence(held_out: float, expected: float, dispersion: float = 1.0) -> float:
    """Log-odds by flight that an effect was not fitted to. A likelihood ratio whose mean is m varies with a variance of
    2 m; where nothing is to be expected, what comes says nothing. What is beyond that mean, on either side, says no
    more than the mean does."""
    expected = max(expected, 0.0)
    noise = 1.0 + 2.0 * dispersion * expected
    there, elsewhere = (math.sqrt(noise + (share * expected) ** 2) for share in (THERE, ELSEWHERE))
    held_out = min(max(held_out, -expected), expected)
    density = stats.t(FREEDOM).logpdf
    return float(density((held_out - expected) / there) - density(held_out / elsewhere) + math.log(elsewhere / there))


def presence_by_odds(nats: float) -> float:
    """Probability that an effect is there by a likelihood that holds what is systematically wrong with its model: then
    nats are odds."""
    return min(CALIBRATED, float(expit(nats + logit(MISSING))))
