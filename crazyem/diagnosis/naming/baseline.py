"""Trim and thrust of a drone from healthy flights, and how much these differ from day to day."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM
from crazyem.diagnosis.fitting.days import day_sd
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.fit import nominal as nominal_of
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, with_trim_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming.balance import balance_of
from crazyem.diagnosis.settings import FITTING
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Days, Vehicle


def with_baseline(
    vehicle: Vehicle, recordings: Sequence[Recording], say: Callable[[str], None] = lambda text: None
) -> Vehicle:
    """The vehicle with mean trim and thrust of healthy flights, their spread (`Days`), and the aerodynamics of the
    rotors (`Effect.of_healthy_rotors`) fitted to all flights together.

    Args:
        recordings: flights of this drone without a fault, of several days.

    Raises:
        UsageError: fewer than two flights. DataError: a recording cannot be used.
    """
    if len(recordings) < 2:
        raise UsageError("--baseline needs two healthy flights or more: one does not say how days differ.")
    trim = {"x": 0.0, "y": 0.0, "z": 0.0, **vehicle.effects.get(TRIM, {})}
    known = replace(vehicle, effects={**vehicle.effects, TRIM: trim}, days=None)
    lacks, flights = [], []
    for recording in recordings:
        say(f"healthy flight {recording.path}")
        flights.append(flight_of(recording, known))
        data = Data(flights[-1:])
        lacks.append(balance_of(data, _nominal(data, known)).lack)
    data = Data(flights)
    together = refine_base(data, _nominal(data, known), ()).point
    mean, sd = spread_of(np.array(lacks), np.array(day_sd(known)))
    thrust = float(known.effects.get(THRUST.effect, {}).get("scale", 1.0)) * (1.0 - float(mean[0]))
    own = {axis: float(trim[axis] + m) for axis, m in zip("xyz", mean[1:], strict=True)}
    effects = {**known.effects, **rotor_aerodynamics(data, together), TRIM: own, THRUST.effect: {"scale": thrust}}
    days = Days(len(recordings), float(sd[0]), (float(sd[1]), float(sd[2]), float(sd[3])))
    return replace(known, effects=effects, days=days)


def rotor_aerodynamics(data: Data, point: Point) -> dict[str, dict[str, float]]:
    """Drag and flapping as fitted; a number at the end of its prior's reach is that of the vehicle file."""
    found = {}
    for candidate, precisions in nuisances(data, point, ()):
        if candidate.effect in CATALOGUE and CATALOGUE[candidate.effect].of_healthy_rotors:
            filed, here = candidate.neutral(point), candidate.values(point)
            found[candidate.effect] = {
                name: float(
                    here[name]
                    if abs(here[name] - filed[name]) < FITTING.within_reach * FITTING.max_deviation * w**-0.5
                    else filed[name]
                )
                for name, w in zip(candidate.free, precisions, strict=True)
            }
    return found


def _nominal(data: Data, vehicle: Vehicle) -> Point:
    """The vehicle's model with the noise of these flights."""
    bare = Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, start_noise())
    return with_trim_noise(data, nominal_of(data, bare))


def spread_of(found: NDArray, usual: NDArray) -> tuple[NDArray, NDArray]:
    """(k,) means of numbers of flights (n, k), and (k,) scales of the t distribution for the next flight.

    usual: (k,) standard deviations for any drone, which count as p = `FITTING.prior_flights` flights: the conjugate
    prior of a variance (Gelman et al., Bayesian Data Analysis, 3.3). Degrees of freedom: p + n - 1.
    """
    n, mean = len(found), found.mean(axis=0)
    squares = FITTING.prior_flights * np.square(usual) + np.square(found - mean).sum(axis=0)
    return mean, np.sqrt(squares / (FITTING.prior_flights + n - 1.0) * (1.0 + 1.0 / n))
