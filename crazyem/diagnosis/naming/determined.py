"""Plausibility of reported numbers: each lies inside its interval, and the interval inside the physical range.

A number at the end of its range stands for something else. If all intervals of an effect contain neutral, the flights
do not show the effect. Both are "not determined": the effect is no finding and no part of the fitted vehicle, and the
others are fitted again without it. The rule is the same for all effects, by whichever likelihood they were found.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from scipy.special import expit

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import (
    refine_base,
)
from crazyem.diagnosis.naming.answer import Named, Value, numbers_of
from crazyem.diagnosis.naming.balance import Balance, by_balance
from crazyem.diagnosis.naming.prune import left_out
from crazyem.diagnosis.naming.steady import with_exact_torques
from crazyem.diagnosis.naming.trials import Selection, improbable
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.physics.effects.catalogue import CATALOGUE


def determined(effects: Sequence[Named], point: Point) -> tuple[tuple[Named, ...], dict[str, str]]:
    """The effects that are determined, with intervals cut to the physical range; name and reason of the others.

    Args:
        point: a model of the vehicle, whose file gives the neutral values.
    """
    kept, gone = [], {}
    for effect in effects:
        candidate = Candidate(effect.name, tuple(effect.chosen.items()), tuple(effect.parameters))
        there = effect.confidence if effect.log_odds is None else float(expit(effect.log_odds))
        reason = not_determined(candidate, effect.parameters, point) or improbable(there)
        if reason:
            gone[effect.name] = reason
        else:
            possible = {n: _cut(v, *candidate.range_of(n)) for n, v in effect.parameters.items()}
            kept.append(replace(effect, parameters=possible))
    return tuple(kept), gone


def not_determined(candidate: Candidate, parameters: Mapping[str, Value], point: Point) -> str:
    """Reason why an effect with these numbers is not determined; "" if it is."""
    neutral = candidate.neutral(point)
    for name, value in parameters.items():
        low, high = candidate.range_of(name)
        said = candidate.parameter(name).description
        if not all(map(math.isfinite, (value.value, value.sd, *value.ci95))):
            return f"not determined: its {said} has no finite size or interval"
        if not low <= value.value <= high:
            return f"not determined: its {said} would be {value.value:.3g}, and {low:.3g} to {high:.3g} is possible"
        if at_bound(value.value, (low, high), neutral[name]):
            return f"not determined: its {said} is at the end of what is possible, {value.value:.3g}"
        if not value.ci95[0] <= value.value <= value.ci95[1]:
            return f"not determined: its {said} is outside of its own interval"
    amplitude = CATALOGUE[candidate.effect].amplitude
    saying = {n: v for n, v in parameters.items() if n == amplitude} or parameters
    if saying and all(v.ci95[0] <= neutral[n] <= v.ci95[1] for n, v in saying.items()):
        which = ", ".join(
            f"{candidate.parameter(n).description} {v.ci95[0]:.3g} to {v.ci95[1]:.3g} {v.unit}".rstrip()
            for n, v in saying.items()
        )
        return f"not determined: what is found is no surer than that there is none of it (95 %: {which})"
    return ""


def at_bound(value: float, ends: tuple[float, float], neutral: float) -> bool:
    """Whether a number is at an end of its range; neutral is no end."""
    near = CONFIDENCE.at_bound * max(abs(e) for e in ends)
    return min(abs(value - e) for e in ends) <= near and abs(value - neutral) > near


def _cut(value: Value, low: float, high: float) -> Value:
    """The value with its interval cut to a range that contains the value."""
    return replace(value, ci95=(max(value.ci95[0], low), min(value.ci95[1], high)))


def without_undetermined(
    data: Data,
    selection: Selection,
    balance: Balance | None,
    say: Callable[[str], None],
    *,
    extra: Collection[str] = (),
) -> tuple[Selection, Balance | None, dict[str, str]]:
    """The selection fitted again without undetermined effects, the weakest first; its balance; names and reasons.

    If only some numbers of an effect are at an end (the height of a load), these are held at neutral, and the others
    may be determined. Effects in `extra`, which are written whatever their size (a trim), stay in the selection.
    """
    gone: dict[str, str] = {}
    while True:
        numbers, taken = numbers_of(data, selection, balance), selection.taken.values()
        doubtful = [
            (trial.evidence, candidate, found, reason)
            for trial, candidate, found, order in zip(taken, selection.accepted, numbers, selection.orders())
            if candidate.effect not in extra
            and (reason := not_determined(candidate, found, selection.final) or improbable(trial.presence(order)))
        ]
        if not doubtful:
            return selection, balance, gone
        _, candidate, found, reason = min(doubtful, key=lambda entry: entry[0])
        fewer = _without_ends(candidate, found, selection.final)
        if fewer is not None:
            say(f"  held at none, as it is at the end of what is possible: {set(candidate.free) - set(fewer.free)}")
            selection = _held(data, selection, candidate, fewer)
        else:
            say(f"  left out again, {reason}: {candidate.label}")
            gone[candidate.effect] = reason
            selection = left_out(data, selection, candidate)
        selection, balance = by_balance(data, with_exact_torques(data, selection))


def _without_ends(candidate: Candidate, found: Mapping[str, Value], point: Point) -> Candidate | None:
    """The candidate without numbers at an end; None if there are none, or if no number or no amplitude would remain."""
    neutral, amplitude = candidate.neutral(point), CATALOGUE[candidate.effect].amplitude
    rest = tuple(
        n for n in candidate.free if not at_bound(found[n].value, candidate.range_of(n), float(neutral[n]))
    )  # fmt: skip
    if rest == candidate.free or not rest or (amplitude in candidate.free and amplitude not in rest):
        return None
    return replace(candidate, free=rest)


def _held(data: Data, selection: Selection, candidate: Candidate, fewer: Candidate) -> Selection:
    """The selection fitted again with fewer numbers of an effect free, the others at neutral."""
    point, neutral = selection.final, candidate.neutral(selection.final)
    values = {n: v if n in fewer.free else neutral[n] for n, v in candidate.values(point).items()}
    accepted = [fewer if c is candidate else c for c in selection.accepted]
    fitted = refine_base(data, point.with_effects({candidate.effect: values}), accepted)
    return replace(selection, final=fitted.point, fitted=fitted, accepted=tuple(accepted))
