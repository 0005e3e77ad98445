"""Intervals where a noise scale is not determined by the data: integrated over the scale, not taken at its best value.

How sure mass is depends on the intensity s of the noise in thrust, inertia on that of the torque. Where measurement
noise dominates, the likelihood says of log s little but that it is not large, and an interval at its maximum is an
accident. So the posterior is taken at a few values of log s, everything else at its maximum given that value (one
scoring step, in the quadratic approximation), each weighted by the posterior of log s (Laplace's approximation for all
else); the law of total variance and the quantiles of the mixture give the interval. Given the other scales each acts on
parameters of its own, mass or one inertia, so they are integrated one at a time.

The weak prior that keeps steps finite is not knowledge. For the integral the scale gets one so wide (e^4) that it says
nothing within what the data leave open."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from crazyem.estimation.em import Information, WindowEM, offset
from crazyem.estimation.model import Noise, Parameters
from crazyem.estimation.scoring import NOTHING_HELD, P, Point, log_posterior, log_prior, point

MARGINAL_SCALES = (2, 3, 4, 5)  # thrust, torque about x, y, z
WEAK_SCALE_SD = 0.3  # standard deviation of log s beyond which it is integrated over
WIDE_PRIOR_SD = 4.0  # that of its prior then
NODE_SPACING = 1.2  # standard deviations between nodes
NODE_TAIL = 4.5  # nodes end where the posterior of log s has fallen by so much
MOST_NODES = 7  # nodes on a side
REST_REFRESHES = 8  # refreshes until a scale that was found to be determined is looked at again


@dataclass(frozen=True)
class Node:
    """The posterior at one value of a noise scale, relative to where the estimator is.

    Attributes:
        weight: logarithm of the posterior density of log s, up to a constant.
        shift: (9,) where the parameters have their maximum, in the coordinates of `offset`.
        sd: (9,) their standard deviations given this scale.
    """

    weight: float
    shift: NDArray
    sd: NDArray


@dataclass(frozen=True)
class Marginal:
    """Posterior of the parameters with weak noise scales integrated out, in the coordinates of `offset` from theta.

    Attributes:
        shift: (9,) means.
        sd: (9,) standard deviations.
        low, high: (9,) quantiles at 2.5 and 97.5 %.
        scales: which scales were integrated over, as in `Noise.logs`.
    """

    shift: NDArray
    sd: NDArray
    low: NDArray
    high: NDArray
    scales: tuple[int, ...]


def marginalise(em: WindowEM, first: int, last: int, best: Point, information: Information) -> Marginal | None:
    """Integrate over every noise scale that the data leave open; None if there is none.

    Args:
        em: at the maximum; it is left there, the window filtered and smoothed.
        first, last: rows of the window.
        best: the maximum.
        information: there.
    """
    weak = [j for j in MARGINAL_SCALES if best.sd[P + j] > WEAK_SCALE_SD]
    if not weak:
        return None
    grids = [_grid(em, first, last, best, j) for j in weak]
    log_posterior(em, first, last, best.parameters)
    em.backward(first, last)
    return combine(grids, information, scales=tuple(weak))


def _grid(em: WindowEM, first: int, last: int, best: Point, scale: int) -> list[Node]:
    """Nodes on both sides of the maximum until the posterior of the scale has faded."""
    held = NOTHING_HELD.copy()
    held[P + scale] = True
    spacing = NODE_SPACING * best.sd[P + scale]

    def node(count: int) -> Node:
        there = shifted(best.parameters, scale, count * spacing)
        value = log_posterior(em, first, last, there)
        here = point(em, first, last, value, of_noise=best.of_noise, held=held)
        return node_of(em, value, here.score, here.information, scale)

    nodes = [node(0)]
    for side in (-1, 1):
        for count in range(1, MOST_NODES + 1):
            nodes.append(node(side * count))
            if nodes[-1].weight < nodes[0].weight - NODE_TAIL:
                break
    return nodes


def shifted(centre: Parameters, scale: int, shift: float) -> Parameters:
    """The same with the logarithm of one noise scale moved."""
    logs = centre.noise.logs.copy()
    logs[scale] += shift
    return replace(centre, noise=Noise.from_logs(logs))


def node_of(em: WindowEM, value: float, score: NDArray, information: NDArray, scale: int) -> Node:
    """Node from the log-posterior where `em` is, its score (n,) and information (n, n); the first nine are theta's.

    Coordinates that are held have no score and an information of one.
    """
    step = np.linalg.solve(information, score)
    prior = em.setup.prior
    far = em.parameters.noise.logs[scale] - prior.noise.logs[scale]
    widened = 0.5 * far**2 * (prior.noise_sd**-2 - WIDE_PRIOR_SD**-2)
    volume = 0.5 * float(np.linalg.slogdet(information)[1])
    sd = np.sqrt(np.diag(np.linalg.inv(information)))[:P] * em.setup.free
    return Node(float(value + widened + 0.5 * (score @ step) - volume), step[:P], sd)


def combine(grids: list[list[Node]], information: Information, *, scales: tuple[int, ...]) -> Marginal:
    """Mixtures over the nodes of each scale (evenly spaced in log s), brought together parameter by parameter."""
    plain = np.sqrt(np.maximum(np.diag(information.covariance), 0.0))
    shift, variance = np.zeros(P), plain**2
    low, high = -1.96 * plain, 1.96 * plain
    widest = np.full(P, -np.inf)
    for nodes in grids:
        weights = np.array([node.weight for node in nodes])
        weights = np.exp(weights - weights.max())
        weights /= weights.sum()
        means = np.array([node.shift for node in nodes])
        sds = np.sqrt((np.array([node.sd for node in nodes]) * information.inflation) ** 2 + information.bias**2)
        mean = weights @ means
        total = weights @ (sds**2 + (means - mean) ** 2)
        change = np.abs(total - plain**2)
        for i in np.flatnonzero(change > widest):
            low[i], high[i] = (_quantile(q, weights, means[:, i], sds[:, i]) for q in (0.025, 0.975))
        widest = np.maximum(widest, change)
        shift += mean
        variance += total - plain**2
    variance = np.maximum(variance, 0.25 * plain**2)
    return Marginal(shift, np.sqrt(variance), low, high, scales)


class MarginalRefresh:
    """The same for the running estimator: three nodes a scale, one of them renewed a refresh, in bounded time.

    The nodes lie about sqrt(3) standard deviations of log s off the estimate, which with the posterior's own weights is
    Gauss and Hermite's rule; how wide it is, the nodes of the last round have shown. Other noise scales stay put.
    """

    def __init__(self) -> None:
        self._distance = dict.fromkeys(MARGINAL_SCALES, 1.0)
        self._rest = dict.fromkeys(MARGINAL_SCALES, 0)
        self._round: dict[int, list[Node]] = {}  # first nodes of a pair that is not complete yet
        self._pairs: dict[int, list[Node]] = {}
        self._turn = 0

    def refresh(self, em: WindowEM, first: int, last: int, information: Information) -> Marginal | None:
        """Renew one node; the window must have been filtered and scored where `em` is, and is left so."""
        for j in MARGINAL_SCALES:
            self._rest[j] = max(0, self._rest[j] - 1)
            if information.noise_sd[j] <= WEAK_SCALE_SD:
                self._forget(j)
        weak = [j for j in MARGINAL_SCALES if information.noise_sd[j] > WEAK_SCALE_SD and not self._rest[j]]
        if weak:
            self._turn += 1
            self._renew(em, first, last, information, weak[(self._turn // 2) % len(weak)])
        if not self._pairs:
            return None
        plain = np.sqrt(np.maximum(np.diag(np.linalg.inv(_held(em, information.matrix))), 0.0)) * em.setup.free
        centre = Node(0.0, np.zeros(P), plain)
        grids = [[low, centre, high] for low, high in self._pairs.values()]
        return combine(grids, information, scales=tuple(self._pairs))

    def _renew(self, em: WindowEM, first: int, last: int, information: Information, scale: int) -> None:
        best = em.parameters
        centre = _theta_node(
            em, first, last, log_prior(em) + float(em.tape.loglik[first:last].sum()), information.matrix, scale
        )
        done = self._round.setdefault(scale, [])
        distance = self._distance[scale] * (1 if done else -1)
        value = log_posterior(em, first, last, shifted(best, scale, distance))
        node = _theta_node(em, first, last, value, em.sensitivities(first, last), scale)
        log_posterior(em, first, last, best)
        done.append(Node(node.weight - centre.weight, node.shift, node.sd))
        if len(done) < 2:
            return
        del self._round[scale]
        fall = -0.5 * (done[0].weight + done[1].weight)
        width = self._distance[scale] / np.sqrt(2 * max(fall, 0.05))
        if width <= WEAK_SCALE_SD:
            self._forget(scale)
            self._rest[scale] = REST_REFRESHES
        else:
            self._pairs[scale] = done
        self._distance[scale] = float(np.clip(np.sqrt(3) * width, 0.4, 2.6))

    def _forget(self, scale: int) -> None:
        self._pairs.pop(scale, None)
        self._round.pop(scale, None)


def _held(em: WindowEM, matrix: NDArray) -> NDArray:
    """Information of theta with its prior; identity where it is held fixed."""
    free = em.setup.free
    return np.where(np.outer(free, free), matrix, 0.0) + np.diag(np.where(free, em.setup.prior.precision, 1.0))


def _theta_node(em: WindowEM, first: int, last: int, value: float, matrix: NDArray, scale: int) -> Node:
    """Node for which only theta follows, from the information of the data and the score on the tape."""
    setup = em.setup
    score = em.tape.score[first:last].sum(0)
    score = score - setup.prior.precision * offset(em.parameters.theta, setup.prior.centre, setup.unit)
    return node_of(em, value, np.where(setup.free, score, 0.0), _held(em, matrix), scale)


def _quantile(q: float, weights: NDArray, means: NDArray, sds: NDArray) -> float:
    """Quantile of a mixture of normal distributions, by bisection."""
    sds = np.maximum(sds, 1e-300)
    low, high = float(np.min(means - 9 * sds)), float(np.max(means + 9 * sds))
    for _ in range(60):
        middle = 0.5 * (low + high)
        if float(weights @ ndtr((middle - means) / sds)) < q:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
