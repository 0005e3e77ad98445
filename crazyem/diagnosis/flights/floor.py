"""Where the floor is in a recording that does not show it: where the others have it.

A recording that begins with the rotors turning does not show the drone at rest, so its heights would be counted from
the origin of its frame. A marker on top of a drone stands several centimetres above that, which is all that a ground
effect reaches.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from crazyem.diagnosis.flights.flight import Flight

AGREE = 0.02  # m: by how much the others may differ, and by how much a drone may seem to be below the floor
LEAST = 2  # others that show it


def on_one_floor(flights: Sequence[Flight], kept_apart: Sequence[Flight]) -> tuple[list[Flight], list[Flight]]:
    """The flights, those that do not show the floor with that of the others, if these agree and none flew below it."""
    everyone = [*flights, *kept_apart]
    shown = [f.ground for f in everyone if f.grounded]
    if len(shown) < LEAST or len(shown) == len(everyone) or np.ptp(shown) > AGREE:
        return list(flights), list(kept_apart)
    level = float(np.median(shown))
    return [_stood(f, level) for f in flights], [_stood(f, level) for f in kept_apart]


def _stood(flight: Flight, level: float) -> Flight:
    height = flight.y[:, 2]
    if flight.grounded or not np.isfinite(height).any() or float(np.nanmin(height)) < level - AGREE:
        return flight
    said = f"the drone is never seen at rest, so the floor is taken to be where the others have it, z = {level:.3f} m"
    return replace(flight, ground=level, notices=(*flight.notices, said))
