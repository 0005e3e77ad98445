"""Hypotheses of signed axes, and slopes read as units or scale faults; several checks share these functions."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.regression import Slope

Array = NDArray[np.float64]

SCALE_TOLERANCE = 0.02  # relative; sensors and filters in good order differ by this much
FEWEST_SCALE_BLOCKS = 5.0  # least number of blocks (of 1.5 s or more) of motion for a scale fault
_AXIS_NAMES = "xyz"
_FACTOR_TOLERANCE = math.log(1.2)  # largest |log| of a slope over a known factor


def signed(label: str, vector: Array, names: Sequence[str] = _AXIS_NAMES) -> dict[str, tuple[int, Array]]:
    """All 48 signed orders of the components of (n, 3): name -> (cost, values); the unchanged order is first.

    The cost is lower for simpler hypotheses: 1 for a sign (2 for all three), 2 more for another order. Names: "body",
    "body x, -y, z", "body y, x, z".
    """
    out: dict[str, tuple[int, Array]] = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            flipped = sum(s < 0 for s in signs)
            cost = (2 if flipped == 3 else flipped) + (0 if order == (0, 1, 2) else 2)
            parts = ("-" * (s < 0) + names[i] for s, i in zip(signs, order, strict=True))
            name = label if cost == 0 else f"{label} " + ", ".join(parts)
            out[name] = (cost, vector[:, order] * np.array(signs))
    return out


def sign_factor(name: str, names: Sequence[str] = _AXIS_NAMES) -> tuple[float, ...] | None:
    """Factors that undo signs named by `signed` ("x, -y, z"), None if the order changed."""
    parts = name.split(", ")
    if [part.lstrip("-") for part in parts] != list(names):
        return None
    return tuple(-1.0 if part.startswith("-") else 1.0 for part in parts)


def known_factor(found: Slope, known: Mapping[str, float]) -> tuple[str, float] | None:
    """Name and value of the known factor within 20 % of a slope; None if there is none."""
    if found.value <= 0.0:
        return None
    for name, factor in known.items():
        if abs(math.log(found.value / factor)) < _FACTOR_TOLERANCE:
            return name, factor
    return None


@dataclass(frozen=True, slots=True)
class ScaleFault:
    """A scale that is not 1. `text` names the scales and intervals; `repair` has the factors to multiply with."""

    text: str
    repair: tuple[float, ...]


def scale_fault(whole: Slope | None, single: Sequence[Slope | None], least: float) -> ScaleFault | None:
    """A scale fault of all or some components; None if no slope is at least `least` from 1 with certainty.

    Args:
        whole: slope of all components together.
        single: of each component.
        least: deviation from 1 that matters.
    """
    known = [s for s in single if s is not None]
    # one factor for all, if no component contradicts it
    if whole is not None and _off(whole, least) and all(s.low <= whole.high and s.high >= whole.low for s in known):
        return ScaleFault(f"its scale is {_said(whole)}", (1.0 / whole.value,) * len(single))
    off = {i: s for i, s in enumerate(single) if s is not None and _off(s, least)}
    if not off:
        return None
    said = [f"{_AXIS_NAMES[i]} {_said(s)}" for i, s in off.items()]
    repair = tuple(1.0 / off[i].value if i in off else 1.0 for i in range(len(single)))
    return ScaleFault("its scale is " + ", ".join(said), repair)


def numbers(single: Sequence[Slope | None]) -> dict[str, float]:
    """Slopes of the components with their intervals, as evidence."""
    out: dict[str, float] = {}
    for axis, s in zip(_AXIS_NAMES, single, strict=False):
        if s is not None:
            out |= {f"slope_{axis}": s.value, f"slope_{axis}_low": s.low, f"slope_{axis}_high": s.high}
    return out


def _off(s: Slope, least: float) -> bool:
    certain = s.far_low > 1.0 + SCALE_TOLERANCE or s.far_high < 1.0 - SCALE_TOLERANCE
    return abs(s.value - 1.0) >= least and certain and s.explained > 0.8 and s.blocks >= FEWEST_SCALE_BLOCKS


def _said(s: Slope) -> str:
    return f"{s.value:.3f} ({s.low:.3f} to {s.high:.3f})"
