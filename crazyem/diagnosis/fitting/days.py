"""Differences of one drone from day to day: a battery sits elsewhere, propellers and feet are bent.

The vehicle file may give their size (`Days`, from healthy flights). Otherwise the prior of the effect `trim` gives it,
from other drones.
"""

from crazyem.diagnosis.fitting.candidates import TRIM
from crazyem.diagnosis.settings import FITTING
from crazyem.physics.effects import rotors
from crazyem.physics.effects.prior import Conditions
from crazyem.vehicle import Vehicle

_REAL = Conditions(file_effects=frozenset({TRIM}))
TRIM_SD = tuple(rotors.TRIM.prior.usual_in(_REAL).values())  # m, torque over thrust about x, y, z
THRUST_SD = rotors.THRUST_SCALE.prior.usual_in(_REAL)["scale"]  # relative


def trim_known(vehicle: Vehicle) -> bool:
    """Whether the file has the drone's own trim; a trim of 0 only says that the drone is real."""
    return any(float(v) for v in vehicle.effects.get(TRIM, {}).values())


def day_sd(vehicle: Vehicle) -> tuple[float, ...]:
    """Standard deviations from day to day of thrust (relative) and of trim about x, y, z [m]."""
    if vehicle.days is not None:
        return (vehicle.days.thrust_sd, *vehicle.days.trim_sd)
    return (THRUST_SD, *TRIM_SD)


def day_freedom(vehicle: Vehicle) -> float:
    """Degrees of freedom of Student's t distribution of the deviations of a day."""
    days = vehicle.days
    return rotors.TRIM.prior.freedom_in(_REAL) if days is None else FITTING.prior_flights + days.flights - 1.0
