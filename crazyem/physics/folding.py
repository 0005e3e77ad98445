"""Folding of fitted effects into the constants of a rigid body with four rotors, for code that knows no effects.

The online estimator and the firmware know mass, inertia, thrust of the rotors and rotor lag. A payload, another
inertia, a thrust scale or a lag can be expressed by these numbers; a drag cannot.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from crazyem.errors import FileFormatError
from crazyem.physics.effects.catalogue import CATALOGUE, check_effects
from crazyem.physics.effects.mass_properties import CENTER_OF_MASS
from crazyem.physics.effects.timing import MOTOR_LAG
from crazyem.physics.motion import active, body_of, gain
from crazyem.vehicle import Vehicle, load_vehicle, parse_vehicle


def load(name_or_path: str | Path) -> Vehicle:
    """Load a preset or vehicle file and check its effects against the catalogue. Raises as `load_vehicle`."""
    return _checked(load_vehicle(name_or_path), str(name_or_path))


def parse(source: str, *, where: str) -> Vehicle:
    """Parse the text of a vehicle file and check its effects. Raises FileFormatError with `where` and the key."""
    return _checked(parse_vehicle(source, where=where), where)


def _checked(vehicle: Vehicle, where: str) -> Vehicle:
    check_effects(vehicle.effects, where=where)
    if vehicle.effects and np.linalg.eigvalsh(body_of(vehicle, vehicle.effects).inertia)[0] <= 0:
        raise FileFormatError(f"{where}: the inertia with [effects] is not a positive definite matrix")
    return vehicle


def fold(vehicle: Vehicle) -> tuple[Vehicle, list[str]]:
    """The nearest vehicle without effects, and the names of the effects that are left out.

    Effects for which a controller of the firmware has a parameter stay in the vehicle.

    Folded are: payload, inertia and inertia_products into mass and inertia (about the common centre of mass; its offset
    becomes the estimator's torque offset), thrust_scale into the rotors' thrust, torque_scale into the arms, motor_lag
    into the time constant. Without rotors, thrust and torque are inputs and are not scaled.
    """
    if not vehicle.effects:
        return vehicle, []
    found = active(vehicle.effects, vehicle)
    bodies = {effect.name: values for effect, values in found if effect.body and effect is not CENTER_OF_MASS}
    used = {*bodies, *(effect.name for effect, _ in found if effect.gain or effect is MOTOR_LAG)}
    body = body_of(vehicle, bodies)
    matrix = body.inertia
    plain = replace(
        vehicle,
        mass=float(body.mass),
        inertia=(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[2, 2])),
        inertia_products=(float(matrix[0, 1]), float(matrix[0, 2]), float(matrix[1, 2])),
        effects={name: values for name, values in vehicle.effects.items() if CATALOGUE[name].controllers},
    )
    for effect, values in found:
        if effect is MOTOR_LAG:
            plain = replace(plain, motor_time_constant=float(values["time_constant"]))
    if not vehicle.thrust_curve and vehicle.rotor_constant is None:
        used -= {effect.name for effect, _ in found if effect.gain}
    else:
        plain = _scaled(plain, thrust=gain(found, "thrust"), torque=gain(found, "torque"))
    return plain, [name for name in CATALOGUE if name in vehicle.effects and name not in used]


def _scaled(vehicle: Vehicle, *, thrust: float, torque: float) -> Vehicle:
    """The vehicle with rotor thrusts times `thrust`, and torques times `torque` in addition."""
    constant = vehicle.rotor_constant
    return replace(
        vehicle,
        thrust_curve=tuple(c * thrust for c in vehicle.thrust_curve),
        rotor_constant=None if constant is None else constant * thrust,
        thrust_max=vehicle.thrust_max * thrust,
        arm=(vehicle.arm[0] * torque, vehicle.arm[1] * torque),
        torque_per_thrust=vehicle.torque_per_thrust * torque,
    )


def notice(left_out: list[str]) -> str:
    """Message to the user about effects that are not used; "" if all are used."""
    if not left_out:
        return ""
    return (
        f"the vehicle file's effects {', '.join(left_out)} are not used: the online estimator knows mass, inertia, "
        "thrust and rotor lag only."
    )
