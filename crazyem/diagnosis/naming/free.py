"""What was left free beside the effects: the numbers that no vehicle file says exactly, as they came out."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyem.diagnosis.fitting.fit import Fitted
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.physics.effects.catalogue import CATALOGUE


@dataclass(frozen=True)
class Free:
    """A number that was left free, in `unit`.

    Attributes:
        name, words: the effect that it is of, in the catalogue and for people.
        parameter: of it; a recording, where each has its own.
        value, sd: as it came out.
        expected, usual: where its prior has its mean, and that prior's standard deviation.
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
        """As docs/reference/json.md has it."""
        return {
            "name": self.name, "words": self.words, "parameter": self.parameter, "value": self.value, "sd": self.sd,
            "unit": self.unit, "expected": self.expected, "usual": self.usual,
        }  # fmt: skip


def left_free(fitted: Fitted) -> tuple[Free, ...]:
    """Of the final fit, in the order of its columns."""
    if not fitted.nuisances:
        return ()
    variance = np.diag(solved(fitted)[0].covariance)
    at, found = sum(len(c.free) for c in fitted.candidates), []
    for candidate in fitted.nuisances:
        values, expected = candidate.values(fitted.point), candidate.neutral(fitted.point)
        words = CATALOGUE[candidate.effect].said({}) if candidate.effect in CATALOGUE else candidate.label
        for name in candidate.free:
            p, sd = candidate.parameter(name), max(variance[at], 0.0) ** 0.5
            usual = fitted.precision[at] ** -0.5 if fitted.precision[at] > 0.0 else math.inf
            numbers = [float(x) for x in (values[name], sd, expected[name], usual)]
            found.append(Free(candidate.effect, words, p.said, p.unit, *numbers))
            at += 1
    return tuple(found)
