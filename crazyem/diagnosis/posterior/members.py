"""What a model may be made of: every effect of the catalogue in each of its variants, with what its prior says."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate, impossible, variants
from crazyem.diagnosis.fitting.conditions import conditions_of
from crazyem.diagnosis.fitting.model import Column, Point
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.posterior.evidence import Gaussian
from crazyem.diagnosis.posterior.settings import SETTINGS
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect
from crazyem.physics.effects.prior import Sizes

ACCELEROMETER_NEEDS = ("specific_force",)  # needs of an effect that the accelerometer alone shows (`accelerometer.py`)
INDISTINCT = "in such recordings it differs by as much as it may be off"

Key = tuple[str, Any, Any, str]  # of a column: effect, choices, beginning, parameter
Slopes = Mapping[Key, tuple[Column, ...]]  # derivatives by column, one a flight


def key_of(c: Candidate, name: str) -> Key:
    """Of the column of a parameter."""
    return c.effect, c.fixed, c.begin, name


@dataclass(frozen=True)
class Member:
    """A variant of an effect.

    Attributes:
        candidate: its parameters and choices.
        own: (k,) standard deviations of what all recordings share.
        odds: log prior odds of the variant.
    """

    candidate: Candidate
    own: NDArray
    odds: float

    @property
    def effect(self) -> str:
        return self.candidate.effect

    def prior(self, point: Point, *, nudged: bool = False) -> Gaussian:
        """Of its parameters less neutral.

        nudged: it is not part of the model, and derivatives are taken where there is little of it (`Candidate.begin`):
        those by the others are as much smaller, so their changes are larger.
        """
        c, neutral = self.candidate, self.candidate.neutral(point)
        low, high = (np.array([c.range_of(n)[k] - neutral[n] for n in c.free]) for k in (0, 1))
        own, effect = self.own.copy(), CATALOGUE[c.effect]
        if nudged and c.begin and len(c.free) > 1:
            k = c.free.index(effect.amplitude)
            others = np.arange(len(c.free)) != k
            own[others] *= own[k] / (dict(c.begin)[effect.amplitude] - neutral[effect.amplitude])
            low, high = np.where(others, -np.inf, low), np.where(others, np.inf, high)
        together = np.full((own.size, own.size), effect.prior.together)
        np.fill_diagonal(together, 1.0)
        return Gaussian(together * np.outer(own, own), low, high)


@dataclass(frozen=True)
class Pool:
    """All that may be part of a model.

    Attributes:
        members: variants of effects that may be missing, whole.
        looks: the same as they are looked at from a model without them (fewer parameters where there are many
            beginnings).
        usual: what differs from recording to recording anyway, with its standard deviations (flights, k).
        random: effects that are random processes.
        left_out: effects that the recordings cannot speak of, and why.
    """

    members: tuple[Member, ...]
    looks: tuple[Member, ...]
    usual: tuple[tuple[Candidate, NDArray], ...]
    random: tuple[Effect, ...]
    left_out: dict[str, str]


def pool_of(flights: Sequence[Flight], point: Point, wanted: Sequence[str] = ()) -> Pool:
    """What flights may ask for."""
    signals = frozenset.intersection(*(f.signals for f in flights))
    facts = [conditions_of([f], point) for f in flights]
    measured = flights[0].inputs.measured
    members: list[Member] = []
    looks: list[Member] = []
    usual: list[tuple[Candidate, NDArray]] = []
    random: list[Effect] = []
    left_out: dict[str, str] = {}
    for name, effect in CATALOGUE.items():
        reason = impossible(effect, signals, measured)
        if reason:
            left_out[name] = reason
            continue
        if effect.random is not None:
            random.append(effect)
            continue
        if effect.needs == ACCELEROMETER_NEEDS:
            continue
        found = variants(effect, point, signals)
        never = {} if any(p.chosen for p in effect.parameters) else effect.prior.systematic
        spreads = [{**never, **effect.prior.usual_in(fact)} for fact in facts]
        names = tuple(dict.fromkeys(n for s in spreads for n in s))
        if names:
            table = np.array([[s.get(n, 0.0) * share(effect, n, point) for n in names] for s in spreads])
            centre = tuple((n, c) for n, c in effect.prior.centre.items() if n in names)
            usual.append((Candidate(name, centre, names, both_ways=effect.prior.signed), table))
        if effect.prior.own and (not wanted or name in wanted or effect.prior.unnamed):
            told = _distinct(effect, spreads)
            found = [replace(c, free=tuple(n for n in c.free if n in told)) for c in found]
            found = [c for c in found if c.free]
            if not found:
                left_out[name] = INDISTINCT
                continue
            count = len({(c.fixed, c.free) for c in found})
            odds = prior_odds() - math.log(count)
            many = max((len(v) for v in effect.beginnings.values()), default=0) > SETTINGS.max_full_starts
            for c in found:
                members.append(Member(c, _sizes(effect, c, effect.prior.own, point), odds))
                first = replace(c, free=(effect.amplitude,)) if many else c
                looks.append(Member(first, _sizes(effect, first, effect.prior.own, point), odds))
    return Pool(tuple(members), tuple(looks), tuple(usual), tuple(random), left_out)


def prior_odds() -> float:
    """Log odds that an effect is missing."""
    return math.log(SETTINGS.prior_missing / (1.0 - SETTINGS.prior_missing))


def _distinct(effect: Effect, spreads: Sequence[Sizes]) -> set[str]:
    """Parameters of which recordings differ by less than what is asked for, in one of them at least."""
    return {n for n, own in effect.prior.own.items() if min(s.get(n, 0.0) for s in spreads) < own}


def _sizes(effect: Effect, candidate: Candidate, sizes: Sizes, point: Point) -> NDArray:
    return np.array([sizes[n] * share(effect, n, point) for n in candidate.free])


def share(effect: Effect, name: str, point: Point) -> float:
    """What the sizes of a parameter are shares of; 1 where they are in SI units."""
    if name not in effect.prior.per:
        return 1.0
    neutral = Candidate(effect.name, (), (name,)).neutral(point)[name]
    return effect.prior.share(name, mass=point.vehicle.mass, inertia=point.vehicle.inertia[0], neutral=float(neutral))


def away(c: Candidate, point: Point, name: str) -> float:
    """A parameter less neutral; 0 while the effect is no part of the point."""
    neutral = c.neutral(point)[name]
    return float(point.effects.get(c.effect, {}).get(name, neutral)) - float(neutral)


def started(point: Point, c: Candidate, change: NDArray) -> Point:
    """The point with an effect put in where the linear approximation says."""
    if c.begin:
        return point.with_effects({c.effect: c.started(point, change.tolist())})
    here, neutral = c.values(point), c.neutral(point)
    values = {n: float(np.clip(here[n] + d, *c.range_of(n))) for n, d in zip(c.free, change, strict=True)}
    return point.with_effects({c.effect: {**neutral, **here, **values}})
