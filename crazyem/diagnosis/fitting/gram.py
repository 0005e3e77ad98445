"""Score and information of many columns by blocks of flight, and the gain of any subset of columns.

Near a model, the log-likelihood changes by b'd - d'A d/2 for small changes d of the parameters, with score b and
information A, summed over blocks of about a second. So one pass over the flight is enough for every subset of columns.
Innovations of real recordings are neither white nor Gaussian. So errors come from the scatter of the scores of the
blocks (the sandwich; White 1982), not from the information alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.settings import FITTING


@dataclass(frozen=True)
class Solution:
    """A subset of columns, fitted.

    Attributes:
        theta: (k,) change of the parameters.
        gain: log-likelihood gained [nats].
        held_out: the same on blocks that were not used for the fit, summed over folds [nats].
        covariance: (k, k), the sandwich, scaled so that no variance is smaller than that of the inverse information.
        dispersion: variance of the scores of the tested columns over that of the model, the other columns profiled out.
    """

    theta: NDArray
    gain: float
    held_out: float
    covariance: NDArray
    dispersion: float


@dataclass(frozen=True)
class Gram:
    """Score (b, c) and information (b, c, c) by block; `flight` (b,): the flight of each block."""

    score: NDArray
    information: NDArray
    flight: NDArray

    @classmethod
    def joined(cls, parts: Sequence[Any]) -> "Gram":
        """That of several flights, from parts with a `score` and an `information` by block."""
        flight = [np.full(len(part.score), i) for i, part in enumerate(parts)]
        score, information = ([getattr(part, name) for part in parts] for name in ("score", "information"))
        return cls(np.concatenate(score), np.concatenate(information), np.concatenate(flight))

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.score.shape[1]

    def moved(self, change: NDArray) -> "Gram":
        """Score and information after a small change (c,) of the parameters."""
        return replace(self, score=self.score - self.information @ change)

    def total(self, columns: Sequence[int]) -> tuple[NDArray, NDArray]:
        """Sums over all blocks: (k,), (k, k)."""
        c = np.asarray(columns, int)
        return self.score[:, c].sum(0), self.information[:, c][:, :, c].sum(0)

    def solve(
        self,
        columns: Sequence[int],
        *,
        precision: NDArray | None = None,
        low: NDArray | None = None,
        high: NDArray | None = None,
        prior: NDArray | None = None,
        tested: Sequence[int] | None = None,
        effective: bool = False,
    ) -> Solution:
        """Fit a subset of columns.

        Args:
            columns: indices (k,).
            precision: (k,) of Gaussian priors around `prior` (default 0); 0: none.
            low, high: (k,) bounds of the change.
            tested: positions (of the k) whose scores the dispersion is of; default all.
            effective: degrees of freedom are those that the blocks determine (`used`), instead of k.
        """
        c = np.asarray(columns, int)
        k = c.size
        weight = np.zeros(k) if precision is None else np.asarray(precision, float)
        centre = np.zeros(k) if prior is None else np.asarray(prior, float)
        scores, infos = self.score[:, c], self.information[:, c][:, :, c]
        b, a = scores.sum(0), infos.sum(0)
        theta = bounded(a + np.diag(weight), b + weight * centre, low, high)
        gain = float(b @ theta - 0.5 * theta @ a @ theta - 0.5 * weight @ (theta - centre) ** 2)
        gain += float(0.5 * weight @ centre**2)
        held, fold = 0.0, np.arange(len(scores)) // FITTING.blocks_together % FITTING.folds  # chunks dealt out in turn
        for f in range(FITTING.folds):
            out = fold == f
            if not out.any() or out.all():
                continue
            b_out, a_out = scores[out].sum(0), infos[out].sum(0)
            t = bounded(a - a_out + np.diag(weight), b - b_out + weight * centre, low, high)
            held += float(b_out @ t - 0.5 * t @ a_out @ t)
        which = np.arange(k) if tested is None else np.asarray(tested, int)
        curvature = a + np.diag(weight)
        covariance, meat = self._sandwich(scores, infos, theta, curvature, effective)
        dispersion = self._dispersion(a, curvature, meat, which, len(scores))
        return Solution(theta, gain, held, covariance, dispersion)

    def by_flights(self, theta: NDArray, precision: NDArray) -> tuple[NDArray, int]:
        """Standard deviations (c,) of all columns from the scatter of the scores of flights, and degrees of freedom.

        Some errors are the same in all blocks of a flight (clock, battery, air), so the scatter of blocks does not show
        them (the sandwich by clusters; Liang and Zeger, Biometrika 73, 1986). 0 for fewer than `FITTING.min_flights`.

        Args:
            theta: (c,) change of the parameters to the maximum.
            precision: (c,) of Gaussian priors.
        """
        which, of_flight = np.unique(self.flight, return_inverse=True)
        if which.size < FITTING.min_flights:
            return np.zeros(self.size), 0
        residual = self.score - self.information @ theta
        scores = np.zeros((which.size, self.size))
        np.add.at(scores, of_flight, residual)
        scores -= scores.mean(0)
        each = scores @ _inverse(self.information.sum(0) + np.diag(precision))
        return np.sqrt(np.square(each).sum(0) * which.size / (which.size - 1)), which.size - 1

    @staticmethod
    def _sandwich(
        scores: NDArray, infos: NDArray, theta: NDArray, a: NDArray, effective: bool
    ) -> tuple[NDArray, NDArray]:
        residual = scores - infos @ theta
        blocks, k = residual.shape
        residual = residual - residual.mean(0)
        meat = residual.T @ residual * blocks / max(blocks - 1, 1)
        # neighbours are correlated: half of their covariance is added (Newey and West 1987, one lag), which leaves it
        # positive semidefinite
        lagged = residual[1:].T @ residual[:-1]
        meat += 0.5 * (lagged + lagged.T)
        inverse = _inverse(a)
        freedom = max(blocks - (used(infos.sum(0), a) if effective else k), 2)
        sandwich = inverse @ meat @ inverse * blocks / freedom
        larger = np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse)) / np.maximum(np.diag(sandwich), 1e-300))
        return sandwich * np.outer(larger, larger), meat

    @staticmethod
    def _dispersion(a: NDArray, curvature: NDArray, meat: NDArray, which: NDArray, blocks: int) -> float:
        """Median over the tested columns of the variance of scores over that of the model, the others profiled out."""
        if which.size == 0:
            return 1.0
        project = _profiled(curvature, which, np.setdiff1d(np.arange(len(a)), which))
        by_scatter, by_model = (np.einsum("ij,jk,ik->i", project, m, project) for m in (meat, a))
        # a column that the others explain completely has no scatter
        left = by_model > 1e-9 * np.diag(a)[which]
        if not left.any():
            return 1.0
        taken = min(used(a, curvature), blocks - 2) if which.size < len(a) else 0.0
        return float(np.median(by_scatter[left] / by_model[left])) * blocks / (blocks - max(taken, 0.0))


def _inverse(curvature: NDArray) -> NDArray:
    """Inverse of a curvature (k, k) of columns of very different sizes."""
    scale = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    inverse: NDArray = np.linalg.pinv(curvature / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    return inverse


def _profiled(a: NDArray, which: NDArray, others: NDArray) -> NDArray:
    """Matrix (w, k) from scores (k,) to those of the tested columns, the others profiled out (efficient scores)."""
    project = np.zeros((which.size, a.shape[0]))
    project[np.arange(which.size), which] = 1.0
    if others.size:
        own = np.diag(a)[others]  # 0 for a column that changes nothing
        project[:, others] = -np.linalg.solve(
            a[np.ix_(others, others)] + np.diag(1e-12 * own + (own <= 0)), a[np.ix_(others, which)]
        ).T
    return project


def used(information: NDArray, posterior: NDArray) -> float:
    """Number of parameters that the data determine: the trace of information over information with priors."""
    scale = np.sqrt(np.maximum(np.diag(posterior), 1e-300))
    both = [m / np.outer(scale, scale) for m in (information, posterior)]
    return float(np.trace(np.linalg.pinv(both[1], hermitian=True) @ both[0]))


def bounded(a: NDArray, b: NDArray, low: NDArray | None, high: NDArray | None) -> NDArray:
    """Maximum of b't - t'A t/2 within bounds, by an active set.

    Nocedal and Wright, Numerical Optimization, 2nd ed., algorithm 16.3. Without bounds, one linear solution.
    """
    k = b.size
    if k == 0:
        return np.zeros(0)
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    a = a / np.outer(scale, scale) + 1e-10 * np.eye(k)
    b = b / scale
    if low is None or high is None:
        return np.linalg.solve(a, b) / scale
    within, low, high = (low, high), low * scale, high * scale
    t, free, inward = np.clip(np.zeros(k), low, high), np.ones(k, bool), np.zeros(k)
    for _ in range(20 * k + 20):
        index, fixed = np.flatnonzero(free), np.flatnonzero(~free)
        step = np.zeros(k)
        if index.size:
            step[index] = np.linalg.solve(a[np.ix_(index, index)], b[index] - a[np.ix_(index, fixed)] @ t[fixed])
            step[index] -= t[index]
        room = np.where(step > 0, high - t, low - t)
        share = np.divide(room, step, out=np.full(k, np.inf), where=step != 0)
        first = int(np.argmin(share))
        if share[first] < 1.0:  # a step meets a bound: go to the bound, then along it
            inward[first] = -np.sign(step[first])
            t = np.clip(t + share[first] * step, low, high)
            t[first] = low[first] if inward[first] > 0 else high[first]
            free[first] = False
            continue
        t = np.clip(t + step, low, high)
        pull = np.where(free | (low >= high), 0.0, (b - a @ t) * inward)
        back = int(np.argmax(pull))
        if pull[back] <= 1e-9 * max(1.0, float(np.abs(b).max())):
            break
        free[back] = True
    return np.clip(t / scale, *within)


def neutral_gain(
    gram: Gram, order: Sequence[int], own: int, weights: NDArray, low: NDArray, high: NDArray, centre: NDArray
) -> tuple[float, float]:
    """Gain, on all blocks and on held-out blocks, with the last `own` columns fixed at neutral.

    weights, centre: of all columns; low, high: of the others.
    """
    away = centre[len(order) - own :]
    wide = np.where(np.abs(away) > 0, np.abs(away), 1.0) * 1e-9
    solution = gram.solve(
        order, precision=weights, prior=centre, low=np.append(low, away - wide), high=np.append(high, away + wide)
    )
    return solution.gain, solution.held_out
