"""rotor_inertia: the rotors' angular momentum, which turns with the body (gyroscope) and reacts on spinning up."""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Prior

SPIN = np.array([1.0, -1.0, 1.0, -1.0])  # rotors 1 and 3 turn counter-clockwise seen from above
# N/(rad/s)^2, for vehicles that have none, and inertia is then relative to it: 46 mm propellers of a brushed Crazyflie,
# which lift 28.6 g at 17174 rpm, 17.3 g at 13522 rpm (Bitcraze, Measuring propeller RPM, part 3, 2015).
TYPICAL_ROTOR_CONSTANT = 2.1e-8


def reaction(situation: Situation, body: Body, *, inertia: float) -> Wrench:
    """-w x H e3 - dH/dt e3 with H = inertia (W1 - W2 + W3 - W4), inertia [kg m^2] of one rotor.

    W_i = sqrt(f_i/rotor_constant); f_i is the thrust after the lag, before what changes thrust at the same speed.
    Source: Euler's equation of a body with rotors, e.g. Hughes, Spacecraft Attitude Dynamics, 3.4.
    """
    lagged = situation.thrust if situation.lagged is None else situation.lagged
    constant = TYPICAL_ROTOR_CONSTANT if math.isnan(situation.rotor_constant) else situation.rotor_constant
    momentum = inertia * (_speed(lagged, constant) @ SPIN)
    step = np.where(situation.step > 0, situation.step, 1e-3)[:, None]
    half = situation.thrust_rate * step / 2
    change = (_speed(lagged + half, constant) - _speed(lagged - half, constant)) / step
    torque = np.empty((situation.size, 3))
    torque[:, 0] = -situation.body_rate[:, 1] * momentum
    torque[:, 1] = situation.body_rate[:, 0] * momentum
    torque[:, 2] = -inertia * (change @ SPIN)
    return Wrench(np.zeros((situation.size, 3)), torque)


def _speed(thrust: NDArray, constant: float) -> NDArray:
    """rad/s; the mean change over a step is taken between its ends, where a rate of the root would have a pole at 0."""
    return np.sqrt(np.maximum(thrust, 0.0) / constant)


ROTOR_INERTIA = Effect(
    "rotor_inertia",
    (Parameter("inertia", "kg m^2", 0.0, 0.0, 1e-6, 2e-9),),
    order=66,
    external=reaction,
    # own: a bar of 0.3 g and 46 mm; a Crazyflie's propeller and rotor: a tenth of that, in no file
    prior=Prior(own={"inertia": 4e-8}, usual={"inertia": 2e-9}),
    needs=("body_rate", "attitude"),
    separates="yaw for 5 s at 2 Hz (spin-up), and roll while turning about yaw (gyroscope); weigh a propeller",
)
