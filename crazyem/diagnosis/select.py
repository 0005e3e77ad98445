"""Which effects a flight asks for: one after the other, each fitted together with those before it, with a stop rule.

Each turn one pass gives score and information of every candidate (`gram`); the most promising are fitted without the
linear approximation, and compared by what they gain beyond their number of parameters, on the flights fitted (in
units in which scores scatter as they should) and on those held out. What comes close to the winner is kept as a
look-alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.always import TRIM, by_gain, nuisances, on_held_out, refine_base, solved, with_nuisances, without
from crazyem.diagnosis.candidates import Candidate
from crazyem.diagnosis.fit import TORQUES, Data, Fitted, held_near, moved, remembering_anew
from crazyem.diagnosis.gram import Gram, Solution
from crazyem.diagnosis.model import Column, Point
from crazyem.diagnosis.onset import date, onset_of
from crazyem.diagnosis.restless import beside_peaks, peaks

ADMITTED = 8.0  # nats of evidence that an effect must bring
WANDERING = 10.0  # nats that disturbing torques with memory must gain to be allowed for
HELD = 3.0  # nats it must bring on flight held out
SURE = 1e-3  # p-value of the score test, before counting candidates,
LIKELY = 1e-2  # which flights held out may lower where it is below this
SHORTLIST = 6
WORTH, ANYWAY = 0.15, 3  # share of the largest linear gain from which a candidate is fitted, and how many are anyway
CLOSE = 4.0  # nats within which two explanations cannot be told apart,
TOLD = 1.64  # or standard deviations of the difference of their likelihoods, over blocks
MOST = 4  # effects
# Smaller than this, these are not told from what filters and sampling do: s, s, 1, rad, rad/s, 1.
LEAST = {"measurement_delay": 3e-3, "input_delay": 4e-3, "velocity_scale": 0.05, "attitude_misalignment": 2e-3,
         "gyro_bias": 3e-3, "torque_scale": 0.05}  # fmt: skip
LEAST_INERTIA = 0.06  # relative, the same
LEAST_CENTRE = {"x": 1e-4, "y": 1e-4, "z": 1e-3}  # m; z shows in lateral accelerations of O alone


@dataclass(frozen=True)
class Trial:
    """A candidate, tried beside the effects already found.

    Attributes:
        candidate: which.
        gain: log-likelihood beyond the model before it [nats], on the flights fitted.
        held_out: the same on held-out flights or blocks.
        dispersion: by how much scores scatter more than the model says.
        p_value: of the score test.
        evidence: what counts: gain over dispersion less the number of parameters, and the held-out gain.
        fitted: the model with it; None if only the linear approximation was looked at.
        blocks: (b,) its log-likelihood by blocks of the flights fitted and of those held out.
    """

    candidate: Candidate
    gain: float
    held_out: float
    dispersion: float
    p_value: float
    evidence: float
    fitted: Fitted | None = None
    blocks: NDArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Step:
    """One turn of the selection: all trials, best first, and which was taken (None: the end)."""

    trials: tuple[Trial, ...]
    taken: Trial | None
    alike: tuple[Trial, ...] = ()


@dataclass(frozen=True)
class Selection:
    """What was selected: the nominal model, the final one, and how it came about."""

    nominal: Point
    final: Point
    steps: tuple[Step, ...]
    accepted: tuple[Candidate, ...]
    fitted: Fitted
    tried: int


def linear_trials(
    data: Data, point: Point, accepted: Sequence[Candidate], candidates: Sequence[Candidate]
) -> list[tuple[Trial, Solution]]:
    """What each candidate would gain in the linear approximation, best first. The last columns are the candidate's."""
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
    weights = np.array([0.0 for c in accepted for _ in c.free] + [w for _, p in free for w in p])
    low = np.array([b for c in base for b in c.bounds(point)[0]])
    high = np.array([b for c in base for b in c.bounds(point)[1]])
    away = [c.neutral(point)[n] - c.values(point)[n] for c, _ in free for n in c.free]
    centre = np.array([0.0 for c in accepted for _ in c.free] + away)
    wide_low, wide_high = low, high
    low, high = held_near(low, high, -centre, weights)
    zero = gram.solve(always, precision=weights, prior=centre, low=low, high=high) if always else None
    gain0, held0 = (zero.gain, zero.held_out) if zero else (0.0, 0.0)
    found = []

    def judge(c: Candidate, order: list[int], w: NDArray, lo: NDArray, hi: NDArray, mid: NDArray) -> None:
        k = len(c.free)
        solution = gram.solve(order, precision=w, prior=mid, low=lo, high=hi, tested=range(len(order) - k, len(order)))
        dispersion = max(1.0, gram.solve(order[-k:]).dispersion)
        gain, held = solution.gain - gain0, solution.held_out - held0
        p_value = by_gain(point, gain / dispersion, k, len(gram.score), solution.p_value)
        found.append((Trial(c, gain, held, dispersion, p_value, gain / dispersion - k), solution))

    for c, mine in zip(tested, index[len(base) :], strict=True):
        later = onset_of(data, c, gram, mine)
        if later is not None:
            found += linear_trials(data, point, accepted, [later])
        lo, hi = (np.array(b) for b in c.bounds(point))
        judge(c, always + mine, np.append(weights, np.zeros(len(mine))), np.append(low, lo), np.append(high, hi),
              np.append(centre, np.zeros(len(mine))))  # fmt: skip
    for c in tested_nuisances:
        mine = index[base.index(c)]
        order = [*(i for i in range(len(always)) if always[i] not in mine), *(always.index(i) for i in mine)]
        w = weights[order].copy()
        w[len(order) - len(mine) :] = 0.0
        near = order[: len(order) - len(mine)]
        lo = np.append(low[near], wide_low[order[len(near) :]])
        hi = np.append(high[near], wide_high[order[len(near) :]])
        judge(c, [always[i] for i in order], w, lo, hi, centre[order])
    return sorted(found, key=lambda t: -t[0].evidence)


def with_started(point: Point, candidate: Candidate, solution: Solution) -> Point:
    """The model with a candidate put in where the linear approximation says."""
    change = solution.theta[len(solution.theta) - len(candidate.free) :]
    if candidate.effect in point.effects and not candidate.begin:
        here = candidate.values(point)
        started = {
            n: float(np.clip(here[n] + d, candidate.parameter(n).low, candidate.parameter(n).high))
            for n, d in zip(candidate.free, change, strict=True)
        }
        return point.with_effects({candidate.effect: {**here, **started}})
    return point.with_effects({candidate.effect: candidate.started(point, change.tolist())})


def select(
    data: Data,
    nominal_point: Point,
    candidates: Sequence[Candidate],
    *,
    held_out: Data | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Selection:
    """The effects that the flights ask for."""
    point = nominal_point
    nominal_fit = refine_base(data, point, ())
    point = nominal_fit.point
    value = nominal_fit.loglik
    held_value = on_held_out(held_out, point, ()).loglik if held_out else 0.0
    accepted: list[Candidate] = []
    steps: list[Step] = []
    fitted = nominal_fit
    for turn in range(MOST + 1):
        rest = [c for c in candidates if all(c.effect != a.effect for a in accepted)]
        say(f"looking for effect {turn + 1} among {len(rest)} candidates")
        linear = linear_trials(data, point, accepted, rest)
        promising = shortlist(linear)
        trials = []
        for trial, solution in promising:
            say(f"  fitting {trial.candidate.label}")
            fit = refine_base(data, with_started(point, trial.candidate, solution), [*accepted, trial.candidate],
                              rounds=3, noise=False)  # fmt: skip
            gain = fit.loglik - value
            mine = [*accepted, trial.candidate]
            blocks = data.block_loglik(fit.point)
            held = trial.held_out
            if held_out:
                there = on_held_out(held_out, fit.point, mine)
                held, blocks = there.loglik - held_value, np.append(blocks, held_out.block_loglik(there.point))
            k = len(trial.candidate.free)
            wald_p = significance(fit, k, offset=sum(len(c.free) for c in accepted))
            wald_p = by_gain(point, gain / trial.dispersion, k, len(fit.gram.score), wald_p)
            sure = both(max(trial.p_value, wald_p), held / trial.dispersion if held_out else 0.0)
            sure = sure if matters(fit.point, trial.candidate) else 1.0
            trials.append(replace(trial, gain=gain, held_out=held, p_value=sure, fitted=fit,
                                  blocks=blocks))  # fmt: skip
        trials = weighed(trials, counted=held_out is not None)
        rest_trials = [t for t, _ in linear if all(t.candidate is not p.candidate for p in trials)]
        best = trials[0] if trials else None
        enough = (
            best is not None and own_evidence(best, counted=held_out is not None) > ADMITTED and best.p_value < SURE
        )
        if not enough or turn == MOST:
            steps.append(Step((*trials, *rest_trials), None))
            break
        assert best is not None
        assert best.fitted is not None
        equals = [best, *(t for t in trials[1:] if t.p_value < SURE and not told_apart(best, t))]
        simplest = min(equals, key=lambda t: (len(t.candidate.free), -t.evidence))
        if own_evidence(simplest, counted=held_out is not None) > ADMITTED:
            best = simplest
        assert best.fitted is not None
        alike = tuple(t for t in equals if t.candidate.effect != best.candidate.effect)
        steps.append(Step((*trials, *rest_trials), best, alike))
        dated, candidate = date(data, best.fitted, best.candidate)
        accepted.append(candidate)
        say(f"  found {candidate.label}: {best.evidence:.1f} nats")
        fitted = refine_base(data, remembering_anew(data, dated.point), accepted)
        point, value = fitted.point, fitted.loglik
        held_value = on_held_out(held_out, point, accepted).loglik if held_out else 0.0
    fitted, accepted, steps = drop(data, fitted, accepted, steps, held_out, say)
    if TRIM not in point.vehicle.effects:  # both judge by the scatter of blocks (see `by_gain`)
        fitted, accepted, steps = outlive(data, nominal_point, fitted, accepted, steps, say)
        fitted, accepted, steps = survive(data, fitted, accepted, steps, held_out, say)
    point = fitted.point
    return Selection(nominal_fit.point, point, tuple(steps), tuple(accepted), fitted, len(candidates))


def margin(best: Trial, other: Trial) -> tuple[float, float]:
    """Log-likelihood of one less that of the other, each less its number of parameters, with its standard deviation.

    The scatter of the difference over blocks counts, in which all that both miss cancels (Vuong 1989), with half of the
    covariance of neighbours on each side.
    """
    d = best.blocks - other.blocks
    centred = d - d.mean()
    variance = float(centred @ centred + max(0.0, float(centred[1:] @ centred[:-1])))
    return float(d.sum()) - len(best.candidate.free) + len(other.candidate.free), float(np.sqrt(variance)) + 1e-9


def told_apart(best: Trial, other: Trial) -> bool:
    """Whether the flights prefer the one by more than chance."""
    nats, sd = margin(best, other)
    return nats > CLOSE and nats > TOLD * sd


def shortlist(linear: Sequence[tuple[Trial, Solution]]) -> list[tuple[Trial, Solution]]:
    """Those worth a fit of their own: the largest gains, and the largest when scatter is allowed for; one beginning of
    each."""
    sound = [t for t in linear if t[0].evidence > 2.0 and t[0].p_value < 0.03]
    chosen: list[tuple[Trial, Solution]] = []
    least = WORTH * max((t.gain for t, _ in sound), default=0.0)
    by_gain = sorted(sound, key=lambda t: 2 * len(t[0].candidate.free) - t[0].gain)
    for entry in [x for pair in zip(by_gain, sound, strict=True) for x in pair]:
        c = entry[0].candidate
        twins = [t for t, _ in chosen if t.candidate.effect == c.effect]
        same = any(t.candidate.fixed == c.fixed and t.candidate.free == c.free for t in twins)
        if not same and len(twins) < 2 and (entry[0].gain > least or len(chosen) < ANYWAY):
            chosen.append(entry)
        if len(chosen) == SHORTLIST:
            break
    return chosen


def weighed(trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """Evidence of each, the same dispersion for all so that likelihoods are compared and not scatters; best first."""
    if not trials:
        return []
    common = float(np.median([t.dispersion for t in trials]))
    judged = [
        replace(t, evidence=(t.gain + (t.held_out if counted else 0.0)) / common - len(t.candidate.free))
        for t in trials
    ]
    return sorted(judged, key=lambda t: (t.p_value >= SURE, -t.evidence))


def both(p_value: float, held: float) -> float:
    """p-value on the flights fitted and on those held out, where the effect as fitted brings `held` nats.

    By chance a likelihood ratio of fixed models exceeds exp(held) with a probability of at most exp(-held).
    """
    return p_value * float(np.exp(-max(held, 0.0))) if p_value < LIKELY else p_value


def own_evidence(trial: Trial, *, counted: bool) -> float:
    """Evidence by the candidate's own scatter: what it must bring to be admitted."""
    return (trial.gain + (trial.held_out if counted else 0.0)) / trial.dispersion - len(trial.candidate.free)


def significance(fitted: Fitted, count: int, *, offset: int) -> float:
    """p-value that `count` free parameters from `offset` on are neutral, by their covariance at the maximum (Wald)."""
    solution, taken = solved(fitted)
    at = slice(offset, offset + count)
    away = np.array([c.values(fitted.point)[n] - c.neutral(fitted.point)[n] for c in fitted.candidates for n in c.free])
    return wald(away[at], solution.covariance[at, at], fitted.gram, taken)


def wald(away: NDArray, covariance: NDArray, gram: Gram, columns: float) -> float:
    """p-value that parameters (k,) `away` from neutral with a covariance (k, k) are neutral, of so many columns."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    z = away / scale
    distance = float(z @ np.linalg.lstsq(covariance / np.outer(scale, scale), z, rcond=1e-9)[0])
    return float(stats.f.sf(distance / len(z), len(z), max(len(gram.score) - columns, 3)))


def matters(point: Point, candidate: Candidate) -> bool:
    """Whether the effect is larger than what an onboard filter or the sampling of a log looks like."""
    least = LEAST.get(candidate.effect)
    here, neutral = candidate.values(point), candidate.neutral(point)
    if candidate.effect == "center_of_mass":
        return any(abs(here[n] - neutral[n]) > LEAST_CENTRE[n] for n in candidate.free)
    if candidate.effect == "inertia":
        return any(abs(here[n] / neutral[n] - 1.0) > LEAST_INERTIA for n in candidate.free)
    if least is None:
        return True
    return any(abs(here[n] - neutral[n]) > least for n in candidate.free)


def drop(
    data: Data,
    fitted: Fitted,
    accepted: list[Candidate],
    steps: list[Step],
    held_out: Data | None,
    say: Callable[[str], None],
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Leave out again what the final model does not need, on the flights fitted or on those held out."""
    accepted, steps = list(accepted), list(steps)
    while accepted:
        here = data.loglik(fitted.point, passes=2)
        held_here = on_held_out(held_out, fitted.point, accepted).loglik if held_out else 0.0
        judged = []
        for c in accepted:
            rest = [a for a in accepted if a is not c]
            bare = without(fitted.point, c.effect)
            less = refine_base(data, bare, rest, rounds=2, noise=False)
            step = next(s for s in steps if s.taken and s.taken.candidate.effect == c.effect)
            assert step.taken is not None
            gain = (here - less.loglik) / step.taken.dispersion
            held = held_here - on_held_out(held_out, less.point, rest).loglik if held_out else 0.0
            held /= step.taken.dispersion
            judged.append((gain - len(c.free) + held, gain, held, c, less))
            now = replace(step.taken, gain=gain * step.taken.dispersion, held_out=held * step.taken.dispersion)
            steps = [replace(s, taken=now) if s is step and held_out else s for s in steps]
        worst = min(judged, key=lambda j: min(j[0], j[2] + ADMITTED - HELD if held_out else j[0]))
        if worst[0] > ADMITTED and (held_out is None or worst[2] > HELD):
            break
        say(f"  left out again: {worst[3].label}")
        accepted.remove(worst[3])
        steps = [s for s in steps if s.taken is None or s.taken.candidate.effect != worst[3].effect]
        fitted = refine_base(data, worst[4].point, accepted)
    return fitted, accepted, steps


def survive(
    data: Data,
    fitted: Fitted,
    accepted: list[Candidate],
    steps: list[Step],
    held_out: Data | None,
    say: Callable[[str], None],
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Leave out what is no longer significant once torques may wander: noise with memory looks like a wrong inertia."""
    while accepted:
        noise = replace(fitted.point.noise, disturbance=np.concatenate([np.zeros(3), TORQUES]), memory=1.0)
        point = data.fit_noise(replace(fitted.point, noise=noise), iterations=5)
        if data.loglik(point, passes=2) < data.loglik(fitted.point, passes=2) + WANDERING:
            break
        wandering = refine_base(data, point, accepted, rounds=2, noise=False)
        sure, offset = [], 0
        for c in accepted:
            p_value = significance(wandering, len(c.free), offset=offset)
            if held_out and SURE <= p_value < LIKELY:
                taken = next(s.taken for s in steps if s.taken and s.taken.candidate.effect == c.effect)
                p_value = both(p_value, held_gain(data, held_out, wandering, accepted, c) / taken.dispersion)
            sure.append(p_value)
            offset += len(c.free)
        worst = int(np.argmax(sure))
        if sure[worst] < SURE:
            break
        say(f"  left out again, torques may wander: {accepted[worst].label}")
        fitted, accepted, steps = left_out(data, fitted, accepted, steps, accepted[worst])
    return fitted, accepted, steps


def held_gain(data: Data, held_out: Data, fitted: Fitted, accepted: Sequence[Candidate], candidate: Candidate) -> float:
    """What an effect as fitted gains on flights held out [nats]."""
    rest = [a for a in accepted if a is not candidate]
    less = refine_base(data, without(fitted.point, candidate.effect), rest, rounds=2, noise=False)
    there = on_held_out(held_out, fitted.point, accepted).loglik
    return there - on_held_out(held_out, less.point, rest).loglik


def outlive(
    data: Data, nominal: Point, fitted: Fitted, accepted: list[Candidate], steps: list[Step], say: Callable[[str], None]
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Leave out what speaks in a hump of the spectrum only: the loop answers a vibration, so gains seem wrong there."""
    found = [peaks(m, nominal) for m in data.models]  # before what is always free gave way to them
    while accepted and any(found):
        free = [*accepted, *(c for c, _ in nuisances(data, fitted.point, accepted))]
        gram = beside_peaks(data, fitted.point, [x for c in free for x in c.columns(fitted.point)], found)
        here = np.array([c.values(fitted.point)[n] - c.neutral(fitted.point)[n] for c in free for n in c.free])
        away = np.where(fitted.precision > 0, here, 0.0)
        solution = gram.solve(range(gram.size), precision=fitted.precision, prior=-away)
        sure, offset = [], 0
        for c in accepted:
            at = slice(offset, offset + len(c.free))
            p_value = wald(here[at] + solution.theta[at], solution.covariance[at, at], gram, gram.size)
            there = moved(fitted.point, accepted, solution.theta[: sum(len(a.free) for a in accepted)])
            sure.append(p_value if matters(there, c) else 1.0)
            offset = at.stop
        worst = int(np.argmax(sure))
        if sure[worst] < SURE:
            break
        say(f"  left out again, it speaks where something shakes only: {accepted[worst].label}")
        fitted, accepted, steps = left_out(data, fitted, accepted, steps, accepted[worst])
    return fitted, accepted, steps


def left_out(
    data: Data, fitted: Fitted, accepted: list[Candidate], steps: list[Step], candidate: Candidate
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Without one of the effects, fitted again."""
    rest = [a for a in accepted if a is not candidate]
    kept = [s for s in steps if s.taken is None or s.taken.candidate.effect != candidate.effect]
    return refine_base(data, without(fitted.point, candidate.effect), rest), rest, kept


def exchanged(data: Data, selection: Selection, old: Candidate, new: Candidate, values: Sequence[float]) -> Selection:
    """The selection with an effect in the place of another, its free parameters beginning at `values`."""
    bare = without(selection.final, old.effect)
    point = bare.with_effects({new.effect: {**new.neutral(bare), **dict(zip(new.free, values, strict=True))}})
    accepted = tuple(new if c is old else c for c in selection.accepted)
    fitted = refine_base(data, point, accepted, rounds=3, noise=False)
    steps = tuple(
        replace(s, taken=replace(s.taken, candidate=new)) if s.taken and s.taken.candidate.effect == old.effect else s
        for s in selection.steps
    )
    return replace(selection, final=fitted.point, fitted=fitted, accepted=accepted, steps=steps)
