"""The maximum of the posterior and its intervals, by EM, search and scoring in turn.

Plain EM (`em`, `mstep`) needs hundreds of passes where measurement noise dominates: its steps are in proportion to the
information of the data over the information with all states known. So `maximise_posterior` has these stages:

1. Far from the maximum: up to `MOST_EM_MAPS` maps of EM. Each raises the likelihood from any start; scoring would make
   the noise scales too large here.
2. If the window begins without an attitude: its first state is smoothed from all later samples (`initial_state`).
3. Still far: line search of the noise scales, and parameter steps with less process noise (`search_and_step`). In
   closed loop the torque contains a response to measurement noise. If the assumed process noise is too large, the
   filter finds this noise in the torque again: the inertia comes out too small, the misfit requires large process
   noise, and scoring is slow along this ridge. With too small process noise there is no such bias. So a parameter step
   is taken with less process noise than fits best. Then the scales are searched again, and the posterior decides.
4. Near: damped Fisher scoring over parameters and noise scales together (`scoring`), until the score test is passed.
5. At the maximum: intervals from the information (`em.information`), widened for noise of sampled commands and
   disturbances with memory (`inflation`). Scales that the data do not determine are integrated out (`marginal`).
"""

from dataclasses import dataclass

import numpy as np

from crazyem.estimation.em import Information, WindowEM, offset
from crazyem.estimation.initial_state import known_initial_state
from crazyem.estimation.marginal import Marginal, marginalise
from crazyem.estimation.scoring import REUSED_WITHIN_FAR, P, PathPoint, limit_step, log_posterior, moved, scoring_steps

# groups of scales that are searched together: lateral force; thrust; torque x; y; z
SCALE_GROUPS = ((0, 1), (2,), (3,), (4,), (5,))
SEARCH_STRIDE = 1.0  # stride of the search, in log s
MOST_STRIDES = 8
TRUSTED_LOG_SCALE = 2.0  # of log s, below its best value, for a parameter step


def search_scales(em: WindowEM, first: int, last: int, value: float) -> float:
    """Move each scale of process noise in strides while the posterior rises; returns the highest, and `em` is there."""
    for group in SCALE_GROUPS:
        members = [j for j in group if not em.setup.known_scales[j]]
        if not members:
            continue
        for stride in (-SEARCH_STRIDE, SEARCH_STRIDE):
            begin = value
            for _ in range(MOST_STRIDES):
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


def search_and_step(em: WindowEM, first: int, last: int) -> bool:
    """One search and parameter step; False, with only the scales changed, if the step does not raise the posterior."""
    value = search_scales(em, first, last, log_posterior(em, first, last, em.parameters))
    best = em.parameters
    for trust in (TRUSTED_LOG_SCALE, 0.5 * TRUSTED_LOG_SCALE):
        less = np.zeros(P + 11)
        less[P : P + 6] = -trust
        log_posterior(em, first, last, moved(em, best, less))
        step = np.zeros(P + 11)
        step[:P] = _parameter_step(em, first, last)
        there = moved(em, best, limit_step(step))
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


PASSED_SCORE_TEST = 0.2  # standard deviations; with a shorter scoring step the score test is passed
EM_BEYOND = 10.0  # standard deviations from the maximum, beyond which EM and search go first
MOST_SEARCHES = 3  # after the EM maps, while the parameters are still so far from the maximum
SEARCH_ROWS = 1000  # rows of the window that the first search uses
MOST_EM_MAPS = 3
MOST_SCORING_STEPS = 25
ROUGH_TOLERANCE = 1.0  # standard deviations; with a shorter scoring step the initial state is smoothed again
SCORING_TOLERANCE = 0.02  # standard deviations; with a shorter step scoring ends
RETRY_PASSES = 40  # passes of EM with scoring where damped scoring does not pass the score test


@dataclass(frozen=True)
class Maximum:
    """Result of the estimation of a window.

    Attributes:
        information: at the maximum.
        marginal: posterior with weakly determined noise scales integrated out; None if there is no such scale.
        maps: number of EM maps at the begin.
        path: all points on the path, those of the maps first, with the length of their scoring step. From the scoring
            stage on, the step is over parameters and noise scales together.
    """

    information: Information
    marginal: Marginal | None
    maps: int
    path: tuple[PathPoint, ...]

    @property
    def converged(self) -> bool:
        """Whether the score test was passed, for parameters and noise scales together."""
        return self.path[-1].length < PASSED_SCORE_TEST

    @property
    def steps(self) -> int:
        """Number of steps until the score test stays passed; all steps if it is not passed."""
        lengths = [stop.length for stop in self.path[self.maps :]]
        failed = [k for k, length in enumerate(lengths) if not length < PASSED_SCORE_TEST]
        return min(failed[-1] + 1, len(lengths) - 1) if failed else 0


def maximise_posterior(em: WindowEM, first: int, last: int) -> Maximum:
    """Maximise the posterior over rows first..last-1 from the present parameters; the tape is left at the maximum."""
    path: list[PathPoint] = []
    while True:
        em.full_pass(first, last)
        there = em.information(first, last)
        length = max(there.decrement, there.noise_length)
        if len(path) == MOST_EM_MAPS or length < EM_BEYOND:
            break
        path.append(PathPoint(em.parameters.theta, length))
        em.parameters = em.maximise(first, last)
    maps = len(path)
    with known_initial_state(em, first, last) as begin:
        for end in (min(first + SEARCH_ROWS, last), *(last,) * (MOST_SEARCHES - 1)):
            if length < EM_BEYOND:
                break
            path.append(PathPoint(em.parameters.theta, length))
            if not search_and_step(em, first, end) and end == last:
                break
            em.forward(first, last, restart=True)
            em.backward(first, last)
            length = em.information(first, last).decrement
        scoring_steps(
            em, first, last, steps=MOST_SCORING_STEPS, tolerance=ROUGH_TOLERANCE, path=path,
            reused_within=REUSED_WITHIN_FAR,
        )  # fmt: skip
        begin()
        best = scoring_steps(em, first, last, steps=MOST_SCORING_STEPS, tolerance=SCORING_TOLERANCE, path=path)
        if not path[-1].length < PASSED_SCORE_TEST:
            em.converge(first, last, passes=RETRY_PASSES)
            best = scoring_steps(em, first, last, steps=MOST_SCORING_STEPS, tolerance=SCORING_TOLERANCE, path=path)
        # with known noise, the intervals of mass and inertia depend on it, so it is computed at the maximum
        of_noise = em.noise_information(first, last) if em.setup.carried.any() else best.of_noise
        information = em.information(first, last, of_noise=of_noise)
        marginal = marginalise(em, first, last, best, information)
    return Maximum(information, marginal, maps, tuple(path))
