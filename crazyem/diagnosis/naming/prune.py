"""Backward elimination: effects that the final model does not need, or that noise of another kind explains as well."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted
from crazyem.diagnosis.fitting.gram import used
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import (
    can_be_finding,
    held_out_fit,
    held_out_twin,
    nuisances,
    refine_base,
    without,
)
from crazyem.diagnosis.locating.random_torques import off_peak_gram, peaks
from crazyem.diagnosis.naming.detection_limits import is_implausible
from crazyem.diagnosis.naming.trials import Selection, Step, dispersion_of, p_value_of_both, significance, wald
from crazyem.diagnosis.settings import FITTING, SELECTION


def pruned(
    data: Data, nominal: Point, selection: Selection, held_out: Data | None, say: Callable[[str], None]
) -> Selection:
    """The selection without effects that are not needed, and with the doubted ones marked.

    `nominal` is the model before any nuisance is fitted.
    """
    fitted, accepted, steps = selection.fitted, list(selection.accepted), list(selection.steps)
    held_out = held_out and held_out_twin(held_out, fitted.point, accepted)
    fitted, accepted, steps = backward_elimination(data, fitted, accepted, steps, held_out, say)
    doubtful: frozenset[str] = frozenset()
    if TRIM not in selection.final.vehicle.effects:  # both judge by the scatter of blocks (see `by_gain`)
        fitted, accepted, steps = without_noise_look_alikes(data, fitted, accepted, steps, held_out, say)
        doubtful = vibration_look_alikes(data, nominal, fitted, accepted, say)
    return replace(
        selection, final=fitted.point, steps=tuple(steps), accepted=tuple(accepted), fitted=fitted, doubtful=doubtful
    )


def backward_elimination(
    data: Data,
    fitted: Fitted,
    accepted: list[Candidate],
    steps: list[Step],
    held_out: Data | None,
    say: Callable[[str], None],
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Leave out the effects that the fitted or the held-out flights do not need, the weakest first.

    An effect stays if another would leave its physical range without it: a thrust curve without a thrust scale goes to
    the slope at which the thrust does not depend on the command.
    """
    accepted, steps = list(accepted), list(steps)
    kept = [s.taken.candidate for s in steps if s.taken and s.taken.log_odds is not None]  # the balance decides
    while accepted:
        here = data.loglik(fitted.point, passes=2)
        held_here = held_out_fit(held_out, fitted.point, accepted).loglik if held_out else 0.0
        judged = []
        bare = data.workers.map(partial(fit_without, data, held_out, fitted, accepted), accepted)
        for k, (c, (less, held_less)) in enumerate(zip(accepted, bare, strict=True)):
            step = next(s for s in steps if s.taken and s.taken.candidate.effect == c.effect)
            assert step.taken is not None
            dispersion = dispersion_of(fitted, len(c.free), offset=sum(len(a.free) for a in accepted[:k]))
            gain, held = (here - less.loglik) / dispersion, (held_here - held_less) / dispersion
            need = -max(SELECTION.min_evidence, SELECTION.cost_share * gain)
            # held-out flights that should bring little of the gain cannot show the effect
            least = max(SELECTION.informative, SELECTION.cost_share * gain) * dispersion
            should = np.inf if held_out is None else expected(held_out, fitted, accepted, c)
            if should > least:
                need = SELECTION.min_held_out
            brings = gain - len(c.free) + held
            held_up = held + SELECTION.min_evidence - need if held_out else np.inf
            # an effect that no flight needs goes first: it may be why another fails on held-out flight
            judged.append(((brings > SELECTION.min_evidence, min(brings, held_up)), c, less))
            now = replace(
                step.taken, gain=gain * dispersion, held_out=held * dispersion, expected=should, dispersion=dispersion
            )
            steps = [replace(s, taken=now) if s is step and held_out else s for s in steps]
        worst = min((j for j in judged if j[1] not in kept), key=lambda j: j[0], default=None)
        if worst is None or worst[0][1] > SELECTION.min_evidence:
            break
        rest = [c for c in accepted if c is not worst[1]]
        bare_of_it = refine_base(data, worst[2].point, rest)
        if any(is_implausible(bare_of_it.point, c) and not is_implausible(fitted.point, c) for c in rest):
            say(f"  stays, because another would go on to the end of its range: {worst[1].label}")
            kept.append(worst[1])
            data.settle(fitted.point)
            continue
        say(f"  left out again: {worst[1].label}")
        accepted, fitted = rest, bare_of_it
        steps = [s for s in steps if s.taken is None or s.taken.candidate.effect != worst[1].effect]
    return fitted, accepted, steps


def expected(held_out: Data, fitted: Fitted, accepted: Sequence[Candidate], candidate: Candidate) -> float:
    """Mean gain of a real effect of this size on held-out flights [nats]: z'Az/2, all else profiled out.

    A hover says nothing of a damping, real or not. The bounds of nuisances are left out, so the value is rather too
    small: an order of magnitude.
    """
    point = fitted.point if held_out.own is None else replace(fitted.point, noise=held_out.own.noise)
    rest = [c for c in accepted if c is not candidate]
    free = nuisances(held_out, point, accepted)
    columns = [x for c in [candidate, *rest, *(c for c, _ in free)] for x in c.columns(point)]
    held_out.settle(point)
    _, information = held_out.gram(point, columns).total(range(len(columns)))
    own = len(candidate.free)
    weight = np.array([0.0] * sum(len(c.free) for c in [candidate, *rest]) + [w for _, p in free for w in p])
    a = information + np.diag(weight)
    inner = a[:own, :own] - a[:own, own:] @ np.linalg.lstsq(a[own:, own:], a[own:, :own], rcond=1e-12)[0]
    here, neutral = candidate.values(point), candidate.neutral(point)
    away = np.array([here[n] - neutral[n] for n in candidate.free])
    # an effect that is a nuisance, too, gains part of this without being a finding
    usual = {n: w for c, p in nuisances(held_out, point, ()) if c.effect == candidate.effect for n, w in zip(c.free, p)}
    spread = np.diag([usual[n] ** -0.5 if n in usual else 0.0 for n in candidate.free])
    inner = inner @ np.linalg.inv(np.eye(own) + spread @ spread @ inner)
    return 0.5 * float(away @ inner @ away)


def fit_without(
    data: Data, held_out: Data | None, fitted: Fitted, accepted: Sequence[Candidate], candidate: Candidate
) -> tuple[Fitted, float]:
    """The fit without one of the effects, and its log-likelihood on held-out flights; the data stay as they are."""
    rest = [a for a in accepted if a is not candidate]
    here, there = data.twin(), held_out.twin() if held_out else None
    if can_be_finding(candidate):
        here, there = here.constraining(candidate.effect), there and there.constraining(candidate.effect)
    less = refine_base(here, without(fitted.point, candidate.effect), rest, rounds=2, noise=False)
    return less, held_out_fit(there, less.point, rest).loglik if there else 0.0


def without_noise_look_alikes(
    data: Data,
    fitted: Fitted,
    accepted: list[Candidate],
    steps: list[Step],
    held_out: Data | None,
    say: Callable[[str], None],
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Leave out effects that are not significant beside disturbances with memory.

    Noise with memory looks like a wrong inertia, and gusts look like a wrong thrust curve. The test is on a copy of the
    data, so that the fit does not start from the model with disturbances.
    """
    while accepted:
        apart = data.twin()
        noise = replace(
            fitted.point.noise,
            disturbance=np.concatenate([np.full(3, FITTING.start_force), np.full(3, FITTING.start_torque)]),
            memory=1.0,
        )
        point = apart.fit_noise(replace(fitted.point, noise=noise))
        if apart.loglik(point, passes=2) < data.loglik(fitted.point, passes=2) + SELECTION.memory_gain:
            break
        with_memory = refine_base(apart, point, accepted, rounds=2, noise=False)
        sure, offset = [], 0
        for c in accepted:
            p_value = significance(with_memory, len(c.free), offset=offset)
            if held_out and SELECTION.p_value <= p_value < SELECTION.held_out_p_value:
                taken = next(s.taken for s in steps if s.taken and s.taken.candidate.effect == c.effect)
                p_value = p_value_of_both(
                    p_value, held_gain(data, held_out, with_memory, accepted, c) / taken.dispersion
                )
            sure.append(p_value)
            offset += len(c.free)
        worst = int(np.argmax(sure))
        if sure[worst] < SELECTION.p_value:
            break
        say(f"  left out again, disturbances with memory explain it: {accepted[worst].label}")
        fitted, accepted, steps = left_out(data, fitted, accepted, steps, accepted[worst])
    return fitted, accepted, steps


def held_gain(data: Data, held_out: Data, fitted: Fitted, accepted: Sequence[Candidate], candidate: Candidate) -> float:
    """Gain of a fitted effect on held-out flights [nats]."""
    there = held_out_fit(held_out, fitted.point, accepted).loglik
    return there - fit_without(data, held_out, fitted, accepted, candidate)[1]


def vibration_look_alikes(
    data: Data, nominal: Point, fitted: Fitted, accepted: Sequence[Candidate], say: Callable[[str], None]
) -> frozenset[str]:
    """Effects that have another size without the peaks of the spectrum than with them: a vibration explains them.

    The control loop answers a vibration, so gains, delays and inertias seem wrong at its frequency. A delay whose loop
    oscillates makes a peak, too. But the peak is gone in the model with the delay, or the delay has the same size
    without the peak.
    """
    found = [peaks(m, nominal) for m in data.models]  # before nuisances have fitted the peaks
    if not accepted or not any(found) or not any(peaks(m, fitted.point) for m in data.models):
        return frozenset()
    free = [*accepted, *(c for c, _ in nuisances(data, fitted.point, accepted))]
    columns = [x for c in free for x in c.columns(fitted.point)]
    here = np.array([c.values(fitted.point)[n] - c.neutral(fitted.point)[n] for c in free for n in c.free])
    away = np.where(fitted.precision > 0, here, 0.0)
    whole, beside = (
        (g, g.solve(range(g.size), precision=fitted.precision, prior=-away, effective=True))
        for g in (data.gram(fitted.point, columns), off_peak_gram(data, fitted.point, columns, found))
    )
    information = beside[0].total(range(beside[0].size))[1]
    taken = used(information, information + np.diag(fitted.precision))  # priors use no degrees of freedom
    doubtful, offset = [], 0
    for c in accepted:
        at = slice(offset, offset + len(c.free))
        offset = at.stop
        covariance = beside[1].covariance[at, at]
        size, apart = here[at] + whole[1].theta[at], beside[1].theta[at] - whole[1].theta[at]
        share = float(apart @ np.linalg.pinv(covariance) @ apart) / float(size @ np.linalg.pinv(covariance) @ size)
        if share > SELECTION.size_difference**2 and wald(apart, covariance, beside[0], taken) < SELECTION.hausman_p:
            say(f"  it has another size without the vibration: {c.label}")
            doubtful.append(c.effect)
    return frozenset(doubtful)


def left_out(
    data: Data, fitted: Fitted, accepted: list[Candidate], steps: list[Step], candidate: Candidate
) -> tuple[Fitted, list[Candidate], list[Step]]:
    """Without one of the effects, fitted again."""
    rest = [a for a in accepted if a is not candidate]
    kept = [s for s in steps if s.taken is None or s.taken.candidate.effect != candidate.effect]
    return refine_base(data, without(fitted.point, candidate.effect), rest), rest, kept
