"""A flight under a model: innovations from vehicle, effects and noise, and their derivatives by any columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.diagnosis.fitting import specific_force
from crazyem.diagnosis.fitting.situation import (
    causal_middle,
    impulses,
    initial_path,
    integrated_path,
    situation_of,
    thrust_of,
    unmeasured,
    with_interpolated_states,
    with_rotors,
)
from crazyem.diagnosis.fitting.sweeps import Noise, Swept, run_sweep
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect, Effects, Offset, Situation, Values
from crazyem.physics.motion import measured, motion
from crazyem.vehicle import Vehicle


def diverges(flight: Flight, vehicle: Vehicle, name: str) -> bool:
    """Whether a flight drives a hidden state into chaos: a small error of the measured path changes much of an effect's
    force, from one of some beginnings."""
    known = initial_path(flight)
    off = known.copy()
    off[:, 3:6] += NOISE.chaos_velocity * np.random.default_rng(0).normal(size=(len(off), 3))
    thrusts = thrust_of(flight, vehicle, {})
    paths = [situation_of(flight, path, vehicle, thrusts) for path in (known, off)]
    free = [motion(there, vehicle=vehicle, effects={}).specific_force for there in paths]
    for values in _some(CATALOGUE[name]):
        pull, other = (
            motion(there, vehicle=vehicle, effects={name: values}).specific_force - without
            for there, without in zip(paths, free, strict=True)
        )
        swing = _rms(pull - pull.mean(axis=0))
        if swing > NOISE.chaos_swing * _rms(pull) and _rms(other - pull) > NOISE.chaos_change * swing:
            return True
    return False


def _some(effect: Effect) -> list[Values]:
    """Values of an effect at one in `NOISE.chaos_every` of its beginnings; none for an effect without sizes."""
    if not effect.sizes:
        return []
    size = effect.sizes[len(effect.sizes) // 2]
    return [
        {effect.amplitude: size, name: value}
        for name, values in effect.beginnings.items()
        for value in values[NOISE.chaos_every // 2 :: NOISE.chaos_every]
    ]


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# Prefix of the deviations of single recordings: "own:gyro_bias" -> {"FLIGHT/x": deviation}, added to the shared value
# of the effect. Batteries and sensors change from day to day.
OWN = "own:"


@dataclass(frozen=True)
class Point:
    """A model: vehicle and effects (name -> parameter -> value) and the noise."""

    vehicle: Vehicle
    effects: Effects
    noise: Noise

    def with_effects(self, changes: Mapping[str, Mapping[str, Any]]) -> "Point":
        """The model with some parameters of effects replaced."""
        merged = {name: dict(values) for name, values in self.effects.items()}
        for name, values in changes.items():
            merged[name] = {**merged.get(name, {}), **values}
        return replace(self, effects=merged)


@dataclass(frozen=True)
class Column:
    """A direction in the space of models: the difference of the effects `plus` and `minus` over `width`.

    `minus` None: the effects of the model. Without `plus`, `acting` and `showing` are the derivatives themselves: of
    the accelerations (n, 6) and of the offsets of measurements (n, 12).
    """

    name: str
    plus: Effects | None = None
    minus: Effects | None = None
    width: float = 1.0
    acting: NDArray | None = None
    showing: NDArray | None = None


def filter_corrections(swept: Swept, flight: Flight) -> tuple[NDArray, NDArray, NDArray]:
    """Corrections of a pass of the filter to its model by steps: changes (n, 6) of velocity [m/s] and body rate
    [rad/s], body axes; lengths (n,) of the steps [s]; whether they are known (n,). Unknown ones are 0.

    The first measurement after a start corrects a guess, which says nothing of the model.
    """
    step = np.diff(flight.time, prepend=flight.time[0])
    known = (step > 0) & ~flight.starts & ~np.roll(unmeasured(flight).any(axis=1), 1)
    impulse = np.zeros((step.size, 6))
    impulses(swept.predicted, swept.filtered, step, known, impulse)
    return impulse, np.where(known, step, 0.0), known


def observed_force(acceleration: NDArray, impulse: NDArray, step: NDArray, known: NDArray) -> NDArray:
    """(n, 3) m/s^2, specific force over each step: of the model, plus `filter_corrections`; NaN: not known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        seen: NDArray = np.where(known[:, None], acceleration[:, :3] + impulse[:, :3] / step[:, None], np.nan)
    return seen


def force_noise(noise: Noise) -> NDArray:
    """(3,) m/s^2 sqrt(s), intensity of the random specific force, white and with memory."""
    memory = np.broadcast_to(np.asarray(noise.memory, float), (6,))[:3]
    found: NDArray = np.sqrt(np.square(noise.impulse[:3]) + 2.0 * memory * np.square(noise.disturbance[:3]))
    return found


def missing_acceleration(impulse: NDArray, step: NDArray, known: NDArray) -> NDArray:
    """(n, 6) specific force m/s^2 and angular acceleration rad/s^2, body axes, that a model lacks along a flight.

    The mean over the last `NOISE.averaging` of disturbances with memory and of corrections by measurements (both in
    `filter_corrections`). The filter sees faster changes too late; they would look like a gyro that is early. The
    measurements of a row are not used for the row itself: its innovations must not contain them.
    """
    forget = [1.0, -np.exp(-float(np.median(step[known])) / NOISE.averaging)] if known.any() else [1.0, 0.0]
    total, span = (lfilter([1.0], forget, v, axis=0) for v in (impulse, step[:, None]))
    mean: NDArray = total / np.maximum(span, NOISE.averaging)
    mean[1:], mean[0] = mean[:-1].copy(), 0.0
    return mean


def of_recording(effects: Effects, name: str) -> Effects:
    """The effects in the recording of that name: the shared values plus its own deviations."""
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
    """Recording -> parameter -> deviation of this recording from the shared value of the effect."""
    found: dict[str, dict[str, float]] = {}
    for place, value in effects.get(OWN + effect, {}).items():
        recording, _, parameter = place.rpartition("/")
        found.setdefault(recording, {})[parameter] = float(value)
    return found


@dataclass
class Model:
    """A flight under similar models: it stores the path of the last pass, at which the physics is evaluated."""

    flight: Flight
    path: NDArray | None = None  # (n, 19) in the middle of each step
    rows_path: NDArray | None = None  # (n, 19) at the rows, without the measurements of the row: predicted, or a start
    observed_acceleration: NDArray | None = None  # (n, 6) along that path: of the model, plus `missing_acceleration`
    observed_force: NDArray | None = None  # (n, 3) specific force over each step of that path (`observed_force`)
    _thrusts: dict[str, tuple[NDArray, NDArray]] = field(default_factory=dict)
    _path_situation: Situation | None = None  # along the path
    _row_situation: Situation | None = None  # at the rows
    _offsets: dict[str, Offset] = field(default_factory=dict)  # of single effects, at `_row_situation`
    _diverging: dict[str, bool] = field(default_factory=dict)  # effect -> `diverges`; shared by twins
    _force_axes: tuple[int, ...] | None = None

    def twin(self) -> "Model":
        """A copy with the same stored arrays; they are shared, because they are replaced and never changed."""
        return replace(self, _thrusts=dict(self._thrusts))

    def thrusts(self, vehicle: Vehicle, effects: Effects) -> tuple[NDArray, NDArray]:
        """Thrusts after the lag; stored, because most columns do not change the inputs of the rotors."""
        effects = of_recording(effects, self.flight.name)
        before = {n: effects[n] for n in effects if _changes_input(n)}
        key = f"{vehicle!r} {before!r}"
        found = self._thrusts.get(key)
        if found is None:
            found = thrust_of(self.flight, vehicle, before)
            # a new dictionary, because other threads may read the old one
            self._thrusts = {**(self._thrusts if len(self._thrusts) <= 8 else {}), key: found}
        return found

    def accelerations(self, point: Point, effects: Effects | None = None) -> tuple[NDArray, Situation]:
        """(n, 6) specific force and angular acceleration over each step, and the situation."""
        effects = of_recording(point.effects if effects is None else effects, self.flight.name)
        path = initial_path(self.flight) if self.path is None else self.path
        thrusts = self.thrusts(point.vehicle, effects)
        if self._path_situation is None:
            self._path_situation = situation_of(self.flight, path, point.vehicle, thrusts)
        situation = with_rotors(self._path_situation, point.vehicle, thrusts)
        # only if the effect diverges: in other flights the path is enough, and `seen` contains the drift of attitudes
        if self.observed_force is not None and any(
            CATALOGUE[name].tied is not None and self.diverges(name, point.vehicle) for name in effects
        ):
            situation = replace(situation, seen=self.observed_force, unrest=force_noise(point.noise))
        moved = motion(situation, vehicle=point.vehicle, effects=effects)
        return np.concatenate([moved.specific_force, moved.angular_acceleration], axis=1), situation

    def diverges(self, name: str, vehicle: Vehicle) -> bool:
        """Whether the flight drives the state of an effect into chaos (`diverges`); stored."""
        if name not in self._diverging:
            self._diverging[name] = diverges(self.flight, vehicle, name)
        return self._diverging[name]

    def offsets(self, point: Point, accelerations: NDArray, effects: Effects | None = None) -> NDArray:
        """(n, 12) offsets of the measurements from the state, evaluated at the filtered states.

        The offset of a lagging sensor follows from the true accelerations, not from those of a wrong model. A centre of
        mass shifted by 0.7 mm makes 10 rad/s^2; with a lag of 1 ms this would be a gyro bias of 10 mrad/s.
        """
        effects = of_recording(point.effects if effects is None else effects, self.flight.name)
        showing = [name for name in CATALOGUE if name in effects and _changes_measurement(name)]
        offset, tilt = np.zeros((self.flight.time.size, 12)), np.zeros((self.flight.time.size, 3))
        if not showing:
            return offset
        situation = self._situation_shown(point, accelerations)
        for name in showing:
            key, here = f"{name} {effects[name]!r}", situation
            if CATALOGUE[name].uses_force:  # it depends on the offsets of the effects before it
                here = replace(situation, tilt=tilt)
                force = situation.specific_force if situation.model_force is None else situation.model_force
                key += f" {hash(tilt.tobytes())} {hash(force.tobytes())}"
            if key not in self._offsets or self.observed_acceleration is None:
                self._offsets[key] = measured(here, vehicle=point.vehicle, effects={name: effects[name]})
            offset += self._offsets[key].state
            tilt = tilt + self._offsets[key].filter_tilt
        return offset

    def _situation_shown(self, point: Point, accelerations: NDArray) -> Situation:
        """The situation at the rows; stored after the first pass, which estimates the true accelerations."""
        if self._row_situation is not None and self.observed_acceleration is not None:
            return self._row_situation
        path = initial_path(self.flight) if self.rows_path is None else self.rows_path
        model_force = accelerations[:, :3]
        accelerations = accelerations if self.observed_acceleration is None else self.observed_acceleration
        situation = situation_of(self.flight, path, point.vehicle, self.thrusts(point.vehicle, {}))
        self._row_situation = replace(
            situation, specific_force=accelerations[:, :3], angular_acceleration=accelerations[:, 3:],
            integrated=integrated_path(situation, accelerations), model_force=model_force,
        )  # fmt: skip
        return self._row_situation

    def sweep(
        self, point: Point, columns: Sequence[Column] = (), *, passes: int = 1, workers: Workers | None = None
    ) -> Swept:
        """Filter the flight; with columns, score and information by block. Each pass evaluates the physics again."""
        for _ in range(max(1, passes) - 1):
            self._once(point, ())
        return self._once(point, columns, workers)

    def settle(self, point: Point, passes: int = 2) -> Swept:
        """Passes without columns, after which the physics is evaluated at the states of the filter."""
        return self.sweep(point, passes=passes)

    def _once(self, point: Point, columns: Sequence[Column], workers: Workers | None = None) -> Swept:
        flight = self.flight
        acceleration, _ = self.accelerations(point)
        offset = self.offsets(point, acceleration)
        acting, showing, order = self.derivatives(point, columns, acceleration, offset, workers or Workers(1))
        swept = run_sweep(flight, acceleration, offset, acting, showing, point.noise)
        swept = self._with_specific_force(swept, acceleration, acting)
        if order is not None:
            swept = _in_order(swept, order)
        self._path_situation = self._row_situation = None
        self._offsets = {}
        if not np.isfinite(swept.filtered).all():  # the next model must not start from such states
            self.path = self.rows_path = self.observed_acceleration = self.observed_force = None
            return swept
        filtered, predicted = with_interpolated_states(flight, swept.filtered, swept.predicted)
        self.path = causal_middle(filtered, predicted, flight.starts)
        at_rows = np.where(flight.starts[:, None], filtered, predicted)
        self.rows_path = under_relaxed(at_rows, self.rows_path, offset)
        found = filter_corrections(swept, flight)
        self.observed_acceleration = acceleration + missing_acceleration(*found)
        self.observed_force = observed_force(acceleration, *found)
        return swept

    @property
    def force_axes(self) -> tuple[int, ...]:
        """Axes along which only the accelerometer shows forces."""
        if self._force_axes is None:
            self._force_axes = specific_force.axes_needed(self.flight)
        return self._force_axes

    def force_residuals(self, point: Point) -> NDArray:
        """(m, 3) m/s^2: accelerometer less model, without the sensor's errors; the filter must have settled."""
        swept, force = self.sweep(point), self.accelerations(point)[0][:, :3]
        errors = specific_force.sensor_errors(self.flight, force, swept.filtered[:, 10:13])
        return specific_force.residuals(self.flight, force, errors)[1]

    def _with_specific_force(self, swept: Swept, acceleration: NDArray, acting: NDArray) -> Swept:
        """The pass with the evidence of the accelerometer (`specific_force.py`) added, where it is needed."""
        axes = self.force_axes
        if not axes or not np.isfinite(swept.filtered).all():
            return swept
        force = acceleration[:, :3]
        errors = specific_force.sensor_errors(self.flight, force, swept.filtered[:, 10:13])
        rows, score, information = specific_force.evidence(self.flight, force, acting[:, :3], errors, axes)
        if acting.shape[2] and swept.score.size:
            swept.score[:, : acting.shape[2]] += score
            swept.information[:, : acting.shape[2], : acting.shape[2]] += information
        return replace(swept, loglik=swept.loglik + float(rows.sum()), rows=swept.rows + rows)

    def derivatives(
        self,
        point: Point,
        columns: Sequence[Column],
        acceleration: NDArray,
        offset: NDArray,
        workers: Workers,
    ) -> tuple[NDArray, NDArray, NDArray | None]:
        """Derivatives of accelerations (n, 6, c) and of offsets (n, 12, d), and the places (2, columns) of each column
        among these derivatives: of accelerations, of offsets (None: no columns).

        A column changes accelerations, offsets or both. A column of another recording changes nothing. A place of -1
        means no change.
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
        """The columns with fixed derivatives at a point, to be used near this point."""
        acceleration, _ = self.accelerations(point)
        offset = self.offsets(point, acceleration)
        found = workers.map(lambda c: self._derivative(point, c, acceleration, offset), columns)
        return [Column(c.name, acting=a, showing=s) for c, (a, s) in zip(columns, found, strict=True)]

    def _derivative(
        self, point: Point, column: Column, acceleration: NDArray, offset: NDArray
    ) -> tuple[NDArray | None, NDArray | None]:
        """Derivatives of accelerations (n, 6) and of offsets (n, 12) by a column; None: 0."""
        if column.plus is None:
            return column.acting, column.showing
        here = of_recording(point.effects, self.flight.name)
        plus = of_recording(column.plus, self.flight.name)
        minus = here if column.minus is None else of_recording(column.minus, self.flight.name)
        changed = [n for n in {**minus, **plus} if plus.get(n) != minus.get(n)]
        d_acting = d_showing = None
        if any(not _changes_measurement(name) for name in changed):
            up = self.accelerations(point, plus)[0]
            down = acceleration if column.minus is None else self.accelerations(point, column.minus)[0]
            d_acting = (up - down) / column.width
        if any(_changes_measurement(name) for name in changed):
            up = self.offsets(point, acceleration, plus)
            down = offset if column.minus is None else self.offsets(point, acceleration, column.minus)
            d_showing = (up - down) / column.width
        elif d_acting is not None:
            d_showing = self._shown_by(point, d_acting, acceleration)
        return d_acting, d_showing

    def _shown_by(self, point: Point, change: NDArray, acceleration: NDArray) -> NDArray | None:
        """(n, 12) change of the offsets by a change of accelerations (n, 6), through the force; None: 0."""
        if not self.flight.fused or np.linalg.norm(change[:, :2]) < NOISE.min_lateral * np.linalg.norm(change):
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


def under_relaxed(states: NDArray, before: NDArray | None, offset: NDArray) -> NDArray:
    """(n, 19) states for the next offsets of measurements, from the states of this pass and of the last one.

    If a measured velocity is s times too large, the offset follows from the velocity of the last pass. An error of this
    velocity returns -(s - 1) times as large, so passes do not converge from s = 1.8 on. Therefore only 1/s of each
    change is taken.
    """
    if before is None or not offset[:, 3:6].any():
        return states
    old = before[:, 3:6]
    excess = np.sum(offset[:, 3:6] * old, axis=0) / np.maximum(np.sum(old * old, axis=0), 1e-12)
    out = states.copy()
    out[:, 3:6] = old + (states[:, 3:6] - old) / (1.0 + np.maximum(excess, 0.0))
    return out


def _in_order(swept: Swept, order: NDArray) -> Swept:
    """The pass with score and information in the order of the columns; a column is the sum of its two derivatives.

    order: (2, columns) places among the derivatives; -1: a derivative of zeros.
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


def _changes_input(name: str) -> bool:
    effect = CATALOGUE[name]
    return effect.commanded is not None or effect.timing is not None or effect.speed is not None


def _changes_measurement(name: str) -> bool:
    return CATALOGUE[name].measured is not None
