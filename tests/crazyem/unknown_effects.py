"""Effects of which nothing is known but what is usual."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate


def unknown(candidates: Sequence[Candidate]) -> NDArray:
    """A covariance (k, k) of their parameters that says no more than what is usual, so that each costs a nat."""
    return np.diag([c.parameter(n).width ** 2 for c in candidates for n in c.free])
