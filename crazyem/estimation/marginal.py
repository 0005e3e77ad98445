"""Intervals with noise scales integrated out, for scales that the data do not determine.

The interval of mass depends on the intensity s of the noise in thrust, that of an inertia on the noise of a torque.
Where measurement noise dominates, the likelihood only excludes large log s, and its maximum depends on chance. So the
posterior is computed at a few values of log s. At each value, all other parameters are at their maximum given s (one
scoring step, in the quadratic approximation), and the weight is the posterior of log s (Laplace approximation for the
others). The law of total variance and the quantiles of the mixture give the interval. Given the other scales, each
scale acts on mass or on one inertia, so the scales are integrated one at a time.

The weak prior of the scales only keeps steps finite. For the integral, a scale gets a prior so wide (e^4) that it does
not matter."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from crazyem.estimation.em import Information, WindowEM, offset
from crazyem.estimation.inflation import variance_with_bias
from crazyem.estimation.model import Noise, Parameters
from crazyem.estimation.scoring import NOTHING_HELD, P, Point, log_posterior, log_prior, point

MARGINAL_SCALES = (2, 3, 4, 5)  # indices of thrust, torque about x, y, z in `Noise.logs`
WEAK_SCALE_SD = 0.3  # standard deviation of log s from which a scale is integrated out
WIDE_PRIOR_SD = 4.0  # standard deviation of the prior of log s in the integral
NODE_SPACING = 1.2  # standard deviations of log s between nodes
NODE_TAIL = 4.5  # nats below the maximum at which nodes end
MOST_NODES = 7  # nodes on each side
REST_REFRESHES = 8  # refreshes until a scale that was found to be determined is tested again


@dataclass(frozen=True)
class Node:
    """The posterior at one value of a noise scale, relative to the present parameters of the estimator.

    Attributes:
        weight: logarithm of the posterior density of log s, up to a constant.
        shift: (9,) maximum of the parameters given this scale, in the coordinates of `offset`.
        sd: (9,) standard deviations of the parameters given this scale.
    """

    weight: float
    shift: NDArray
    sd: NDArray


@dataclass(frozen=True)
class Marginal:
    """Posterior of the parameters with weakly determined noise scales integrated out, as `offset` from theta.

    Attributes:
        shift: (9,) means.
        sd: (9,) standard deviations.
        low, high: (9,) quantiles at 2.5 and 97.5 %.
        scales: scales that were integrated out, as indices in `Noise.logs`.
    """

    shift: NDArray
    sd: NDArray
    low: NDArray
    high: NDArray
    scales: tuple[int, ...]


def marginalise(em: WindowEM, first: int, last: int, best: Point, information: Information) -> Marginal | None:
    """Integrate out every noise scale that the data do not determine; None if there is none.

    `em` is at the maximum `best`, before and after; the window first..last-1 is left filtered and smoothed.
    """
    weak = [j for j in MARGINAL_SCALES if best.sd[P + j] > WEAK_SCALE_SD]
    if not weak:
        return None
    grids = [_grid(em, first, last, best, j) for j in weak]
    log_posterior(em, first, last, best.parameters)
    em.backward(first, last)
    return combine(grids, information, scales=tuple(weak))


def _grid(em: WindowEM, first: int, last: int, best: Point, scale: int) -> list[Node]:
    """Nodes on both sides of the maximum, until the posterior of the scale is below `NODE_TAIL`."""
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
    """The parameters with the logarithm of one noise scale changed by `shift`."""
    logs = centre.noise.logs.copy()
    logs[scale] += shift
    return replace(centre, noise=Noise.from_logs(logs))


def node_of(em: WindowEM, value: float, score: NDArray, information: NDArray, scale: int) -> Node:
    """Node from log-posterior, score (n,) and information (n, n) at the present parameters; the first nine are theta's.

    Coordinates that are held have a score of zero and an information of one.
    """
    step = np.linalg.solve(information, score)
    prior = em.setup.prior
    far = em.parameters.noise.logs[scale] - prior.noise.logs[scale]
    widened = 0.5 * far**2 * (prior.noise_sd**-2 - WIDE_PRIOR_SD**-2)
    volume = 0.5 * float(np.linalg.slogdet(information)[1])
    sd = np.sqrt(np.diag(np.linalg.inv(information)))[:P] * em.setup.free
    return Node(float(value + widened + 0.5 * (score @ step) - volume), step[:P], sd)


def combine(grids: list[list[Node]], information: Information, *, scales: tuple[int, ...]) -> Marginal:
    """Combine the mixtures over the nodes of each scale (evenly spaced in log s), parameter by parameter."""
    plain = np.sqrt(np.maximum(np.diag(information.covariance), 0.0))
    shift, variance = np.zeros(P), plain**2
    low, high = -1.96 * plain, 1.96 * plain
    widest = np.full(P, -np.inf)
    for nodes in grids:
        weights = np.array([node.weight for node in nodes])
        weights = np.exp(weights - weights.max())
        weights /= weights.sum()
        means = np.array([node.shift for node in nodes])
        variances = (np.array([node.sd for node in nodes]) * information.inflation) ** 2
        sds = np.sqrt(variance_with_bias(variances, np.broadcast_to(information.bias, variances.shape)))
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
    """The same integral for the running estimator, with bounded time: three nodes per scale, one renewed per refresh.

    The outer nodes are about sqrt(3) standard deviations of log s from the estimate; with the weights of the posterior
    this is the Gauss-Hermite rule. The standard deviation comes from the last pair of nodes. Other scales are fixed.
    """

    def __init__(self) -> None:
        self._distance = dict.fromkeys(MARGINAL_SCALES, 1.0)
        self._rest = dict.fromkeys(MARGINAL_SCALES, 0)
        self._round: dict[int, list[Node]] = {}  # first nodes of a pair that is not complete yet
        self._pairs: dict[int, list[Node]] = {}
        self._turn = 0

    def refresh(self, em: WindowEM, first: int, last: int, information: Information) -> Marginal | None:
        """Renew one node; before and after, the window is filtered and scored at the present parameters."""
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
    """Information of theta with its prior; identity where a parameter is fixed."""
    free = em.setup.free
    return np.where(np.outer(free, free), matrix, 0.0) + np.diag(np.where(free, em.setup.prior.precision, 1.0))


def _theta_node(em: WindowEM, first: int, last: int, value: float, matrix: NDArray, scale: int) -> Node:
    """Node with all noise scales fixed, from the information (9, 9) of the data and the score on the tape."""
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
