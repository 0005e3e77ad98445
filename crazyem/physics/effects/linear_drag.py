"""linear_drag: a force against the velocity through the air, in body axes."""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench


def force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """-D v: x, y, z [N s/m] along body axes."""
    return Wrench(-np.array([x, y, z]) * situation.airspeed, np.zeros((situation.size, 3)))


LINEAR_DRAG = Effect(
    "linear_drag",
    tuple(Parameter(axis, "N s/m", 0.0, 0.0, 0.5, 1e-3) for axis in "xyz"),
    order=60,
    external=force,
    couples_air=True,
    needs=("velocity", "position"),
    separates="fly straight legs of different speeds in opposite directions",
)
