"""Evidence of a model from score and information: what differs from flight to flight integrated out, priors cut.

Parameters of flight f are theta_f = phi + delta_f, delta_f ~ N(0, usual_f^2) in each flight, phi ~ N(0, own^2) within
bounds where the effect is part of the model, else 0 (all less neutral). Around a point, the log-likelihood of a flight
is b'd - d'A d/2, so delta_f goes in closed form, and what is left of phi is a normal distribution in a box:

    log Z = log Z(phi = 0) + s'C s/2 - log|I + F P^-1|/2 + log Pr(box; C s, C) - log Pr(box; 0, P^-1),  C = (F + P)^-1,

with score s and information F of phi, P the precision of its prior (Laplace's approximation; MacKay, Information
Theory, ch. 28). The probability of a box is found by expectation propagation (Cunningham, Hennig, Lacoste-Julien 2011).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

SWEEPS, CLOSE = 50, 1e-7  # of expectation propagation at most; change of the mean in standard deviations that ends it
ROOT = 0.5 * np.log(2.0 * np.pi)


@dataclass(frozen=True)
class Pass:
    """One flight at a point.

    Attributes:
        loglik: nats.
        score: (b, c) by block.
        information: (b, c, c) by block.
        here: (c,) parameters less neutral.
    """

    loglik: float
    score: NDArray
    information: NDArray
    here: NDArray


@dataclass(frozen=True)
class Gaussian:
    """A normal prior in a box.

    Attributes:
        covariance: (k, k) before it is cut.
        low, high: (k,) bounds, less neutral.
    """

    covariance: NDArray
    low: NDArray
    high: NDArray


@dataclass(frozen=True)
class Posterior:
    """log evidence over that of phi = 0; mean (k,) and covariance (k, k) of phi in its box."""

    gain: float
    mean: NDArray
    covariance: NDArray


class Shared:
    """What flights say of phi, with what is of each flight integrated out.

    Attributes:
        score: (c,). information: (c, c).
        nothing: log evidence with phi = 0 [nats].
        blocks: (b, c) scores of all blocks at the point, without what differs from flight to flight.
        scatter: (c,) variance of the blocks' scores over what the model says of it, at least 1.
    """

    def __init__(self, flights: Sequence[Pass], usual: NDArray) -> None:
        """usual: (flights, c) standard deviations; 0: the flight has no deviation."""
        c = usual.shape[1]
        self.usual = usual
        self.score, self.information, self.nothing = np.zeros(c), np.zeros((c, c)), 0.0
        self._own: list[tuple[NDArray, NDArray, NDArray, NDArray]] = []
        rest = []
        for flight, sd in zip(flights, usual, strict=True):
            free = np.flatnonzero(sd > 0)
            d = sd[free]
            b, a = flight.score.sum(0), flight.information.sum(0)
            neutral = b + a @ flight.here  # score at neutral
            inner = np.eye(free.size) + d[:, None] * a[np.ix_(free, free)] * d
            across, known = d[:, None] * a[free], d * neutral[free]
            solved = np.linalg.solve(inner, np.column_stack([across, known]))
            self.score += neutral - across.T @ solved[:, -1]
            self.information += a - across.T @ solved[:, :-1]
            self.nothing += flight.loglik - b @ flight.here - 0.5 * flight.here @ a @ flight.here
            self.nothing += 0.5 * float(known @ solved[:, -1]) - 0.5 * float(np.linalg.slogdet(inner)[1])
            self._own.append((free, inner, across, known))
            # blocks' scores at the point, without what the deviations take
            left = flight.score - flight.score[:, free] @ (d[:, None] * solved[:, :-1])
            rest.append(left)
        self.blocks = np.concatenate(rest)
        self.scatter = scatter_of(self.blocks, np.diag(self.information))

    def posterior(self, at: Sequence[int], prior: Gaussian) -> Posterior:
        """Of the columns `at` (k,), the others 0."""
        index = np.asarray(at, int)
        if not index.size:
            return Posterior(0.0, np.zeros(0), np.zeros((0, 0)))
        s, f = self.score[index], self.information[np.ix_(index, index)]
        root = np.linalg.cholesky(prior.covariance)  # in its units the prior is white
        white = np.eye(index.size) + root.T @ f @ root
        covariance = root @ np.linalg.inv(white) @ root.T
        mean = covariance @ s
        gain = 0.5 * float(s @ mean) - 0.5 * float(np.linalg.slogdet(white)[1])
        inside, mean, covariance = box(mean, covariance, prior.low, prior.high)
        before, _, _ = box(np.zeros(index.size), prior.covariance, prior.low, prior.high)
        return Posterior(gain + inside - before, mean, covariance)

    def deviations(self, flight: int) -> tuple[NDArray, NDArray]:
        """Columns (d,) that differ in a flight, and their covariance (d, d) about what all share."""
        free, inner, _, _ = self._own[flight]
        sd = self.usual[flight][free]
        return free, np.linalg.inv(inner) * np.outer(sd, sd)

    def there(self, flights: Sequence[Pass], phi: NDArray) -> list[Pass]:
        """The flights at the maximum with phi (c,) given, where their scores scatter by noise alone."""
        found = []
        for flight, theta in zip(flights, self.parameters(phi), strict=True):
            away = theta - flight.here
            gain = float(flight.score.sum(0) @ away - 0.5 * away @ flight.information.sum(0) @ away)
            score = flight.score - flight.information @ away
            found.append(Pass(flight.loglik + gain, score, flight.information, theta))
        return found

    def parameters(self, phi: NDArray) -> list[NDArray]:
        """(c,) by flight: parameters less neutral at the maximum, with phi (c,) given."""
        found = []
        for (free, inner, across, known), sd in zip(self._own, self.usual, strict=True):
            theta = phi.copy()
            theta[free] += sd[free] * np.linalg.solve(inner, known - across @ phi)
            found.append(theta)
        return found


def scatter_of(scores: NDArray, information: NDArray) -> NDArray:
    """Variance of the sum of blocks' scores (b, c), neighbours alike, over the information (c,)."""
    r = scores - scores.mean(0)
    spread = np.sum(r * r, axis=0) + np.maximum(2.0 * np.sum(r[1:] * r[:-1], axis=0), 0.0)
    ratio = np.divide(spread, information, out=np.ones_like(spread), where=information > 0)
    return np.maximum(ratio, 1.0)


def box(mean: NDArray, covariance: NDArray, low: NDArray, high: NDArray) -> tuple[float, NDArray, NDArray]:
    """Log probability of a box under a normal distribution; mean and covariance within it."""
    k = mean.size
    sd = np.sqrt(np.diag(covariance))
    lo, hi = (low - mean) / sd, (high - mean) / sd
    reached = np.flatnonzero((lo > -8.0) | (hi < 8.0))
    if not reached.size:
        return 0.0, mean, covariance
    prior = covariance / np.outer(sd, sd)
    s, m = prior.copy(), np.zeros(k)
    tau, nu = np.zeros(k), np.zeros(k)
    for _ in range(SWEEPS):
        before = m.copy()
        for i in reached:
            precision = 1.0 / s[i, i] - tau[i]
            if precision <= 1e-12:
                continue
            centre = (m[i] / s[i, i] - nu[i]) / precision
            _, first, second = _cut(centre, 1.0 / precision, lo[i], hi[i])
            change = 1.0 / second - precision - tau[i]
            tau[i] += change
            nu[i] = first / second - centre * precision
            s = s - change / (1.0 + change * s[i, i]) * np.outer(s[:, i], s[i])
            m = s @ nu
        if np.max(np.abs(m - before)) < CLOSE:
            break
    inside = 0.5 * float(nu @ m) - 0.5 * float(np.linalg.slogdet(np.eye(k) + prior * tau)[1])
    for i in reached:
        precision = 1.0 / s[i, i] - tau[i]
        if precision <= 1e-12:
            continue
        h = m[i] / s[i, i] - nu[i]
        inside += _cut(h / precision, 1.0 / precision, lo[i], hi[i])[0]
        inside -= 0.5 * ((h + nu[i]) ** 2 * s[i, i] - h * h / precision) - 0.5 * np.log1p(tau[i] / precision)
    return float(inside), mean + sd * m, s * np.outer(sd, sd)


def _cut(mean: float, variance: float, low: float, high: float) -> tuple[float, float, float]:
    """Log probability of an interval under a normal distribution; mean and variance within it."""
    sd = variance**0.5
    a, b = (low - mean) / sd, (high - mean) / sd
    flipped = a > 0.0  # the lower tail keeps its digits
    if flipped:
        a, b = -b, -a
    top, bottom = float(log_ndtr(b)), float(log_ndtr(a))
    inside = top + (np.log(-np.expm1(min(bottom - top, -1e-300))) if np.isfinite(bottom) else 0.0)
    at_a = np.exp(-0.5 * a * a - ROOT - inside) if np.isfinite(a) else 0.0
    at_b = np.exp(-0.5 * b * b - ROOT - inside) if np.isfinite(b) else 0.0
    shift = at_a - at_b
    spread = 1.0 + (a * at_a if at_a else 0.0) - (b * at_b if at_b else 0.0) - shift * shift
    first = mean + (-shift if flipped else shift) * sd
    return float(inside), float(first), float(variance * max(spread, 1e-9))
