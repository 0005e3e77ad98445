"""What an effect would be worth if it were fitted to all flights, and what its parameters cost: the evidence by which
two explanations are compared."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import (
    Data,
    DivergedError,
    Fitted,
    bounds_of,
    freedom_of,
    held_near,
    local_precision,
    moved,
)
from crazyem.diagnosis.fitting.gram import bounded
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import nuisances
from crazyem.physics.effects.catalogue import CATALOGUE

FAR = 20.0  # nats that one step is believed to bring without looking


def tuning(candidates: Sequence[Candidate], covariance: NDArray) -> float:
    """Nats that it costs effects that their parameters (k, in order) might have been anything.

    What is left of what is usual once they are known, as in Laplace's approximation of the evidence (MacKay 1992): a
    load that explains weak rotors must sit in the middle of the drone, and one that could be anywhere hardly ever does,
    within what a flight tells of it. What no flight tells costs nothing by this, and at least a nat for each parameter,
    as chance brings that much.

    Args:
        covariance: (k, k), with what is usual as prior (`known_of`).
    """
    root = np.linalg.inv(np.linalg.cholesky(_usual(candidates)))
    left = np.linalg.eigvalsh(root @ covariance @ root.T)
    return max(float(len(root)), -0.5 * float(np.sum(np.log(np.clip(left, 1e-12, 1.0)))))


def known_of(candidates: Sequence[Candidate], curvature: NDArray) -> NDArray:
    """(k, k) covariance of the parameters of the candidates, which come first in a curvature (n, n), all else free,
    with what is usual as prior."""
    usual = _usual(candidates)
    with_prior = curvature.copy()
    with_prior[: len(usual), : len(usual)] += np.linalg.inv(usual)
    return _inverse(with_prior)[: len(usual), : len(usual)]


def _usual(candidates: Sequence[Candidate]) -> NDArray:
    """(k, k) covariance of how far the parameters usually are from neutral."""
    width = np.array([c.parameter(n).width for c in candidates for n in c.free])
    which = np.repeat(np.arange(len(candidates)), [len(c.free) for c in candidates])
    alike = np.array([CATALOGUE[c.effect].alike for c in candidates])[which]
    together = np.where(which[:, None] == which, alike, 0.0)
    np.fill_diagonal(together, 1.0)
    covariance: NDArray = together * np.outer(width, width)
    return covariance


def gain_of_both(
    fitted: Fitted, held_out: Data, there: Fitted, accepted: Sequence[Candidate]
) -> tuple[float, NDArray, NDArray]:
    """What an effect fitted to the one set of flights would gain on both [nats] if it were fitted to both, the
    log-likelihood of those held out then, by blocks (b,), and the covariance (k, k) of what is accepted by both
    (`known_of`).

    By one step from `there`, the flights held out with the effect as it was fitted. The curvature at `fitted` is the
    prior of its parameters; what is of a kind that is always free may differ from what was fitted by its scatter in
    either set of flights. Of these kinds `there` has moved already, and paid for it as for the scatter of its own
    flights, which is given back. To be admitted an effect must hold as it is; to be compared with another it must not
    suffer from being less well known: a poor flight to fit would always prefer fewer parameters.
    """
    free = nuisances(held_out, there.point, accepted)
    own, parts = sum(len(c.free) for c in accepted), [*accepted, *(c for c, _ in free)]
    score, information = _total(held_out, there.point, parts)
    apart = {(c.effect, n): w for c, p in nuisances(held_out, there.point, ()) for n, w in zip(c.free, p, strict=True)}
    paid = np.array([apart.get((c.effect, n), 0.0) for c in accepted for n in c.free])
    away = np.array([
        *(c.values(there.point)[n] - c.values(fitted.point)[n] for c in accepted for n in c.free),
        *(c.values(there.point)[n] - c.neutral(there.point)[n] for c, _ in free for n in c.free),
    ])  # fmt: skip
    freedom = np.append(np.full(own, np.inf), freedom_of([c for c, _ in free]))
    usual = np.array([*np.zeros(own), *(w for _, precision in free for w in precision)])
    known = np.diag(local_precision(away, usual, freedom))
    differing = np.divide(1.0, paid, out=np.zeros(own), where=paid > 0.0)
    curvature = fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision)
    known[:own, :own] = _inverse(_inverse(curvature)[:own, :own] + np.diag(2.0 * differing))
    back = 0.5 * float(paid @ np.square(away[:own]) - away[:own] @ known[:own, :own] @ away[:own])
    rest = score - known @ away
    near = np.diag(known) * (np.arange(len(away)) >= own)
    low, high = held_near(*bounds_of(parts, there.point), away, near, freedom)
    step = bounded(information + known, rest, low, high)
    gain = float(rest @ step - 0.5 * step @ (information + known) @ step)
    blocks, covariance = held_out.block_loglik(there.point), known_of(accepted, information + known)
    if gain < FAR:
        return back + gain, blocks, covariance
    # So much is told by slopes where an effect is far from what these flights want; what the step brings is to be seen
    looked = held_out.twin()
    begin, best = looked.loglik(there.point) - 0.5 * float(away @ known @ away), 0.0
    for part in (1.0, 0.5, 0.25):
        moves = part * step
        point = moved(there.point, parts, moves)
        with np.errstate(over="ignore", invalid="ignore"):
            brought = looked.loglik(point, passes=2) - begin
        brought -= 0.5 * float((away + moves) @ known @ (away + moves))
        if np.isfinite(brought) and brought > best:
            # by which explanations scatter: a drag that is right and was fitted to a hover ruins what it was not fitted
            # to, so badly that none could be told from it
            best, blocks = brought, looked.block_loglik(point)
    return back + min(best, gain), blocks, covariance


def known_by(fitted: Fitted, accepted: Sequence[Candidate]) -> NDArray:
    """(k, k) covariance of what is accepted at the maximum (`known_of`)."""
    return known_of(accepted, fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision))


def _total(data: Data, point: Point, parts: Sequence[Candidate]) -> tuple[NDArray, NDArray]:
    """Score (k,) and information (k, k) of all free parameters."""
    columns = [x for c in parts for x in c.columns(point)]
    return data.gram(point, columns).total(range(len(columns)))


def _inverse(matrix: NDArray) -> NDArray:
    """Of a covariance or a curvature (k, k) whose parameters are of very different sizes; of one that says nothing, 0.

    Raises:
        DivergedError: a number of it is not finite.
    """
    if not np.isfinite(matrix).all():
        raise DivergedError("the curvature of a fit is not finite")
    informed = np.diag(matrix) > 0.0
    scale = np.sqrt(np.where(informed, np.diag(matrix), 1.0))
    inverse: NDArray = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)
    return inverse
