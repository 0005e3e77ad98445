"""suspended_load: a point mass on a massless string at O below the drone; the tension acts on the drone."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench, stretches
from crazyem.physics.effects.pendulum import DAMPING, swing_along, watched_along
from crazyem.physics.effects.prior import Prior
from crazyem.physics.rotations import skew


def pulled(situation: Situation, body: Body, *, mass: float, length: float) -> Wrench:
    """Force of the string at O; mass [kg], length [m]. The string is always taut: in free fall it pushes like a rod.

    The acceleration of the load is a_O + L d2n/dt2; the string fixes its component along n. a_O is the acceleration
    under all other forces plus A n T, with A the mobility of O. Solved for the tension T, no unknown acceleration
    remains:

        T (1 + m n'A n) = m (n'd + L |dn/dt|^2 - n'f)

    with f the specific force at O without the string and d the drag of the load over its mass. The swing comes from
    `situation.swing`, or from the drone's path and the pull measured in earlier rows.
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
    """Direction of the string (unit, world) and its derivative [1/s] along the rows of a situation, (n, 6).

    share: mass of the load over that of drone and load, for corrections by the pull if `situation.seen` is known.
    """
    gap, broken = stretches(situation)
    velocity, air = situation.velocity, situation.air
    if situation.seen is None or situation.unrest is None or share <= 0.0:
        return swing_along(gap=gap, broken=broken, velocity=velocity, air=air, length=length)
    return watched_along(
        gap=gap, broken=broken, velocity=velocity, air=air, length=length, share=share, rotation=situation.rotation,
        free=situation.specific_force, shown=situation.seen, noise=situation.unrest,
    )  # fmt: skip


# Start values of the length [m]. A pendulum with a wrong period fits no better than none: within the 10 s of DAMPING,
# an error of 0.1 rad/s gives a phase error of one radian. So the start values, 1.6 m to 0.1 m, are 0.14 rad/s apart,
# and derivatives use a far smaller step.
LENGTHS = tuple(round(9.81 / (2.48 + 0.14 * k) ** 2, 4) for k in range(54))


SUSPENDED_LOAD = Effect(
    "suspended_load",
    (Parameter("mass", "kg", 0.0, 0.0, 0.5, 5e-4), Parameter("length", "m", 0.3, 0.02, 10.0, 2e-4, usual=0.3)),
    order=70,
    tied=pulled,
    # relative error of mass: a small error of the thrust looks like a weight; of length in chaotic flights: 2.1 % too
    # long (rms of seven simulated loads)
    prior=Prior(
        own={"mass": 0.08, "length": 0.3},
        per={"mass": "mass"},
        relative_error={"mass": 3e-3, "length": 5e-3},
        relative_error_chaotic={"length": 0.02},
    ),
    needs=("position", "velocity"),  # the swing follows from the drone's path, not from an accelerometer alone
    separates="stop sharply from a straight leg and hover for 10 s, so that what hangs can be seen swinging",
    nudge={"mass": 5e-4},
    amplitude="mass",
    beginnings={"length": LENGTHS},
    imbalance="mean thrust",
    sizes=(1e-3, 2e-3, 4e-3),  # in excited flights, the filter follows the load only with about the right mass
)
