"""By how much one drone differs from day to day: batteries are put in again, propellers and feet are bent.

A vehicle file may say so (`Days`, from healthy flights). Else the spread of other drones counts, which stands with the
effect `trim`.
"""

from crazyem.physics.effects.prior import Conditions
from crazyem.physics.effects.rotors import THRUST_SCALE, TRIM
from crazyem.vehicle import Vehicle

_REAL = Conditions(file_effects=frozenset({TRIM.name}))
TRIM_SD = tuple(TRIM.prior.usual_in(_REAL).values())  # m, torque over thrust about x, y, z
THRUST_SD = THRUST_SCALE.prior.usual_in(_REAL)["scale"]  # relative
# Flights that the spread of other drones is worth beside a drone's own: the two drones of CrazyPAD differ by a factor
# of four in it, so other drones say little.
PRIOR_FLIGHTS = 2.0


def trim_known(vehicle: Vehicle) -> bool:
    """Whether the file has the drone's own trim; one of 0 only says that it is a real drone."""
    return any(float(v) for v in vehicle.effects.get(TRIM.name, {}).values())


def day_sd(vehicle: Vehicle) -> tuple[float, ...]:
    """By how much thrust (relative) and trim about x, y, z [m] differ from day to day."""
    if vehicle.days is not None:
        return (vehicle.days.thrust_sd, *vehicle.days.trim_sd)
    return (THRUST_SD, *TRIM_SD)


def day_freedom(vehicle: Vehicle) -> float:
    """Degrees of freedom of Student's t distribution of a day."""
    return TRIM.prior.freedom_in(_REAL) if vehicle.days is None else PRIOR_FLIGHTS + vehicle.days.flights - 1.0
