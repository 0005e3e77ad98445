"""center_of_mass: the bare body's centre of mass is not in the middle of its rotors."""

from dataclasses import replace

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter


def shifted(body: Body, *, x: float, y: float, z: float) -> Body:
    """Centre of mass at x, y, z [m] from O; mass and inertia about the centre of mass stay."""
    return replace(body, centre=np.array([x, y, z]))


CENTER_OF_MASS = Effect(
    "center_of_mass",
    tuple(Parameter(axis, "m", 0.0, -0.1, 0.1, 5e-4) for axis in "xyz"),
    order=12,
    words="shift of the centre of mass",
    body=shifted,
    separates=(
        "balance the drone on an edge, or log the accelerometer and yaw for 5 s at 2 Hz; for z fly hard sideways steps"
    ),
)
