"""The search among sets of effects: every single one is fitted once, then one is added, taken away or exchanged.

All models are compared by fitted evidence. What the pass of a fitted model says of its neighbours in the linear
approximation only tells which of them are fitted next.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import DivergedError
from crazyem.diagnosis.posterior.evidence import scatter_of
from crazyem.diagnosis.posterior.members import Member, Slopes
from crazyem.diagnosis.posterior.onset import begun_later, dated
from crazyem.diagnosis.posterior.settings import SETTINGS
from crazyem.diagnosis.posterior.study import Fit, Look, Study

Say = Callable[[str], None]


@dataclass(frozen=True)
class Neighbour:
    """A model with one effect more, by the linear approximation.

    Attributes:
        member: the best variant; None: a random effect.
        effect: its name.
        gain: log posterior odds against the model that it was looked at from.
        change: (k,) of its parameters from neutral.
        most: the gain where the noise has no memory, if that is more: a force that lasts may hide in such noise.
    """

    member: Member | None
    effect: str
    gain: float
    change: NDArray
    most: float = -np.inf


class Search:
    """Models that were fitted, by their effects."""

    def __init__(self, study: Study, say: Say) -> None:
        self.study, self.say = study, say
        self.visited: dict[frozenset[str], Fit] = {}
        self._looked: dict[frozenset[str], list[Neighbour]] = {}
        self._slopes: dict[frozenset[str], Slopes] = {}

    def run(self) -> list[Fit]:
        """All models that were fitted, the most probable first."""
        study = self.study
        nothing = study.fit([d.twin() for d in study.data], study.points, (), frozenset(), np.zeros(0), {})
        still = study.stilled(nothing.points)
        if any(a is not b for a, b in zip(still, nothing.points, strict=True)):
            nothing = study.fit([d.twin() for d in study.data], still, (), frozenset(), np.zeros(0), {})
        self._keep(nothing)
        self.say(f"nothing missing: {nothing.value:.1f}, scatter {np.median(nothing.look.shared.scatter):.2f}")
        self._grow(nothing, least=SETTINGS.single_log_odds, most=None)
        for _ in range(SETTINGS.max_turns):
            best = self.best
            self._grow(best)
            if self.best is best:
                self._swap(best)
            if self.best is best:
                break
        return sorted(self.visited.values(), key=lambda f: -f.value)

    @property
    def best(self) -> Fit:
        """The most probable."""
        return max(self.visited.values(), key=lambda f: f.value)

    def _keep(self, fit: Fit) -> Fit:
        known = self.visited.get(fit.effects)
        if known is None or fit.value > known.value:
            self.visited[fit.effects] = fit
        return self.visited[fit.effects]

    def neighbours(self, fit: Fit) -> list[Neighbour]:
        """Models with one effect more, the most promising first."""
        if fit.effects in self._looked:
            return self._looked[fit.effects]
        study = self.study
        found: dict[str, Neighbour] = {}
        loud: dict[str, float] = {}
        raws: dict[str, float] = {}
        data = [d.twin() for d in fit.data]
        near = study.slopes(data, fit.points, fit.members, study.pool.looks)
        look = study.look(data, fit.points, fit.members, near, study.pool.looks)
        quiet = study.look([d.twin() for d in data], study.quiet(fit.points), fit.members, near, study.pool.looks)
        usual = {c.effect for c, _ in study.pool.usual}
        self._slopes[fit.effects] = {key: columns for key, columns in near.items() if key[0] in usual}
        base, bare = (study.posterior(there, fit.members).gain for there in (look, quiet))
        size = fit.phi.size
        for whole, m in zip(study.pool.members, study.pool.looks, strict=True):
            if m.effect in fit.effects:
                continue
            there = study.posterior(look, (*fit.members, m), nudged=(m,))
            still = study.posterior(quiet, (*fit.members, m), nudged=(m,))
            gain = (there.gain - base) / _scatter(look, m, there.mean[size:]) + m.odds
            bared = (still.gain - bare) / _scatter(quiet, m, still.mean[size:]) + m.odds
            loud[m.effect] = max(loud.get(m.effect, gain), gain, bared)
            # of an effect of many beginnings only the amplitude was looked at; the rest is where it begins
            change = np.zeros(len(whole.candidate.free))
            change[[whole.candidate.free.index(n) for n in m.candidate.free]] = there.mean[size:]
            variants = [(there.gain - base + m.odds, Neighbour(whole, m.effect, gain, change))]
            later = begun_later(study, fit, look, m)
            if later is not None:
                gain = (later.gain - base) / later.scatter + later.member.odds
                loud[m.effect] = max(loud[m.effect], gain)
                raw = later.gain - base + later.member.odds
                variants.append((raw, Neighbour(later.member, m.effect, gain, later.change)))
            for raw, one in variants:  # scatter tells what to fit, and not which rotor it is
                if m.effect not in found or raw > raws[m.effect]:
                    found[m.effect], raws[m.effect] = one, raw
        for effect in study.pool.random:
            if effect.name not in fit.effects and fit.held:
                found[effect.name] = Neighbour(None, effect.name, np.inf, np.zeros(0))
        most = [replace(n, most=max(n.gain, loud.get(n.effect, n.gain))) for n in found.values()]
        self._looked[fit.effects] = sorted(most, key=lambda n: -n.most)
        return self._looked[fit.effects]

    def _fitted(self, base: Fit, neighbour: Neighbour) -> Fit | None:
        """A neighbour, fitted; None where it leaves the range of numbers."""
        near = self._slopes[base.effects]
        try:
            if neighbour.member is None:
                return self.study.restarted(base, base.members, base.random | {neighbour.effect}, near)
            return dated(self.study, self.study.begun(base, neighbour.member, neighbour.change, near), near)
        except (DivergedError, np.linalg.LinAlgError):
            return None

    def _grow(self, base: Fit, *, least: float | None = None, most: int | None = SETTINGS.max_neighbours) -> None:
        """Fit neighbours with one effect more, of which as much is expected; a few in any case."""
        near = self.neighbours(base)
        top = max((n.most for n in near if np.isfinite(n.most)), default=0.0)
        least = min(top - SETTINGS.gain_margin, SETTINGS.gain_share * top) if least is None else least
        wanted = [n for k, n in enumerate(near) if n.most > least or k < SETTINGS.min_neighbours][:most]
        self._fit_all(base, [n for n in wanted if base.effects | {n.effect} not in self.visited])

    def _swap(self, best: Fit) -> None:
        """Fit the model without each of its effects, and with another one in its place."""
        for effect in sorted(best.effects):
            less = best.effects - {effect}
            if less not in self.visited:
                members = [m for m in best.members if m.effect != effect]
                try:
                    self._keep(self.study.restarted(best, members, best.random - {effect}, {}))
                except (DivergedError, np.linalg.LinAlgError):
                    continue
            if less:  # rivals of an effect that brings much must bring some of that, too
                self._grow(self.visited[less], least=SETTINGS.gain_share * (best.value - self.visited[less].value))

    def _fit_all(self, base: Fit, wanted: Sequence[Neighbour]) -> None:
        for n, fit in zip(wanted, self.study.workers.map(lambda n: self._fitted(base, n), wanted), strict=True):
            if fit is None:
                continue
            self._keep(fit)
            self.say(f"  {', '.join(sorted(fit.effects))}: {fit.value - base.value:+.1f} (linear {n.gain:+.1f})")


def _scatter(look: Look, member: Member, change: NDArray) -> float:
    """Variance of the blocks' scores of a member, taken after its change, over what the model says of it."""
    at = list(look.places[member.candidate])
    if not look.passes:
        return 1.0
    inner = [p.information[:, at][:, :, at] for p in look.passes]
    rest = [p.score[:, at] - a @ change for p, a in zip(look.passes, inner, strict=True)]
    size = np.sum([np.einsum("bii->i", a) for a in inner], axis=0)
    return float(np.median(scatter_of(np.concatenate(rest), size)))


def tempered(best: Fit, other: Fit) -> float:
    """Log posterior odds of a model against the best, by how the difference of their likelihoods scatters over blocks.

    A difference of normal likelihoods that holds has a variance of twice its mean; where it scatters more, blocks count
    less: the odds are 2 m^2 / v for a mean m and a variance v (Pauli, Racugno, Ventura 2011).
    """
    gap = best.value - other.value
    apart = best.blocks - other.blocks
    centred = apart - apart.mean()
    variance = float(centred @ centred + max(0.0, 2.0 * float(centred[1:] @ centred[:-1])))
    return -min(gap, 2.0 * gap * gap / max(variance, 1e-9)) if gap > 0.0 else 0.0


def probabilities(models: Sequence[Fit]) -> list[float]:
    """Of models, the most probable first."""
    weights = np.array([tempered(models[0], m) for m in models])
    weights = np.exp(weights - weights.max())
    return (weights / weights.sum()).tolist()
