"""Variants of an effect with the priors of their parameters, and the usual nuisances of a flight."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate, impossible, variants
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import conditions_of
from crazyem.diagnosis.flights.flight import Flight
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect
from crazyem.physics.effects.prior import Sizes

MANY = 5  # with more start values of a parameter than this, only the amplitude of the effect is free


@dataclass(frozen=True)
class Variant:
    """A variant of an effect.

    Attributes:
        candidate: its parameters and choices.
        own: (k,) prior standard deviations of its parameters, if the effect is missing from the vehicle file.
    """

    candidate: Candidate
    own: NDArray[np.float64]

    def covariance(self, point: Point) -> NDArray[np.float64]:
        """Prior covariance (k, k) of its parameters.

        Derivatives are taken at a small amplitude (`Candidate.begin`). So derivatives by the other parameters are too
        small by the ratio of amplitudes, and their standard deviations are multiplied by the inverse ratio.
        """
        c, own, effect = self.candidate, self.own.copy(), CATALOGUE[self.candidate.effect]
        if c.begin and len(c.free) > 1:
            k, neutral = c.free.index(effect.amplitude), c.neutral(point)
            others = np.arange(len(c.free)) != k
            own[others] *= own[k] / (dict(c.begin)[effect.amplitude] - neutral[effect.amplitude])
        together = np.full((own.size, own.size), effect.prior.together)
        np.fill_diagonal(together, 1.0)
        covariance: NDArray[np.float64] = together * np.outer(own, own)
        return covariance


def variants_of(name: str, flight: Flight, point: Point) -> list[Variant]:
    """The variants of an effect that is missing from the vehicle file.

    Raises:
        UsageError: the flight carries no information on the effect.
    """
    effect, sizes = CATALOGUE[name], CATALOGUE[name].prior.own
    reason = impossible(effect, flight.signals, flight.inputs.measured)
    daily = effect.prior.usual_in(conditions_of([flight], point))
    distinct = {n for n, own in sizes.items() if daily.get(n, 0.0) < own}
    if not sizes:
        reason = "nobody says how large it may be"
    elif not distinct:
        reason = "in such recordings it differs by as much as it may be off"
    if reason:
        raise UsageError(f"a flight cannot speak of {name}: {reason}.")
    many = max((len(v) for v in effect.beginnings.values()), default=0) > MANY
    found = []
    for c in variants(effect, point, flight.signals):
        free = (effect.amplitude,) if many else tuple(n for n in c.free if n in distinct)
        if free:
            found.append(Variant(replace(c, free=free), np.array([_size(effect, n, sizes, point) for n in free])))
    return found


def nuisances_of(flight: Flight, point: Point, apart_from: Sequence[str]) -> list[tuple[Candidate, float]]:
    """Usual deviations from recording to recording: candidates of one parameter each, with standard deviations."""
    conditions, found = conditions_of([flight], point), []
    for name, effect in CATALOGUE.items():
        if name in apart_from or effect.random or impossible(effect, flight.signals, False):
            continue
        never = {} if any(p.chosen for p in effect.parameters) else effect.prior.systematic
        sizes = {**never, **effect.prior.usual_in(conditions)}
        centre = tuple((n, c) for n, c in effect.prior.centre_in(conditions).items() if n in sizes)
        found += [
            (Candidate(name, centre, (n,), both_ways=effect.prior.signed), _size(effect, n, sizes, point))
            for n in sizes if sizes[n] > 0.0
        ]  # fmt: skip
    return found


def _size(effect: Effect, name: str, sizes: Sizes, point: Point) -> float:
    """Standard deviation of a parameter, in its own unit."""
    if name not in effect.prior.per:
        return sizes[name]
    neutral = float(Candidate(effect.name, (), (name,)).neutral(point)[name])
    return sizes[name] * effect.prior.share(
        name, mass=point.vehicle.mass, inertia=point.vehicle.inertia[0], neutral=neutral
    )  # fmt: skip
