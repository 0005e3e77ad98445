"""wind, gusts, force_by_place: external forces other than drag.

Gusts are a random process. They have parameters here and a likelihood elsewhere, and do not change the mean motion.
force_by_place depends on the position of the drone: the force of a cable, a fan or a draught at a wall to first order,
a constant and slopes for each world axis. It is no finding and never part of a vehicle file. It is a rival of named
effects that may imitate it (`crazyem/diagnosis/naming/alternatives.py`).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Conditions, Prior, in_turn

ALONE = 0.007  # N s/m, force over wind speed for a drone without a known drag
# m/s, detection limits of wind. CALM, for files of real drones: a draught in a room, where the trim differs from day to
# day and the drone's response to air is unknown (hover in a real room looks like 0 to 0.6 m/s). STILL, for other
# drones: steady wind that errors of filters and sampling look like.
CALM, STILL = 1.0, 0.1
STEEP = 3.0  # largest vertical over horizontal wind; more is an error of the thrust


def blowing(situation: Situation, *, x: float, y: float, z: float) -> NDArray:
    """Constant velocity of the air [m/s], world."""
    return np.broadcast_to(np.array([x, y, z], float), (situation.size, 3))


def pushing(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Force of wind if no effect is a drag: 0.007 N s/m times wind, world axes; the drone's motion is not damped."""
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
    needs=("velocity", "position"),  # a lasting force moves the drone; an accelerometer alone shows only a tilt
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
    # usual: a room with people in it; detection limit: CALM for files of real drones, else the air of a room
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
    """Force (x, y, z) [N] plus a matrix [N/m] times the position [m], world axes; xy: force along x per y."""
    slope = np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]])
    return Wrench(situation.to_body(np.array([x, y, z]) + situation.position @ slope.T), np.zeros((situation.size, 3)))


FORCE_BY_PLACE = Effect(
    "force_by_place",
    CONSTANT + SLOPES,
    order=66,
    words="force that depends on place",
    external=pulling,
    own_likelihood=True,
    # own: 3 % of a Crazyflie's weight; usual: errors of the modelled thrust and drag
    prior=Prior(
        dict.fromkeys((p.name for p in CONSTANT + SLOPES), 0.01),
        {**in_turn("x y z", 4e-4, 4e-4, 1e-3), **dict.fromkeys((p.name for p in SLOPES), 5e-4)},
    ),
    needs=("position",),
    mistaken_for=("wind", "ground_effect"),
    separates="fly the same path elsewhere in the room",
)
