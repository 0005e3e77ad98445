"""suspended_load: a point mass on a massless string at O, swinging below the drone; its tension acts on the drone."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench, stretches
from crazyem.physics.effects.pendulum import DAMPING, swing_along, watched_along
from crazyem.physics.effects.prior import Prior
from crazyem.physics.rotations import skew


def pulled(situation: Situation, body: Body, *, mass: float, length: float) -> Wrench:
    """The string's force at O; mass [kg], length [m]. Always taut: in free fall it pushes like a rod.

    The load accelerates with a_O + L d2n/dt2, of which the part along n is fixed by the string; a_O is that under all
    other forces plus A n T, A the mobility of O. Solved for T there is no acceleration left to be known beforehand:

        T (1 + m n'A n) = m (n'd + L |dn/dt|^2 - n'f)

    with f the specific force at O without the string and d the drag of the load over its mass. The swing comes from
    the drone's path and from how it was seen to pull before (or `situation.swing`).
    """
    swing = situation.swing
    if swing is None:
        swing = swing_of(situation, length=length, share=mass / (body.mass + mass))
    direction, turning = swing[:, :3], swing[:, 3:]
    drag = -DAMPING * (situation.velocity + length * turning - situation.air)
    along = situation.to_body(direction)
    centre = skew(body.centre)
    mobility = np.eye(3) / body.mass - centre @ np.linalg.inv(body.inertia) @ centre
    taut = _dot(direction, drag) + length * _dot(turning, turning) - _dot(along, situation.specific_force)
    tension = mass * taut / (1 + mass * _dot(along @ mobility, along))
    return Wrench(tension[:, None] * along, np.zeros((situation.size, 3)))


def _dot(a: NDArray, b: NDArray) -> NDArray:
    return np.einsum("ni,ni->n", a, b)


def swing_of(situation: Situation, *, length: float, share: float = 0.0) -> NDArray:
    """(n, 6) direction of the string (unit, world) and its derivative [1/s] along the rows of a situation.

    share: mass of the load over that of drone and load, by which it is seen to pull where `situation.seen` is known.
    """
    gap, broken = stretches(situation)
    velocity, air = situation.velocity, situation.air
    if situation.seen is None or situation.unrest is None or share <= 0.0:
        return swing_along(gap=gap, broken=broken, velocity=velocity, air=air, length=length)
    return watched_along(
        gap=gap, broken=broken, velocity=velocity, air=air, length=length, share=share, rotation=situation.rotation,
        free=situation.specific_force, shown=situation.seen, noise=situation.unrest,
    )  # fmt: skip


# A pendulum of the wrong period fits no better than none: in the 10 s that DAMPING leaves it, 0.1 rad/s put it a
# radian out of step. So the lengths to begin from, 1.6 m to 0.1 m, are 0.14 rad/s apart, and derivatives are taken over
# a step far below that.
LENGTHS = tuple(round(9.81 / (2.48 + 0.14 * k) ** 2, 4) for k in range(54))


SUSPENDED_LOAD = Effect(
    "suspended_load",
    (Parameter("mass", "kg", 0.0, 0.0, 0.5, 5e-4), Parameter("length", "m", 0.3, 0.02, 10.0, 2e-4, usual=0.3)),
    order=70,
    tied=pulled,
    # error: its weight is thrust that is a little wrong. Lengths were 2.1 % too long (rms of seven loads of seeds 2038
    # to 2041) where a flight drives loads astray
    prior=Prior(
        own={"mass": 0.08, "length": 0.3},
        per={"mass": "mass"},
        relative_error={"mass": 3e-3, "length": 5e-3},
        relative_error_chaotic={"length": 0.02},
    ),
    needs=("position", "velocity"),  # it swings by the drone's path, which no accelerometer alone shows
    separates="stop sharply from a straight leg and hover for 10 s, so that what hangs can be seen swinging",
    nudge={"mass": 5e-4},
    amplitude="mass",
    beginnings={"length": LENGTHS},
    imbalance="mean thrust",
    sizes=(1e-3, 2e-3, 4e-3),  # where it shakes, a load is followed only by one that pulls about as much
)
