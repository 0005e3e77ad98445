"""The height of the floor in a recording that does not show it, from other recordings.

A recording that begins with turning rotors does not show the drone at rest, so heights would count from the origin of
its frame. A marker on top of a drone is several centimetres higher, which is as far as a ground effect reaches.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import LEVELLING


def with_common_floor(flights: Sequence[Flight], kept_apart: Sequence[Flight]) -> tuple[list[Flight], list[Flight]]:
    """The flights; those without a floor get the floor of the others, if these agree and the flight is not below it."""
    everyone = [*flights, *kept_apart]
    shown = [f.ground for f in everyone if f.grounded]
    if len(shown) < LEVELLING.min_floors or len(shown) == len(everyone) or np.ptp(shown) > LEVELLING.floor_range:
        return list(flights), list(kept_apart)
    level = float(np.median(shown))
    return [_stood(f, level) for f in flights], [_stood(f, level) for f in kept_apart]


def _stood(flight: Flight, level: float) -> Flight:
    height = flight.y[:, 2]
    if flight.grounded or not np.isfinite(height).any() or float(np.nanmin(height)) < level - LEVELLING.floor_range:
        return flight
    said = f"the drone is never seen at rest, so the floor is taken to be where the others have it, z = {level:.3f} m"
    return replace(flight, ground=level, notices=(*flight.notices, said))
