"""What the flight before the windows tells of the drag: discounted sums of scores and information.

Drag is a constant of the drone, so 20 s of flight know it better than 2.6 s of windows. Without this memory, an unknown
drag explains a wind in any flight at a constant speed. Delays and scales of measurements are not remembered: they
depend on the motion, as errors of an onboard filter look like a delay or a scale.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.monitoring.columns import LASTING, NUISANCES


class NuisanceMemory:
    """Sums since the tests began, with a time constant.

    Args:
        seconds: the time constant [s].
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._counted = (np.zeros(NUISANCES), np.zeros((NUISANCES, NUISANCES)))
        self.restart()

    def restart(self) -> None:
        """Forget: the drone has changed."""
        self._score, self._among = np.zeros(NUISANCES), np.zeros((NUISANCES, NUISANCES))

    def add(self, passed: float, score: NDArray[np.float64], among: NDArray[np.float64]) -> None:
        """Sums score (M,) and among (M, M, lower triangle) of the whole flight, `passed` s after the last ones."""
        keep = math.exp(-passed / self.seconds)
        self._score = keep * self._score + score - self._counted[0]
        self._among = keep * self._among + among - self._counted[1]
        self._counted = (score.copy(), among.copy())

    def sums(self, precision: NDArray[np.float64], scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Score (M,) and information (M, M) of the lasting nuisances, with the others integrated out.

        Scores of innovations that are not white vary by `scale` times more than their information says, so both are
        divided by it.

        Args:
            precision: (M,) of the prior. scale: 1 for white innovations.
        """
        own, others = np.array(LASTING), np.setdiff1d(np.arange(NUISANCES), LASTING)
        whole = self._among + np.tril(self._among, -1).T
        cross = whole[np.ix_(others, own)]
        inner = whole[np.ix_(others, others)] + np.diag(precision[others])
        weight = np.linalg.solve(inner, np.column_stack([cross, self._score[others]]))
        among, score = np.zeros_like(whole), np.zeros_like(self._score)
        among[np.ix_(own, own)] = (whole[np.ix_(own, own)] - cross.T @ weight[:, :-1]) / scale
        score[own] = (self._score[own] - cross.T @ weight[:, -1]) / scale
        return score, among
