"""thrust_scale, rotor_fault, torque_scale: rotors that give more or less than they should at the same speed."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Parameter, Situation
from crazyem.physics.effects.prior import Logged, Prior, Sizes


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
    # usual: common to all axes of 76 flights of known torques (`fitting/always.py`)
    prior=Prior(own={"scale": 0.2}, usual=lambda logged: {"scale": 0.03 * logged.coarse}),
    needs=("body_rate", "attitude"),
    separates="swing the drone on two threads (bifilar pendulum): torque over inertia is all that a flight shows",
)
