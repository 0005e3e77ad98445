"""Onset of effects that begin in mid-flight: detection and estimate of the time; the fit of a found effect."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, Fitted
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import held_out_value, is_nonphysical, refine_base, refine_with_memory
from crazyem.diagnosis.naming.detection_limits import is_implausible
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


@dataclass(frozen=True)
class Extension:
    """The fit of a model with a found effect, all nuisances free; the held-out flights under it (`held_out_value`)."""

    fitted: Fitted
    held_out: Data | None
    held_value: float


def extend(
    data: Data, held_out: Data | None, fit: Fitted, candidate: Candidate, accepted: Sequence[Candidate]
) -> Extension | str:
    """The model with one more effect, the last of its candidates, and its onset; or why the effect must stay out.

    An effect at the end of its physical range stands for something else.
    """
    try:
        dated, candidate = date(data, fit, candidate)
        found = refine_with_memory(data, dated.point, [*accepted, candidate])
        if is_implausible(found.point, candidate):
            return "at the end of its physical range"
        odd = is_nonphysical(found.point, found.candidates)  # then held-out flights are not asked
        return Extension(found, *held_out_value(None if odd else held_out, found.point, found.candidates))
    except DivergedError:
        return "with it, the model leaves the range of numbers"
