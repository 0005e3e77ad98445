"""Which rows of a situation hang together: where a path is broken, nothing before it acts on what comes after."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Situation

LONGEST_STEP = 0.1  # s: across a longer one nothing is interpolated


def stretches(situation: Situation) -> tuple[NDArray, NDArray]:
    """Where rows hang together: (n,) s from the row before to each row (0 at breaks), (n,) whether a break."""
    gap = np.diff(situation.time, prepend=situation.time[:1])
    broken = ~((situation.step > 0) & (situation.step <= LONGEST_STEP) & (gap > 0) & (gap <= LONGEST_STEP))
    broken[:1] = True
    return np.where(broken, 0.0, gap), broken
