"""The search among sets of effects on a linear toy, of which every subset's posterior is known."""

from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from crazyem.diagnosis.posterior.answer import beliefs_of
from crazyem.diagnosis.posterior.search import Search
from crazyem.diagnosis.workers import Workers

MISSING = 0.1
ODDS = np.log(MISSING / (1.0 - MISSING))


@dataclass(frozen=True)
class ToyCandidate:
    free: tuple[str, ...] = ("size",)


@dataclass(frozen=True)
class ToyMember:
    effect: str
    candidate: ToyCandidate = field(default_factory=ToyCandidate)
    odds: float = ODDS


@dataclass(frozen=True, eq=False)
class ToyFit:
    members: tuple[Any, ...]
    value: float
    blocks: Any
    random: frozenset = frozenset()
    phi: Any = field(default_factory=lambda: np.zeros(0))
    data: tuple = ()
    points: tuple = ()
    held: bool = False
    look: Any = None

    @property
    def effects(self) -> frozenset:
        return frozenset(m.effect for m in self.members)


class Shared:
    scatter = np.ones(1)


class Look:
    shared = Shared()
    passes = ()

    def __init__(self, members: Any) -> None:
        self.places = {m.candidate: (0,) for m in members}


class Pool:
    random, usual = (), ()

    def __init__(self, members: Any) -> None:
        self.members = self.looks = members


class Gain:
    def __init__(self, gain: float, size: int) -> None:
        self.gain, self.mean = gain, np.zeros(size)


class Toy:
    """y = X theta + noise of unit variance; an effect is a column with theta of variance 4, or 0 without it."""

    def __init__(self, seed: int, effects: int = 6, *, alike: float = 0.0) -> None:
        random = np.random.default_rng(seed)
        x = random.normal(size=(40, effects)) / 2.5
        x[:, 1] = alike * x[:, 0] + np.sqrt(1.0 - alike**2) * x[:, 1]
        self.there = random.random(effects) < MISSING
        theta = np.where(self.there, 2.0 * random.normal(size=effects), 0.0)
        self.x, self.y = x, x @ theta + random.normal(size=40)
        self.names = [f"effect {i}" for i in range(effects)]
        self.pool = Pool([ToyMember(n) for n in self.names])
        self.data, self.points, self.workers = (), (), Workers(1)

    def evidence(self, names: Any) -> float:
        x = self.x[:, [self.names.index(n) for n in sorted(names)]]
        covariance = np.eye(40) + 4.0 * x @ x.T
        return float(-0.5 * self.y @ np.linalg.solve(covariance, self.y) - 0.5 * np.linalg.slogdet(covariance)[1])

    def made(self, members: Any) -> ToyFit:
        names = {m.effect for m in members}
        x = self.x[:, [self.names.index(n) for n in sorted(names)]]
        theta = np.linalg.solve(x.T @ x + 0.25 * np.eye(x.shape[1]), x.T @ self.y)
        blocks = -0.5 * np.square(self.y - x @ theta).reshape(20, 2).sum(1)
        value = self.evidence(names) + ODDS * len(names)
        return ToyFit(tuple(members), value, blocks, phi=np.zeros(len(names)), look=Look(members))

    def fit(self, data: Any, points: Any, members: Any, random: Any, phi: Any, near: Any) -> ToyFit:
        return self.made(members)

    def begun(self, base: ToyFit, member: Any, change: Any, near: Any) -> ToyFit:
        return self.made((*base.members, member))

    def restarted(self, base: ToyFit, members: Any, random: Any, near: Any) -> ToyFit:
        return self.made(members)

    def quiet(self, points: Any) -> Any:
        return points

    def stilled(self, points: Any) -> Any:
        return points

    def slopes(self, *given: Any) -> dict:
        return {}

    def look(self, data: Any, points: Any, members: Any, near: Any, more: Any = ()) -> Look:
        return Look([*members, *more])

    def posterior(self, look: Any, members: Any, *, nudged: Any = ()) -> Gain:
        return Gain(self.evidence({m.effect for m in members}), len(members))

    def enumerated(self) -> dict[frozenset, float]:
        sets = [frozenset(c) for k in range(len(self.names) + 1) for c in combinations(self.names, k)]
        values = np.array([self.evidence(s) + ODDS * len(s) for s in sets])
        weights = np.exp(values - values.max())
        return dict(zip(sets, weights / weights.sum(), strict=True))


@pytest.mark.parametrize("seed", range(12))
def test_the_search_finds_the_posterior_over_all_subsets(seed: int) -> None:
    toy = Toy(seed, alike=0.95 if seed % 2 else 0.0)
    models = Search(toy, lambda text: None).run()
    known = toy.enumerated()
    assert models[0].effects == max(known, key=known.get)
    weights = np.exp(np.array([m.value for m in models]) - models[0].value)
    for name in toy.names:
        said = sum(w for w, m in zip(weights, models, strict=True) if name in m.effects) / weights.sum()
        assert said == pytest.approx(sum(p for s, p in known.items() if name in s), abs=0.12)


def test_probabilities_of_a_toy_are_as_often_right_as_they_say() -> None:
    said, right = [], []
    for seed in range(1000, 1300):
        toy = Toy(seed, 4)
        beliefs = beliefs_of(Search(toy, lambda text: None).run())
        said += [beliefs.of(n) for n in toy.names]
        right += list(toy.there)
    said_, right_ = np.array(said), np.array(right, float)
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.01)):
        use = (said_ >= low) & (said_ < high)
        chance = np.sqrt(said_[use].mean() * (1.0 - said_[use].mean()) / use.sum())
        assert right_[use].mean() == pytest.approx(said_[use].mean(), abs=3.0 * chance + 0.01)
