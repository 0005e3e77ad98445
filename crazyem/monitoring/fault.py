"""Reports of the monitor: a change in flight with its size, onset, probability and look-alikes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Size:
    """A size with its 95 % interval."""

    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Fault:
    """A change that the monitor found; reported at the detection, and again with its final size.

    Attributes:
        effect: name of the hypothesis. rotor: 1 to 4, or None. text: words for people.
        onset: s on the drone's clock, start of the change. detected: s, when the test passed its threshold.
        sizes: label -> size.
        probability: posterior probability among the hypotheses, with equal priors.
        look_alikes: name -> probability of other hypotheses that are not ruled out.
        settled: whether this is the second report.
        followed: whether it may be a change to which the estimator adapts by itself.
    """

    effect: str
    rotor: int | None
    text: str
    onset: float
    detected: float
    sizes: Mapping[str, Size]
    probability: float
    look_alikes: Mapping[str, float]
    settled: bool = False
    followed: bool = False

    @property
    def name(self) -> str:
        """Effect and rotor in one word."""
        return self.effect if self.rotor is None else f"{self.effect} {self.rotor}"

    def to_json(self) -> dict[str, Any]:
        """Form for recordings and programs (an interface: names are fixed)."""
        return {
            "effect": self.effect,
            "rotor": self.rotor,
            "onset": self.onset,
            "detected": self.detected,
            "sizes": {n: {"value": s.value, "ci95": list(s.ci95), "unit": s.unit} for n, s in self.sizes.items()},
            "probability": self.probability,
            "look_alikes": dict(self.look_alikes),
            "settled": self.settled,
        }

    def __str__(self) -> str:
        sizes = ", ".join(_said(label, size) for label, size in self.sizes.items())
        others = ", ".join(f"{name} {100 * p:.0f} %" for name, p in self.look_alikes.items())
        return (
            f"{self.text} at {self.onset:.2f} s ({sizes}; probability {100 * self.probability:.0f} %"
            + (f", or {others}" if others else "")
            + f"), noticed {self.detected - self.onset:.2f} s later"
        )


def _said(label: str, size: Size) -> str:
    low, high = size.ci95
    if not size.unit:
        return f"{label} {100 * size.value:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
    return f"{label} {size.value:.3g} {size.unit} [{low:.3g}, {high:.3g}]"
