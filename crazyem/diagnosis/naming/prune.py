"""Backward elimination of effects that are improbable beside the others, not determined, or predict flights worse.

A reported number lies inside its interval, and the interval inside the physical range. A number at the end of its range
stands for something else. If all intervals of an effect contain neutral, the flights do not show the effect. Both are
"not determined": the effect is no finding and no part of the fitted vehicle, and the others are fitted again without
it. The rule is the same for all effects, by whichever likelihood they were found.

The likelihood judges predictions of one step. There a control loop that answers an unknown vibration or wind makes
inertias, lags and torques look wrong: they gain thousands of nats, but spoil predictions within a tenth of a second. A
real effect improves predictions, or leaves them as they are where it hardly matters.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import expit

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import (
    can_be_finding,
    held_out_fit,
    held_out_twin,
    nuisances,
    refine_base,
    without,
)
from crazyem.diagnosis.flights.flight import without as without_signals
from crazyem.diagnosis.naming.answer import Named, Value, numbers_of
from crazyem.diagnosis.naming.balance import Balance, by_balance
from crazyem.diagnosis.naming.evidence import expected_gain, is_implausible
from crazyem.diagnosis.naming.steady import with_exact_torques
from crazyem.diagnosis.naming.trials import Selection, Trial, dispersion_of, improbable
from crazyem.diagnosis.prediction.horizon import UNITS, HorizonErrors, errors, open_loop, windows
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.diagnosis.settings import CONFIDENCE, SELECTION
from crazyem.errors import DataError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle


def pruned(data: Data, selection: Selection, held_out: Data | None, say: Callable[[str], None]) -> Selection:
    """The selection without improbable effects, the most improbable left out first, whatever the order of finding.

    An effect stays if another would leave its physical range without it: a thrust curve without a thrust scale goes to
    the slope at which the thrust does not depend on the command. One that the balance of the flights decided stays, and
    so does a trim, which every real drone has.
    """
    held_out = held_out and held_out_twin(held_out, selection.final, selection.accepted)
    while selection.accepted:
        selection, bare = with_conditional_gains(data, held_out, selection)
        found = zip(selection.taken.values(), selection.orders(), selection.accepted, bare, strict=True)
        doubtful = [
            (trial.presence(1), trial.presence(order), candidate, less)
            for trial, order, candidate, less in found
            if trial.log_odds is None and candidate.effect != TRIM
        ]
        for _, chance, candidate, less in sorted(doubtful, key=lambda entry: entry[0]):
            reason = improbable(chance)
            fitted = _fit_of_others(data, selection, less, candidate) if reason else None
            if fitted is not None:
                say(f"  left out again, improbable beside the others: {candidate.label}")
                left_out = {**selection.left_out, candidate.effect: reason}
                selection = replace(_without(selection, fitted, candidate), left_out=left_out)
                break
        else:
            break
    return selection


def _fit_of_others(data: Data, selection: Selection, less: Fitted, candidate: Candidate) -> Fitted | None:
    """The fit without an effect, from the fit `less`; None if another effect would leave its physical range."""
    rest = [c for c in selection.accepted if c is not candidate]
    fitted = refine_base(data, less.point, rest)
    if any(is_implausible(fitted.point, c) and not is_implausible(selection.final, c) for c in rest):
        data.settle(selection.final)
        return None
    return fitted


def with_conditional_gains(data: Data, held_out: Data | None, selection: Selection) -> tuple[Selection, list[Fitted]]:
    """The selection with the gain of each effect beside all the others, and the fits without each."""
    fitted, accepted = selection.fitted, selection.accepted
    here = data.loglik(fitted.point, passes=2)
    there = held_out_fit(held_out, fitted.point, accepted).loglik if held_out else 0.0
    trials = [replace(selection.taken[c.effect], candidate=c) for c in accepted]  # an accepted onset is dated
    bare = data.workers.map(partial(_fit_without, data, held_out, fitted, accepted), trials)
    for k, (c, trial, (less, held_less)) in enumerate(zip(accepted, trials, bare, strict=True)):
        dispersion = dispersion_of(fitted, len(c.free), offset=sum(len(a.free) for a in accepted[:k]))
        again = replace(selection.taken[c.effect], gain=here - less.loglik, dispersion=dispersion)
        if held_out:
            mean = _expected(held_out, fitted, accepted, trial)
            again = replace(again, held_out=there - held_less, expected=mean)
        selection = selection.with_step(c.effect, taken=again)
    return selection, [less for less, _ in bare]


def _expected(held_out: Data, fitted: Fitted, accepted: Sequence[Candidate], trial: Trial) -> float:
    """Mean gain of a real effect of this size on held-out flights [nats] (`evidence.expected_gain`)."""
    held_out, candidate = _constrained(held_out, trial), trial.candidate
    point = fitted.point if held_out.own is None else replace(fitted.point, noise=held_out.own.noise)
    rest = [c for c in accepted if c is not candidate]
    free = nuisances(held_out, point, accepted)
    columns = [x for c in [candidate, *rest, *(c for c, _ in free)] for x in c.columns(point)]
    held_out.settle(point)
    _, information = held_out.gram(point, columns).total(range(len(columns)))
    own = len(candidate.free)
    weight = np.array([0.0] * sum(len(c.free) for c in [candidate, *rest]) + [w for _, p in free for w in p])
    here, neutral = candidate.values(point), candidate.neutral(point)
    away = np.array([here[n] - neutral[n] for n in candidate.free])
    usual = {n: w for c, p in nuisances(held_out, point, ()) if c.effect == candidate.effect for n, w in zip(c.free, p)}
    spread = np.array([usual[n] ** -0.5 if n in usual else 0.0 for n in candidate.free])
    return expected_gain(information + np.diag(weight), slice(0, own), away, spread)


def _constrained(data: Data, trial: Trial) -> Data:
    """The flights without the nuisances that could stand for the effect; a nuisance could stand for itself."""
    mine = {trial.candidate.effect} if can_be_finding(trial.candidate) else set[str]()
    for name in mine | trial.constrained:
        data = data.constraining(name)
    return data


def _fit_without(
    data: Data, held_out: Data | None, fitted: Fitted, accepted: Sequence[Candidate], trial: Trial
) -> tuple[Fitted, float]:
    """The fit without one of the effects, and its log-likelihood on held-out flights; the data stay as they are."""
    rest = [a for a in accepted if a is not trial.candidate]
    here = _constrained(data.twin(), trial)
    less = refine_base(here, without(fitted.point, trial.candidate.effect), rest, rounds=2, noise=False)
    if held_out is None:
        return less, 0.0
    return less, held_out_fit(_constrained(held_out.twin(), trial), less.point, rest).loglik


def left_out(data: Data, selection: Selection, candidate: Candidate) -> Selection:
    """The selection without one of its effects, fitted again."""
    rest = [a for a in selection.accepted if a is not candidate]
    return _without(selection, refine_base(data, without(selection.final, candidate.effect), rest), candidate)


def _without(selection: Selection, fitted: Fitted, candidate: Candidate) -> Selection:
    """The selection without one of its effects, and with the fit of the others."""
    rest = tuple(a for a in selection.accepted if a is not candidate)
    left = selection.with_step(candidate.effect, taken=None, alike=())
    return replace(left, final=fitted.point, accepted=rest, fitted=fitted)


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


def without_worse_predictions(
    data: Data,
    selection: Selection,
    vehicle: Vehicle,
    recordings: Sequence[Recording],
    *,
    withhold: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Selection:
    """The selection without effects that make open-loop predictions of recordings worse than those by `vehicle`.

    Args:
        recordings: the held-out ones, or the fitted ones if there are none.
    """
    if data.coarse:  # the recorded commands lack the torques: no model predicts the rotation
        return selection
    shown = [without_signals(r, withhold) for r in recordings]
    nominal = [_errors_of(r, vehicle) for r in shown]

    def worse(accepted: Sequence[Candidate]) -> float:
        fitted = with_accepted_effects(vehicle, selection, accepted)
        return ratio(nominal, [_errors_of(r, fitted) for r in shown])

    while selection.accepted and worse(selection.accepted) > SELECTION.max_error_ratio:
        rest = [[a for a in selection.accepted if a is not c] for c in selection.accepted]
        misled = selection.accepted[int(np.argmin(data.workers.map(worse, rest)))]
        say(f"  left out again, flights are predicted worse with it: {misled.label}")
        selection = left_out(data, selection, misled)
    return selection


def with_accepted_effects(vehicle: Vehicle, selection: Selection, accepted: Sequence[Candidate]) -> Vehicle:
    """The vehicle with the accepted effects at their fitted values."""
    kept = {n: dict(v) for n, v in vehicle.effects.items()}
    for candidate in accepted:
        found = selection.final.effects.get(candidate.effect, {})
        kept[candidate.effect] = {k: v for k, v in found.items() if v is not None}
    return replace(vehicle, effects=kept)


def ratio(before: Sequence[HorizonErrors | None], after: Sequence[HorizonErrors | None]) -> float:
    """Geometric mean of errors after over errors before, for recordings, quantities and all horizons but the first; 1
    if there are none, inf if the model diverges."""
    found = [
        a.rms[name][k] / b.rms[name][k]
        for b, a in zip(before, after, strict=True)
        if a is not None and b is not None
        for name in UNITS
        for k in range(1, len(b.horizons))
        if np.isfinite(b.rms[name][k]) and b.rms[name][k] > 0 and not np.isnan(a.rms[name][k])
    ]
    return float(np.exp(np.mean(np.log(np.maximum(found, 1e-9))))) if found else 1.0


def _errors_of(recording: Recording, vehicle: Vehicle) -> HorizonErrors | None:
    """Errors of open-loop predictions by a vehicle; None where the recording has no complete states."""
    try:
        shown = recorded(recording, vehicle)
        at = windows(shown)
        return errors(open_loop(shown, at), at)
    except DataError:
        return None
