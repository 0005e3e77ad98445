"""Candidates: each effect of the catalogue in each of its variants, as columns of the regression."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from crazyem.diagnosis.fitting.model import OWN, Column, Point
from crazyem.diagnosis.flights.flight import Flight
from crazyem.errors import UsageError
from crazyem.physics.effects import rotors
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect, Parameter
from crazyem.physics.motion import vehicle_values

TRIM = rotors.TRIM.name


@dataclass(frozen=True)
class Candidate:
    """An effect with its discrete choices made.

    Attributes:
        effect: name in the catalogue.
        fixed: parameters that are chosen (a rotor, a stream).
        free: parameters that are fitted.
        begin: values at which derivatives are taken while the effect is not part of the model.
        both_ways: values below the physical range are admitted: a delay in the model may be too long.
        likeliest: the fit starts from `begin`, whatever the derivatives say. `begin` is then the most likely of many
            starts, or the derivatives at neutral are zero.
        freedom: degrees of freedom of the prior, if the candidate is a nuisance (`Prior.freedom`).
    """

    effect: str
    fixed: tuple[tuple[str, Any], ...]
    free: tuple[str, ...]
    begin: tuple[tuple[str, float], ...] = ()
    both_ways: bool = False
    likeliest: bool = False
    freedom: float = math.inf

    @property
    def label(self) -> str:
        """Name with its choices, for people: rotor_fault[rotor=3]."""
        chosen = ", ".join(f"{k}={v}" for k, v in self.fixed if v is not None)
        if CATALOGUE[self.effect].alternatives:
            chosen = ", ".join(filter(None, [chosen, *self.free]))
        return f"{self.effect}[{chosen}]" if chosen else self.effect

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(p for p in CATALOGUE[self.effect].parameters if p.name == name)

    def range_of(self, name: str) -> tuple[float, float]:
        """Admitted range of a parameter in a fit: a payload is on the drone, a faulty rotor is not stronger."""
        p, effect = self.parameter(name), CATALOGUE.get(self.effect)
        admitted = effect.admitted(dict(self.fixed)) if effect else {}  # a deviation has no effect here
        low, high = admitted.get(name, (-math.inf, math.inf))
        return max(-p.high if self.both_ways else p.low, low), min(p.high, high)

    def neutral(self, point: Point) -> dict[str, Any]:
        """All parameters with the values of the vehicle file, else neutral; with the discrete choices."""
        own = vehicle_values(point.vehicle).get(self.effect, {})
        filed = point.vehicle.effects.get(self.effect, {})
        if any(filed.get(name, value) != value for name, value in self.fixed):
            filed = {}  # the file has another choice, such as another rotor
        return {**CATALOGUE[self.effect].complete(filed, own), **dict(self.fixed)}

    def values(self, point: Point) -> dict[str, Any]:
        """All parameters with their values in a model, else neutral."""
        return {**self.neutral(point), **point.effects.get(self.effect, {})}

    def columns(self, point: Point) -> list[Column]:
        """Columns of the free parameters: at the model, or at `begin` if the effect is not part of the model."""
        present = self.effect in point.effects
        base = {**self.neutral(point), **(point.effects[self.effect] if present else dict(self.begin))}
        before = point.with_effects({self.effect: base}).effects if not present or self.begin else None
        columns = []
        for name in self.free:
            parameter = self.parameter(name)
            width = parameter.scale if base[name] + parameter.scale <= parameter.high else -parameter.scale
            plus = point.with_effects({self.effect: {**base, name: base[name] + width}}).effects
            minus = before if self.begin and not present else None
            columns.append(Column(f"{self.effect}.{name}", plus, minus, width))
        return columns

    def bounds(self, point: Point) -> tuple[list[float], list[float]]:
        """Admitted changes of the free parameters from their present values."""
        here = self.values(point)
        ends = [self.range_of(n) for n in self.free]
        low = [min(end[0] - here[n], 0.0) for end, n in zip(ends, self.free, strict=True)]
        return low, [max(end[1] - here[n], 0.0) for end, n in zip(ends, self.free, strict=True)]

    def started(self, point: Point, change: Sequence[float]) -> dict[str, Any]:
        """Values of the effect after a linear step from a model without it.

        The derivatives by the other parameters were taken at a small amplitude. So their changes scale with the ratio
        of the small to the new amplitude.
        """
        base = {**self.neutral(point), **dict(self.begin)}
        amplitude, grown, ratio = CATALOGUE[self.effect].amplitude, None, 1.0
        moved = dict(zip(self.free, change, strict=True))
        if amplitude in moved and amplitude in dict(self.begin):
            neutral = self.neutral(point)[amplitude]
            small = base[amplitude] - neutral
            p = self.parameter(amplitude)
            grown = neutral + moved[amplitude]
            if abs(moved[amplitude]) < 0.05 * abs(small) or not p.low <= grown <= p.high:
                grown = base[amplitude]  # without amplitude, the others have no derivatives
            ratio = small / (grown - neutral)
        found = {n: base[n] + step * ratio for n, step in moved.items()}
        if grown is not None:
            found[amplitude] = grown
        ends = {n: self.range_of(n) for n in self.free}
        return {**base, **{n: min(max(found[n], low), high) for n, (low, high) in ends.items()}}


THRUST = Candidate(rotors.THRUST_SCALE.name, (), ("scale",))


class OfRecordings(Candidate):
    """Deviations of an effect in each recording from its shared value (`model.OWN`): nuisances, never named."""

    @property
    def label(self) -> str:
        """For people."""
        return f"{self._shared.description({})} of each recording"

    @property
    def _shared(self) -> Effect:
        return CATALOGUE[self.effect.removeprefix(OWN)]

    def parameter(self, name: str) -> Parameter:
        """The deviation of one parameter in one recording."""
        recording, _, own = name.rpartition("/")
        p = next(p for p in self._shared.parameters if p.name == own)
        words, middle = f"{p.description} of {recording.rpartition('/')[2]}", float(p.neutral)
        return replace(p, name=name, words=words, neutral=0.0, low=p.low - middle, high=p.high - middle)

    def neutral(self, point: Point) -> dict[str, Any]:
        """Deviations of 0."""
        return dict.fromkeys(self.free, 0.0)


def of_recordings(effect: str, parameters: Sequence[str], flights: Sequence[Flight]) -> OfRecordings:
    """The deviations of some parameters in each flight; two flights of one name are one."""
    names = dict.fromkeys(f.name for f in flights)
    return OfRecordings(OWN + effect, (), tuple(f"{name}/{p}" for name in names for p in parameters))


def candidates_for(
    point: Point,
    signals: frozenset[str],
    *,
    measured_speeds: bool,
    wanted: Sequence[str] = (),
) -> tuple[list[Candidate], dict[str, str]]:
    """All candidates that the recorded signals can show; and the effects that they cannot show, with the reason.

    Raises:
        UsageError: a wanted effect is not in the catalogue.
    """
    for name in wanted:
        if name not in CATALOGUE:
            raise UsageError(f"unknown effect '{name}' (known: {', '.join(CATALOGUE)})")
    found: list[Candidate] = []
    left_out: dict[str, str] = {}
    for name, effect in CATALOGUE.items():
        if wanted and name not in wanted:
            continue
        reason = impossible(effect, signals, measured_speeds)
        if reason:
            left_out[name] = reason
        elif (effect.prior.own and not effect.own_likelihood) or (effect.on_request and name in wanted):
            found += variants(effect, point, signals)
    return found, left_out


def impossible(effect: Effect, signals: frozenset[str], measured_speeds: bool) -> str:
    if effect.needs and not any(s in signals for s in effect.needs):
        return f"needs {' or '.join(effect.needs).replace('_', ' ')}, which the recording does not have"
    if effect.speed is not None and not measured_speeds:
        return "needs measured rotor speeds"
    before_rotors = effect.timing is not None and "rotor_speed" not in effect.needs
    if measured_speeds and (effect.commanded is not None or before_rotors):
        return "acts before the rotors, whose speeds were measured"
    return ""


def variants(effect: Effect, point: Point, signals: frozenset[str]) -> list[Candidate]:
    """One candidate for each discrete choice, set of parameters and beginning."""
    chosen = [p for p in effect.parameters if p.chosen]
    continuous = [p.name for p in effect.parameters if not p.chosen and _fitted(p, signals)]
    grid = ({**effect.nudge, **dict(zip(effect.beginnings, v))} for v in product(*effect.beginnings.values()))
    begins = [tuple(values.items()) for values in grid]
    found = []
    for picks in product(*(p.chosen for p in chosen)):
        fixed = tuple(zip((p.name for p in chosen), picks, strict=True))
        if ("accelerometer",) in picks:
            continue  # the accelerometer is compared by itself (`naming/other_likelihoods.py`)
        for free in effect.alternatives or (tuple(continuous),):
            if not all(name in continuous for name in free):
                continue
            found += [Candidate(effect.name, fixed, tuple(free), begin) for begin in begins]
    return found


def _fitted(parameter: Parameter, signals: frozenset[str]) -> bool:
    if parameter.needs and not any(s in signals for s in parameter.needs):
        return False
    return parameter.neutral is not None and parameter.scale > 0 and math.isfinite(parameter.scale)
