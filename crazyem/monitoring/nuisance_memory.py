"""What the flight before the windows tells of the nuisances: discounted sums of their scores and information.

Drag, delays and scales are those of the drone and of its filter, so 20 s of flight know them better than 2.6 s of
windows. Without this memory, an unknown drag explains a wind in any flight at a constant speed.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.monitoring.columns import NUISANCES, PARAMETERS


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
        """Score (M,) and information (M, M, lower triangle) of the nuisances that are no parameters of the estimator.

        The estimator renews its parameters, so these are integrated out. Scores of innovations that are not white vary
        by `scale` times more than their information says, so both are divided by it.

        Args:
            precision: (M,) of the prior. scale: 1 for white innovations.
        """
        p = PARAMETERS
        among, score = np.zeros_like(self._among), np.zeros_like(self._score)
        lower, cross = self._among[:p, :p], self._among[p:, :p].T
        inner = lower + np.tril(lower, -1).T + np.diag(precision[:p])
        weight = np.linalg.solve(inner, np.column_stack([cross, self._score[:p]]))
        among[p:, p:] = (self._among[p:, p:] - cross.T @ weight[:, :-1]) / scale
        score[p:] = (self._score[p:] - cross.T @ weight[:, -1]) / scale
        return score, among
