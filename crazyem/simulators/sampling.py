"""Draw vehicles from the joint posterior of a fitted vehicle, for domain randomisation and for ensembles.

Flights identify ratios (thrust over mass, torque over inertia), but not the mass; the mass is drawn separately. From
day to day, thrust, trim and rotor lag of a drone vary by more than the posterior says, so their variation is added.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.days import day_sd
from crazyem.errors import DataError, UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import THRUST_SCALE, TRIM
from crazyem.physics.effects.timing import LAG_SD, MOTOR_LAG
from crazyem.physics.motion import vehicle_values
from crazyem.simulators.constants import NUMBERS, from_vehicle, impossible
from crazyem.simulators.findings import rescaled
from crazyem.vehicle import Vehicle

Array = NDArray[np.float64]
MASS_SD = 0.02  # relative: other batteries, decks or markers that were not weighed
USUAL_LAG = 0.05  # s, nominal lag for which `LAG_SD` was found; their ratio is the sd of the lag's logarithm
TRIES = 200  # most draws until a drone is physically possible


@dataclass(frozen=True, eq=False)
class VehicleSample:
    """Drones that were drawn.

    Attributes:
        vehicles: one per draw.
        parameters: k names, as in the posterior. draws: (n, k) their values. seed: of the draws.
    """

    vehicles: tuple[Vehicle, ...]
    parameters: tuple[str, ...]
    draws: Array
    seed: int

    def arrays(self) -> dict[str, Array]:
        """Constants by their names in `Constants`, (n,) each, and parameters of effects that no constant expresses."""
        rows = [from_vehicle(v)[0] for v in self.vehicles]
        found = {n: np.array([r.or_(n, math.nan) for r in rows]) for n in NUMBERS}
        found = {n: v for n, v in found.items() if np.isfinite(v).all()}
        left = from_vehicle(self.vehicles[0])[1]
        for effect in left:
            for name, value in self.vehicles[0].effects[effect].items():
                if isinstance(value, int | float) and not isinstance(value, bool):
                    found[f"{effect}.{name}"] = np.array([v.effects[effect][name] for v in self.vehicles], float)
        return found


def sample(
    vehicle: Vehicle, count: int, *, seed: int = 0, days: bool = True, mass_sd: float = MASS_SD
) -> VehicleSample:
    """Draw drones from the posterior of a fitted vehicle.

    Args:
        count: number of drones.
        seed: the same seed gives the same drones.
        days: whether to add the day-to-day variation of thrust, trim and lag.
        mass_sd: relative standard deviation of the mass; inertia, thrust and drag scale with it. 0 for a weighed drone.

    Raises: UsageError: the vehicle has no posterior. DataError: hardly any draw is physically possible.
    """
    posterior = vehicle.posterior
    if posterior is None:
        raise UsageError(f"vehicle {vehicle.name} has no [posterior]; diagnose --write-vehicle writes one.")
    for key in posterior.parameters:
        effect, _, name = key.partition(".")
        if effect not in CATALOGUE or name not in {p.name for p in CATALOGUE[effect].parameters}:
            raise UsageError(f"vehicle {vehicle.name}: its [posterior] has an unknown parameter '{key}'.")
    rng = np.random.default_rng(seed)
    variances, directions = np.linalg.eigh(np.array(posterior.covariance, float))
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    mean = np.array(posterior.mean, float)
    vehicles, draws = [], []
    for _ in range(count):
        for _ in range(TRIES):
            theta = mean + root @ rng.standard_normal(mean.size)
            drawn = _drawn(vehicle, posterior.parameters, theta)
            if days:
                drawn = _another_day(drawn, rng)
            mass = from_vehicle(drawn)[0].or_("mass", drawn.mass)  # of the whole drone
            drawn = rescaled(drawn, mass * math.exp(mass_sd * rng.standard_normal()))
            if _possible(drawn):
                break
        else:
            raise DataError(
                f"vehicle {vehicle.name}: hardly any drone of its posterior has a possible inertia and effects"
            )
        vehicles.append(drawn)
        draws.append(theta)
    return VehicleSample(tuple(vehicles), posterior.parameters, np.array(draws), seed)


def _drawn(vehicle: Vehicle, parameters: Sequence[str], theta: Array) -> Vehicle:
    own = vehicle_values(vehicle)
    effects = {n: dict(v) for n, v in vehicle.effects.items()}
    for key, value in zip(parameters, theta, strict=True):
        effect, _, name = key.partition(".")
        if effect not in effects:
            effects[effect] = CATALOGUE[effect].complete({}, own.get(effect, {}))
        effects[effect][name] = float(value)
    return replace(vehicle, effects=effects, posterior=None)


def _another_day(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """The same drone with the thrust, trim and lag of another day."""
    effects = {n: dict(v) for n, v in vehicle.effects.items()}
    thrust_sd, *trim_sd = day_sd(vehicle)
    scale = effects.setdefault(THRUST_SCALE.name, {"scale": 1.0})
    scale["scale"] *= 1.0 + thrust_sd * rng.standard_normal()
    trim = effects.setdefault(TRIM.name, dict.fromkeys("xyz", 0.0))
    for axis, sd in zip("xyz", trim_sd, strict=True):
        trim[axis] = trim.get(axis, 0.0) + sd * rng.standard_normal()
    lag = effects.get(MOTOR_LAG.name, {}).get("time_constant", vehicle.motor_time_constant)
    if lag > 0.0:
        effects[MOTOR_LAG.name] = {"time_constant": lag * math.exp(LAG_SD / USUAL_LAG * rng.standard_normal())}
    return replace(vehicle, effects=effects)


def _possible(vehicle: Vehicle) -> bool:
    for name, values in vehicle.effects.items():
        for p in CATALOGUE[name].parameters:
            value = values.get(p.name)
            if isinstance(value, float) and not p.low <= value <= p.high:
                return False
    constants = from_vehicle(vehicle)[0]
    moments = [constants.or_(f"inertia_{a}", 0.0) for a in ("xx", "yy", "zz")]
    return min(moments) > 0.0 and not impossible(constants, str)
