"""Forward selection of effects, with a stop rule.

Each turn adds one effect. One pass of the filter gives the score and the information of all candidates (`gram`). The
candidates with the largest linear gains are fitted in full. Their evidence is the gain over the dispersion, on fitted
and held-out flights, less the number of parameters. The best one joins the model; look-alikes are kept
beside it. In the end, effects that are improbable beside the others are left out again (`prune`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import (
    Data,
    DivergedError,
    Fitted,
    bounds_of,
    freedom_of,
    local_precision,
    nuisance_bounds,
)
from crazyem.diagnosis.fitting.gram import Solution, neutral_gain
from crazyem.diagnosis.fitting.model import Column, Point
from crazyem.diagnosis.fitting.nuisances import (
    can_be_finding,
    held_out_fit,
    held_out_twin,
    held_out_value,
    is_nonphysical,
    nuisances,
    refine_base,
    refine_with_memory,
    with_nuisances,
    without,
)
from crazyem.diagnosis.naming.balance import decided_by_balance
from crazyem.diagnosis.naming.evidence import accepted_covariance, exceeds_limit, joint_gain, occam_cost
from crazyem.diagnosis.naming.prune import pruned
from crazyem.diagnosis.naming.starting_points import best_starting_points, extend, onset_of
from crazyem.diagnosis.naming.steady import steady_rivals, without_trim_rivals
from crazyem.diagnosis.naming.trials import (
    Selection,
    Step,
    Trial,
    additions,
    by_evidence,
    dispersion_of,
    distinguishable,
    is_explanation,
)
from crazyem.diagnosis.settings import SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE


def linear_trials(
    data: Data,
    point: Point,
    accepted: Sequence[Candidate],
    candidates: Sequence[Candidate],
    *,
    instead_of: Candidate | None = None,
) -> list[tuple[Trial, Solution]]:
    """The trials of all candidates by the linear approximation, best first; a candidate's columns come last.

    instead_of: one of the accepted effects, in whose place the candidates are tried.
    """
    free = nuisances(data, point, accepted)
    point = with_nuisances(point, free)
    base = [*accepted, *(c for c, _ in free)]
    tested = [c for c in candidates if all(c.effect != n.effect for n, _ in free)]
    tested_nuisances = [n for n, _ in free if any(c.effect == n.effect for c in candidates)]
    columns: list[Column] = []
    index: list[list[int]] = []
    for c in [*base, *tested]:
        added = c.columns(point)
        index.append(list(range(len(columns), len(columns) + len(added))))
        columns += added
    gram = data.gram(point, columns)
    always = [i for group in index[: len(base)] for i in group]
    wide_low, wide_high = bounds_of(base, point)
    away = [c.neutral(point)[n] - c.values(point)[n] for c, _ in free for n in c.free]
    centre = np.array([0.0 for c in accepted for _ in c.free] + away)
    freedom = np.append(np.full(len(centre) - len(away), np.inf), freedom_of([c for c, _ in free]))
    weights = np.array([0.0 for c in accepted for _ in c.free] + [w for _, p in free for w in p])
    weights = local_precision(centre, weights, freedom)
    low, high = nuisance_bounds(wide_low, wide_high, -centre, weights, freedom)
    if instead_of is not None:
        gone = index[list(accepted).index(instead_of)]
        here, neutral = instead_of.values(point), instead_of.neutral(point)
        low[gone] = high[gone] = [neutral[n] - here[n] for n in instead_of.free]
    zero = gram.solve(always, precision=weights, prior=centre, low=low, high=high) if always else None
    gain0, held0 = (zero.gain, zero.held_out) if zero else (0.0, 0.0)
    found = []

    def judge(
        c: Candidate, order: list[int], w: NDArray, lo: NDArray, hi: NDArray, mid: NDArray,
        before: tuple[float, float] | None = None,
    ) -> None:  # fmt: skip
        k = len(c.free)
        solution = gram.solve(order, precision=w, prior=mid, low=lo, high=hi, tested=range(len(order) - k, len(order)))
        dispersion = max(1.0, gram.solve(order[-k:]).dispersion)
        gain, held = (now - then for now, then in zip((solution.gain, solution.held_out), before or (gain0, held0)))
        found.append((Trial(c, gain, held, dispersion, gain / dispersion - k), solution))

    for c, mine in zip(tested, index[len(base) :], strict=True):
        later = onset_of(data, point, c, gram, mine)
        if later is not None:
            found += linear_trials(data, point, accepted, [later])
        if decided_by_balance(point.vehicle, c):  # the balance decides on steady effects, not on later onsets
            continue
        lo, hi = (np.array(b) for b in c.bounds(point))
        judge(c, always + mine, np.append(weights, np.zeros(len(mine))), np.append(low, lo), np.append(high, hi),
              np.append(centre, np.zeros(len(mine))))  # fmt: skip
    for c in tested_nuisances:
        mine = index[base.index(c)]
        order = [*(i for i in range(len(always)) if always[i] not in mine), *(always.index(i) for i in mine)]
        w = weights[order].copy()
        w[len(order) - len(mine) :] = 0.0
        near = order[: len(order) - len(mine)]
        none = neutral_gain(gram, [always[i] for i in order], len(mine), w, low[near], high[near], centre[order])
        lo = np.append(low[near], wide_low[order[len(near) :]])
        hi = np.append(high[near], wide_high[order[len(near) :]])
        asked = next(a for a in candidates if a.effect == c.effect)
        judge(asked, [always[i] for i in order], w, lo, hi, centre[order], none if can_be_finding(c) else None)
    return sorted(found, key=lambda t: -t[0].evidence)


def at_linear_size(point: Point, candidate: Candidate, solution: Solution) -> Point:
    """The model with a candidate at the size of the linear approximation."""
    change = solution.theta[len(solution.theta) - len(candidate.free) :]
    if candidate.effect in point.effects and not candidate.begin:
        here = candidate.values(point)
        started = {
            n: float(np.clip(here[n] + d, candidate.parameter(n).low, candidate.parameter(n).high))
            for n, d in zip(candidate.free, change, strict=True)
        }
        return point.with_effects({candidate.effect: {**here, **started}})
    if candidate.likeliest:
        return point.with_effects({candidate.effect: {**candidate.neutral(point), **dict(candidate.begin)}})
    return point.with_effects({candidate.effect: candidate.started(point, change.tolist())})


@dataclass(frozen=True)
class Basis:
    """The flights and the model that a candidate is added to, and the model's log-likelihoods."""

    data: Data
    held_out: Data | None
    point: Point
    accepted: tuple[Candidate, ...]
    value: float
    held_value: float


def fitted_trial(basis: Basis, trial: Trial, solution: Solution, *, say: Callable[[str], None]) -> Trial:
    """The trial after a full fit; the basis stays as it is."""
    basis = constrained_basis(basis, trial.candidate)
    say(f"  fitting {trial.candidate.label}")
    return _refitted(basis, trial, at_linear_size(basis.point, trial.candidate, solution), noise=False)


def _refitted(basis: Basis, trial: Trial, start: Point, *, noise: bool) -> Trial:
    """The trial after a fit from a start, with its own noise scales or not; unfitted where the fit diverges."""
    data, mine = basis.data.twin(), [*basis.accepted, trial.candidate]
    try:
        if noise:
            fit = refine_with_memory(data, start, mine, rounds=3)
        else:
            fit = refine_base(data, start, mine, rounds=3, noise=False)
        return compared(basis, trial, data, fit)
    except DivergedError:  # the linear approximation went too far
        return trial


def constrained_basis(basis: Basis, candidate: Candidate) -> Basis:
    """The basis without an effect that is a nuisance and a possible finding, too."""
    name = candidate.effect
    if not can_be_finding(candidate) or name in basis.data.constrained:
        return basis
    data, apart = basis.data.constraining(name), basis.held_out and basis.held_out.constraining(name)
    fit = refine_base(data, without(basis.point, name), basis.accepted, rounds=3, noise=False)
    held = held_out_fit(apart.twin(), fit.point, basis.accepted).loglik if apart else 0.0
    return replace(basis, data=data, held_out=apart, value=fit.loglik, held_value=held)


def with_held_out_by(basis: Basis, trial: Trial) -> Basis:
    """The basis with the held-out flights as a trial has them: two explanations are compared in the noise of one."""
    if basis.held_out is None:
        return basis
    assert trial.fitted is not None
    apart = held_out_twin(basis.held_out, trial.fitted.point, [*basis.accepted, trial.candidate])
    before = held_out_fit(apart.twin(), basis.point, basis.accepted).loglik
    return replace(basis, held_out=apart, held_value=before)


def with_noise_refit(basis: Basis, trial: Trial) -> Trial:
    """A trial with its own noise scales: those of the model before it contain the effect, and hide the gain."""
    assert trial.fitted is not None
    return _refitted(constrained_basis(basis, trial.candidate), trial, trial.fitted.point, noise=True)


def compared(basis: Basis, trial: Trial, data: Data, fit: Fitted) -> Trial:
    """The trial with the gains of its fit, on the fitted flights (`data`) and on the held-out ones."""
    gain = fit.loglik - basis.value
    blocks, recording = data.block_loglik(fit.point), data.recordings_of_blocks()
    held, value, mine = trial.held_out, gain, [*basis.accepted, trial.candidate]
    if basis.held_out:
        apart = basis.held_out.twin()
        there = held_out_fit(apart, fit.point, mine)
        held = there.loglik - basis.held_value
        joint = joint_gain(fit, apart, there, mine)
        blocks = np.append(blocks, joint.blocks)
        recording = np.append(recording, len(data.models) + apart.recordings_of_blocks())
        value += held + joint.gain
        covariance = joint.covariance
    else:
        covariance = accepted_covariance(fit, mine)
    k = len(trial.candidate.free)
    return replace(
        trial,
        gain=gain,
        held_out=held,
        dispersion=dispersion_of(fit, k, offset=sum(len(c.free) for c in basis.accepted)),
        admissible=exceeds_limit(fit.point, trial.candidate, data),
        fitted=fit,
        blocks=blocks,
        value=value,
        recording=recording,
        parameter_cost=occam_cost([trial.candidate], covariance[-k:, -k:]),
        constrained=data.constrained,
    )


def compatible(effect: str, found: set[str]) -> bool:
    """Whether an effect may be added to those found: not twice, and not beside another form of itself."""
    together = {effect, *found}
    same_again = any(group <= together for name in together for group in CATALOGUE[name].never_beside)
    return effect not in found and not found & set(CATALOGUE[effect].twins) and not same_again


def step_of(basis: Basis, linear: Sequence[tuple[Trial, Solution]], *, say: Callable[[str], None]) -> Step:
    """One turn of the selection: candidates with large gains are fitted, the best is taken if it is an explanation."""
    counted = basis.held_out is not None
    fitted = basis.data.workers.map(lambda entry: fitted_trial(basis, *entry, say=say), shortlist(linear))
    trials = by_evidence([t for t in fitted if t.fitted is not None], counted=counted)
    rest = [t for t, _ in linear if all(t.candidate is not p.candidate for p in trials)]
    if trim := next((t for t in trials if t.candidate.effect == TRIM and is_explanation(t, counted=counted)), None):
        return Step(
            (*trials, *rest), trim, steady_rivals(trim, [t for t in trials if is_explanation(t, counted=counted)])
        )
    if not trials or not is_explanation(trials[0], counted=counted):
        return Step((*trials, *rest), None)
    trials, equals = compared_with_refitted_noise(basis, trials, say=say)
    return Step((*trials, *rest), equals[0], tuple(t for t in equals[1:] if not _same_effect(t, equals[0])))


def constrained_step(
    basis: Basis,
    linear: Sequence[tuple[Trial, Solution]],
    candidates: Sequence[Candidate],
    *,
    say: Callable[[str], None],
) -> Step:
    """One turn of the selection, in which the best effect and its rivals have the same nuisances.

    An effect that is a nuisance, too, gains what it explains beyond a model without it. A rival would gain only what it
    explains beyond this nuisance. So rivals are fitted once more, without the nuisance.
    """
    step = step_of(basis, linear, say=say)
    taken, counted = step.taken, basis.held_out is not None
    if taken is None or taken.fitted is None:
        return step
    same = constrained_basis(basis, taken.candidate)
    if same is basis:
        return step
    name, point = taken.candidate.effect, taken.fitted.point
    data = same.data.twin()
    data.settle(point)
    others = [c for c in candidates if c.effect != name]
    linear = linear_trials(data, point, [*basis.accepted, taken.candidate], others, instead_of=taken.candidate)
    same = replace(same, point=without(point, name))
    rivals = basis.data.workers.map(lambda entry: fitted_trial(same, *entry, say=say), shortlist(linear))
    trials = by_evidence([taken, *(t for t in rivals if t.fitted is not None)], counted=counted)
    trials, equals = compared_with_refitted_noise(same, trials, say=say)
    rest = [t for t in step.trials if all(t.candidate.effect != r.candidate.effect for r in trials)]
    return Step((*trials, *rest), equals[0], tuple(t for t in equals[1:] if not _same_effect(t, equals[0])))


def select(
    data: Data,
    nominal_point: Point,
    candidates: Sequence[Candidate],
    *,
    held_out: Data | None = None,
    begun: Selection | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Selection:
    """The effects that explain the flights, beyond those of the selection `begun`."""
    # with a trim in the file noise stays (`with_trim_noise`): a steady torque must not become a torque with memory
    begin = refine_base if TRIM in nominal_point.vehicle.effects else refine_with_memory
    fitted = begin(data, nominal_point, ()) if begun is None else begun.fitted
    nominal = fitted.point if begun is None else begun.nominal
    point, value = fitted.point, fitted.loglik
    accepted, steps = (list(begun.accepted), list(begun.steps)) if begun else ([], [])
    apart, held_value = held_out_value(held_out, point, accepted)
    first, reasons = len(accepted), begun.left_out if begun else {}
    while True:
        rest = [c for c in candidates if compatible(c.effect, {a.effect for a in accepted})]
        rest = without_trim_rivals(rest, accepted)
        say(f"looking for effect {len(accepted) + 1} among {len(rest)} candidates")
        rest = best_starting_points(data, point, accepted, rest)
        linear = linear_trials(data, point, accepted, rest)
        if len(accepted) > first:
            steps[-1] = replace(steps[-1], beside=additions(steps[-1], [t for t, _ in linear]))
        if len(accepted) >= SELECTION.max_effects:  # the linear trials show what stands beside the last
            steps.append(Step(tuple(t for t, _ in linear), None))
            break
        basis = Basis(data, apart, point, tuple(accepted), value, held_value)
        steps.append(constrained_step(basis, linear, rest, say=say))
        taken = steps[-1].taken
        if taken is None:
            break
        assert taken.fitted is not None
        say(f"  found {taken.candidate.label}: {taken.evidence:.1f} nats")
        extension = extend(data, held_out, taken.fitted, taken.candidate, accepted)
        if isinstance(extension, str):
            say(f"  left out again, {extension}: {taken.candidate.label}")
            steps.pop()
            candidates = [c for c in candidates if c.effect != taken.candidate.effect]
            data.settle(fitted.point)
            continue
        fitted, apart, held_value = extension
        accepted, point, value = list(fitted.candidates), fitted.point, fitted.loglik
        if is_nonphysical(point, accepted):  # `diagnose` reports that
            return Selection(nominal, point, tuple(steps), tuple(accepted), fitted, reasons)
    found = {c.effect for c in accepted}
    whole = Selection(nominal, point, tuple(steps), tuple(accepted), fitted, reasons)
    chosen = pruned(data, whole, held_out, say)
    gone = found - {c.effect for c in chosen.accepted}
    if not hid_another(whole.steps, gone, counted=held_out is not None):
        return chosen
    rest = [c for c in candidates if c.effect not in gone]
    return select(data, nominal_point, rest, held_out=held_out, begun=chosen, say=say)


def hid_another(steps: Sequence[Step], gone: set[str], *, counted: bool) -> bool:
    """Whether effects that are left out again may have hidden another: one was found after them, or they had rivals."""
    taken = [s for s in steps if s.taken]
    first = next((i for i, s in enumerate(taken) if s.taken and s.taken.candidate.effect in gone), len(taken))
    after = [s.taken.candidate.effect for s in taken[first:] if s.taken]
    others = [
        t.candidate.effect for s in taken[first : first + 1] for t in s.trials if is_explanation(t, counted=counted)
    ]
    return any(name not in gone for name in (*after, *others))


def shortlist(linear: Sequence[tuple[Trial, Solution]]) -> list[tuple[Trial, Solution]]:
    """The trials to be fitted: those of the largest gains and those of the largest evidence, one start of each."""
    sound = [t for t in linear if t[0].evidence > 2.0]
    chosen: list[tuple[Trial, Solution]] = []
    least = SELECTION.gain_share * max((t.gain for t, _ in sound), default=0.0)
    by_gain = sorted(sound, key=lambda t: 2 * len(t[0].candidate.free) - t[0].gain)
    for entry in [x for pair in zip(by_gain, sound, strict=True) for x in pair]:
        c = entry[0].candidate
        twins = [t for t, _ in chosen if t.candidate.effect == c.effect]
        same = any(t.candidate.fixed == c.fixed and t.candidate.free == c.free for t in twins)
        if not same and len(twins) < 2 and (entry[0].gain > least or len(chosen) < SELECTION.min_fitted):
            chosen.append(entry)
        if len(chosen) == SELECTION.max_fitted:
            break
    for name in [n for n, effect in CATALOGUE.items() if effect.twins]:
        for twin in CATALOGUE[name].twins:
            names = {t.candidate.effect for t, _ in chosen}
            if name in names and twin not in names:
                chosen += [e for e in linear if e[0].candidate.effect == twin][:1]
    chosen += [e for t, _ in chosen for e in imitators(t, chosen, linear)]
    asked = [e for e in linear if e[0].candidate.likeliest]
    asked += [e for e in linear if e[0].candidate.effect == TRIM][:1]
    return chosen + [e for e in asked if all(e is not c for c in chosen)]


def imitators(
    trial: Trial, chosen: Sequence[tuple[Trial, Solution]], linear: Sequence[tuple[Trial, Solution]]
) -> list[tuple[Trial, Solution]]:
    """Imitators of a trial, at a start where they differ from neutral: at neutral their scores say nothing."""
    found = []
    for name, begin in CATALOGUE[trial.candidate.effect].imitators.items():
        asked = [e for e in linear if e[0].candidate.effect == name][:1]
        if all(t.candidate.effect != name for t, _ in chosen):
            found += [
                (replace(t, candidate=replace(t.candidate, begin=tuple(begin.items()), likeliest=True)), s)
                for t, s in asked
            ]
    return found


def compared_with_refitted_noise(
    basis: Basis, trials: list[Trial], *, say: Callable[[str], None]
) -> tuple[list[Trial], list[Trial]]:
    """The trials, and the best of them with its look-alikes, each of these with its own noise scales.

    Trials with nearly the same gain are compared like this, too: the noise of a model without the effect contains much
    of the effect, and under that noise a wrong torque scale may be better than the right inertias.
    """
    counted = basis.held_out is not None
    equals = alike_with(trials[0], trials, counted=counted)
    turns = bool(CATALOGUE[trials[0].candidate.effect].twins)
    nearly = [
        t
        for t in trials
        if is_explanation(t, counted=counted)
        and (t.value > SELECTION.noise_share * trials[0].value or (turns and CATALOGUE[t.candidate.effect].twins))
    ]
    equals += [t for t in nearly[: SELECTION.max_compared] if all(t is not e for e in equals)]
    if len(equals) == 1:
        return trials, equals
    say(f"  comparing {', '.join(t.candidate.label for t in equals)}")
    again = basis.data.workers.map(partial(with_noise_refit, with_held_out_by(basis, trials[0])), equals)
    rest = [t for t in trials if all(t is not e for e in equals)]
    trials = by_evidence([*again, *rest], counted=counted)
    close = [t for t in trials if any(t.candidate is a.candidate for a in again)]
    explain = [t for t in close if t is close[0] or is_explanation(t, counted=counted)]
    # by the evidence on all flights: slow flights do not determine a drag
    best = max(explain, key=lambda t: t.worth)
    return trials, alike_with(best, close, counted=counted)


def alike_with(best: Trial, trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """The best trial and its look-alikes."""
    others = [t for t in trials if t is not best and is_explanation(t, counted=counted)]
    return [best, *(t for t in others if not distinguishable(best, t))]


def _same_effect(one: Trial, other: Trial) -> bool:
    return one.candidate.effect == other.candidate.effect
