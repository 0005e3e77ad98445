"""center_of_mass: the bare body's centre of mass is not in the middle of its rotors."""

from dataclasses import replace

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter
from crazyem.physics.effects.prior import Prior, alike, in_turn


def shifted(body: Body, *, x: float, y: float, z: float) -> Body:
    """Centre of mass at x, y, z [m] from O; mass and inertia about the centre of mass stay."""
    return replace(body, centre=np.array([x, y, z]))


CENTER_OF_MASS = Effect(
    "center_of_mass",
    tuple(Parameter(axis, "m", 0.0, -0.1, 0.1, 5e-4) for axis in "xyz"),
    order=12,
    words="shift of the centre of mass",
    body=shifted,
    # own: a battery of a third of the weight, put in some millimetres off; usual height: what velocities of filters on
    # board look like (`fitting/always.py`)
    prior=Prior(alike("x y z", 1.5e-3), in_turn("x y z", 3e-5, 3e-5, 7e-4)),
    separates=(
        "balance the drone on an edge, or log the accelerometer and yaw for 5 s at 2 Hz; for z fly hard sideways steps"
    ),
)
