"""A flight under a model: vehicle, effects, noise -> innovations, and their derivatives by any columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.diagnosis.fitting import specific_force
from crazyem.diagnosis.fitting.divergence import diverges
from crazyem.diagnosis.fitting.situation import (
    causal_middle,
    impulses,
    initial_path,
    integrated_path,
    situation_of,
    thrust_of,
    with_rotors,
)
from crazyem.diagnosis.fitting.sweeps import Noise, Swept, run_sweep
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effects, Situation
from crazyem.physics.motion import measured, motion
from crazyem.vehicle import Vehicle

LATERAL = 0.05  # share of its accelerations from which a column's force along x and y counts in what a filter shows
RECENT = 0.5  # s, over which what a model lacks is averaged: long enough that the noise of one sample is nothing
# Prefix of what belongs to one recording and to no drone: "own:gyro_bias" -> {"FLIGHT/x": deviation}, added to what all
# recordings share of that effect. Batteries and sensors are not the same on another day.
OWN = "own:"


@dataclass(frozen=True)
class Point:
    """A model: vehicle and effects (name -> parameter -> value) and the noise."""

    vehicle: Vehicle
    effects: Effects
    noise: Noise

    def with_effects(self, changes: Mapping[str, Mapping[str, Any]]) -> "Point":
        """The same with some effects' parameters replaced."""
        merged = {name: dict(values) for name, values in self.effects.items()}
        for name, values in changes.items():
            merged[name] = {**merged.get(name, {}), **values}
        return replace(self, effects=merged)


@dataclass(frozen=True)
class Column:
    """A direction in the space of models: effects displaced, against effects as they are, over the displacement.

    `acting` and `showing` give derivatives that are no effect's: of the accelerations (n, 6), of what is shown (n, 12).
    """

    name: str
    plus: Effects | None = None
    minus: Effects | None = None
    width: float = 1.0
    acting: NDArray | None = None
    showing: NDArray | None = None


def corrected(swept: Swept, flight: Flight) -> tuple[NDArray, NDArray, NDArray]:
    """What a pass of the filter found beyond its model, step by step: changes (n, 6) of velocity m/s and body rate
    rad/s, body axes; lengths (n,) of the steps [s]; which of them (n,) are known (0 where not)."""
    step = np.diff(flight.time, prepend=flight.time[0])
    known = (step > 0) & ~flight.starts
    impulse = np.zeros((step.size, 6))
    impulses(swept.predicted, swept.filtered, step, known, impulse)
    return impulse, np.where(known, step, 0.0), known


def seen_force(acceleration: NDArray, impulse: NDArray, step: NDArray, known: NDArray) -> NDArray:
    """(n, 3) m/s^2: specific force over each step by the model and what the filter found beside it (`corrected`); NaN:
    not known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        seen: NDArray = np.where(known[:, None], acceleration[:, :3] + impulse[:, :3] / step[:, None], np.nan)
    return seen


def unrest(noise: Noise) -> NDArray:
    """(3,) m/s^2 sqrt(s): intensity of the specific force that comes and goes, with a memory or without."""
    memory = np.broadcast_to(np.asarray(noise.memory, float), (6,))[:3]
    found: NDArray = np.sqrt(np.square(noise.impulse[:3]) + 2.0 * memory * np.square(noise.disturbance[:3]))
    return found


def lacking(impulse: NDArray, step: NDArray, known: NDArray) -> NDArray:
    """(n, 6) specific force m/s^2 and angular acceleration rad/s^2, body axes, that a model lacks along a flight.

    The mean over the last `RECENT` of the disturbances with a memory and of what measurements corrected (both in
    `corrected`): what comes and goes faster is known to the filter too late, and would look like a gyro that is early.
    """
    forget = [1.0, -np.exp(-float(np.median(step[known])) / RECENT)] if known.any() else [1.0, 0.0]
    total, span = (lfilter([1.0], forget, v, axis=0) for v in (impulse, step[:, None]))
    mean: NDArray = total / np.maximum(span, RECENT)
    return mean


def of_recording(effects: Effects, name: str) -> Effects:
    """The effects as they act in the recording of that name: with its own deviations, where there are some."""
    own = [key for key in effects if key.startswith(OWN)]
    if not own:
        return effects
    found: dict[str, Mapping[str, Any]] = {n: v for n, v in effects.items() if n not in own}
    for key in own:
        here = deviations(effects, key.removeprefix(OWN)).get(name, {})
        if any(here.values()):
            shared = CATALOGUE[key.removeprefix(OWN)].complete(found.get(key.removeprefix(OWN), {}), {})
            found[key.removeprefix(OWN)] = {n: v + here.get(n, 0.0) for n, v in shared.items()}
    return found


def deviations(effects: Effects, effect: str) -> dict[str, dict[str, float]]:
    """Name of the recording -> parameter -> how far it is there from what all recordings share of the effect."""
    found: dict[str, dict[str, float]] = {}
    for place, value in effects.get(OWN + effect, {}).items():
        recording, _, parameter = place.rpartition("/")
        found.setdefault(recording, {})[parameter] = float(value)
    return found


@dataclass
class Model:
    """A flight under models near one another: remembers the path of the last pass, at which physics is evaluated."""

    flight: Flight
    path: NDArray | None = None  # (n, 19) in the middle of each step
    shown: NDArray | None = None  # (n, 19) filtered, at the rows
    moved: NDArray | None = None  # (n, 6) accelerations of that path, with what the model lacks
    seen: NDArray | None = None  # (n, 3) specific force over each step of that path, as it was found to be
    _thrusts: dict[str, tuple[NDArray, NDArray]] = field(default_factory=dict)
    _there: Situation | None = None  # along the path
    _as_shown: Situation | None = None  # at the rows
    _offsets: dict[str, NDArray] = field(default_factory=dict)  # of one effect each, there
    _strays: dict[str, bool] = field(default_factory=dict)  # shared by twins: it is of the flight alone
    _felt_alone: bool | None = None
    _vibration: NDArray | None = None

    def twin(self) -> "Model":
        """A model that remembers the same; arrays are shared, as they are only ever replaced."""
        return replace(self, _thrusts=dict(self._thrusts))

    def thrusts(self, vehicle: Vehicle, effects: Effects) -> tuple[NDArray, NDArray]:
        """Thrusts after the lag; remembered, since most columns change nothing before the rotors."""
        effects = of_recording(effects, self.flight.name)
        before = {n: effects[n] for n in effects if _before_rotors(n)}
        key = f"{vehicle!r} {before!r}"
        found = self._thrusts.get(key)
        if found is None:
            found = thrust_of(self.flight, vehicle, before)
            # another one, where columns are shared out: somebody may be looking at the old one
            self._thrusts = {**(self._thrusts if len(self._thrusts) <= 8 else {}), key: found}
        return found

    def accelerations(self, point: Point, effects: Effects | None = None) -> tuple[NDArray, Situation]:
        """(n, 6) specific force and angular acceleration over each step, and the situation."""
        effects = of_recording(point.effects if effects is None else effects, self.flight.name)
        path = initial_path(self.flight) if self.path is None else self.path
        thrusts = self.thrusts(point.vehicle, effects)
        if self._there is None:
            self._there = situation_of(self.flight, path, point.vehicle, thrusts)
        situation = with_rotors(self._there, point.vehicle, thrusts)
        # where the path tells well enough, the drift of an attitude would be taken for a pull
        if self.seen is not None and any(_ties(name) and self.diverges(name, point.vehicle) for name in effects):
            situation = replace(situation, seen=self.seen, unrest=unrest(point.noise))
        moved = motion(situation, vehicle=point.vehicle, effects=effects)
        return np.concatenate([moved.specific_force, moved.angular_acceleration], axis=1), situation

    def diverges(self, name: str, vehicle: Vehicle) -> bool:
        """Whether the flight drives what an effect does into chaos (`divergence.diverges`); remembered."""
        if name not in self._strays:
            self._strays[name] = diverges(self.flight, vehicle, name)
        return self._strays[name]

    def offsets(self, point: Point, accelerations: NDArray, effects: Effects | None = None) -> NDArray:
        """(n, 12) what the sensors show beyond the truth, evaluated at the filtered states.

        A lag shows by the accelerations that the drone has, not by those that a wrong model gives: a shifted centre of
        mass of 0.7 mm is 10 rad/s^2, and 1 ms of that would be a gyro's bias of 10 mrad/s.
        """
        effects = of_recording(point.effects if effects is None else effects, self.flight.name)
        showing = [name for name in CATALOGUE if name in effects and _shows(name)]
        offset = np.zeros((self.flight.time.size, 12))
        if not showing:
            return offset
        situation = self._situation_shown(point, accelerations)
        for name in showing:
            only = {name: effects[name]}
            if CATALOGUE[name].uses_force:  # it goes by what those before it show
                turned = replace(situation, tilt=offset[:, 6:9])
                offset = offset + measured(turned, vehicle=point.vehicle, effects=only).state
                continue
            key = f"{name} {effects[name]!r}"
            if key not in self._offsets or self.moved is None:
                self._offsets[key] = measured(situation, vehicle=point.vehicle, effects=only).state
            offset += self._offsets[key]
        return offset

    def _situation_shown(self, point: Point, accelerations: NDArray) -> Situation:
        """The situation at the rows; remembered, once a pass has told the accelerations that the drone has."""
        if self._as_shown is not None and self.moved is not None:
            return self._as_shown
        path = initial_path(self.flight) if self.shown is None else self.shown
        model_force = accelerations[:, :3]
        accelerations = accelerations if self.moved is None else self.moved
        situation = situation_of(self.flight, path, point.vehicle, self.thrusts(point.vehicle, {}))
        self._as_shown = replace(
            situation, specific_force=accelerations[:, :3], angular_acceleration=accelerations[:, 3:],
            integrated=integrated_path(situation, accelerations), model_force=model_force,
        )  # fmt: skip
        return self._as_shown

    def sweep(
        self, point: Point, columns: Sequence[Column] = (), *, passes: int = 1, workers: Workers | None = None
    ) -> Swept:
        """Filter the flight; with columns, score and information by block. Later passes evaluate physics anew."""
        for _ in range(max(1, passes) - 1):
            self._once(point, ())
        return self._once(point, columns, workers)

    def settle(self, point: Point, passes: int = 2) -> Swept:
        """Passes without columns until physics is evaluated where the filter is."""
        return self.sweep(point, passes=passes)

    def _once(self, point: Point, columns: Sequence[Column], workers: Workers | None = None) -> Swept:
        flight = self.flight
        acceleration, _ = self.accelerations(point)
        offset = self.offsets(point, acceleration)
        acting, showing, order = self.derivatives(point, columns, acceleration, offset, workers or Workers(1))
        swept = run_sweep(flight, acceleration, offset, acting, showing, point.noise)
        if self._needs_specific_force():
            swept = self._with_specific_force(swept, acceleration, acting)
        if order is not None:
            swept = _in_order(swept, order)
        self._there = self._as_shown = None
        self._offsets = {}
        if not np.isfinite(swept.filtered).all():  # a model that left the range of numbers must not spoil the next one
            self.path = self.shown = self.moved = self.seen = None
            return swept
        self.path = causal_middle(swept.filtered, swept.predicted, flight.starts)
        self.shown = relaxed(swept.filtered, self.shown, offset)
        found = corrected(swept, flight)
        self.moved = acceleration + lacking(*found)
        self.seen = seen_force(acceleration, *found)
        return swept

    def _needs_specific_force(self) -> bool:
        if self._felt_alone is None:
            self._felt_alone = specific_force.is_needed(self.flight)
        return self._felt_alone

    def _with_specific_force(self, swept: Swept, acceleration: NDArray, acting: NDArray) -> Swept:
        """With the accelerometer's evidence added, where nothing else shows forces."""
        if self._vibration is None:
            self._vibration = specific_force.vibration(self.flight, acceleration[:, :3])
        bias = np.append(np.nanmedian(self.flight.force[:, :2] - acceleration[:, :2], axis=0), 0.0)
        loglik, score, information = specific_force.evidence(
            self.flight, acceleration[:, :3], acting[:, :3], self._vibration, bias
        )
        if acting.shape[2] and swept.score.size:
            swept.score[:, : acting.shape[2]] += score
            swept.information[:, : acting.shape[2], : acting.shape[2]] += information
        return replace(swept, loglik=swept.loglik + loglik)

    def derivatives(
        self,
        point: Point,
        columns: Sequence[Column],
        acceleration: NDArray,
        offset: NDArray,
        workers: Workers,
    ) -> tuple[NDArray, NDArray, NDArray | None]:
        """Derivatives of accelerations (n, 6, c) and offsets (n, 12, d), and where each column went (None: no columns).

        A column changes accelerations, what is shown, both, or nothing here: what belongs to another recording. Where
        it went are two rows: places among all derivatives, -1 for none.
        """
        n = self.flight.time.size
        if not columns:
            return np.zeros((n, 6, 0)), np.zeros((n, 12, 0)), None
        acting: list[NDArray] = []
        showing: list[NDArray] = []
        where: list[tuple[int, int]] = []
        for d_acting, d_showing in workers.map(lambda c: self._derivative(point, c, acceleration, offset), columns):
            where.append((-1 if d_acting is None else len(acting), -1 if d_showing is None else len(showing)))
            acting += [] if d_acting is None else [d_acting]
            showing += [] if d_showing is None else [d_showing]
        order = np.array(where).T
        order[1, order[1] >= 0] += len(acting)
        stack = (np.stack(acting, 2) if acting else np.zeros((n, 6, 0)),
                 np.stack(showing, 2) if showing else np.zeros((n, 12, 0)))  # fmt: skip
        return np.ascontiguousarray(stack[0]), np.ascontiguousarray(stack[1]), order

    def slopes(self, point: Point, columns: Sequence[Column], workers: Workers) -> list[Column]:
        """The columns with their derivatives at a point, to be used near it."""
        acceleration, _ = self.accelerations(point)
        offset = self.offsets(point, acceleration)
        found = workers.map(lambda c: self._derivative(point, c, acceleration, offset), columns)
        return [Column(c.name, acting=a, showing=s) for c, (a, s) in zip(columns, found, strict=True)]

    def _derivative(
        self, point: Point, column: Column, acceleration: NDArray, offset: NDArray
    ) -> tuple[NDArray | None, NDArray | None]:
        """What a column changes: accelerations (n, 6), what is shown (n, 12); None: nothing."""
        if column.plus is None:
            return column.acting, column.showing
        here = of_recording(point.effects, self.flight.name)
        plus = of_recording(column.plus, self.flight.name)
        minus = here if column.minus is None else of_recording(column.minus, self.flight.name)
        changed = [n for n in {**minus, **plus} if plus.get(n) != minus.get(n)]
        d_acting = d_showing = None
        if any(not _shows(name) for name in changed):
            up = self.accelerations(point, plus)[0]
            down = acceleration if column.minus is None else self.accelerations(point, column.minus)[0]
            d_acting = (up - down) / column.width
        if any(_shows(name) for name in changed):
            up = self.offsets(point, acceleration, plus)
            down = offset if column.minus is None else self.offsets(point, acceleration, column.minus)
            d_showing = (up - down) / column.width
        elif d_acting is not None:
            d_showing = self._shown_by(point, d_acting, acceleration)
        return d_acting, d_showing

    def _shown_by(self, point: Point, change: NDArray, acceleration: NDArray) -> NDArray | None:
        """(n, 12) what a change of accelerations (n, 6) changes in what is shown, where that goes by forces."""
        if not self.flight.fused or np.linalg.norm(change[:, :2]) < LATERAL * np.linalg.norm(change):
            return None
        here = of_recording(point.effects, self.flight.name)
        effects = {name: here[name] for name in here if CATALOGUE[name].uses_force}
        if not effects:
            return None
        situation = replace(self._situation_shown(point, acceleration), model_force=acceleration[:, :3])
        changed = replace(situation, model_force=acceleration[:, :3] + change[:, :3])
        up, down = (measured(s, vehicle=point.vehicle, effects=effects).state for s in (changed, situation))
        shown: NDArray = up - down
        return shown if shown.any() else None


def relaxed(filtered: NDArray, before: NDArray | None, offset: NDArray) -> NDArray:
    """(n, 19) states at which what sensors show is evaluated next, by those of this pass and of the one before.

    A velocity that is shown s times too large is taken off by the velocity of the pass before, so errors of that come
    back -(s - 1) times as large: passes went to and fro without end from s = 1.8 on. Of each change 1/s is taken.
    """
    if before is None or not offset[:, 3:6].any():
        return filtered
    old = before[:, 3:6]
    excess = np.sum(offset[:, 3:6] * old, axis=0) / np.maximum(np.sum(old * old, axis=0), 1e-12)
    out = filtered.copy()
    out[:, 3:6] = old + (filtered[:, 3:6] - old) / (1.0 + np.maximum(excess, 0.0))
    return out


def _in_order(swept: Swept, order: NDArray) -> Swept:
    """The pass with its columns put where they were asked for: the sums of two derivatives; -1: a column of zeros.

    order: (2, columns) places among the derivatives.
    """
    score, information = (np.pad(v, [(0, 0)] + [(0, 1)] * (v.ndim - 1)) for v in (swept.score, swept.information))
    first, more = np.where(order[0] >= 0, order[0], order[1]), np.flatnonzero((order >= 0).all(axis=0))
    second = order[1, more]
    ordered, products = score[:, first], information[:, first][:, :, first]
    ordered[:, more] += score[:, second]
    cross = information[:, second][:, :, first]
    products[:, more] += cross
    products[:, :, more] += np.swapaxes(cross, 1, 2)
    products[np.ix_(np.arange(len(products)), more, more)] += information[:, second][:, :, second]
    return replace(swept, score=ordered, information=products)


def _before_rotors(name: str) -> bool:
    effect = CATALOGUE[name]
    return effect.commanded is not None or effect.timing is not None or effect.speed is not None


def _ties(name: str) -> bool:
    return CATALOGUE[name].tied is not None


def _shows(name: str) -> bool:
    return CATALOGUE[name].measured is not None
