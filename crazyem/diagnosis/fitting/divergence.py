"""Flights that drive a hidden state into chaos: the force of the effect then does not follow from the recorded path."""

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.situation import initial_path, situation_of, thrust_of
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect, Values
from crazyem.physics.motion import motion
from crazyem.vehicle import Vehicle


def diverges(flight: Flight, vehicle: Vehicle, name: str) -> bool:
    """Whether a small error of the measured path changes much of an effect's force, from one of some beginnings."""
    known = initial_path(flight)
    off = known.copy()
    off[:, 3:6] += NOISE.chaos_velocity * np.random.default_rng(0).normal(size=(len(off), 3))
    thrusts = thrust_of(flight, vehicle, {})
    paths = [situation_of(flight, path, vehicle, thrusts) for path in (known, off)]
    free = [motion(there, vehicle=vehicle, effects={}).specific_force for there in paths]
    for values in _some(CATALOGUE[name]):
        pull, other = (
            motion(there, vehicle=vehicle, effects={name: values}).specific_force - without
            for there, without in zip(paths, free, strict=True)
        )
        swing = _rms(pull - pull.mean(axis=0))
        if swing > NOISE.chaos_swing * _rms(pull) and _rms(other - pull) > NOISE.chaos_change * swing:
            return True
    return False


def _some(effect: Effect) -> list[Values]:
    """Values of an effect at one in `NOISE.chaos_every` of its beginnings; none for an effect without sizes."""
    if not effect.sizes:
        return []
    size = effect.sizes[len(effect.sizes) // 2]
    return [
        {effect.amplitude: size, name: value}
        for name, values in effect.beginnings.items()
        for value in values[NOISE.chaos_every // 2 :: NOISE.chaos_every]
    ]


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
