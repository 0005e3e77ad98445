"""trim: the steady torque that every real drone needs.

No four rotors are equal or upright, and no battery sits in the middle. It goes with the thrust, so nothing acts on a
drone with its rotors at rest. For a vehicle file that has it, the day's trim differs a little from the file's; how much
is in `crazyem/diagnosis/fitting/always.py`.
"""

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Logged, Prior, Sizes, in_turn


def trimmed(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Torque (x, y, z) [m, that is N m per N] times the thrust of all rotors, body axes."""
    total = situation.thrust.sum(axis=1)[:, None]
    return Wrench(np.zeros((situation.size, 3)), np.array([x, y, z]) * total)


def _of_the_day(logged: Logged) -> Sizes:
    """As healthy and damaged flights of two drones on several days scatter (docs/results/diagnosis_real.md)."""
    return in_turn("x y z", 5e-4, 5e-4, 1.6e-4) if logged.dated else {}


TRIM = Effect(
    "trim",
    tuple(Parameter(axis, "m", 0.0, -0.02, 0.02, 1e-4) for axis in "xyz"),
    order=41,
    external=trimmed,
    prior=Prior(usual=_of_the_day),
    separates="fly the drone while it is well and judge by the vehicle file written from that: its trim is in there",
)
