"""Flights that drive a hidden state into chaos: what an effect does there follows from no recorded path."""

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.situation import initial_path, situation_of, thrust_of
from crazyem.diagnosis.flights.flight import Flight
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect, Values
from crazyem.physics.motion import motion
from crazyem.vehicle import Vehicle

OFF = 0.01  # m/s by which a path may be off from one row to the next, as a filter's may
# Share of what comes and goes of the force by which that changes it: in simulated flights that shake all of it changes,
# in others some per cent. And share of the force that comes and goes at least: in a hover noise is all that swings.
CHANGED, SWINGING = 0.3, 0.2
FEWER = 6  # of an effect's beginnings one in so many is asked


def diverges(flight: Flight, vehicle: Vehicle, name: str) -> bool:
    """Whether a flight, as it was measured, drives an effect that has sizes astray, from any of some beginnings."""
    known = initial_path(flight)
    off = known.copy()
    off[:, 3:6] += OFF * np.random.default_rng(0).normal(size=(len(off), 3))
    thrusts = thrust_of(flight, vehicle, {})
    paths = [situation_of(flight, path, vehicle, thrusts) for path in (known, off)]
    free = [motion(there, vehicle=vehicle, effects={}).specific_force for there in paths]
    for values in _some(CATALOGUE[name]):
        pull, other = (
            motion(there, vehicle=vehicle, effects={name: values}).specific_force - without
            for there, without in zip(paths, free, strict=True)
        )
        swing = _rms(pull - pull.mean(axis=0))
        if swing > SWINGING * _rms(pull) and _rms(other - pull) > CHANGED * swing:
            return True
    return False


def _some(effect: Effect) -> list[Values]:
    """Values of an effect from one in `FEWER` of its beginnings; none for one without sizes."""
    if not effect.sizes:
        return []
    size = effect.sizes[len(effect.sizes) // 2]
    return [
        {effect.amplitude: size, name: value}
        for name, values in effect.beginnings.items()
        for value in values[FEWER // 2 :: FEWER]
    ]


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
