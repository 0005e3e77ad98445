"""The maximum of the posterior and its intervals: what scoring adds to EM, in the order in which it happens.

Plain EM (`em`, `mstep`) would get there, but its steps shrink with the share of the information that the data hold of
what they would hold if every state were known: hundreds of passes where measurement noise dominates. So, in
`maximise_posterior`:

1. Far off, up to `MOST_EM_MAPS` maps of EM: each raises the likelihood from anywhere, and scoring would inflate noise.
2. Where the window begins without an attitude, its first state is found from all that follows (`initial_state`).
3. Still far: noise scales by plain search and parameter steps that trust the model (`search_and_step`). In closed loop
   the torque answers to measurement noise. A filter whose process noise is assumed too large finds that noise in the
   torque again: inertia comes out too small, the misfit asks for large process noise, and scoring crawls along this
   ridge. A filter that trusts the model more than it should has no such bias. So a parameter step is taken with less
   process noise than fits best, and the scales are searched for again; the posterior decides.
4. Near: Fisher scoring over parameters and noise scales together, damped (`scoring`), until the score test is passed.
5. At the maximum: intervals by the information (`em.information`), which `inflation` widens for the noise of sampled
   commands and for disturbances with memory; noise scales that the data leave open are integrated out (`marginal`).
"""

from dataclasses import dataclass

import numpy as np

from crazyem.estimation.em import Information, WindowEM, offset
from crazyem.estimation.initial_state import known_initial_state
from crazyem.estimation.marginal import Marginal, marginalise
from crazyem.estimation.scoring import REUSED_WITHIN_FAR, P, PathPoint, limit_step, log_posterior, moved, scoring_steps

# scales that are searched together: lateral force, thrust, torque x, y, z
SCALE_GROUPS = ((0, 1), (2,), (3,), (4,), (5,))
SEARCH_STRIDE = 1.0  # of the search, in log s
MOST_STRIDES = 8  # strides at most
TRUSTED_LOG_SCALE = 2.0  # by how much log s lies below its best value for a parameter step


def search_scales(em: WindowEM, first: int, last: int, value: float) -> float:
    """Move each scale of process noise in strides while the posterior rises; returns it. `em` is left at the best."""
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
    """One search and parameter step; False, and nothing changed but the scales, if it did not raise the posterior."""
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


PASSED_SCORE_TEST = 0.2  # standard deviations: a score test that asks for a shorter step is passed
EM_BEYOND = 10.0  # standard deviations from the maximum beyond which EM goes first: scoring would inflate the noise
MOST_SEARCHES = 3  # after them, as long as the parameters are that far off
SEARCH_ROWS = 1000  # rows of a longer window that the first of these makes do with
MOST_EM_MAPS = 3  # of EM, at most
MOST_SCORING_STEPS = 25  # of scoring, at most
ROUGH_TOLERANCE = 1.0  # standard deviations within which the first sample is looked for again
SCORING_TOLERANCE = 0.02  # standard deviations: scoring ends
RETRY_PASSES = 40  # passes of plain EM and scoring where the likelihood is too rough for it


@dataclass(frozen=True)
class Maximum:
    """Where a window's estimation ended.

    Attributes:
        information: at the end.
        marginal: intervals with weak noise scales integrated out; None where none was weak.
        maps: EM maps taken first.
        path: every point on the way, those of the maps first; with the length of the scoring step there, from the
            first scoring step on that over parameters and noise scales together.
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
        """Scoring steps until the score test was passed for good; all of them if it was not."""
        lengths = [stop.length for stop in self.path[self.maps :]]
        failed = [k for k, length in enumerate(lengths) if not length < PASSED_SCORE_TEST]
        return min(failed[-1] + 1, len(lengths) - 1) if failed else 0


def maximise_posterior(em: WindowEM, first: int, last: int) -> Maximum:
    """Maximise the posterior over rows first..last-1 from where `em` is; the tape is left as the maximum has it."""
    path: list[PathPoint] = []
    while True:
        em.refill_inputs(first, last)
        em.forward(first, last, restart=True)
        em.backward(first, last)
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
            em,
            first,
            last,
            steps=MOST_SCORING_STEPS,
            tolerance=ROUGH_TOLERANCE,
            path=path,
            reused_within=REUSED_WITHIN_FAR,
        )
        begin()
        best = scoring_steps(em, first, last, steps=MOST_SCORING_STEPS, tolerance=SCORING_TOLERANCE, path=path)
        if not path[-1].length < PASSED_SCORE_TEST:
            em.converge(first, last, passes=RETRY_PASSES)
            best = scoring_steps(em, first, last, steps=MOST_SCORING_STEPS, tolerance=SCORING_TOLERANCE, path=path)
        # of known noise it says how sure mass and inertia are, so there it must be that of the very end
        of_noise = em.noise_information(first, last) if em.setup.carried.any() else best.of_noise
        information = em.information(first, last, of_noise=of_noise)
        marginal = marginalise(em, first, last, best, information)
    return Maximum(information, marginal, maps, tuple(path))
