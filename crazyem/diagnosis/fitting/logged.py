"""What the usual spread of recordings depends on (`physics/effects/prior.py`), of flights that are fitted together."""

from collections.abc import Sequence

import numpy as np

from crazyem.diagnosis.fitting.days import day_freedom, day_sd
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.sampling import coarsely_sampled, interval, unlogged_share
from crazyem.diagnosis.flights.flight import Flight
from crazyem.physics.effects.prior import Logged

LEAST_SPEED = 0.01  # m/s, of which a jitter is a share


def logged(flights: Sequence[Flight], point: Point) -> Logged:
    """The facts of some flights, under a model of them."""
    vehicle = point.vehicle
    days = day_sd(vehicle)
    return Logged(
        signals=frozenset.intersection(*(f.signals for f in flights)),
        measured=flights[0].inputs.measured,
        onboard=any(f.fused for f in flights),
        turned=any(np.isfinite(f.y[:, 6]).any() for f in flights),
        levelled=all(f.levelled for f in flights),
        differs=all(f.differs for f in flights),
        filed=frozenset(vehicle.effects),
        arm=vehicle.arm,
        lag=vehicle.motor_time_constant,
        days=(days[0], days[1], days[2], days[3], day_freedom(vehicle)),
        speed=rms_speed(flights),
        period=max(interval(f) for f in flights),
        unlogged=unlogged_share(flights, vehicle),
        unheard=coarsely_sampled(flights, vehicle),
        apart=all(f.coarse for f in flights),
        rotor_inertia=float(point.effects.get("rotor_inertia", {}).get("inertia", 0.0)),
        gyro_bias=float(np.linalg.norm([float(v) for v in point.effects.get("gyro_bias", {}).values()])),
    )


def rms_speed(flights: Sequence[Flight]) -> np.ndarray:
    """(3,) m/s, root mean square along world axes; of flights without a velocity the least."""
    moving = [np.nanmean(np.square(f.y[:, 3:6]), axis=0) for f in flights if np.isfinite(f.y[:, 3]).any()]
    found: np.ndarray = np.sqrt(np.maximum(np.mean(moving, axis=0) if moving else np.zeros(3), LEAST_SPEED**2))
    return found
