"""force_by_place: a force that depends on where the drone is, and what nobody names.

A cable, a fan or the draught of a wall to first order: a constant and a slope for each world axis. It is no finding and
never part of a vehicle file; it stands against named effects that would have to imitate it
(`crazyem/diagnosis/naming/place_rivals.py`).
"""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Prior, in_turn

AXES = "xyz"
CONSTANT = tuple(Parameter(i, "N", 0.0, -0.5, 0.5, 2e-3) for i in AXES)
SLOPES = tuple(Parameter(f"{i}{j}", "N/m", 0.0, -1.0, 1.0, 2e-3) for i in AXES for j in AXES)


def pulling(
    situation: Situation, body: Body, *, x: float, y: float, z: float, xx: float, xy: float, xz: float, yx: float,
    yy: float, yz: float, zx: float, zy: float, zz: float,
) -> Wrench:  # fmt: skip
    """(x, y, z) [N] plus a matrix [N/m] times the position [m], force and place in world axes; xy: along x, by y."""
    slope = np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]])
    return Wrench(situation.to_body(np.array([x, y, z]) + situation.position @ slope.T), np.zeros((situation.size, 3)))


FORCE_BY_PLACE = Effect(
    "force_by_place",
    CONSTANT + SLOPES,
    order=66,
    words="force that depends on place",
    external=pulling,
    # own: 3 % of a Crazyflie's weight; usual: what thrust and drag leave
    prior=Prior(
        dict.fromkeys((p.name for p in CONSTANT + SLOPES), 0.01),
        {**in_turn("x y z", 4e-4, 4e-4, 1e-3), **dict.fromkeys((p.name for p in SLOPES), 5e-4)},
        unnamed=True,
    ),
    needs=("position",),
    separates="fly the same path elsewhere in the room",
)
