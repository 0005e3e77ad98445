"""Which flights are fitted and which confirm: those that hover say too little to be fitted where others say more."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import Flight

# Below these a flight hovers [m/s, horizontal; rad/s]: simulated hovers have 0.006 to 0.08 and 0.08 to 0.4 (in gusts),
# small shakes from 0.128 and 0.74 on. There velocities are mostly the jitter of the onboard estimate (see
# `sensing.jitter`), and a drag is whatever that looks like.
STILL, STEADY = 0.1, 0.5
LIVELIER = 3.0  # times as quick, at least: rooms are never still, and flights of a kind differ by chance


def swapped(fitted: Sequence[Flight], kept_apart: Sequence[Flight]) -> bool:
    """Whether the flights to fit only hover and those kept apart do not: then these are fitted, the hovers confirm.

    A velocity scale of 1.13 was 1.56 to a hover, and ruined what it was held against; a quadratic drag of 0.02 was
    0.07.
    """
    if not kept_apart:
        return False
    here, there = np.array([_quick(f) for f in fitted]), np.array([_quick(f) for f in kept_apart])
    hovers = bool(np.all(here[:, 0] < STILL) and np.all(here[:, 1] < STEADY))
    return hovers and bool(np.any(there[:, 0] > max(STILL, LIVELIER * float(here[:, 0].max()))))


def swap_sentence(fitted: Sequence[str], kept_apart: Sequence[str]) -> str:
    """The sentence that says so, of what is fitted now and what was named first."""
    now, first = (", ".join(Path(p).name for p in part) for part in (fitted, kept_apart))
    here = f"physics is fitted to what was held out, {now}, and confirmed by it"
    return f"{first}: only hovers, so {here} (--strict-held-out forbids that)"


def _quick(flight: Flight) -> NDArray:
    """(2,) rms of the horizontal speed [m/s] and of the body rate [rad/s]; NaN where not measured."""
    return np.array([_rms(flight.y[:, 3:5]), _rms(flight.y[:, 10:13])])


def _rms(values: NDArray) -> float:
    known = np.isfinite(values).all(axis=1)
    return float(np.sqrt(np.mean(np.sum(np.square(values[known]), axis=1)))) if known.any() else float("nan")
