"""linear_drag: a force against the velocity through the air, in body axes."""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Prior, alike, in_turn


def force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """-D v: x, y, z [N s/m] along body axes."""
    return Wrench(-np.array([x, y, z]) * situation.airspeed, np.zeros((situation.size, 3)))


LINEAR_DRAG = Effect(
    "linear_drag",
    tuple(Parameter(axis, "N s/m", 0.0, 0.0, 0.5, 1e-3) for axis in "xyz"),
    order=60,
    external=force,
    couples_air=True,
    # usual: an attitude 1 ms late is a force of 3e-4 N s/m; along z thrust is a little wrong (`fitting/always.py`)
    prior=Prior(alike("x y z", 0.012), in_turn("x y z", 5e-4, 5e-4, 1e-3)),
    needs=("velocity", "position"),
    separates="fly straight legs of different speeds in opposite directions",
)
