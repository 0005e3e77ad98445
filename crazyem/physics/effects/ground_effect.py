"""ground_effect: rotors lift more near the floor."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Parameter, Situation
from crazyem.physics.effects.prior import Prior


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
