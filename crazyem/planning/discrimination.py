"""Expected log odds of a flight between two effects, with the model of the diagnosis.

Under a model M with parameters theta ~ N(0, P), the score s of all columns is normal with covariance F + F_M P F_M'. F
is the information with the usual nuisances integrated out. If the first of two models is true, the expected log odds
are the Kullback-Leibler divergence between two normal distributions of few dimensions (Lindley 1956; Box and Hill,
Discrimination among mechanistic models, 1967). With parallel columns of the two effects, F does not have full rank, and
no flight can distinguish the effects. This is known before the flight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.fitting.noise import TYPICAL
from crazyem.diagnosis.flights.flight import Flight
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.motion import RotorInput
from crazyem.planning.closed_loop import Flown
from crazyem.planning.limits import Limits
from crazyem.planning.priors import nuisances_of, variants_of
from crazyem.vehicle import Vehicle

HEIGHT = 1.0  # m of the hover above the floor (control/named_trajectories.py, DEFAULT_HEIGHT)
HELD = 3.5e-3  # s between a command's stamp and its effect (estimation/model.py, DELAY_OF_COMMANDS)
THINNED = 2  # every second sample is used, enough for the odds
DECIDED = math.log(20.0)  # nats; odds of 20 to 1 decide (Kass and Raftery 1995: strong)
DRAWS = 1000  # draws of drones and noise for the share of right decisions
LIKELY = 0.8  # least share of right decisions of a useful manoeuvre
LOST = 1e-9  # eigenvalue over the largest, below which a direction of the scores has no information
SIGNALS = frozenset({"position", "velocity", "attitude", "body_rate", "voltage", "motor_command"})


@dataclass(frozen=True)
class Odds:
    """Expected odds of a flight between two effects.

    Attributes:
        effects: the two effects.
        expected: (2,) expected log odds [nats] for the first effect if the first is true, for the second likewise.
        decided: (2,) share of drones for which the odds reach 20 to 1 for the true effect.
        wrong: (2,) share of drones for which the odds reach 20 to 1 for the other effect.
        correlation: largest correlation between combinations of columns of the two effects, with nuisances projected
            out; at 1 the columns are parallel.
    """

    effects: tuple[str, str]
    expected: tuple[float, float]
    decided: tuple[float, float]
    wrong: tuple[float, float]
    correlation: float

    @property
    def decides(self) -> bool:
        """Whether the flight is likely to decide, whichever effect is true."""
        return min(self.decided) >= LIKELY


def flight_of(flown: Flown, vehicle: Vehicle, limits: Limits) -> Flight:
    """A simulated flight without noise, in the diagnosis's form of a recording."""
    n = flown.time.size
    y = flown.state.copy()
    y[:, 2] += HEIGHT
    voltage = np.linspace(limits.voltage + 0.3, limits.voltage, n)  # V, a battery that discharges in flight
    inputs = RotorInput(
        time=flown.time, thrust=flown.command, voltage=voltage, flown=flown.time + 2.0, measured=False, delay=HELD
    )
    keep = slice(None, None, THINNED)
    time = np.ascontiguousarray(flown.time[keep])  # as in recordings: one compiled kernel serves both
    starts = np.zeros(time.size, bool)
    starts[0] = True
    return Flight(
        name="plan", time=time, starts=starts, gaps=starts, y=np.ascontiguousarray(y[keep]),
        force=np.full((time.size, 3), np.nan), voltage=voltage[keep], flown=time + 2.0, ground=0.0,
        block=np.zeros(time.size, np.int64), inputs=inputs, signals=SIGNALS, fused=True,
    )  # fmt: skip


class Pair:
    """Two effects that a flight of one vehicle should distinguish."""

    def __init__(self, first: str, second: str, vehicle: Vehicle, limits: Limits) -> None:
        """Raises UsageError: an effect is unknown, or random, so that a plan cannot show it; or both are the same."""
        for name in (first, second):
            if name not in CATALOGUE:
                raise UsageError(f"unknown effect '{name}' (known: {', '.join(CATALOGUE)}).")
            if CATALOGUE[name].random:
                raise UsageError(f"{name} is random motion of the air: it has no columns, and a plan cannot aim at it.")
        if first == second:
            raise UsageError("--split needs two different effects.")
        self.effects = (first, second)
        self.vehicle, self.limits = vehicle, limits
        self.point = Point(vehicle, dict(vehicle.effects), TYPICAL)

    def odds(self, flown: Flown, *, draws: int = DRAWS, seed: int = 0) -> Odds:
        """Expected odds of a flight, with shares from `draws` drones and noises; with 0 draws the shares are NaN."""
        first, second = self._statistics(flown)
        random = np.random.default_rng(seed)
        expected, decided, wrong = [], [], []
        for mine, other in ((first, second), (second, first)):
            means = [min(_divergence(a, b) for b in other) for a in mine]
            expected.append(float(np.mean(means)))
            right, false = _shares(mine, other, random, draws) if draws else (math.nan, math.nan)
            decided.append(right)
            wrong.append(false)
        correlation = max(_correlation(a, b) for a in first for b in second)
        return Odds(
            self.effects, (expected[0], expected[1]), (decided[0], decided[1]), (wrong[0], wrong[1]), correlation
        )

    def merit(self, flown: Flown) -> float:
        """Merit for the optimiser: mainly the smaller of both expected log odds; logarithms limit very large ones."""
        odds = self.odds(flown, draws=0)
        low, high = sorted(odds.expected)
        return math.log1p(low) + 0.1 * math.log1p(high)

    def _statistics(self, flown: Flown) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
        """Columns (r, k) of each variant of the two effects, in the space where noise and nuisances are white; columns
        are multiplied by the Cholesky factor of the prior covariance of the parameters."""
        flight = flight_of(flown, self.vehicle, self.limits)
        variants = [variants_of(name, flight, self.point) for name in self.effects]
        usual = nuisances_of(flight, self.point, self.effects)
        columns = [column for c, _ in usual for column in c.columns(self.point)]
        ends = [len(columns)]
        for v in (*variants[0], *variants[1]):
            columns += v.candidate.columns(self.point)
            ends.append(len(columns))
        swept = Model(flight).sweep(self.point, columns)
        information = swept.information.sum(0)
        u = ends[0]
        sd = np.array([s for _, s in usual])
        inner = np.eye(u) + sd[:, None] * information[:u, :u] * sd
        across = sd[:, None] * information[:u, u:]
        rest = information[u:, u:] - across.T @ np.linalg.solve(inner, across)
        root = _root(rest)
        white = [
            root[:, begin - u : end - u] @ np.linalg.cholesky(v.covariance(self.point))
            for v, begin, end in zip((*variants[0], *variants[1]), ends[:-1], ends[1:])
        ]
        return white[: len(variants[0])], white[len(variants[0]) :]


def _root(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """R (r, c) with R'R = information, without directions that have no information."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > LOST * max(float(values[-1]), 1e-300)
    root: NDArray[np.float64] = (np.sqrt(values[kept])[:, None] * vectors[:, kept].T) * scale
    return root


def _divergence(true: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Kullback-Leibler divergence [nats] of N(0, I + B B') from the true N(0, I + A A'); A (r, k), B (r, l)."""
    r = true.shape[0]
    s, t = np.eye(r) + true @ true.T, np.eye(r) + other @ other.T
    return 0.5 * float(np.trace(np.linalg.solve(t, s)) - r + np.linalg.slogdet(t)[1] - np.linalg.slogdet(s)[1])


def _shares(
    mine: Sequence[NDArray[np.float64]], other: Sequence[NDArray[np.float64]], random: np.random.Generator, draws: int
) -> tuple[float, float]:
    """Shares of draws under the first effect in which the log evidence decides for the first, and for the second."""
    each = max(1, draws // len(mine))
    odds = []
    for a in mine:
        z = random.standard_normal((each, a.shape[0])) + random.standard_normal((each, a.shape[1])) @ a.T
        odds.append(_log_evidence(mine, z) - _log_evidence(other, z))
    found = np.concatenate(odds)
    return float(np.mean(found > DECIDED)), float(np.mean(found < -DECIDED))


def _log_evidence(variants: Sequence[NDArray[np.float64]], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log evidence (n,) of scores z (n, r), for equally likely variants."""
    rows = []
    for a in variants:
        inner = np.eye(a.shape[1]) + a.T @ a
        projected = z @ a
        rows.append(
            0.5 * np.einsum("nk,kl,nl->n", projected, np.linalg.inv(inner), projected)
            - 0.5 * float(np.linalg.slogdet(inner)[1])
        )
    total: NDArray[np.float64] = np.logaddexp.reduce(np.array(rows), axis=0) - math.log(len(rows))
    return total


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Largest canonical correlation between the columns of A (r, k) and B (r, l); 0 if one of them has no columns."""
    bases = []
    for matrix in (a, b):
        scale = np.linalg.norm(matrix, axis=0)
        kept = matrix[:, scale > 1e-6 * max(float(scale.max()), 1e-300)]
        if not kept.size or not scale.max() > 0:
            return 0.0
        u, s, _ = np.linalg.svd(kept / np.linalg.norm(kept, axis=0), full_matrices=False)
        bases.append(u[:, s > 1e-3 * s[0]])
    return min(float(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0]), 1.0)
