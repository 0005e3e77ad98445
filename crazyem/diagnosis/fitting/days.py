"""Differences of one drone from day to day: a battery sits elsewhere, propellers and feet are bent.

The vehicle file may give their size (`Days`, from healthy flights). Otherwise the prior of the effect `trim` gives it,
from other drones.
"""

from crazyem.diagnosis.settings import FITTING
from crazyem.physics.effects.prior import Conditions
from crazyem.physics.effects.rotors import THRUST_SCALE, TRIM
from crazyem.vehicle import Vehicle

_REAL = Conditions(file_effects=frozenset({TRIM.name}))
TRIM_SD = tuple(TRIM.prior.usual_in(_REAL).values())  # m, torque over thrust about x, y, z
THRUST_SD = THRUST_SCALE.prior.usual_in(_REAL)["scale"]  # relative


def trim_known(vehicle: Vehicle) -> bool:
    """Whether the file has the drone's own trim; a trim of 0 only says that the drone is real."""
    return any(float(v) for v in vehicle.effects.get(TRIM.name, {}).values())


def day_sd(vehicle: Vehicle) -> tuple[float, ...]:
    """Standard deviations from day to day of thrust (relative) and of trim about x, y, z [m]."""
    if vehicle.days is not None:
        return (vehicle.days.thrust_sd, *vehicle.days.trim_sd)
    return (THRUST_SD, *TRIM_SD)


def day_freedom(vehicle: Vehicle) -> float:
    """Degrees of freedom of Student's t distribution of the deviations of a day."""
    return TRIM.prior.freedom_in(_REAL) if vehicle.days is None else FITTING.prior_flights + vehicle.days.flights - 1.0
