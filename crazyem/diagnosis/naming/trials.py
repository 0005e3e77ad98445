"""Effects that were tried, and how two of them are compared: evidence, significance, what cannot be told apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, logit

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Fitted
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.diagnosis.naming.presence import presence
from crazyem.diagnosis.settings import CONFIDENCE, FITTING, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE


@dataclass(frozen=True)
class Trial:
    """A candidate that was fitted beside the effects found so far.

    Attributes:
        candidate: which.
        gain: log-likelihood with the candidate less that without it [nats], on the fitted flights.
        held_out: the same on held-out flights; without such flights, on held-out blocks.
        expected: mean of `held_out` if the effect is real and as large as fitted; None: as large as `gain`.
        dispersion: variance of the scores over that of the model.
        p_value: of the score test; of a fitted trial, of the Wald test.
        evidence: (gain + held_out) over dispersion, less the number of parameters.
        fitted: the model with the candidate; None: the linear approximation alone was computed.
        blocks: (b,) log-likelihood by blocks of the fitted and the held-out flights.
        value: the gain on all these blocks [nats] if the candidate were fitted to all of them; the priors of the
            nuisances are part of it.
        recording: (b,) int, the recording of each block.
        tuned: nats that the width of its prior costs (`evidence.occam_cost`); None: one nat a parameter.
        log_odds: log posterior odds of the effect, where the balance of the flights gives them (`steady_odds.py`).
        size: the parameters that these odds are of.
        other_evidence: nats of signals that the filter does not use.
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
    parameter_cost: float | None = None
    log_odds: float | None = None
    size: Mapping[str, float] = field(default_factory=dict)
    other_evidence: float = 0.0
    expected: float | None = None

    def presence(self, order: int) -> float:
        """Probability that the effect is real, as the `order`-th that was found (from 1); look-alikes aside."""
        if self.log_odds is not None:
            return min(CONFIDENCE.max_probability, float(expit(self.log_odds)))
        expected = self.gain if self.expected is None else self.expected
        there = presence(self.gain / self.dispersion, self.held_out, expected, order, dispersion=self.dispersion)
        return min(CONFIDENCE.max_probability, float(expit(logit(there) + self.other_evidence)))

    @property
    def worth(self) -> float:
        """Log evidence, by which two trials are compared: the gain on all blocks less the cost of parameters [nats]."""
        return self.value - (len(self.candidate.free) if self.parameter_cost is None else self.parameter_cost)


@dataclass(frozen=True)
class Step:
    """One turn of the selection.

    Attributes:
        trials: of all candidates, best first.
        taken: the trial whose effect joined the model; None: none did, and the selection ends.
        alike: the look-alikes of `taken`.
        beside: effects that explain something else, too: they keep their gain beside `taken`.
    """

    trials: tuple[Trial, ...]
    taken: Trial | None
    alike: tuple[Trial, ...] = ()
    beside: frozenset[str] = frozenset()

    def explanations(self) -> list[Trial]:
        """The trials that explain what this turn is about.

        A trial explains it if it is significant and has positive evidence on all flights, or a larger `value` than the
        trial that was taken. The second rule is for effects that a slow flight does not determine: a quadratic drag
        fitted to slow flight makes a quick one worse, and explains both once fitted to both. Look-alikes of the trial
        that was taken explain it in any case.
        """
        return [t for t in self.trials if self._explains(t) or any(t is a for a in self.alike)]

    def _explains(self, trial: Trial) -> bool:
        better_on_all = self.taken is not None and trial.value > self.taken.value
        return trial.p_value < SELECTION.p_value and (trial.evidence > 0 or better_on_all)


@dataclass(frozen=True)
class Selection:
    """The selected effects.

    Attributes:
        nominal, final: the model without and with them.
        steps: the turns of the search.
        accepted: the effects. fitted: the fit with them. tried: number of candidates.
        doubted: effects that a vibration explains as well.
    """

    nominal: Point
    final: Point
    steps: tuple[Step, ...]
    accepted: tuple[Candidate, ...]
    fitted: Fitted
    tried: int
    doubtful: frozenset[str] = frozenset()

    def orders(self) -> list[int]:
        """The rank of each selected effect in the order of their selection (from 1); a trim is not counted."""
        names = [s.taken.candidate.effect for s in self.steps if s.taken]
        return [1 + sum(n != TRIM for n in names[:k]) for k in range(len(names))]

    def with_evidence(self, candidate: Candidate, nats: float) -> "Selection":
        """With so many nats of another likelihood for a selected effect; its look-alikes are gone."""
        steps = list(self.steps)
        for k, step in enumerate(steps):
            if step.taken is not None and step.taken.candidate.effect == candidate.effect:
                steps[k] = replace(step, taken=replace(step.taken, other_evidence=nats), alike=())
        return replace(self, steps=tuple(steps))


def margin(best: Trial, other: Trial, *, recordings: bool = True) -> tuple[float, float]:
    """Difference of log evidence of two trials, and its standard deviation [nats].

    The evidence contains the priors of the nuisances: a factor on all torques that needs three other inertias is the
    worse for it. The standard deviation is that of the difference over blocks, in which errors of both models cancel
    (Vuong 1989); half of the covariance of neighbours is added. From five recordings on, the scatter between
    `recordings` counts where it is larger: a clock or a battery is the same in all blocks of a recording.
    """
    nats = best.worth - other.worth
    apart = best.blocks - other.blocks
    return nats, max(scatter(apart), between(apart, best.recording) if recordings else 0.0)


def better(one: Trial, other: Trial, *, recordings: bool = True) -> float:
    """Probability that one trial explains more than the other: by the scatter of the difference, and at most by the
    odds that the difference is."""
    nats, sd = margin(one, other, recordings=recordings)
    by_scatter, by_odds = float(stats.norm.cdf(nats / sd)), float(expit(nats))
    return min(by_scatter, by_odds) if nats > 0.0 else max(by_scatter, by_odds)


def undominated(near: Sequence[Trial]) -> list[Trial]:
    """The trials that no significant other beats with a probability of more than 1 - `SELECTION.beaten`."""
    sure = [t for t in near if t.p_value < SELECTION.p_value]
    return [t for t in near if all(t is o or better(t, o, recordings=False) > SELECTION.beaten for o in sure)]


def preferred(taken: Trial, rivals: Sequence[Trial]) -> float:
    """Probability that none of the rivals is the better explanation.

    A rival that is not significant is at most as probable. Its likelihood may be larger, because it frees a direction
    that no flight determines and that differs between flights (the mass of a load beside a thrust scale). A rival of a
    trim is at most as probable, too: every real drone has a trim.
    """
    chance = 1.0
    known = taken.candidate.effect == TRIM
    for rival in rivals:
        if rival.fitted is not None and rival.blocks.size == taken.blocks.size:
            chance *= max(
                better(taken, rival), CONFIDENCE.min_probability if known or rival.p_value >= SELECTION.p_value else 0.0
            )
    return chance


def scatter(differences: NDArray) -> float:
    """Standard deviation of the sum of differences (b,) over blocks, with half of the covariance of neighbours."""
    centred = differences - differences.mean()
    return float(np.sqrt(centred @ centred + max(0.0, float(centred[1:] @ centred[:-1])))) + 1e-9


def between(differences: NDArray, recording: NDArray) -> float:
    """Standard deviation of the sum of differences (b,) over recordings (b,); 0 if they are too few for a scatter."""
    if recording.size != differences.size or len(np.unique(recording)) < FITTING.min_flights:
        return 0.0
    total, length = np.bincount(recording, differences), np.bincount(recording)
    away = total - length * total.sum() / length.sum()
    return float(np.sqrt(away @ away * length.size / (length.size - 1)))


def distinguishable(best: Trial, other: Trial, *, recordings: bool = True) -> bool:
    """Whether the flights prefer one trial: whether the other is no look-alike."""
    nats, sd = margin(best, other, recordings=recordings)
    return nats > SELECTION.look_alike_difference and nats > SELECTION.separation * sd


def by_evidence(trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """The trials with the evidence at their common (median) dispersion, best first: so likelihoods are compared, and
    not dispersions."""
    if not trials:
        return []
    common = float(np.median([t.dispersion for t in trials]))
    judged = [
        replace(t, evidence=(t.gain + (t.held_out if counted else 0.0)) / common - len(t.candidate.free))
        for t in trials
    ]
    return sorted(judged, key=lambda t: (t.p_value >= SELECTION.p_value, -t.evidence))


def additions(step: Step, later: Sequence[Trial]) -> frozenset[str]:
    """Effects of a turn that keep their gain beside the one that was taken: they explain something else.

    Look-alikes gain no more together than the better one alone.
    """
    left = {c: max(t.gain for t in later if t.candidate.effect == c) for c in {t.candidate.effect for t in later}}
    fitted = [t for t in step.trials if t.fitted is not None and t.candidate.effect in left]
    return frozenset(t.candidate.effect for t in fitted if 0 < SELECTION.kept_share * t.gain < left[t.candidate.effect])


def p_value_of_both(p_value: float, held: float) -> float:
    """p-value on fitted and held-out flights, where the fitted effect brings `held` nats.

    The likelihood ratio of two fixed models exceeds exp(held) by chance with a probability of at most exp(-held).
    """
    return p_value * float(np.exp(-max(held, 0.0))) if p_value < SELECTION.held_out_p_value else p_value


def separate_evidence(trial: Trial, *, counted: bool) -> float:
    """Evidence at the candidate's own dispersion, by which it is admitted."""
    return (trial.gain + (trial.held_out if counted else 0.0)) / trial.dispersion - len(trial.candidate.free)


def dispersion_of(fitted: Fitted, count: int, *, offset: int) -> float:
    """Variance of the scores of `count` free parameters from `offset` on, over that of the model; at least 1.

    At the maximum with these parameters: there the scores do not contain what the effect itself explains.
    """
    gram, own = fitted.gram, range(offset, offset + count)
    solution = gram.solve(range(gram.size), precision=fitted.precision, tested=own, effective=True)
    return max(1.0, solution.dispersion)


def significance(fitted: Fitted, count: int, *, offset: int) -> float:
    """p-value of the Wald test that `count` free parameters from `offset` on are neutral.

    Of an effect with an amplitude, the amplitude alone is tested: a load without mass has no length.
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


def is_significant(point: Point, p_value: float) -> bool:
    """Whether the p-value is small enough for the effect to be taken."""
    return p_value < (SELECTION.daily_p_value if TRIM in point.vehicle.effects else SELECTION.p_value)
