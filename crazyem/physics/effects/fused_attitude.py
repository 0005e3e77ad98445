"""What a filter on board makes of a gyro that is late: an attitude that is off where the drone turns fast.

It integrates the gyro, and fixes of the pose draw it back, so its error e [rad, body axes] goes by

    e' = r - e / T,    r: what the gyro shows less the rate that was [rad/s].

T is that of the firmware's Kalman filter with a pose at 100 Hz; what a gyro's bias leads such attitudes to in simulated
flights, the bias times T, says 0.038 to 0.043 s.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.physics.effects.effect import Situation
from crazyem.physics.effects.stretches import stretches

CORRECTION_SECONDS = 0.04  # s, T above
MEMORY_SECONDS = 3.0 * CORRECTION_SECONDS  # s: what a gyro showed before is 5 % of an attitude's error


@compiled
def _relaxed(gap, broken, drive, time, out):
    """e at every row, from drives (n, 3) that are the means over the steps that end there; 0 where a stretch begins."""
    for k in range(len(gap)):
        if broken[k]:
            out[k] = 0.0
            continue
        left = np.exp(-gap[k] / time)
        for i in range(3):
            out[k, i] = left * out[k - 1, i] + time * (1.0 - left) * drive[k, i]


def disturbs_attitude(values: Mapping[str, Any]) -> bool:
    """Whether an effect with these values disturbs attitudes that are made on board."""
    return "gyro" in values.get("streams", ()) or bool(values.get("rate_lag", 0.0))


def attitude_error(situation: Situation, rate_error: NDArray, *, delay: float) -> NDArray:
    """(n, 3) rad, body axes: how far an attitude made on board is off by a gyro's errors; 0 where it is not made so.

    rate_error: (n, 3) rad/s at the rows, of a gyro that is `delay` [s] late. What it is at a row it has been since
    `delay` after the row before: rates go straight from row to row.
    """
    out = np.zeros((situation.size, 3))
    if not situation.fused or not situation.size:
        return out
    gap, broken = stretches(situation)
    before = np.roll(rate_error, 1, axis=0)
    before[broken] = 0.0
    share = np.clip(0.5 * delay / np.where(gap > 0.0, gap, np.inf), 0.0, 0.5)[:, None]
    drive = np.ascontiguousarray((1.0 - share) * rate_error + share * before, dtype=np.float64)
    _relaxed(gap, broken, drive, CORRECTION_SECONDS, out)
    return out
