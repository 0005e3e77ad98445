"""Starting points for effects whose likelihood has many maxima, such as a swinging load.

A pendulum of a wrong period gets out of phase within its damping time. So the likelihood over its length has a peak
some per cent wide, and a fit that starts beside the peak does not reach it. One pass gives the gain of the amplitude
alone at every starting point; the best few are fitted in full. If the flight drives a load into chaos, the response of
a small load says nothing of a larger one. Then starting points are compared by their likelihoods.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, Candidate
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Column, Point
from crazyem.diagnosis.fitting.nuisances import nuisances, with_nuisances
from crazyem.diagnosis.settings import SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE


def best_starting_points(
    data: Data, point: Point, accepted: Sequence[Candidate], candidates: Sequence[Candidate]
) -> list[Candidate]:
    """The candidates; of those with many starting points, only the ones with the largest gains."""
    families: dict[tuple[object, ...], list[Candidate]] = {}
    for c in candidates:
        families.setdefault((c.effect, c.fixed, c.free), []).append(c)
    many = [family for family in families.values() if len(family) > SELECTION.full_fits]
    if not many:
        return list(candidates)
    free = nuisances(data, point, accepted)
    point = with_nuisances(point, free)
    base = [*accepted, *(c for c, _ in free)]
    columns = [x for c in base for x in c.columns(point)]
    weights = np.array([0.0] * sum(len(c.free) for c in accepted) + [w for _, p in free for w in p])
    for family in many:
        columns += [_amplitude(c, point) for c in family]
    gram = data.gram(point, columns)
    dropped, added, at = set[Candidate](), list[Candidate](), len(weights)
    for family in many:
        gains = [_gain(gram, weights, at + i) for i in range(len(family))]
        at += len(family)
        best = peaks(gains)
        chaotic = max(gains) > SELECTION.chaos_gain and any(
            model.diverges(family[0].effect, point.vehicle) for model in data.models
        )
        found = likeliest_start(data, point, family) if chaotic else None
        dropped |= set(family) - ({family[i] for i in best} if found is None else set())
        added += [found] if found is not None else []
    return [*(c for c in candidates if c not in dropped), *added]


def likeliest_start(data: Data, point: Point, family: Sequence[Candidate]) -> Candidate | None:
    """The likeliest starting point, with its size; None if none is likelier than no effect.

    The thrust scale balances the weight of the effect.
    """
    effect = CATALOGUE[family[0].effect]
    nothing = data.twin().loglik(point)

    def gain(tried: tuple[float, Candidate]) -> float:
        size, candidate = tried
        values = {**candidate.neutral(point), **dict(candidate.begin), effect.amplitude: size}
        scale = point.effects.get(THRUST.effect, {}).get("scale", 1.0) * (1.0 + size / point.vehicle.mass)
        return data.twin().loglik(point.with_effects({effect.name: values, THRUST.effect: {"scale": scale}})) - nothing

    tried = list(product(effect.sizes, family))
    gains = data.workers.map(gain, tried)
    if not tried or max(gains) <= 0.0:
        return None
    size, likeliest = tried[int(np.argmax(gains))]
    begin = {**dict(likeliest.begin), effect.amplitude: size}
    return replace(likeliest, begin=tuple(begin.items()), likeliest=True)


def peaks(gains: Sequence[float]) -> list[int]:
    """Indices of the highest local maxima, `SELECTION.peaks` at most, highest first."""
    padded = [-np.inf, *gains, -np.inf]
    local = [i for i in range(len(gains)) if padded[i] < padded[i + 1] >= padded[i + 2]]
    return sorted(local, key=lambda i: -gains[i])[: SELECTION.peaks]


def _amplitude(candidate: Candidate, point: Point) -> Column:
    name = CATALOGUE[candidate.effect].amplitude
    return candidate.columns(point)[candidate.free.index(name)]


def _gain(gram: Gram, weights: NDArray, column: int) -> float:
    """Gain of a column beside the base, without bounds [nats]; 0 if the amplitude would be negative."""
    b, a = gram.total([*range(len(weights)), column])
    a = a + np.diag(np.append(weights, 0.0))
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    a, b = a / np.outer(scale, scale), b / scale
    along = np.linalg.lstsq(a[:-1, :-1], a[:-1, -1], rcond=1e-12)[0]
    left, size = b[-1] - along @ b[:-1], a[-1, -1] - along @ a[:-1, -1]
    return float(left**2 / (2 * size)) if left > 0 and size > 1e-9 else 0.0
