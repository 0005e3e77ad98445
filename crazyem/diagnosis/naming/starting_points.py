"""Onset of effects that begin in mid-flight, and starting points for effects whose likelihood has many maxima.

A pendulum of a wrong period gets out of phase within its damping time. So the likelihood over its length has a peak
some per cent wide, and a fit that starts beside the peak does not reach it. One pass gives the gain of the amplitude
alone at every starting point; the best few are fitted in full. If the flight drives a load into chaos, the response of
a small load says nothing of a larger one. Then starting points are compared by their likelihoods.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, Fitted
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import (
    held_out_value,
    is_nonphysical,
    nuisances,
    refine_base,
    refine_with_memory,
    with_nuisances,
)
from crazyem.diagnosis.naming.evidence import is_implausible
from crazyem.diagnosis.settings import SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE

ONSET = "onset_time"  # of effects that may begin in mid-flight


def onset_of(data: Data, point: Point, candidate: Candidate, gram: Gram, index: list[int]) -> Candidate | None:
    """The same effect with an onset that explains more than the effect from the start; None if there is none.

    Sums over blocks find the block, and the likelihood finds the tenth of a second: with a memory of the noise, the
    likelihood has a narrow peak at the true onset, and some samples off it counts against the effect.
    """
    known = dict(candidate.fixed)
    if known.get(ONSET) is not None or all(p.name != ONSET for p in CATALOGUE[candidate.effect].parameters):
        return None
    flight = data.flights[0]
    rows = gram.flight == 0
    b, a = gram.score[rows][:, index[0]], gram.information[rows][:, index[0], index[0]]
    after_b, after_a = np.cumsum(b[::-1])[::-1], np.cumsum(a[::-1])[::-1]
    gains = np.divide(after_b**2, 2 * after_a, out=np.zeros_like(b), where=after_a > 0)
    k = int(np.argmax(gains))
    theta = after_b[k] / after_a[k] if after_a[k] > 0 else 0.0
    residual = b - a * theta * (np.arange(len(b)) >= k)
    scatter = max(1.0, float(residual @ residual / max(a.sum(), 1e-300) * len(b) / max(len(b) - 2, 1)))
    if k < 2 or gains[k] - gains[0] < SELECTION.onset_gain * scatter:
        return None
    begins = float(flight.time[np.flatnonzero(flight.block == k)[0]])
    name, values = candidate.free[0], candidate.values(point)
    size = float(np.clip(values[name] + theta, *candidate.range_of(name)))
    begins = likeliest(data, point, candidate, {**values, name: size}, begins, *SELECTION.onset_scans[0])
    return replace(candidate, fixed=(*candidate.fixed, (ONSET, begins)))


def likeliest(
    data: Data, point: Point, candidate: Candidate, values: Mapping[str, Any], begins: float, reach: float, step: float
) -> float:
    """The likeliest onset [s] of those every `step` within `reach` of `begins`; changes nothing."""
    count = round(reach / step)
    tried = [begins + k * step for k in range(-count, count + 1)]
    points = [point.with_effects({candidate.effect: {**values, ONSET: at}}) for at in tried]
    return tried[int(np.argmax(data.workers.map(lambda there: data.twin().loglik(there), points)))]


def date(data: Data, fitted: Fitted, candidate: Candidate) -> tuple[Fitted, Candidate]:
    """The effect with its onset to some hundredths of a second, by the likelihood; all else is fitted again.

    At a wrong onset the noise absorbs the change: torques with memory grow until the likelihood hardly depends on the
    onset. So a fit at the best onset follows each scan. The noise shrinks in this fit, and a finer scan follows.
    """
    begins = dict(candidate.fixed).get(ONSET)
    if begins is None:
        return fitted, candidate
    for reach, step in SELECTION.onset_scans:
        begins = likeliest(data, fitted.point, candidate, candidate.values(fitted.point), begins, reach, step)
        moved = replace(candidate, fixed=tuple((n, begins if n == ONSET else v) for n, v in candidate.fixed))
        others = tuple(moved if c is candidate else c for c in fitted.candidates)
        candidate = moved
        fitted = refine_base(data, fitted.point.with_effects({candidate.effect: {ONSET: begins}}), others, rounds=3)
    return fitted, candidate


def extend(
    data: Data, held_out: Data | None, fit: Fitted, candidate: Candidate, accepted: Sequence[Candidate]
) -> tuple[Fitted, Data | None, float] | str:
    """The fit with one more effect, the last of its candidates, and its onset, all nuisances free, with the held-out
    flights under it (`held_out_value`); or why the effect must stay out.

    An effect at the end of its physical range stands for something else.
    """
    try:
        dated, candidate = date(data, fit, candidate)
        found = refine_with_memory(data, dated.point, [*accepted, candidate])
        if is_implausible(found.point, candidate):
            return "at the end of its physical range"
        odd = is_nonphysical(found.point, found.candidates)  # then held-out flights are not asked
        return found, *held_out_value(None if odd else held_out, found.point, found.candidates)
    except DivergedError:
        return "with it, the model leaves the range of numbers"


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
        columns += [c.columns(point)[c.free.index(CATALOGUE[c.effect].amplitude)] for c in family]
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


def _gain(gram: Gram, weights: NDArray, column: int) -> float:
    """Gain of a column beside the base, without bounds [nats]; 0 if the amplitude would be negative."""
    b, a = gram.total([*range(len(weights)), column])
    a = a + np.diag(np.append(weights, 0.0))
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    a, b = a / np.outer(scale, scale), b / scale
    along = np.linalg.lstsq(a[:-1, :-1], a[:-1, -1], rcond=1e-12)[0]
    left, size = b[-1] - along @ b[:-1], a[-1, -1] - along @ a[:-1, -1]
    return float(left**2 / (2 * size)) if left > 0 and size > 1e-9 else 0.0
