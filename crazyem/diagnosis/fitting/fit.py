"""Fit of effects to flights: derivatives of all columns in one pass, Gauss-Newton steps, noise scales in between."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import OWN, Column, Model, Point, Swept
from crazyem.diagnosis.fitting.noise import Curvatures, coloured, fit_noise, without_negligible
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import FITTING
from crazyem.diagnosis.workers import Workers
from crazyem.errors import DataError
from crazyem.physics.effects.catalogue import CATALOGUE


@dataclass(frozen=True)
class Fitted:
    """A model fitted to flights.

    Attributes:
        point: vehicle, effects and noise.
        candidates: effects with free parameters.
        loglik: log-likelihood of the fitted flights with the log prior of the nuisances [nats].
        gram: score and information of the free columns at the maximum, nuisances last.
        precision: (columns of `gram`,) precisions of the priors; 0 for the candidates.
        nuisances: effects that are free beside the candidates, in the order of the columns.
    """

    point: Point
    candidates: tuple[Candidate, ...]
    loglik: float
    gram: Gram
    precision: NDArray
    nuisances: tuple[Candidate, ...] = ()


class DivergedError(DataError):
    """The filter leaves the range of numbers under a model: no fit can start from this model."""


class Data:
    """Flights that are fitted together.

    Args:
        workers: threads that share the work; None: the calling thread alone.
    """

    def __init__(self, flights: Sequence[Flight], workers: Workers | None = None) -> None:
        self.models = [Model(f) for f in flights]
        self.workers = workers or Workers(1)
        self.curvatures: Curvatures = {}
        self.constrained: frozenset[str] = frozenset()  # nuisances that are not free here
        self.own: Point | None = None  # of held-out flights: their noise and the start values of their nuisances

    def constraining(self, effect: str) -> "Data":
        """A twin in which a nuisance keeps its value of the vehicle file."""
        twin = self.twin()
        twin.constrained = self.constrained | {effect}
        return twin

    def twin(self) -> "Data":
        """An independent copy: the same flights with the paths of the last pass."""
        twin = Data((), self.workers)
        twin.models = [m.twin() for m in self.models]
        twin.curvatures = self.curvatures.copy()
        twin.constrained, twin.own = self.constrained, self.own
        return twin

    def together_with(self, other: "Data | None") -> "Data":
        """A twin of these flights and of others, for one fit."""
        both = self.twin()
        both.models += other.twin().models if other is not None else []
        return both

    def each(self) -> list["Data"]:
        """Twins of the flights one by one."""
        parts = [Data((), self.workers) for _ in self.models]
        for part, model in zip(parts, self.models, strict=True):
            part.models, part.constrained = [model.twin()], self.constrained
        return parts

    @property
    def flights(self) -> list[Flight]:
        """The flights."""
        return [m.flight for m in self.models]

    @property
    def signals(self) -> frozenset[str]:
        """Signals that all flights measure."""
        return frozenset.intersection(*(f.signals for f in self.flights))

    @property
    def differ(self) -> bool:
        """Whether each flight has a thrust scale of its own."""
        return bool(self.models) and all(f.differs for f in self.flights)

    @property
    def coarse(self) -> bool:
        """Whether in all flights the recorded commands do not explain the rotation (see `Flight.coarse`)."""
        return all(f.coarse for f in self.flights)

    def loglik(self, point: Point, passes: int = 1) -> float:
        """Log-likelihood [nats]; rows at which the filter starts do not count."""
        return sum(self.workers.map(lambda m: m.sweep(point, passes=passes).loglik, self.models))

    def block_loglik(self, point: Point) -> NDArray:
        """(b,) log-likelihood by blocks of all flights [nats]."""
        return np.concatenate([np.bincount(m.flight.block, m.sweep(point).rows) for m in self.models])

    def recordings_of_blocks(self) -> NDArray:
        """(b,) int, the flight of each block of `block_loglik`."""
        return np.repeat(np.arange(len(self.models)), [m.flight.blocks for m in self.models])

    def settle(self, point: Point) -> list[Swept]:
        """Evaluate the physics at the states of the filter."""
        return self.workers.map(lambda m: m.settle(point), self.models)

    def converged(self, point: Point, columns: Sequence[Column]) -> tuple[Gram, float]:
        """`gram_and_loglik`, with passes before it until the physics is evaluated at the states of the filter.

        Only with an effect that is `has_large_offset` more than one pass is needed.
        """
        if not any(has_large_offset(name, values) for name, values in point.effects.items()):
            return self.gram_and_loglik(point, columns)
        self.loglik(point)
        for _ in range(FITTING.passes):
            before = self.loglik(point)
            gram, now = self.gram_and_loglik(point, columns)
            if abs(now - before) < FITTING.pass_change:
                break
        return gram, now

    def fit_noise(self, point: Point, *, near: bool = False) -> Point:
        """The model with fitted noise scales; `near`: the start values are near the maximum."""
        parts = []
        for model in self.models:
            acceleration, _ = model.accelerations(point)
            parts.append((model.flight, acceleration, model.offsets(point, acceleration)))
        found = fit_noise(parts, point.noise, near=near, workers=self.workers, curvatures=self.curvatures)
        return replace(point, noise=found)

    def leave_out_wild(self, point: Point) -> int:
        """Restart the filter at outlying steps (a stalled link, pulses of command between samples); returns their
        number.

        One such step outweighs seconds of flight, and says nothing of effects that act at other times.
        """
        count = 0
        for i, model in enumerate(self.models):
            swept = model.sweep(point)
            seen = swept.variance > 0
            squares = np.divide(swept.innovation**2, swept.variance, out=np.zeros_like(swept.variance), where=seen)
            mean = squares.sum(1) / np.maximum(seen.sum(1), 1)
            limit = max(FITTING.outlier, FITTING.outlier * float(np.quantile(mean, 0.95)) / 2)
            wild = mean > limit
            if wild.sum() > 0.02 * wild.size:
                wild &= mean >= np.quantile(mean, 0.98)
            wild[1:] |= wild[:-1].copy()
            if wild.any():
                count += int(wild.sum())
                flight = replace(model.flight, starts=model.flight.starts | wild)
                self.models[i] = Model(flight)
        return count

    def gram(self, point: Point, columns: Sequence[Column]) -> Gram:
        """Score and information of columns."""
        return self.gram_and_loglik(point, columns)[0]

    def gram_and_loglik(self, point: Point, columns: Sequence[Column]) -> tuple[Gram, float]:
        """Score and information of columns, and the log-likelihood."""
        swept = self.workers.map(lambda m: m.sweep(point, columns, workers=self.workers), self.models)
        return Gram.joined(swept), sum(s.loglik for s in swept)


def has_large_offset(name: str, values: Mapping[str, Any]) -> bool:
    """Whether an effect makes measurements differ so much from the state that one pass is not enough."""
    if name.startswith(OWN) or CATALOGUE[name].measured is None:
        return False
    slight = CATALOGUE[name].linear_range
    parameters = CATALOGUE[name].parameters if slight else ()
    return not slight or any(abs(values.get(p.name, p.neutral) - p.neutral) > slight for p in parameters)


def nominal(data: Data, point: Point) -> Point:
    """The nominal model with fitted noise scales, and with torques with memory where the likelihood gains by them."""
    data.settle(point)
    fitted = data.fit_noise(point)
    fitted = data.fit_noise(replace(fitted, noise=coloured(fitted.noise, data.flights)), near=True)
    if any(f.fused for f in data.flights):  # a filter that integrates an accelerometer knows all forces
        all_forces = data.fit_noise(replace(fitted, noise=replace(fitted.noise, thrust_only=False)), near=True)
        fitted = max((fitted, all_forces), key=lambda p: data.loglik(p, passes=2))
    fitted = replace(fitted, noise=without_negligible(fitted.noise, data.flights))
    if data.leave_out_wild(fitted):
        data.settle(fitted)
        fitted = data.fit_noise(fitted)
    fitted = with_torque_memory(data, fitted)
    data.settle(fitted)
    return fitted


def with_torque_memory(data: Data, point: Point) -> Point:
    """The point with disturbing torques that have a memory, where the likelihood gains by them.

    A command sampled at 100 Hz stands for five or ten commands that the rotors got. The commands between the samples
    act through the rotor lag: they are torque noise with the memory of the lag. If this noise is modelled as white, the
    torques look too weak by some 10 % (errors in variables). Moving air makes torques with a memory of about 0.5 s.
    """
    seconds = sum(f.duration for f in data.flights)
    lag = 0.0 if data.flights[0].inputs.measured else point.vehicle.motor_time_constant
    best, value = point, data.loglik(point)
    for memory, needed in ((lag, FITTING.min_lag_gain), (FITTING.air_memory, FITTING.min_air_gain * seconds)):
        if memory > 0:
            start = np.concatenate([point.noise.disturbance[:3], np.full(3, FITTING.start_torque)])
            noise = replace(point.noise, disturbance=start, memory=memory)
            there = data.fit_noise(replace(point, noise=noise), near=True)
            data.settle(there)
            found = data.loglik(there)
            if found > value + needed:
                best, value = there, found
    return best


def with_torque_memory_refit(data: Data, point: Point) -> Point:
    """`with_torque_memory` for a model with a newly found effect, whose torques were part of the noise."""
    if not point.noise.disturbance[3:].any():
        return with_torque_memory(data, point)
    forces = np.concatenate([point.noise.disturbance[:3], np.zeros(3)])
    white = data.fit_noise(replace(point, noise=replace(point.noise, disturbance=forces)), near=True)
    data.settle(white)
    chosen = with_torque_memory(data, white)
    data.settle(chosen)
    return chosen


def bounds_of(candidates: Sequence[Candidate], point: Point) -> tuple[NDArray, NDArray]:
    """Admitted changes of all free parameters."""
    low, high = [], []
    for c in candidates:
        lo, hi = c.bounds(point)
        low += lo
        high += hi
    return np.array(low), np.array(high)


def freedom_of(candidates: Sequence[Candidate]) -> NDArray:
    """Degrees of freedom of the prior of each free parameter; infinite: a normal prior."""
    return np.array([c.freedom for c in candidates for _ in c.free])


def log_prior(away: NDArray, precision: NDArray, freedom: NDArray) -> float:
    """Log density of the priors, relative to neutral: normal, or Student's t with this precision."""
    square = precision * np.square(away)
    normal = np.isinf(freedom)
    nu = np.where(normal, 1.0, freedom)
    return float(-0.5 * np.sum(np.where(normal, square, (nu + 1.0) * np.log1p(square / nu))))


def local_precision(away: NDArray, precision: NDArray, freedom: NDArray) -> NDArray:
    """Precisions of normal priors that are tangent to the given priors, and below them, at the present parameters.

    A step with these precisions never lowers the posterior (Lange, Little and Taylor, 1989: EM for the t distribution).
    """
    normal = np.isinf(freedom)
    nu = np.where(normal, 1.0, freedom)
    return np.where(normal, precision, precision * (nu + 1.0) / (nu + precision * np.square(away)))


def nuisance_bounds(
    low: NDArray, high: NDArray, away: NDArray, precision: NDArray, freedom: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Bounds of change. A parameter with a normal prior stays within `FITTING.max_deviation` standard deviations: a
    larger deviation is an effect, not a nuisance."""
    reach = np.where(precision > 0, FITTING.max_deviation / np.sqrt(np.maximum(precision, 1e-300)), np.inf)
    if freedom is not None:
        reach = np.where(np.isinf(freedom), reach, np.inf)
    return np.maximum(low, np.minimum(-reach - away, 0.0)), np.minimum(high, np.maximum(reach - away, 0.0))


def with_change(point: Point, candidates: Sequence[Candidate], change: NDArray) -> Point:
    """The point with the free parameters changed."""
    changes: dict[str, dict[str, Any]] = {}
    at = 0
    for c in candidates:
        here = c.values(point)
        for name in c.free:
            here[name] = float(np.clip(here[name] + change[at], *c.range_of(name)))
            at += 1
        changes[c.effect] = {**changes.get(c.effect, {}), **here}
    return point.with_effects(changes)


def refine(
    data: Data,
    point: Point,
    candidates: Sequence[Candidate],
    *,
    nuisances: Sequence[tuple[Candidate, tuple[float, ...]]] = (),
    about: Point | None = None,
    rounds: int = FITTING.rounds,
    noise: bool = True,
) -> Fitted:
    """Maximum of the posterior near a point, a model that contains the effects of the candidates.

    The `nuisances` are free, with normal or Student's t priors (`Candidate.freedom`) about neutral or about `about`.

    Raises: DivergedError if the filter leaves the range of numbers at the point.
    """
    free = [*candidates, *(c for c, _ in nuisances)]
    own = sum(len(c.free) for c in candidates)
    weight = np.array([0.0] * own + [w for _, precision in nuisances for w in precision])
    freedom = np.append(np.full(own, np.inf), freedom_of([c for c, _ in nuisances]))

    def away(at: Point) -> NDArray:
        middle = [c.neutral(at) if about is None else c.values(about) for c, _ in nuisances]
        apart = [c.values(at)[n] - m[n] for (c, _), m in zip(nuisances, middle, strict=True) for n in c.free]
        return np.array([0.0] * own + apart)

    def look(at: Point) -> tuple[float, Gram]:
        gram, loglik = data.converged(at, [column for c in free for column in c.columns(at)])
        return loglik + log_prior(away(at), weight, freedom), gram

    data.loglik(point)  # from here on, the physics is evaluated at the states of the filter
    with np.errstate(over="ignore", invalid="ignore"):
        value, gram = look(point)
    if not np.isfinite(value) or not np.isfinite(gram.information).all():
        raise DivergedError("the vehicle's model leaves the range of numbers on this flight: is it this drone's?")
    for turn in range(rounds if free else 0):
        low, high = nuisance_bounds(*bounds_of(free, point), away(point), weight, freedom)
        local = local_precision(away(point), weight, freedom)
        best = gram.solve(range(gram.size), low=low, high=high, precision=local, prior=-away(point))
        before, near = value, best.gain < FITTING.min_round_gain
        if near:  # the linear approximation is exact enough
            point, value, gram = with_change(point, free, best.theta), value + best.gain, gram.moved(best.theta)
        for k in range(0 if near else FITTING.tries):
            there = with_change(point, free, best.theta / 3**k)
            found, slopes = look(there)
            if found > value - 1e-6:
                point, value, gram = there, found, slopes
                break
            if found > value - FITTING.min_round_gain:  # a smaller step would gain too little, too
                break
        gained = value - before
        if noise and (turn < 1 or gained > 2.0):
            better = data.fit_noise(point, near=True)
            found, slopes = look(better)
            if found > value:
                point, value, gram = better, found, slopes
        if gained < FITTING.min_round_gain:
            break
    local = local_precision(away(point), weight, freedom)
    return Fitted(point, tuple(candidates), value, gram, local, tuple(c for c, _ in nuisances))
