"""Backward elimination: effects that are improbable beside the others are left out again."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted
from crazyem.diagnosis.fitting.nuisances import (
    can_be_finding,
    held_out_fit,
    held_out_twin,
    nuisances,
    refine_base,
    without,
)
from crazyem.diagnosis.naming.evidence import expected_gain, is_implausible
from crazyem.diagnosis.naming.trials import Selection, Trial, dispersion_of, improbable


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
