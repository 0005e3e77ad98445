"""Flights under a model: what one pass says of it and of its neighbours, and its fit by Gauss-Newton steps.

A model is a set of members (variants of effects) and of random effects. Each flight has a point of its own: what all
share and what differs from recording to recording, and its noise scales.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, nominal
from crazyem.diagnosis.fitting.gram import bounded
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import first_guess
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.posterior.evidence import Gaussian, Pass, Posterior, Shared
from crazyem.diagnosis.posterior.members import Key, Member, Slopes, away, key_of, pool_of, prior_odds, started
from crazyem.diagnosis.posterior.settings import SETTINGS
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect
from crazyem.physics.effects.prior import Conditions
from crazyem.vehicle import Vehicle

FORCES = (0, 1, 2)  # of the disturbances


@dataclass(frozen=True)
class Look:
    """One pass at a point of every flight.

    Attributes:
        places: columns of each member and each variant that was looked at.
        usual: columns of what differs from recording to recording.
        shared: what the flights say.
        loglik: of all flights [nats]. passes: of each.
    """

    places: Mapping[Candidate, tuple[int, ...]]
    usual: Mapping[Candidate, tuple[int, ...]]
    shared: Shared
    loglik: float
    passes: tuple[Pass, ...]


@dataclass(frozen=True)
class Fit:
    """A model, fitted.

    Attributes:
        members, random: what it is made of.
        phi: (k,) what all flights share of its members, less neutral, in their order.
        points: one a flight. data: the flights with the paths of the last pass.
        value: log evidence and log prior odds [nats].
        blocks: (b,) log-likelihood by blocks of all flights.
        posterior: of phi.
        look: at these points.
        held: whether the forces of its noise are as large as is usual.
    """

    members: tuple[Member, ...]
    random: frozenset[str]
    phi: NDArray
    points: tuple[Point, ...]
    data: tuple[Data, ...]
    value: float
    blocks: NDArray
    posterior: Posterior
    look: Look
    held: bool

    @property
    def effects(self) -> frozenset[str]:
        """Names."""
        return frozenset(m.effect for m in self.members) | self.random


class Study:
    """Flights to be explained together, and what they may be explained by."""

    def __init__(
        self, flights: Sequence[Flight], vehicle: Vehicle, workers: Workers, *, wanted: Sequence[str] = ()
    ) -> None:
        bare = Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, first_guess())
        self.workers, self.vehicle = workers, vehicle
        self.pool = pool_of(flights, bare, wanted)
        self.effects = {m.effect for m in self.pool.members}
        self.calm = np.array([self._calm(e, bare) for e in self.pool.random]).min(initial=np.inf)
        data, points = [], []
        for flight in flights:
            one = Data([flight], workers)
            point = self._moving(nominal(one, bare))
            for c, _ in self.pool.usual:
                if c.effect not in point.effects:
                    point = point.with_effects({c.effect: c.neutral(point)})
            data.append(one)
            points.append(point)
        self.data, self.points = tuple(data), tuple(points)

    # noise

    def _calm(self, effect: Effect, point: Point) -> float:
        """m/s^2: the spread of a force with memory that is usual."""
        assert effect.random is not None
        one = effect.random(np.ones(6), SETTINGS.correlation_time, mass=point.vehicle.mass, drag=float("nan"))
        return effect.prior.usual_in(Conditions())[effect.amplitude] / one[effect.amplitude]

    def _moving(self, point: Point) -> Point:
        """With a force that has a memory as part of the noise, as every flight has."""
        if not np.isfinite(self.calm):
            return point
        old = point.noise
        memory = np.broadcast_to(np.asarray(old.memory, float), (6,)).copy()
        memory[list(FORCES)] = SETTINGS.correlation_time
        disturbance = old.disturbance.copy()
        disturbance[list(FORCES)] = 0.5 * self.calm
        return replace(point, noise=replace(old, disturbance=disturbance, memory=memory))

    def noisy(self, data: Data, point: Point, random: frozenset[str], *, near: bool = True) -> Point:
        """Noise scales that fit; forces with memory no larger than is usual where the model has no random effect."""
        found = data.fit_noise(point, near=near, rows=SETTINGS.noise_rows)
        if random or not np.isfinite(self.calm):
            return found
        large = tuple(i for i in FORCES if found.noise.disturbance[i] > self.calm)
        if not large:
            return found
        disturbance = found.noise.disturbance.copy()
        disturbance[list(large)] = self.calm
        held = replace(found, noise=replace(found.noise, disturbance=disturbance))
        return data.fit_noise(held, near=near, rows=SETTINGS.noise_rows, held=large)

    def stilled(self, points: Sequence[Point]) -> tuple[Point, ...]:
        """The points without a force that has a memory, where it is far below what is usual in all of them."""
        if any(np.any(p.noise.disturbance[list(FORCES)] > SETTINGS.negligible_share * self.calm) for p in points):
            return tuple(points)
        turns = [np.where(np.isin(range(6), FORCES), 0.0, p.noise.disturbance) for p in points]
        return tuple(
            replace(p, noise=replace(p.noise, disturbance=d)) for p, d in zip(points, turns, strict=True)
        )  # fmt: skip

    def quiet(self, points: Sequence[Point]) -> list[Point]:
        """The points with little of the noise that has a memory."""
        return [
            replace(p, noise=replace(p.noise, disturbance=SETTINGS.reduced_share * p.noise.disturbance)) for p in points
        ]  # fmt: skip

    def random_log_prior(self, fit: Fit) -> float:
        """Log of how much probability the spread of its random effects takes of their prior."""
        total = 0.0
        for effect in self.pool.random:
            if effect.name not in fit.random:
                continue
            value = self.size_of(effect, fit)[effect.amplitude]
            own = effect.prior.own[effect.amplitude]
            seconds = sum(f.duration for d in fit.data for f in d.flights)
            told = 1.0 / np.sqrt(max(3.0 * seconds / SETTINGS.correlation_time, 2.0))  # relative; three axes
            total += float(np.log(2.0 * value * told / own) - 0.5 * (value / own) ** 2) + prior_odds()
        return total

    def size_of(self, effect: Effect, fit: Fit) -> dict[str, float]:
        """Parameters of a random effect, by the noise of a fit."""
        spread = np.median([p.noise.disturbance for p in fit.points], axis=0)
        drag = _drag(fit)
        assert effect.random is not None
        return effect.random(spread, SETTINGS.correlation_time, mass=self.vehicle.mass, drag=drag)

    # one pass

    def look(
        self, data: Sequence[Data], points: Sequence[Point], members: Sequence[Member], near: Slopes,
        more: Sequence[Member] = (),
    ) -> Look:  # fmt: skip
        """One pass with the columns of the members, of what is usual, and of `more`.

        near: derivatives that were taken near the points; those of the members are taken at these.

        Raises: DivergedError.
        """
        keys: dict[Key, int] = {}
        columns: list[Candidate] = []

        def placed(c: Candidate, names: Sequence[str]) -> tuple[int, ...]:
            for n in names:
                if key_of(c, n) not in keys:
                    keys[key_of(c, n)] = len(columns)
                    columns.append(replace(c, free=(n,)))
            return tuple(keys[key_of(c, n)] for n in names)

        present = {m.effect: m.candidate for m in members}
        places = {m.candidate: placed(m.candidate, m.candidate.free) for m in members}
        usual: dict[Candidate, tuple[int, ...]] = {}
        sds: dict[int, NDArray] = {}
        for c, table in self.pool.usual:
            usual[c] = placed(present.get(c.effect, c), c.free)
            sds.update(zip(usual[c], table.T, strict=True))
        for m in more:
            if m.effect not in present:
                places[m.candidate] = placed(m.candidate, m.candidate.free)
        sd = np.array([sds.get(i, np.zeros(len(data))) for i in range(len(columns))]).T
        passes = []
        for f, (one, point) in enumerate(zip(data, points, strict=True)):
            used = [
                near[key_of(c, c.free[0])][f]
                if c.effect not in present and key_of(c, c.free[0]) in near
                else c.columns(point)[0]
                for c in columns
            ]
            with np.errstate(over="ignore", invalid="ignore"):
                gram, loglik = one.gram_and_loglik(point, used)
            if not np.isfinite(loglik) or not np.isfinite(gram.information).all():
                raise DivergedError(
                    "the vehicle's model leaves the range of numbers on this flight: is it this drone's?"
                )
            here = np.array([away(c, point, c.free[0]) for c in columns])
            passes.append(Pass(loglik, gram.score, gram.information, here))
        return Look(places, usual, Shared(passes, sd), sum(p.loglik for p in passes), tuple(passes))

    def slopes(
        self, data: Sequence[Data], points: Sequence[Point], members: Sequence[Member], more: Sequence[Member] = ()
    ) -> Slopes:
        """Derivatives of what is usual and of `more` at some points, but for the members' effects."""
        present, wanted = {m.effect for m in members}, {}
        for c in (*(c for c, _ in self.pool.usual), *(m.candidate for m in more)):
            if c.effect not in present:
                wanted.update({key_of(c, n): replace(c, free=(n,)) for n in c.free})
        each = [
            d.models[0].slopes(p, [c.columns(p)[0] for c in wanted.values()], self.workers)
            for d, p in zip(data, points, strict=True)
        ]
        return dict(zip(wanted, zip(*each, strict=True), strict=True))

    def prior(self, members: Sequence[Member], *, nudged: Sequence[Member] = ()) -> Gaussian:
        """Of what all flights share of some members, in their order."""
        parts = [m.prior(self.points[0], nudged=m in nudged) for m in members]
        size = sum(p.low.size for p in parts)
        covariance, k = np.zeros((size, size)), 0
        for p in parts:
            covariance[k : k + p.low.size, k : k + p.low.size] = p.covariance
            k += p.low.size
        low, high = (np.concatenate([getattr(p, n) for p in parts] or [np.zeros(0)]) for n in ("low", "high"))
        return Gaussian(covariance, low, high)

    def posterior(self, look: Look, members: Sequence[Member], *, nudged: Sequence[Member] = ()) -> Posterior:
        """Of some members that were looked at."""
        at = [i for m in members for i in look.places[m.candidate]]
        return look.shared.posterior(at, self.prior(members, nudged=nudged))

    # a fit

    def height(self, look: Look, points: Sequence[Point], members: Sequence[Member], phi: NDArray) -> float:
        """Log-likelihood of the flights by a look, and log density of what is usual and of phi, but for constants."""
        common, k, total = {}, 0, look.loglik
        for m in members:
            common.update({(m.effect, n): phi[k + i] for i, n in enumerate(m.candidate.free)})
            k += len(m.candidate.free)
        for c, table in self.pool.usual:
            own = next((m.candidate for m in members if m.effect == c.effect), c)
            for point, sd in zip(points, table, strict=True):
                apart = np.array([away(own, point, n) - common.get((c.effect, n), 0.0) for n in c.free])
                used = sd > 0
                total -= 0.5 * float(np.sum(np.square(apart[used] / sd[used])))
        if phi.size:
            total -= 0.5 * float(phi @ np.linalg.solve(self.prior(members).covariance, phi))
        return total

    def fit(
        self, data: Sequence[Data], points: Sequence[Point], members: Sequence[Member], random: frozenset[str],
        phi: NDArray, near: Slopes,
    ) -> Fit:  # fmt: skip
        """The maximum near some points, with noise scales that fit there; what is in `data` changes.

        Raises: DivergedError.
        """
        data, points = tuple(data), tuple(points)

        def seen(points: tuple[Point, ...], phi: NDArray) -> tuple[float, Look]:
            for one, point in zip(data, points, strict=True):
                with np.errstate(over="ignore", invalid="ignore"):
                    one.converge(point)
            look = self.look(data, points, members, near)
            return self.height(look, points, members, phi), look

        for one, point in zip(data, points, strict=True):
            one.settle(point)
        height, look = seen(points, phi)
        for turn in range(SETTINGS.max_rounds):
            before = height
            aim, wanted = self._aim(look, members)
            for part in SETTINGS.step_shares:
                there = self._moved(points, members, look, wanted, part), phi + part * (aim - phi)
                try:
                    found, slopes = seen(*there)
                except DivergedError:
                    continue
                if found > height - 1e-3:
                    (points, phi), height, look = there, found, slopes
                    break
            if turn < 1 or height - before > SETTINGS.noise_refit:
                noisy = tuple(self.noisy(d, p, random) for d, p in zip(data, points, strict=True))
                found, slopes = seen(noisy, phi)
                if found > height or turn == 0:
                    points, height, look = noisy, found, slopes
            if abs(height - before) < SETTINGS.convergence:
                break
        return self.fitted(data, points, members, random, phi, look)

    def fitted(
        self, data: tuple[Data, ...], points: tuple[Point, ...], members: Sequence[Member], random: frozenset[str],
        phi: NDArray, look: Look,
    ) -> Fit:  # fmt: skip
        """The fit by its last look."""
        posterior = self.posterior(look, members)
        blocks = np.concatenate([d.block_loglik(p) for d, p in zip(data, points, strict=True)])
        held = bool(np.isfinite(self.calm)) and any(
            np.any(p.noise.disturbance[list(FORCES)] >= 0.999 * self.calm) for p in points
        )
        fit = Fit(tuple(members), random, phi, points, data, 0.0, blocks, posterior, look, held)
        value = look.shared.nothing + posterior.gain + sum(m.odds for m in members) + self.random_log_prior(fit)
        return replace(fit, value=float(value))

    def _aim(self, look: Look, members: Sequence[Member]) -> tuple[NDArray, list[NDArray]]:
        """Where the last look sees the maximum: phi (k,), and the parameters of every flight (c,)."""
        at = np.array([i for m in members for i in look.places[m.candidate]], int)
        prior, shared = self.prior(members), look.shared
        phi = np.zeros(0)
        if at.size:
            curvature = shared.information[np.ix_(at, at)] + np.linalg.inv(prior.covariance)
            phi = bounded(curvature, shared.score[at], prior.low, prior.high)
        whole = np.zeros(shared.score.size)
        whole[at] = phi
        return phi, shared.parameters(whole)

    def _moved(
        self, points: Sequence[Point], members: Sequence[Member], look: Look, wanted: Sequence[NDArray], part: float
    ) -> tuple[Point, ...]:
        """The points, a part of the way to the parameters `wanted` of each flight."""
        free: list[tuple[Candidate, Mapping[str, int], NDArray | None]] = []
        table: NDArray | None
        for c, table in self.pool.usual:
            own = next((m.candidate for m in members if m.effect == c.effect), None)
            free.append((own or c, dict(zip(c.free, look.usual[c], strict=True)), table))
        for m in members:
            free.append((m.candidate, dict(zip(m.candidate.free, look.places[m.candidate], strict=True)), None))
        moved, present = [], {m.effect for m in members}
        for f, (point, goal) in enumerate(zip(points, wanted, strict=True)):
            changes: dict[str, dict[str, Any]] = {}
            for c, where, table in free:
                neutral = c.neutral(point)
                values = changes.setdefault(c.effect, c.values(point))
                for k, (name, i) in enumerate(where.items()):
                    low, high = c.range_of(name)
                    if table is not None and table[f, k] > 0:
                        reach = SETTINGS.deviation_range * table[f, k]
                        low = min(low, neutral[name] - reach)
                        asked = CATALOGUE[c.effect].prior.own.get(name, 0.0) > 0.0 and c.effect in self.effects
                        if asked and c.effect not in present:  # beyond, it is an effect
                            low, high = max(low, neutral[name] - reach), min(high, neutral[name] + reach)
                    here = away(c, point, name)
                    values[name] = float(np.clip(neutral[name] + here + part * (goal[i] - here), low, high))
            moved.append(point.with_effects(changes))
        return tuple(moved)

    def begun(self, base: Fit, member: Member, change: NDArray, near: Slopes) -> Fit:
        """The base with one member more, begun where the linear approximation says, or nearer to nothing.

        Raises: DivergedError.
        """
        c = member.candidate
        tried: list[tuple[float, list[Point], list[Data]]] = []
        for part in SETTINGS.step_shares:
            starts, data = [started(p, c, part * change) for p in base.points], [d.twin() for d in base.data]
            with np.errstate(over="ignore", invalid="ignore"):
                value = sum(d.loglik(p, passes=2) for d, p in zip(data, starts, strict=True))
            tried.append((value if np.isfinite(value) else -np.inf, starts, data))
            if tried[-1][0] > base.look.loglik:
                break
        _, starts, data = max(tried, key=lambda t: t[0])
        phi = np.concatenate([base.phi, [away(c, starts[0], n) - away(c, base.points[0], n) for n in c.free]])
        return self.fit(data, starts, (*base.members, member), base.random, phi, near)

    def without_flight(self, base: Fit, index: int) -> Fit:
        """The base fitted to all flights but one.

        Raises: DivergedError.
        """
        kept = [f for f in range(len(base.points)) if f != index]
        usual = tuple((c, table[kept]) for c, table in self.pool.usual)
        rest = copy(self)
        rest.pool, rest.points = replace(self.pool, usual=usual), tuple(self.points[f] for f in kept)
        data, points = [base.data[f].twin() for f in kept], [base.points[f] for f in kept]
        return rest.fit(data, points, base.members, base.random, base.phi, {})

    def restarted(self, base: Fit, members: Sequence[Member], random: frozenset[str], near: Slopes) -> Fit:
        """The base with some of its members only, or with other random effects.

        Raises: DivergedError.
        """
        kept = {m.effect for m in members}
        gone = [m for m in base.members if m.effect not in kept]
        points, phi, k = [], [], 0
        usual = {c.effect: c for c, _ in self.pool.usual}
        for m in base.members:
            if m.effect in kept:
                phi.append(base.phi[k : k + len(m.candidate.free)])
            k += len(m.candidate.free)
        for point in base.points:
            effects = {n: v for n, v in point.effects.items() if all(n != m.effect for m in gone)}
            for m in gone:
                if m.effect in self.vehicle.effects:
                    effects[m.effect] = dict(self.vehicle.effects[m.effect])
                elif m.effect in usual:
                    effects[m.effect] = usual[m.effect].neutral(point)
            points.append(replace(point, effects=effects))
        return self.fit(
            [d.twin() for d in base.data], points, members, random, np.concatenate([*phi, np.zeros(0)]), near
        )


def _drag(fit: Fit) -> float:
    """N s/m: mean of what couples the air to the drone in a fit; NaN if nothing does."""
    values = [
        float(v) for n, table in fit.points[0].effects.items() for v in table.values()
        if n in CATALOGUE and CATALOGUE[n].couples_air and n in fit.effects
    ]  # fmt: skip
    return float(np.mean(values)) if values else float("nan")
