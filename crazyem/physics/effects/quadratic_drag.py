"""quadratic_drag: a force against the velocity through the air that grows with its square."""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Prior, alike, in_turn


def force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """-Q |v| v: the whole airspeed times each component; x, y, z [N s^2/m^2] along body axes."""
    airspeed = situation.airspeed
    speed = np.sqrt(np.einsum("ni,ni->n", airspeed, airspeed))[:, None]
    return Wrench(-np.array([x, y, z]) * speed * airspeed, np.zeros((situation.size, 3)))


QUADRATIC_DRAG = Effect(
    "quadratic_drag",
    tuple(Parameter(axis, "N s^2/m^2", 0.0, 0.0, 0.1, 5e-4) for axis in "xyz"),
    order=61,
    external=force,
    couples_air=True,
    prior=Prior(alike("x y z", 0.012), in_turn("x y z", 3e-4, 3e-4, 1e-3)),  # usual: as that of a linear drag
    needs=("velocity", "position"),
    separates="fly straight legs at 0.5, 1 and 2 m/s: linear drag doubles with speed, this one goes up four times",
)
