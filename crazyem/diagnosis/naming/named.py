"""An effect that was found, its numbers, and how sure it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.physics.effects.catalogue import CATALOGUE

# Confidence at most beside structure that a name does not outweigh, or where something that shakes explains as much.
DOUBTFUL = 0.45
# Times the nats of what is left, from which a name beside it is as likely right as not. Of 88 names beside structure in
# 1268 simulated drones of four seeds (2045 to 2048), 18 of 18 were right that brought 4 times as much or more; of 8
# with 1 to 4 times as much 2, and 6 of 62 with less.
OUTWEIGHS = 3.0


@dataclass(frozen=True)
class Value:
    """An estimated parameter: value and sd in `unit`, ci95 (low, high)."""

    value: float
    unit: str
    sd: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Named:
    """An effect that was found.

    Attributes:
        name: in the catalogue; `label` with its choices.
        parameters: those fitted; `chosen`: those searched.
        held_out_nats: log-likelihood it brings on flight that it was not fitted to.
        p_value: of its score test, the number of candidates allowed for.
        confidence: probability that this effect is there and not a look-alike.
        fitted_as: the effect as which it was fitted; "": by its own name.
        log_odds: log posterior odds of the effect, whatever its look-alikes; None: not known.
    """

    name: str
    label: str
    parameters: dict[str, Value]
    chosen: dict[str, object]
    held_out_nats: float
    p_value: float
    confidence: float
    fitted_as: str = ""
    log_odds: float | None = None

    @property
    def words(self) -> str:
        """For people, with its choices."""
        values = {**self.chosen, **{n: v.value for n, v in self.parameters.items()}}
        return CATALOGUE[self.name].said(values)

    @property
    def of_recording(self) -> bool:
        """Whether it belongs to the recording and not to the drone."""
        return CATALOGUE[self.name].belongs_to == "recording"


def around(value: float, sd: float) -> tuple[float, float]:
    """The 95 % interval of a normal distribution."""
    return value - 1.96 * sd, value + 1.96 * sd


def trust(remains: Unexplained, held_out_nats: float = 0.0) -> float:
    """What a name is worth beside structure that it does not explain: the right model leaves none.

    What is left outside the catalogue feigns names about as large as it is itself: one that brings far more on flight
    held out is no look-alike of that.
    """
    explained = max(remains.explained, 0.0)
    if not remains.found:
        return explained
    times = max(held_out_nats, 0.0) / max(remains.nats, 1e-9)
    return min(explained, max(DOUBTFUL, times**2 / (times**2 + OUTWEIGHS**2)))


def one_factor(values: NDArray, neutral: NDArray, covariance: NDArray) -> bool:
    """Whether values (k,) with a covariance (k, k) are their neutral ones times one factor, by chi-squared at 5 %.

    Inertias that are, about all three axes, are what a factor on the torques is, to every signal.
    """
    ratio = np.log(values / neutral)
    precision = np.linalg.pinv(covariance / np.outer(values, values))
    mean = (precision @ ratio).sum() / precision.sum()
    distance = float((ratio - mean) @ precision @ (ratio - mean))
    return bool(stats.chi2.sf(distance, len(values) - 1) > 0.05)
