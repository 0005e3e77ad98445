"""Conditions on which the usual spread of recordings depends (`physics/effects/prior.py`), for flights of one fit."""

from collections.abc import Sequence

import numpy as np

from crazyem.diagnosis.fitting.days import day_freedom, day_sd
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.sampling import interval, unlogged_share
from crazyem.diagnosis.flights.flight import Flight
from crazyem.physics.effects.prior import Conditions
from crazyem.physics.effects.rotors import ROTOR_INERTIA
from crazyem.physics.effects.sensing import GYRO_BIAS


def conditions_of(flights: Sequence[Flight], point: Point) -> Conditions:
    """The conditions of some flights under a model."""
    vehicle = point.vehicle
    days = day_sd(vehicle)
    return Conditions(
        signals=frozenset.intersection(*(f.signals for f in flights)),
        measured_speeds=flights[0].inputs.measured,
        onboard=any(f.fused for f in flights),
        inferred_attitude=any(np.isfinite(f.y[:, 6]).any() for f in flights),
        no_voltage=all(f.levelled for f in flights),
        own_battery=all(f.differs for f in flights),
        file_effects=frozenset(vehicle.effects),
        arm=vehicle.arm,
        lag=vehicle.motor_time_constant,
        days=(days[0], days[1], days[2], days[3], day_freedom(vehicle)),
        speed=rms_speed(flights),
        period=max(interval(f) for f in flights),
        unlogged_share=unlogged_share(flights, vehicle),
        other_clock=all(f.coarse for f in flights),
        rotor_inertia=float(point.effects.get(ROTOR_INERTIA.name, {}).get("inertia", 0.0)),
        gyro_bias=float(np.linalg.norm([float(v) for v in point.effects.get(GYRO_BIAS.name, {}).values()])),
    )


def rms_speed(flights: Sequence[Flight]) -> np.ndarray:
    """(3,) m/s, root mean square along world axes; 0 for flights without a velocity."""
    moving = [np.nanmean(np.square(f.y[:, 3:6]), axis=0) for f in flights if np.isfinite(f.y[:, 3]).any()]
    found: np.ndarray = np.sqrt(np.mean(moving, axis=0)) if moving else np.zeros(3)
    return found
