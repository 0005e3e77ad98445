"""From far off to near the maximum: noise scales by plain search, parameters by steps that trust the model.

In closed loop the torque answers to measurement noise. A filter whose process noise is assumed too large follows that
noise and finds it in the torque again: inertia comes out too small, the misfit asks for large process noise, and
scoring crawls along this ridge in zigzags. A filter that trusts the model more than it should has no such bias. So a
parameter step is taken with less process noise than fits best, and the scales are then searched for again; the
posterior decides."""

import numpy as np

from crazyem.estimation.em import WindowEM, offset
from crazyem.estimation.scoring import P, limited, log_posterior, moved

GROUPS = ((0, 1), (2,), (3,), (4,), (5,))  # scales that are searched together: lateral force, thrust, torque x, y, z
STRIDE = 1.0  # of the search, in log s
REACH = 8  # strides at most
TRUST = 2.0  # by how much log s lies below its best value for a parameter step


def search_scales(em: WindowEM, first: int, last: int, value: float) -> float:
    """Move each scale of process noise in strides while the posterior rises; returns it. `em` is left at the best."""
    for group in GROUPS:
        members = [j for j in group if not em.setup.known_scales[j]]
        if not members:
            continue
        for stride in (-STRIDE, STRIDE):
            begin = value
            for _ in range(REACH):
                best = em.parameters
                step = np.zeros(P + 11)
                step[[P + j for j in members]] = stride
                there = log_posterior(em, first, last, moved(em, best, step))
                if not there > value:
                    em.parameters = best
                    break
                value = there
            if value > begin:
                break
    return value


def approach(em: WindowEM, first: int, last: int) -> bool:
    """One search and parameter step; False, and nothing changed but the scales, if it did not raise the posterior."""
    value = search_scales(em, first, last, log_posterior(em, first, last, em.parameters))
    best = em.parameters
    for trust in (TRUST, 0.5 * TRUST):
        less = np.zeros(P + 11)
        less[P : P + 6] = -trust
        log_posterior(em, first, last, moved(em, best, less))
        step = np.zeros(P + 11)
        step[:P] = _parameter_step(em, first, last)
        there = moved(em, best, limited(step))
        after = search_scales(em, first, last, log_posterior(em, first, last, there))
        if after > value:
            return True
    em.parameters = best
    return False


def _parameter_step(em: WindowEM, first: int, last: int) -> np.ndarray:
    setup = em.setup
    free = np.flatnonzero(setup.free)
    matrix = em.sensitivities(first, last)
    precision = setup.prior.precision
    score = em.tape.score[first:last].sum(0) - precision * offset(em.parameters.theta, setup.prior.centre, setup.unit)
    step = np.zeros(P)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)] + np.diag(precision[free]), score[free])
    return step
