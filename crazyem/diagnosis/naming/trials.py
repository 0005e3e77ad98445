"""Effects that were tried, and how two of them are compared: evidence, significance, what cannot be told apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, logit

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Fitted
from crazyem.diagnosis.fitting.gram import MANY, Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.diagnosis.naming.presence import CALIBRATED, presence
from crazyem.physics.effects.catalogue import CATALOGUE

SURE = 1e-3  # p-value of the score test, before counting candidates,
# with a trim in the file, where no test by the scatter of blocks follows (see `select`); some 70 are asked,
SURE_DAILY = 1e-4
LIKELY = 5e-2  # which flights held out may lower where it is below this
CLOSE = 4.0  # nats within which two explanations cannot be told apart,
EVEN = 0.5  # what a name is worth, at least, beside a rival that is not significant itself
SEPARATION = 1.64  # or standard deviations of the difference of their likelihoods, over blocks or recordings
BESIDE = 0.5  # share of its gain that an effect keeps beside another which it is no other name for
BEATEN = 0.1  # probability of being the better explanation below which a simpler one does not give the name


@dataclass(frozen=True)
class Trial:
    """A candidate, tried beside the effects already found.

    Attributes:
        candidate: which.
        gain: log-likelihood beyond the model before it [nats], on the flights fitted.
        held_out: the same on held-out flights or blocks.
        expected: what it brings there if it is there and as large as it was fitted; None: as much as on those fitted.
        dispersion: by how much scores scatter more than the model says.
        p_value: of the score test.
        evidence: what counts: gain over dispersion less the number of parameters, and the held-out gain.
        fitted: the model with it; None if only the linear approximation was looked at.
        blocks: (b,) its log-likelihood by blocks of the flights fitted and of those held out.
        value: the gain on all of these blocks [nats] once fitted to all of them, less what the priors of the always
            free parameters cost.
        recording: (b,) int, which recording each block is of.
        tuned: nats that it costs that its parameters might have been anything (`evidence.tuning`); None: one for each.
        log_odds: log posterior odds that it is there, where they are known (`steady_odds.py`); None: by `held_out`.
        size: parameters by what those odds are of.
        other_evidence: by which a signal speaks for it that the filter does not use.
    """

    candidate: Candidate
    gain: float
    held_out: float
    dispersion: float
    p_value: float
    evidence: float
    fitted: Fitted | None = None
    blocks: NDArray = field(default_factory=lambda: np.zeros(0))
    value: float = 0.0
    recording: NDArray = field(default_factory=lambda: np.zeros(0, int))
    tuned: float | None = None
    log_odds: float | None = None
    size: Mapping[str, float] = field(default_factory=dict)
    other_evidence: float = 0.0
    expected: float | None = None

    def presence(self, order: int) -> float:
        """Probability that it is there as the `order`-th effect that was found (from 1), whatever its look-alikes."""
        if self.log_odds is not None:
            return min(CALIBRATED, float(expit(self.log_odds)))
        expected = self.gain if self.expected is None else self.expected
        there = presence(self.gain / self.dispersion, self.held_out, expected, order, dispersion=self.dispersion)
        return min(CALIBRATED, float(expit(logit(there) + self.other_evidence)))

    @property
    def worth(self) -> float:
        """What counts where two are compared: the gain on all blocks less what its parameters cost [nats]."""
        return self.value - (len(self.candidate.free) if self.tuned is None else self.tuned)


@dataclass(frozen=True)
class Step:
    """One turn of the selection: all trials, best first, which was taken (None: the end), what it was not told apart
    from, and the effects that explain something else as well as it."""

    trials: tuple[Trial, ...]
    taken: Trial | None
    alike: tuple[Trial, ...] = ()
    beside: frozenset[str] = frozenset()

    def explanations(self) -> list[Trial]:
        """The trials that explain what this turn is about: significant alone and of some use on all flights together
        (one that ruins those held out scatters so much there that nothing could be told from it) or, as fitted to all
        of them, better than the one that was taken (a quadratic drag fitted to slow flight ruins a quick one, and is
        still what both show); or, however unsure alone, not told apart from it."""
        return [t for t in self.trials if self._explains(t) or any(t is a for a in self.alike)]

    def _explains(self, trial: Trial) -> bool:
        better_on_all = self.taken is not None and trial.value > self.taken.value
        return trial.p_value < SURE and (trial.evidence > 0 or better_on_all)


@dataclass(frozen=True)
class Selection:
    """What was selected: the nominal model, the final one, and how it came about; `doubted` are effects that something
    which shakes explains as well."""

    nominal: Point
    final: Point
    steps: tuple[Step, ...]
    accepted: tuple[Candidate, ...]
    fitted: Fitted
    tried: int
    doubted: frozenset[str] = frozenset()

    def orders(self) -> list[int]:
        """Of the effects that were selected, which each is among those found (from 1); a trim is not counted."""
        names = [s.taken.candidate.effect for s in self.steps if s.taken]
        return [1 + sum(n != TRIM for n in names[:k]) for k in range(len(names))]

    def with_evidence(self, candidate: Candidate, nats: float) -> "Selection":
        """With so many nats of another likelihood for an effect that was selected, and against its look-alikes."""
        steps = list(self.steps)
        for k, step in enumerate(steps):
            if step.taken is not None and step.taken.candidate.effect == candidate.effect:
                steps[k] = replace(step, taken=replace(step.taken, other_evidence=nats), alike=())
        return replace(self, steps=tuple(steps))


def margin(best: Trial, other: Trial, *, recordings: bool = True) -> tuple[float, float]:
    """Log-likelihood of one less that of the other, each less what its parameters cost, with its standard deviation.

    What the priors of the always free parameters cost counts too: a factor on all torques that needs three inertias to
    be bent is the worse for it. The scatter of the difference over blocks counts, in which all that both miss cancels
    (Vuong 1989), with half of the covariance of neighbours on each side; and where there are many recordings that over
    `recordings`, since what belongs to one (its clock, its battery) is the same in all of its blocks.
    """
    nats = best.worth - other.worth
    apart = best.blocks - other.blocks
    return nats, max(scatter(apart), between(apart, best.recording) if recordings else 0.0)


def better(one: Trial, other: Trial, *, recordings: bool = True) -> float:
    """Probability that one explains more than the other, by the scatter of the difference; no surer than the odds that
    so many nats are, however steadily they come."""
    nats, sd = margin(one, other, recordings=recordings)
    by_scatter, by_odds = float(stats.norm.cdf(nats / sd)), float(expit(nats))
    return min(by_scatter, by_odds) if nats > 0.0 else max(by_scatter, by_odds)


def not_beaten(near: Sequence[Trial]) -> list[Trial]:
    """Those of which none of the others that is significant is better nine to one."""
    sure = [t for t in near if t.p_value < SURE]
    return [t for t in near if all(t is o or better(t, o, recordings=False) > BEATEN for o in sure)]


def preferred(taken: Trial, rivals: Sequence[Trial]) -> float:
    """Probability that none of the rivals is the better explanation, by the scatter of the likelihoods' differences.

    A rival that is not significant itself is at most as probable: its likelihood may be better because it frees a
    direction that no flight tells (the mass of a load beside a thrust scale) and that differs from flight to flight.
    Against a trim, which every real drone has, no rival is more probable either.
    """
    chance = 1.0
    known = taken.candidate.effect == TRIM
    for rival in rivals:
        if rival.fitted is not None and rival.blocks.size == taken.blocks.size:
            chance *= max(better(taken, rival), EVEN if known or rival.p_value >= SURE else 0.0)
    return chance


def scatter(differences: NDArray) -> float:
    """Standard deviation of the sum of differences of log-likelihoods (b,) by blocks, neighbours alike by half."""
    centred = differences - differences.mean()
    return float(np.sqrt(centred @ centred + max(0.0, float(centred[1:] @ centred[:-1])))) + 1e-9


def between(differences: NDArray, recording: NDArray) -> float:
    """Standard deviation of the sum of differences (b,) by how they differ between recordings (b,); 0 for few."""
    if recording.size != differences.size or len(np.unique(recording)) < MANY:
        return 0.0
    total, length = np.bincount(recording, differences), np.bincount(recording)
    away = total - length * total.sum() / length.sum()
    return float(np.sqrt(away @ away * length.size / (length.size - 1)))


def distinguishable(best: Trial, other: Trial, *, recordings: bool = True) -> bool:
    """Whether the flights prefer the one by more than chance."""
    nats, sd = margin(best, other, recordings=recordings)
    return nats > CLOSE and nats > SEPARATION * sd


def by_evidence(trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """Evidence of each, the same dispersion for all so that likelihoods are compared and not scatters; best first."""
    if not trials:
        return []
    common = float(np.median([t.dispersion for t in trials]))
    judged = [
        replace(t, evidence=(t.gain + (t.held_out if counted else 0.0)) / common - len(t.candidate.free))
        for t in trials
    ]
    return sorted(judged, key=lambda t: (t.p_value >= SURE, -t.evidence))


def additions(step: Step, later: Sequence[Trial]) -> frozenset[str]:
    """Effects tried in a turn that gain nearly as much beside the one that was taken: no other name for it, but more.

    Two explanations of one thing gain no more together than the better one alone.
    """
    left = {c: max(t.gain for t in later if t.candidate.effect == c) for c in {t.candidate.effect for t in later}}
    fitted = [t for t in step.trials if t.fitted is not None and t.candidate.effect in left]
    return frozenset(t.candidate.effect for t in fitted if 0 < BESIDE * t.gain < left[t.candidate.effect])


def both(p_value: float, held: float) -> float:
    """p-value on the flights fitted and on those held out, where the effect as fitted brings `held` nats.

    By chance a likelihood ratio of fixed models exceeds exp(held) with a probability of at most exp(-held).
    """
    return p_value * float(np.exp(-max(held, 0.0))) if p_value < LIKELY else p_value


def separate_evidence(trial: Trial, *, counted: bool) -> float:
    """Evidence by the candidate's own scatter: what it must bring to be admitted."""
    return (trial.gain + (trial.held_out if counted else 0.0)) / trial.dispersion - len(trial.candidate.free)


def dispersion_of(fitted: Fitted, count: int, *, offset: int) -> float:
    """By how much the scores of `count` free parameters from `offset` on scatter more than the model says, at the
    maximum with them, where what they explain does not scatter any more; at least 1."""
    gram, own = fitted.gram, range(offset, offset + count)
    solution = gram.solve(range(gram.size), precision=fitted.precision, tested=own, effective=True)
    return max(1.0, solution.dispersion)


def significance(fitted: Fitted, count: int, *, offset: int) -> float:
    """p-value that `count` free parameters from `offset` on are neutral, by their covariance at the maximum (Wald).

    Of an effect with an amplitude that alone is asked: a load of no mass has no length, so none is neutral.
    """
    solution, taken = solved(fitted)
    free = [(c, n) for c in fitted.candidates for n in c.free]
    own = [offset + i for i, (c, n) in enumerate(free[offset : offset + count]) if n == CATALOGUE[c.effect].amplitude]
    at = slice(own[0], own[0] + 1) if own else slice(offset, offset + count)
    away = np.array([c.values(fitted.point)[n] - c.neutral(fitted.point)[n] for c, n in free])
    return wald(away[at], solution.covariance[at, at], fitted.gram, taken)


def wald(away: NDArray, covariance: NDArray, gram: Gram, columns: float) -> float:
    """p-value that parameters (k,) `away` from neutral with a covariance (k, k) are neutral, of so many columns."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    z = away / scale
    distance = float(z @ np.linalg.lstsq(covariance / np.outer(scale, scale), z, rcond=1e-9)[0])
    return float(stats.f.sf(distance / len(z), len(z), max(len(gram.score) - columns, 3)))


def sure_enough(point: Point, p_value: float) -> bool:
    """Whether an effect may be taken by its p-value."""
    return p_value < (SURE_DAILY if TRIM in point.vehicle.effects else SURE)
