"""Estimated nuisances: numbers that no vehicle file gives exactly, fitted beside the effects."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyem.diagnosis.fitting.fit import Fitted
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.physics.effects.catalogue import CATALOGUE


@dataclass(frozen=True)
class Free:
    """A nuisance, in `unit`.

    Attributes:
        name, words: its effect, in the catalogue and for people.
        parameter: of this effect; or a recording, where each recording has its own value.
        value, sd: estimate and standard deviation.
        expected, usual: mean and standard deviation of its prior.
    """

    name: str
    words: str
    parameter: str
    unit: str
    value: float
    sd: float
    expected: float
    usual: float

    def to_json(self) -> dict[str, Any]:
        """The entry of the JSON document (docs/reference/json.md)."""
        return {
            "name": self.name, "words": self.words, "parameter": self.parameter, "value": self.value, "sd": self.sd,
            "unit": self.unit, "expected": self.expected, "usual": self.usual,
        }  # fmt: skip


def left_free(fitted: Fitted) -> tuple[Free, ...]:
    """The nuisances of the final fit, in the order of its columns."""
    if not fitted.nuisances:
        return ()
    variance = np.diag(solved(fitted)[0].covariance)
    at, found = sum(len(c.free) for c in fitted.candidates), []
    for candidate in fitted.nuisances:
        values, expected = candidate.values(fitted.point), candidate.neutral(fitted.point)
        words = CATALOGUE[candidate.effect].description({}) if candidate.effect in CATALOGUE else candidate.label
        for name in candidate.free:
            p, sd = candidate.parameter(name), max(variance[at], 0.0) ** 0.5
            usual = fitted.precision[at] ** -0.5 if fitted.precision[at] > 0.0 else math.inf
            numbers = [float(x) for x in (values[name], sd, expected[name], usual)]
            found.append(Free(candidate.effect, words, p.description, p.unit, *numbers))
            at += 1
    return tuple(found)
