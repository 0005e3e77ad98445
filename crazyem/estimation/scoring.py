"""Fisher scoring on the likelihood of the innovations, over parameters and noise scales together.

Where measurement noise dominates, EM is slow: its steps are in proportion to the information of the data over the
information with all states known. Scoring does not have this problem. The sensitivities of the innovations give score
and information of the parameters (`kernels.sensitivities`). The smoother gives the score of the noise scales (Fisher's
identity), and the derivatives of filter and gain give their information (`kernels.noise_information`). Levenberg
damping prevents steps that lower the posterior. Where the data hardly determine a scale, expected and observed
information differ. Differences of the score give the observed one, and successive scores update it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation import kernels
from crazyem.estimation.em import WindowEM, displaced, offset
from crazyem.estimation.model import Parameters

P = kernels.PARAMETERS
COORDINATES = P + 11  # coordinates of theta (see `offset`), then the logarithms of the noise scales
STEP_THETA, STEP_NOISE = 0.5, 1.5  # longest step of a logarithm (or of a linear parameter in its unit)
STEP_LAG = 0.2  # longest step of lag and delay: the mean inputs are linear in these over a short range only
SCORE_DIFFERENCE_STEP = -0.1  # of log s, for differences of the score
# Standard deviations. The observed curvature is computed by differences of the score, but not within NEAR_MAXIMUM of
# the maximum, nor after a point within FAR_FROM_MAXIMUM: there secants of the scores on the path update it.
NEAR_MAXIMUM = 0.2
FAR_FROM_MAXIMUM = 3.0
# least gain of a step over its expected gain; otherwise steps can jump to and fro over a ridge
LEAST_GAIN_SHARE = 0.1
POSTERIOR_SLACK = 0.01  # nats that a step may lose: the score is that of a linearised filter
REUSED_WITHIN = 0.05  # of log s; with a smaller change, the information on the noise scales is not computed again
# the same far from the maximum: an inexact curvature is enough there, since each step is tested
REUSED_WITHIN_FAR = 0.5
SMALLEST_EIGENVALUE = 0.05  # least eigenvalue of a curvature that is used (the prior gives a noise scale 0.44)
DAMPING_ATTEMPTS = 8  # attempts for one step, with increasing damping
NOTHING_HELD = np.zeros(COORDINATES, bool)


@dataclass(frozen=True)
class Point:
    """Log-posterior, score and information at a point, in the coordinates of theta and the logarithms of the scales.

    Attributes:
        parameters: the point.
        value: log-posterior, up to a constant.
        free: (20,) bool, coordinates that are estimated and not at their floor.
        score: (20,), zero where not free.
        information: (20, 20) expected information of data and prior; identity where not free.
        of_noise: (11, 11) information of the data on the logarithms of the noise scales.
    """

    parameters: Parameters
    value: float
    free: NDArray
    score: NDArray
    information: NDArray
    of_noise: NDArray

    @property
    def decrement(self) -> float:
        """Length of the scoring step in standard deviations, over all coordinates together."""
        return float(np.sqrt(max(float(self.score @ np.linalg.solve(self.information, self.score)), 0.0)))

    @property
    def sd(self) -> NDArray:
        """(20,) standard deviations of the free coordinates from the information, zero where not free."""
        variance: NDArray = np.linalg.inv(self.information).diagonal()
        return np.where(self.free, variance, 0.0) ** 0.5


@dataclass(frozen=True)
class PathPoint:
    """A point on the path to the maximum: theta (9,), and length of its joint scoring step in standard deviations."""

    theta: NDArray
    length: float


def log_posterior(em: WindowEM, first: int, last: int, parameters: Parameters) -> float:
    """Log-likelihood plus log prior, up to a constant; filters the window with the parameters and sets them in `em`."""
    em.parameters = parameters
    em.refill_inputs(first, last)
    return em.forward(first, last, restart=True) + log_prior(em)


def log_prior(em: WindowEM) -> float:
    """Log prior at the present parameters of `em`, up to a constant."""
    setup, p = em.setup, em.parameters
    prior = setup.prior
    theta = offset(p.theta, prior.centre, setup.unit)
    noise = (p.noise.logs - prior.noise.logs)[~setup.known_scales] / prior.noise_sd
    return -0.5 * float(np.sum((theta**2 * prior.precision)[setup.free]) + noise @ noise)


def point(
    em: WindowEM, first: int, last: int, value: float, *, of_noise: NDArray | None = None, held: NDArray = NOTHING_HELD
) -> Point:
    """Score and information at the parameters with which the window was just filtered; smooths the window.

    Args:
        value: result of `log_posterior`.
        of_noise: (11, 11) information on the noise scales; None: it is computed.
        held: (20,) bool, coordinates that are held fixed.
    """
    setup, p = em.setup, em.parameters
    prior = setup.prior
    of_theta = em.sensitivities(first, last)
    em.backward(first, last)
    if of_noise is None:
        of_noise = em.noise_information(first, last)
    noise_score = em.noise_terms(first, last).sum(0)
    # scales that are known in newtons depend on mass and inertia
    carried = setup.carried
    score, information = np.zeros(COORDINATES), np.zeros((COORDINATES, COORDINATES))
    score[:P] = em.tape.score[first:last].sum(0) + carried.T @ noise_score
    score[:P] -= prior.precision * offset(p.theta, prior.centre, setup.unit)
    score[P:] = noise_score + (prior.noise.logs - p.noise.logs) / prior.noise_sd**2
    information[:P, :P] = of_theta + carried.T @ of_noise @ carried + np.diag(prior.precision)
    information[P:, P:] = of_noise + np.eye(11) / prior.noise_sd**2
    information[P:, :P] = of_noise @ carried
    information[:P, P:] = information[P:, :P].T
    floored = (p.noise.logs <= prior.floor + 1e-9) & (score[P:] < 0)
    free = np.concatenate([setup.free, ~(setup.known_scales | floored)]) & ~held
    score[~free] = 0.0
    information[~free, :] = 0.0
    information[:, ~free] = 0.0
    information[~free, ~free] = 1.0
    return Point(p, value, free, score, information, of_noise)


def moved(em: WindowEM, start: Parameters, step: NDArray) -> Parameters:
    """The parameters after a step (20,), with noise scales not below their floors."""
    setup = em.setup
    theta = displaced(start.theta, step[:P], setup.unit)
    logs = np.maximum(start.noise.logs + step[P:], setup.prior.floor)
    return Parameters(theta, setup.noise_at(theta, logs), start.inertia_products)


def scoring_steps(
    em: WindowEM,
    first: int,
    last: int,
    *,
    steps: int,
    tolerance: float,
    held: NDArray = NOTHING_HELD,
    path: list[PathPoint] | None = None,
    reused_within: float = REUSED_WITHIN,
) -> Point:
    """Damped scoring steps from the present point until the next is shorter than `tolerance`, at most `steps`.

    Returns the last point; the tape is left filtered and smoothed with it. Every point, the last one included, is added
    to `path`. The information on the noise scales is computed again once the log of one scale has changed by
    `reused_within`.
    """
    path = [] if path is None else path
    begin = len(path)
    known: Point | None = None

    def at(value: float) -> Point:
        nonlocal known
        given = None
        if known is not None:
            change = em.parameters.noise.logs - known.parameters.noise.logs
            given = known.of_noise if np.max(np.abs(change)) < reused_within else None
        there = point(em, first, last, value, of_noise=given, held=held)
        known = there if given is None else known
        return there

    here = at(log_posterior(em, first, last, em.parameters))
    path.append(PathPoint(here.parameters.theta, here.decrement))
    damping, correction = 0.0, np.zeros((COORDINATES, COORDINATES))
    before: Point | None = None
    step = np.zeros(COORDINATES)
    while len(path) - begin <= steps and path[-1].length >= tolerance:
        if path[-1].length > NEAR_MAXIMUM and (before is None or before.decrement > FAR_FROM_MAXIMUM):
            correction = _observed(em, first, last, here)
        if before is not None:
            correction = _secant(correction, before, here, step)
        taken = _damped_step(em, first, last, here, correction, damping)
        if taken is None:
            log_posterior(em, first, last, here.parameters)
            em.backward(first, last)
            break
        step, value, damping = taken
        damping = 0.0 if damping < 0.5 else 0.2 * damping
        before, here = here, at(value)
        path.append(PathPoint(here.parameters.theta, here.decrement))
    return here


def _damped_step(
    em: WindowEM, first: int, last: int, here: Point, correction: NDArray, damping: float
) -> tuple[NDArray, float, float] | None:
    """The first step that gains enough, the log-posterior after it and its damping; None after `DAMPING_ATTEMPTS`.

    The first attempt uses the observed curvature. Later attempts use the expected one, with increasing damping.
    """
    for attempt in range(DAMPING_ATTEMPTS):
        curvature = here.information + (correction if attempt == 0 else 0.0)
        if attempt == 0 and np.linalg.eigvalsh(curvature)[0] <= SMALLEST_EIGENVALUE:
            curvature = here.information
        step = limit_step(np.linalg.solve((1.0 + damping) * curvature, here.score))
        value = log_posterior(em, first, last, moved(em, here.parameters, step))
        expected = max(float(here.score @ step - 0.5 * step @ here.information @ step), 0.0)
        if value > here.value + LEAST_GAIN_SHARE * expected - POSTERIOR_SLACK:
            return step, value, damping
        if attempt:
            damping = max(3.0 * damping, 1.0)
    return None


def _observed(em: WindowEM, first: int, last: int, here: Point) -> NDArray:
    """Observed less expected information (20, 20) in the scales of process noise, by differences of the score.

    In expectation, parameters and scales are independent, but only at the right noise scales. With too large process
    noise, measurement noise that the controller feeds into the torque changes the inertia, and steps of inertia and
    scale undo each other. And for a scale that the data hardly determine, expected and observed information differ.
    """
    out = np.zeros((COORDINATES, COORDINATES))
    scales = np.arange(P, P + 6)[here.free[P : P + 6]]
    for j in scales:
        there = moved(em, here.parameters, SCORE_DIFFERENCE_STEP * np.eye(COORDINATES)[j])
        value = log_posterior(em, first, last, there)
        score = point(em, first, last, value, of_noise=here.of_noise, held=~here.free).score
        out[:, j] = (here.score - score) / SCORE_DIFFERENCE_STEP - here.information[:, j]
    out[np.ix_(scales, scales)] *= 0.5
    rest = np.setdiff1d(np.arange(COORDINATES), scales)
    out[np.ix_(rest, rest)] = 0.0
    out += out.T
    for _ in range(6):
        if np.linalg.eigvalsh(here.information + out)[0] > SMALLEST_EIGENVALUE:
            return out
        out *= 0.5
    return np.zeros((COORDINATES, COORDINATES))


def limit_step(step: NDArray) -> NDArray:
    """A scoring step of limited length, taken in coordinates in which the data are linear or quadratic.

    Accelerations are linear in 1/m and 1/I. Variances of innovations are linear in the variances of the noise. Where a
    scale s is much too large, its scoring step is at most half a unit of log s. The same step in the variance,
    s'^2 = s^2 (1 + 2 step), reaches the maximum at once. And where two noises look alike (lateral force and
    accelerometer), the data determine the sum of their variances. In logarithms this is a curved ridge, which straight
    steps leave.
    """
    step = step.copy()
    step[:4] = -np.log(1.0 - np.minimum(step[:4], 1.0 - np.exp(-STEP_THETA)))
    step[P:] = 0.5 * np.log(np.clip(1.0 + 2.0 * step[P:], np.exp(-2.0 * STEP_NOISE), np.exp(2.0 * STEP_NOISE)))
    limits = np.concatenate([np.full(P, STEP_THETA), np.full(11, STEP_NOISE)])
    limits[kernels.LAG : kernels.OFFSET] = STEP_LAG
    return np.clip(step, -limits, limits)


def _secant(correction: NDArray, before: Point, after: Point, step: NDArray) -> NDArray:
    """Update of observed less expected information by a secant along the last step (Dennis, Gay, Welsch 1981).

    The scores before and after a step give the observed curvature along it. The expected information differs from it by
    chance, and by much where the data hardly determine a noise scale.
    """
    free = before.free & after.free
    s = np.where(free, step, 0.0)
    y = np.where(free, before.score - after.score, 0.0)
    slope = y @ s
    if slope <= 1e-12:
        return np.zeros_like(correction)
    residual = y - after.information @ s
    along = abs(s @ correction @ s)
    if along > 0:  # an old correction is reduced to the size of the present one
        correction = correction * min(1.0, abs(s @ residual) / along)
    r = residual - correction @ s
    return correction + (np.outer(r, y) + np.outer(y, r)) / slope - (r @ s) / slope**2 * np.outer(y, y)
