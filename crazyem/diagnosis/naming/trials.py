"""Effects that were tried: evidence, probability that they are real, and comparison of two of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, logit

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Fitted
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.settings import CONFIDENCE, FITTING, SELECTION


def presence(gain: float, held_out: float, expected: float, order: int = 1, *, dispersion: float = 1.0) -> float:
    """Probability that an effect is real, look-alikes aside.

    Args:
        gain: on the fitted flights, or on the held-out ones if it is larger there, over the dispersion [nats].
        held_out: gain on the held-out flights [nats].
        expected: mean of `held_out` for a real effect [nats].
        order: 1 for the first effect that was found, 2 for the next.
        dispersion: variance of the effect's scores over that of the model.
    """
    if gain <= 0.0:
        return 0.0
    odds = CONFIDENCE.intercept + CONFIDENCE.gain_power * math.log1p(gain) - CONFIDENCE.order_power * math.log(order)
    return min(CONFIDENCE.max_probability, float(expit(odds + held_out_evidence(held_out, expected, dispersion))))


def held_out_evidence(held_out: float, expected: float, dispersion: float = 1.0) -> float:
    """Log-odds of an effect by its gain on held-out flights.

    A log-likelihood ratio of mean m has a variance of 2 m. With m = 0 the flights say nothing. A gain beyond m or -m
    counts as m or -m.
    """
    expected = max(expected, 0.0)
    noise = 1.0 + 2.0 * dispersion * expected
    there, elsewhere = (
        math.sqrt(noise + (share * expected) ** 2) for share in (CONFIDENCE.real_sd, CONFIDENCE.other_sd)
    )
    held_out = min(max(held_out, -expected), expected)
    density = stats.t(CONFIDENCE.freedom).logpdf
    return float(density((held_out - expected) / there) - density(held_out / elsewhere) + math.log(elsewhere / there))


def presence_by_odds(nats: float) -> float:
    """Probability of an effect by a likelihood that contains the systematic errors of its model: nats are log-odds."""
    return min(CONFIDENCE.max_probability, float(expit(nats + logit(CONFIDENCE.file_lacks))))


def improbable(chance: float) -> str:
    """Reason why an effect of this probability is no finding; "" if it is one."""
    if chance >= CONFIDENCE.min_probability:
        return ""
    return f"not determined: the flights make it probable with {chance:.2g} only"


@dataclass(frozen=True)
class Trial:
    """A candidate that was fitted beside the effects found so far.

    Attributes:
        candidate: which.
        gain: log-likelihood with the candidate less that without it [nats], on the fitted flights.
        held_out: the same on held-out flights; without such flights, on held-out blocks.
        expected: mean of `held_out` if the effect is real and as large as fitted, from the elimination on (`prune`); 0
            without held-out flights, because blocks of the fitted flights confirm nothing.
        dispersion: variance of the scores over that of the model.
        admissible: whether a fitted effect exceeds its detection limit and is not at the end of its range.
        evidence: (gain + held_out) over dispersion, less the number of parameters.
        fitted: the model with the candidate; None: the linear approximation alone was computed.
        blocks: (b,) log-likelihood by blocks of the fitted and the held-out flights.
        value: the gain on all these blocks [nats] if the candidate were fitted to all of them; the priors of the
            nuisances are part of it.
        recording: (b,) int, the recording of each block.
        parameter_cost: nats that the width of its prior costs (`evidence.occam_cost`); None: one nat a parameter.
        log_odds: log posterior odds of the effect, where the balance of the flights gives them (`balance.py`).
        size: the parameters that these odds are of.
        other_evidence: nats of signals that the filter does not use.
        constrained: nuisances that are not free in the model without the effect, since they could stand for it.
    """

    candidate: Candidate
    gain: float
    held_out: float
    dispersion: float
    evidence: float
    fitted: Fitted | None = None
    admissible: bool = False
    blocks: NDArray = field(default_factory=lambda: np.zeros(0))
    value: float = 0.0
    recording: NDArray = field(default_factory=lambda: np.zeros(0, int))
    parameter_cost: float | None = None
    log_odds: float | None = None
    size: Mapping[str, float] = field(default_factory=dict)
    other_evidence: float = 0.0
    expected: float = 0.0
    constrained: frozenset[str] = frozenset()

    def presence(self, order: int) -> float:
        """Probability that the effect is real, as the `order`-th that was found (from 1); look-alikes aside."""
        if self.log_odds is not None:
            return min(CONFIDENCE.max_probability, float(expit(self.log_odds)))
        # by the flights that show it best: it must not matter which of them are called held out
        gain = max(self.gain, self.held_out if self.expected > 0.0 else 0.0)
        there = presence(gain / self.dispersion, self.held_out, self.expected, order, dispersion=self.dispersion)
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

        A trial explains it if it is admissible and has positive evidence on all flights, or a larger `value` than the
        trial that was taken. The second rule is for effects that a slow flight does not determine: a quadratic drag
        fitted to slow flight makes a quick one worse, and explains both once fitted to both. Look-alikes of the trial
        that was taken explain it in any case. What explains next to nothing of the fitted flights is about something
        else in the held-out ones.
        """
        return [t for t in self.trials if self._explains(t) or any(t is a for a in self.alike)]

    def _explains(self, trial: Trial) -> bool:
        better_on_all = (
            self.taken is not None
            and trial.value > self.taken.value
            and trial.gain > SELECTION.gain_share * self.taken.gain
        )
        return trial.admissible and (trial.evidence > 0 or better_on_all)


@dataclass(frozen=True)
class Selection:
    """The selected effects.

    Attributes:
        nominal, final: the model without and with them.
        steps: the turns of the search.
        accepted: the effects. fitted: the fit with them.
        left_out: effects that were found and left out again, with the reasons.
    """

    nominal: Point
    final: Point
    steps: tuple[Step, ...]
    accepted: tuple[Candidate, ...]
    fitted: Fitted
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def taken(self) -> dict[str, Trial]:
        """The trials whose effects joined the model, by effect, in the order of their selection."""
        return {s.taken.candidate.effect: s.taken for s in self.steps if s.taken}

    def orders(self) -> list[int]:
        """The rank of each selected effect in the order of their selection (from 1); a trim is not counted."""
        names = list(self.taken)
        return [1 + sum(n != TRIM for n in names[:k]) for k in range(len(names))]

    def with_step(self, effect: str, **changes: Any) -> "Selection":
        """With changes of the turn in which an effect joined the model."""
        mine = (s.taken and s.taken.candidate.effect == effect for s in self.steps)
        return replace(self, steps=tuple(replace(s, **changes) if m else s for s, m in zip(self.steps, mine)))


def margin(best: Trial, other: Trial) -> tuple[float, float]:
    """Difference of log evidence of two trials, and its standard deviation [nats].

    The evidence contains the priors of the nuisances: a factor on all torques that needs three other inertias is the
    worse for it. The standard deviation is that of the difference over blocks, in which errors of both models cancel
    (Vuong 1989); half of the covariance of neighbours is added. From five recordings on, the scatter between recordings
    counts where it is larger: a clock or a battery is the same in all blocks of a recording.
    """
    nats = best.worth - other.worth
    apart = best.blocks - other.blocks
    return nats, max(scatter(apart), between(apart, best.recording))


def better(one: Trial, other: Trial) -> float:
    """Probability that one trial explains more than the other: by the scatter of the difference, and at most by the
    odds that the difference is."""
    nats, sd = margin(one, other)
    by_scatter, by_odds = float(stats.norm.cdf(nats / sd)), float(expit(nats))
    return min(by_scatter, by_odds) if nats > 0.0 else max(by_scatter, by_odds)


def preferred(taken: Trial, rivals: Sequence[Trial]) -> float:
    """Probability that none of the rivals is the better explanation.

    A rival of a trim is at most as probable: every real drone has a trim.
    """
    least = CONFIDENCE.min_probability if taken.candidate.effect == TRIM else 0.0
    fitted = [r for r in rivals if r.fitted is not None and r.blocks.size == taken.blocks.size]
    return math.prod(max(better(taken, r), least) for r in fitted)


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


def distinguishable(best: Trial, other: Trial) -> bool:
    """Whether the flights prefer one trial: whether the other is too improbable for a look-alike."""
    return better(best, other) > 1.0 - CONFIDENCE.min_look_alike


def by_evidence(trials: Sequence[Trial], *, counted: bool) -> list[Trial]:
    """The trials with the evidence at their common (median) dispersion, best first: so likelihoods are compared, and
    not dispersions. Explanations come before trials whose own scores scatter too much for one."""
    if not trials:
        return []
    common = float(np.median([t.dispersion for t in trials]))
    judged = [
        replace(t, evidence=(t.gain + (t.held_out if counted else 0.0)) / common - len(t.candidate.free))
        for t in trials
    ]
    return sorted(judged, key=lambda t: (not is_explanation(t, counted=counted), not t.admissible, -t.evidence))


def additions(step: Step, later: Sequence[Trial]) -> frozenset[str]:
    """Effects of a turn that keep their gain beside the one that was taken: they explain something else.

    Look-alikes gain no more together than the better one alone.
    """
    left = {c: max(t.gain for t in later if t.candidate.effect == c) for c in {t.candidate.effect for t in later}}
    fitted = [t for t in step.trials if t.fitted is not None and t.candidate.effect in left]
    return frozenset(t.candidate.effect for t in fitted if 0 < SELECTION.kept_share * t.gain < left[t.candidate.effect])


def tempered_evidence(trial: Trial, *, counted: bool) -> float:
    """Evidence of a trial at its own dispersion [nats]; `counted`: with that of held-out flights."""
    return (trial.gain + (trial.held_out if counted else 0.0)) / trial.dispersion - len(trial.candidate.free)


def is_explanation(trial: Trial, *, counted: bool) -> bool:
    """Whether a trial exceeds its detection limit and has enough evidence of its own."""
    return trial.admissible and tempered_evidence(trial, counted=counted) > SELECTION.min_evidence


def dispersion_of(fitted: Fitted, count: int, *, offset: int) -> float:
    """Variance of the scores of `count` free parameters from `offset` on, over that of the model; at least 1.

    At the maximum with these parameters: there the scores do not contain what the effect itself explains.
    """
    gram, own = fitted.gram, range(offset, offset + count)
    solution = gram.solve(range(gram.size), precision=fitted.precision, tested=own, effective=True)
    return max(1.0, solution.dispersion)
