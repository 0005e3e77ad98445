"""payload: a point mass fixed to the body; mass, inertia and centre of mass move together."""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter
from crazyem.physics.effects.prior import Prior, in_turn


def steiner(mass: float, offset: np.ndarray) -> np.ndarray:
    """(3, 3) kg m^2: what a mass [kg] at an offset (3,) [m] adds to the inertia matrix."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def loaded(body: Body, *, mass: float, x: float, y: float, z: float) -> Body:
    """The body with a point mass [kg] at x, y, z [m] from O; inertia about the new centre by Steiner for both parts."""
    place = np.array([x, y, z])
    total = body.mass + mass
    centre = (body.mass * body.centre + mass * place) / total
    inertia = body.inertia + steiner(body.mass, body.centre - centre) + steiner(mass, place - centre)
    return Body(total, inertia, centre)


PAYLOAD = Effect(
    "payload",
    (
        Parameter("mass", "kg", 0.0, 0.0, 1.0, 5e-4),
        *(Parameter(axis, "m", 0.0, -0.3, 0.3, 2e-3) for axis in "xyz"),
    ),
    order=13,
    body=loaded,
    # own: what a drone of this class carries; within its frame
    prior=Prior(in_turn("mass x y z", 0.08, 0.01, 0.01, 0.01), per={"mass": "mass"}),
    separates="weigh the drone",
    nudge={"mass": 5e-4},
    amplitude="mass",
)
