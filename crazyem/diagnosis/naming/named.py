"""An effect that was found: its numbers and its confidence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.physics.effects.catalogue import CATALOGUE


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
        parameters: the fitted ones; `chosen`: the searched ones.
        held_out_nats: gain of log-likelihood on held-out flights.
        confidence: probability that this effect is real, and not one of its look-alikes.
        fitted_as: the effect as which it was fitted; "": by its own name.
        log_odds: log posterior odds of the effect, look-alikes aside; None: not known.
    """

    name: str
    label: str
    parameters: dict[str, Value]
    chosen: dict[str, object]
    held_out_nats: float
    confidence: float
    fitted_as: str = ""
    log_odds: float | None = None

    @property
    def words(self) -> str:
        """The effect in words, with its choices."""
        values = {**self.chosen, **{n: v.value for n, v in self.parameters.items()}}
        return CATALOGUE[self.name].description(values)

    @property
    def of_recording(self) -> bool:
        """Whether it belongs to the recording and not to the drone."""
        return CATALOGUE[self.name].belongs_to == "recording"


def interval_95(value: float, sd: float) -> tuple[float, float]:
    """The 95 % interval of a normal distribution."""
    return value - 1.96 * sd, value + 1.96 * sd


def confidence_factor(remains: Unexplained, held_out_nats: float = 0.0) -> float:
    """Factor on the probability of an effect beside unexplained structure: the right model leaves none.

    Physics outside the catalogue imitates effects of about its own size. An effect with a far larger held-out gain,
    over the dispersion of its scores, is no such imitation.
    """
    if not remains.found:
        return 1.0
    times = max(held_out_nats, 0.0) / max(remains.nats, 1e-9)
    return max(CONFIDENCE.doubtful, times**2 / (times**2 + CONFIDENCE.outweighs**2))


def one_factor(values: NDArray, neutral: NDArray, covariance: NDArray) -> bool:
    """Whether values (k,) with a covariance (k, k) are the neutral values times one factor, by chi-squared at 5 %.

    Inertias with one factor about all three axes give the same signals as a factor on the torques.
    """
    ratio = np.log(values / neutral)
    precision = np.linalg.pinv(covariance / np.outer(values, values))
    mean = (precision @ ratio).sum() / precision.sum()
    distance = float((ratio - mean) @ precision @ (ratio - mean))
    return bool(stats.chi2.sf(distance, len(values) - 1) > 0.05)
