"""The choice of fitted and held-out flights: hovers have too little information to be fitted if others have more."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import RECORDINGS


def swapped(fitted: Sequence[Flight], kept_apart: Sequence[Flight]) -> bool:
    """Whether all flights to fit hover and a held-out one is much faster: then they exchange their roles.

    A fit to hovers gives wrong parameters, which fail on other flights: a velocity scale of 1.56 instead of 1.13, a
    quadratic drag of 0.07 instead of 0.02.
    """
    if not kept_apart:
        return False
    here, there = np.array([_rms_motion(f) for f in fitted]), np.array([_rms_motion(f) for f in kept_apart])
    hovers = bool(np.all(here[:, 0] < RECORDINGS.hover_speed) and np.all(here[:, 1] < RECORDINGS.hover_rate))
    return hovers and bool(
        np.any(there[:, 0] > max(RECORDINGS.hover_speed, RECORDINGS.speed_ratio * float(here[:, 0].max())))
    )


def swap_sentence(fitted: Sequence[str], kept_apart: Sequence[str]) -> str:
    """The sentence that tells of the exchange; `fitted` and `kept_apart` are the new roles."""
    now, first = (", ".join(Path(p).name for p in part) for part in (fitted, kept_apart))
    here = f"physics is fitted to what was held out, {now}, and confirmed by it"
    return f"{first}: only hovers, so {here} (--strict-held-out forbids that)"


def _rms_motion(flight: Flight) -> NDArray:
    """(2,) rms of the horizontal speed [m/s] and of the body rate [rad/s]; NaN where not measured."""
    return np.array([_rms(flight.y[:, 3:5]), _rms(flight.y[:, 10:13])])


def _rms(values: NDArray) -> float:
    known = np.isfinite(values).all(axis=1)
    return float(np.sqrt(np.mean(np.sum(np.square(values[known]), axis=1)))) if known.any() else float("nan")
