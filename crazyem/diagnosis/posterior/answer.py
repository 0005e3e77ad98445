"""What is told of a posterior: names, probabilities of inclusion, groups of look-alikes, sizes with intervals."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyem.diagnosis.naming.free import Free
from crazyem.diagnosis.naming.named import Named, Value
from crazyem.diagnosis.posterior.accelerometer import AccelerometerEffect
from crazyem.diagnosis.posterior.members import prior_odds
from crazyem.diagnosis.posterior.search import Neighbour, probabilities
from crazyem.diagnosis.posterior.settings import SETTINGS
from crazyem.diagnosis.posterior.study import Fit, Study
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.vehicle import Vehicle

Set = frozenset[str]


@dataclass(frozen=True)
class Beliefs:
    """A posterior over sets of effects: probabilities of sets, the best first."""

    models: tuple[tuple[Set, float], ...]

    def of(self, effect: str) -> float:
        """Probability that an effect is there."""
        return sum(p for s, p in self.models if effect in s)

    def instead(self, effect: str, best: Set) -> dict[str, float]:
        """Effects of models that lack one of the best model's, and that the best lacks: probability of those models."""
        found: dict[str, float] = {}
        for s, p in self.models:
            if effect not in s:
                for other in s - best:
                    found[other] = found.get(other, 0.0) + p
        return found


def beliefs_of(models: Sequence[Fit]) -> Beliefs:
    """Of models that were fitted, the most probable first."""
    return Beliefs(tuple(zip((m.effects for m in models), probabilities(models), strict=True)))


def log_odds(probability: float, bound: float = 700.0) -> float:
    """Of a probability."""
    if probability <= 0.0 or probability >= 1.0:
        return math.copysign(bound, probability - 0.5)
    return math.log(probability / (1.0 - probability))


@dataclass(frozen=True)
class PosteriorAnswer:
    """Effects, strongest first; groups that are not told apart; what would tell them apart; reasons for the rest."""

    effects: tuple[Named, ...]
    groups: tuple[tuple[str, ...], ...]
    separate: tuple[str, ...]


def answer_of(study: Study, models: Sequence[Fit], felt: Sequence[AccelerometerEffect]) -> PosteriorAnswer:
    """What a posterior over models says."""
    best, beliefs = models[0], beliefs_of(models)
    found: list[tuple[float, Named]] = []
    groups: list[tuple[str, ...]] = []
    for effect in best.effects:
        rivals = beliefs.instead(effect, best.effects)
        group = [r for r, p in sorted(rivals.items(), key=lambda r: -r[1]) if p > SETTINGS.look_alike_probability]
        probability = beliefs.of(effect)
        together = probability + sum(
            p for s, p in beliefs.models if effect not in s and any(r in s for r in group)
        )  # fmt: skip
        if together < SETTINGS.naming_probability or CATALOGUE[effect].prior.unnamed:
            continue
        odds = _gain(effect, models)
        found.append((odds, named(study, best, effect, probability, odds)))
        known = [r for r in group if not CATALOGUE[r].prior.unnamed]
        if known and probability < SETTINGS.separate_probability:
            groups.append((effect, *known))
    for one in felt:
        if one.odds > log_odds(SETTINGS.naming_probability):
            probability = 1.0 / (1.0 + math.exp(-min(one.odds, 50.0)))
            mean, sd = one.posterior.mean, np.sqrt(np.diag(one.posterior.covariance))
            values = {
                n: _value(one.candidate, n, m, s, study) for n, m, s in zip(one.candidate.free, mean, sd, strict=True)
            }
            name = one.candidate.effect
            found.append((one.odds, _entry(name, one.candidate.label, values, {}, probability, one.odds)))
    found.sort(key=lambda entry: -entry[0])
    separate = dict.fromkeys(CATALOGUE[n].separates for g in groups for n in g if CATALOGUE[n].separates)
    return PosteriorAnswer(tuple(n for _, n in found), tuple(groups), tuple(separate))


def _gain(effect: str, models: Sequence[Fit]) -> float:
    """Log evidence of the best model over the best without an effect."""
    without = [m.value for m in models if effect not in m.effects]
    return models[0].value - max(without) if without else prior_odds()


def named(study: Study, best: Fit, effect: str, probability: float = math.nan, odds: float = math.nan) -> Named:
    """An effect of a fitted model, with its numbers."""
    random = next((e for e in study.pool.random if e.name == effect), None)
    if random is not None:
        return _random(study, best, effect, probability, odds)
    k = 0
    for m in best.members:
        size = len(m.candidate.free)
        if m.effect == effect:
            c, scatter = m.candidate, best.look.shared.scatter[list(best.look.places[m.candidate])]
            sd = np.sqrt(np.diag(best.posterior.covariance)[k : k + size] * scatter)
            mean = best.posterior.mean[k : k + size]
            values = {n: _value(c, n, a, s, study) for n, a, s in zip(c.free, mean, sd, strict=True)}
            return _entry(effect, c.label, values, dict(c.fixed), probability, odds)
        k += size
    raise KeyError(effect)


def _random(study: Study, best: Fit, effect: str, probability: float, odds: float) -> Named:
    values = study.size_of(CATALOGUE[effect], best)
    seconds = sum(f.duration for d in best.data for f in d.flights)
    told = {n: 1.0 / math.sqrt(max(3.0 * seconds / SETTINGS.correlation_time, 2.0)) for n in values}
    found = {}
    for p in CATALOGUE[effect].parameters:
        value, sd = values[p.name], values[p.name] * (told[p.name] if p.name == CATALOGUE[effect].amplitude else 0.5)
        found[p.name] = Value(value, p.unit, sd, (max(value - 1.96 * sd, p.low), value + 1.96 * sd))
    return _entry(effect, effect, found, {}, probability, odds)


def _value(candidate: Any, name: str, mean: float, sd: float, study: Study) -> Value:
    p, (low, high) = candidate.parameter(name), candidate.range_of(name)
    value = float(candidate.neutral(study.points[0])[name] + mean)
    return Value(value, p.unit, float(sd), (max(value - 1.96 * sd, low), min(value + 1.96 * sd, high)))


def _entry(
    name: str, label: str, values: dict[str, Value], chosen: dict[str, object], probability: float, odds: float
) -> Named:
    return Named(name, label, values, chosen, math.nan, math.nan, probability, log_odds=odds)


def fitted_vehicle(vehicle: Vehicle, effects: Sequence[Named], kinds: Collection[str]) -> dict[str, dict[str, Any]]:
    """Effects of a vehicle with those that were named and belong to one of some kinds."""
    found = {n: dict(v) for n, v in vehicle.effects.items()}
    for e in effects:
        if CATALOGUE[e.name].belongs_to in kinds:
            values = {**e.chosen, **{n: v.value for n, v in e.parameters.items()}}
            found[e.name] = {**found.get(e.name, {}), **{n: v for n, v in values.items() if v is not None}}
    return found


def left_free(study: Study, best: Fit) -> tuple[Free, ...]:
    """What differs from recording to recording anyway, as it came out."""
    found = []
    for f, point in enumerate(best.points):
        free, covariance = best.look.shared.deviations(f)
        for c, table in study.pool.usual:
            neutral, values = c.neutral(point), c.values(point)
            for k, (name, i) in enumerate(zip(c.free, best.look.usual[c], strict=True)):
                p, at = c.parameter(name), np.flatnonzero(free == i)
                sd = float(np.sqrt(covariance[at[0], at[0]])) if at.size else math.nan
                found.append(Free(c.effect, CATALOGUE[c.effect].said({}), p.said, p.unit, float(values[name]), sd,
                                  float(neutral[name]), float(table[f, k])))  # fmt: skip
    return tuple(found)


def ranking(models: Sequence[Fit], near: Sequence[Neighbour]) -> tuple[dict[str, Any], ...]:
    """Every single effect by its evidence over nothing, best first; those not fitted by the linear approximation."""
    nothing = next(m for m in models if not m.effects)
    fitted = {next(iter(m.effects)): m for m in models if len(m.effects) == 1}
    found = []
    for n in near:
        candidate, fit = n.member.candidate if n.member else None, fitted.get(n.effect)
        gain = fit.value - nothing.value if fit else n.gain
        found.append({
            "name": n.effect, "label": candidate.label if candidate else n.effect,
            "words": CATALOGUE[n.effect].said(dict(candidate.fixed) if candidate else {}),
            "gain_nats": float(fit.blocks.sum() - nothing.blocks.sum()) if fit else None, "held_out_nats": None,
            "p_value": None, "evidence_nats": gain if math.isfinite(gain) else None,
            "note": "" if fit else "not fitted: linear estimate",
        })  # fmt: skip
    return tuple(sorted(found, key=lambda e: -(e["evidence_nats"] if e["evidence_nats"] is not None else -math.inf)))
