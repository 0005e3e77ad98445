"""How probable it is that an effect is there, by what it explains of flight it was fitted to and of other flight."""

import math

from scipy.special import expit, logit

# Log-odds that a name is right: CONSTANT + HELD_OUT log(nats on flight held out) + FITTED log(1 + nats on the flight it
# was fitted to, over how much more scores scatter than the model says) - ORDER log(k) of the k-th effect found, at most
# `CALIBRATED`. Models are approximate: wrong names gain tens of nats, with a heavy tail, so odds grow with a power of
# what is gained and not with the nats. A file lacks one thing rather than three.
# By maximum likelihood from 79 names in 71 worlds, home, random and foreign (seeds 11501, 11602, 11703, 10501, 10602).
CONSTANT, HELD_OUT, FITTED, ORDER, CALIBRATED = -7.5, 0.35, 1.65, 1.1, 0.95
LEAST_NATS = 0.5  # on flight held out: less is chance, as where a hover can say nothing,
MOST_COST = 1.0  # and so is a cost of a nat there; more speaks against an effect
MISSING = 0.05  # prior probability that one effect is missing from a vehicle file: of 20 drones one
LEAST_PROBABILITY = 0.5  # probability below which an effect is no finding


def presence(held_out: float, fitted: float, order: int = 1) -> float:
    """Probability that an effect is there, whatever its look-alikes.

    Args:
        held_out: nats that it brings on flight that it was not fitted to.
        fitted: nats on the flight that it was fitted to, over the dispersion of its scores.
        order: 1 for the first effect that was found, 2 for the next.
    """
    if held_out < -MOST_COST or fitted <= 0.0:
        return 0.0
    odds = CONSTANT + HELD_OUT * math.log(max(held_out, LEAST_NATS)) + FITTED * math.log1p(fitted)
    odds -= ORDER * math.log(order)
    return min(CALIBRATED, float(expit(odds)))


def presence_by_odds(nats: float) -> float:
    """Probability that an effect is there by a likelihood that holds what is systematically wrong with its model: then
    nats are odds."""
    return min(CALIBRATED, float(expit(nats + logit(MISSING))))
