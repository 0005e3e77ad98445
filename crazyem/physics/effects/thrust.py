"""thrust_scale, rotor_fault, torque_scale, ground_effect, trim: rotors that give more or less than they should.

trim is the steady torque that every real drone needs. No four rotors are equal or upright, and no battery sits in the
middle. The trim goes with the thrust, so nothing acts on a drone with its rotors at rest. For a vehicle file that has
a trim, the day's differs a little from the file's; how much is in `crazyem/diagnosis/fitting/nuisances.py`.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Wrench
from crazyem.physics.effects.prior import Logged, Prior, Sizes, in_turn


def scaled(situation: Situation, *, scale: float) -> NDArray:
    """All rotors times scale, drag torque too."""
    return situation.thrust * scale


def faulty(situation: Situation, *, rotor: int, scale: float, onset_time: float | None) -> NDArray:
    """One rotor (1 to 4) times scale from onset_time on [s, the recording's clock]; None: from the start.

    The step in which it begins gets its share, so that the likelihood has no stairs in onset_time.
    """
    since = np.ones(situation.size)
    if onset_time is not None:
        step = np.where(situation.step > 0, situation.step, 1e-3)
        since = np.clip((situation.time - onset_time) / step, 0.0, 1.0)
    thrust = situation.thrust.copy()
    thrust[:, int(rotor) - 1] *= 1 + (scale - 1) * since
    return thrust


def turned(torque: NDArray, *, scale: float) -> NDArray:
    """The rotors' three torques about O times scale."""
    return torque * scale


def _strength(logged: Logged) -> Sizes:
    """From day to day: batteries are put in again, propellers bend (docs/results/diagnosis_real.md)."""
    return {"scale": 0.02 if logged.dated else 0.009}


THRUST_SCALE = Effect(
    "thrust_scale",
    (Parameter("scale", "", 1.0, 0.1, 5.0, 0.01),),
    order=30,
    rotors=scaled,
    prior=Prior(own={"scale": 0.08}, usual=_strength),
    separates="weigh the drone; without its weight thrust and mass are one number",
)

ROTOR_FAULT = Effect(
    "rotor_fault",
    (
        Parameter("rotor", "", 1, 1, 4, 1, chosen=(1, 2, 3, 4), phrase="of rotor {}"),
        Parameter("scale", "", 1.0, 0.0, 2.0, 0.02, words="thrust"),
        Parameter("onset_time", "s", None, -1e9, 1e9, 0.1, phrase="since {} s"),
    ),
    order=31,
    rotors=faulty,
    prior=Prior(own={"scale": 0.1}),
    separates=(
        "yaw for 5 s at 2 Hz (a weak rotor also lacks drag torque, a heavy corner does not), or hover with the drone's"
        " battery turned round"
    ),
)

TORQUE_SCALE = Effect(
    "torque_scale",
    (Parameter("scale", "", 1.0, 0.0, 5.0, 0.02),),
    order=40,
    turning=turned,
    # usual: common to all axes of 76 flights of known torques (`fitting/nuisances.py`)
    prior=Prior(own={"scale": 0.2}, usual=lambda logged: {"scale": 0.03 * logged.coarse}),
    needs=("body_rate", "attitude"),
    separates="swing the drone on two threads (bifilar pendulum): torque over inertia is all that a flight shows",
)


def lifted(situation: Situation, *, strength: float, height: float) -> NDArray:
    """All thrusts times 1 + strength exp(-z/height), z the height of O above the floor [m]."""
    return situation.thrust * (1 + strength * np.exp(-np.maximum(situation.height, 0.0) / height))[:, None]


GROUND_EFFECT = Effect(
    "ground_effect",
    (
        Parameter("strength", "", 0.0, 0.0, 2.0, 0.02),
        Parameter("height", "m", 0.1, 0.005, 10.0, 0.01),
    ),
    order=32,
    rotors=lifted,
    prior=Prior(own={"strength": 0.3, "height": 0.1}),
    needs=("position",),
    separates="hover for 5 s at each of several heights, from 3 cm to 1 m",
    nudge={"strength": 0.02},
    amplitude="strength",
    beginnings={"height": (0.03, 0.1, 0.3)},
)


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
