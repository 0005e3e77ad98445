"""wind, gusts, force_by_place: forces from outside that are no drag.

Gusts are a random process: they have parameters here and a likelihood elsewhere, and add nothing to the mean motion.
force_by_place depends on where the drone is, and is what nobody names: a cable, a fan or the draught of a wall to first
order, a constant and a slope for each world axis. It is no finding and never part of a vehicle file; it stands against
named effects that would have to imitate it (`crazyem/diagnosis/naming/place_rivals.py`).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Conditions, Prior, in_turn

ALONE = 0.007  # N s/m: the force of wind on a drone whose drag nobody knows
# m/s up to which air is no finding: a room's draft, where trims differ from day to day and a drone's answer to air is
# not known (hovering in a real room looks like 0 to 0.6 m/s); of steady wind on other drones, what filters and sampling
# look like.
CALM, STILL = 1.0, 0.1
STEEP = 3.0  # vertical over horizontal wind: what rises or sinks is thrust that is a little wrong


def blowing(situation: Situation, *, x: float, y: float, z: float) -> NDArray:
    """Constant velocity of the air [m/s], world."""
    return np.broadcast_to(np.array([x, y, z], float), (situation.size, 3))


def pushing(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Without a drag: the constant force 0.007 N s/m times wind, world axes; the drone's own motion is not damped."""
    none = np.zeros((situation.size, 3))
    return Wrench(none if situation.shaken else situation.to_body(ALONE * np.array([x, y, z])), none)


def _blows(here: Mapping[str, Any], neutral: Mapping[str, Any], conditions: Conditions) -> bool:
    along = float(np.hypot(here["x"], here["y"]))
    return along > (CALM if conditions.individual_file else STILL) and abs(here["z"]) < STEEP * along


WIND = Effect(
    "wind",
    tuple(Parameter(axis, "m/s", 0.0, -30.0, 30.0, 0.2) for axis in "xyz"),
    order=64,
    air=blowing,
    external=pushing,
    prior=Prior(in_turn("x y z", 2.0, 2.0, 0.7), finding=_blows),
    needs=("velocity", "position"),  # a force that goes on moves the drone; an accelerometer alone is only tilted by it
    separates="hover for 5 s at each of four headings: wind stays in the world, a tilted frame turns with the drone",
    belongs_to="day",
    steady_force=True,
    imbalance="air",
)

GUSTS = Effect(
    "gusts",
    (
        Parameter("standard_deviation", "m/s", 0.0, 0.0, 10.0, 0.1),
        Parameter("correlation_time", "s", 1.0, 0.01, 100.0, 0.1),
    ),
    order=65,
    random=True,
    own_likelihood=True,
    # usual: a room with people in it; detection limit: the weather of a drone that flew, the air of a room
    prior=Prior(
        own={"standard_deviation": 1.5},
        usual={"standard_deviation": 0.3},
        detection_limit=lambda chosen, conditions: {"standard_deviation": CALM if conditions.individual_file else 0.4},
    ),
    separates="fly the same manoeuvre in still air",
    belongs_to="day",
    amplitude="standard_deviation",
)


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
    own_likelihood=True,
    # own: 3 % of a Crazyflie's weight; usual: what thrust and drag leave
    prior=Prior(
        dict.fromkeys((p.name for p in CONSTANT + SLOPES), 0.01),
        {**in_turn("x y z", 4e-4, 4e-4, 1e-3), **dict.fromkeys((p.name for p in SLOPES), 5e-4)},
    ),
    needs=("position",),
    mistaken_for=("wind", "ground_effect"),
    separates="fly the same path elsewhere in the room",
)
