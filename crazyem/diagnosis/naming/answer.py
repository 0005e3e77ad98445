"""The answer of a diagnosis: effects with intervals and confidence, look-alikes, advice, and estimated nuisances."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logit

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import error_by_lag, solved, systematic_sd
from crazyem.diagnosis.naming.balance import Balance, decided_by_balance, log_odds_by_balance, rotor_loss
from crazyem.diagnosis.naming.balance import steady as steadily
from crazyem.diagnosis.naming.load_or_rotors import LOAD, WEAKER, load_substitutes
from crazyem.diagnosis.naming.trials import Selection, Step, Trial, distinguishable, preferred
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import CONFIDENCE, LOADS, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import ON_BOARD
from crazyem.physics.effects.rotors import ROTOR_FAULT


@dataclass(frozen=True)
class Value:
    """An estimated parameter: value and sd in `unit`, ci95 (low, high)."""

    value: float
    unit: str
    sd: float
    ci95: tuple[float, float]

    @classmethod
    def normal(cls, value: float, unit: str, sd: float) -> "Value":
        """With the 95 % interval of a normal distribution."""
        return cls(value, unit, sd, (value - 1.96 * sd, value + 1.96 * sd))


@dataclass(frozen=True)
class Named:
    """An effect that was found.

    Attributes:
        name: in the catalogue; `label` with its choices.
        parameters: the fitted ones; `chosen`: the searched ones.
        held_out_nats: gain of log-likelihood on held-out flights.
        confidence: probability that this effect is real, and not one of its look-alikes.
        fitted_as: the effect as which it was fitted; "": by its own name.
        log_odds: log posterior odds of the effect, look-alikes aside; None: not known.
    """

    name: str
    label: str
    parameters: dict[str, Value]
    chosen: dict[str, object]
    held_out_nats: float
    confidence: float
    fitted_as: str = ""
    log_odds: float | None = None

    @property
    def words(self) -> str:
        """The effect in words, with its choices."""
        values = {**self.chosen, **{n: v.value for n, v in self.parameters.items()}}
        return CATALOGUE[self.name].description(values)

    @property
    def of_recording(self) -> bool:
        """Whether it belongs to the recording and not to the drone."""
        return CATALOGUE[self.name].belongs_to == "recording"


def confidence_factor(remains: Unexplained, held_out_nats: float = 0.0) -> float:
    """Factor on the probability of an effect beside unexplained structure: the right model leaves none.

    Physics outside the catalogue imitates effects of about its own size. An effect with a far larger held-out gain,
    over the dispersion of its scores, is no such imitation.
    """
    if not remains.found:
        return 1.0
    times = max(held_out_nats, 0.0) / max(remains.nats, 1e-9)
    return max(CONFIDENCE.doubtful, times**2 / (times**2 + CONFIDENCE.outweighs**2))


def one_factor(values: NDArray, neutral: NDArray, covariance: NDArray) -> bool:
    """Whether values (k,) with a covariance (k, k) are the neutral values times one factor, by chi-squared at 5 %.

    Inertias with one factor about all three axes give the same signals as a factor on the torques.
    """
    ratio = np.log(values / neutral)
    precision = np.linalg.pinv(covariance / np.outer(values, values))
    mean = (precision @ ratio).sum() / precision.sum()
    distance = float((ratio - mean) @ precision @ (ratio - mean))
    return bool(stats.chi2.sf(distance, len(values) - 1) > 0.05)


@dataclass(frozen=True)
class Free:
    """A nuisance, in `unit`; an entry of the JSON document (docs/reference/json.md).

    Attributes:
        name, words: its effect, in the catalogue and for people.
        parameter: of this effect; or a recording, where each recording has its own value.
        value, sd: estimate and standard deviation.
        expected, usual: mean and standard deviation of its prior.
    """

    name: str
    words: str
    parameter: str
    value: float
    sd: float
    unit: str
    expected: float
    usual: float


def left_free(fitted: Fitted) -> tuple[Free, ...]:
    """The nuisances of the final fit, in the order of its columns."""
    if not fitted.nuisances:
        return ()
    variance = np.diag(solved(fitted)[0].covariance)
    at, found = sum(len(c.free) for c in fitted.candidates), []
    for candidate in fitted.nuisances:
        values, expected = candidate.values(fitted.point), candidate.neutral(fitted.point)
        words = CATALOGUE[candidate.effect].description({}) if candidate.effect in CATALOGUE else candidate.label
        for name in candidate.free:
            p, sd = candidate.parameter(name), max(variance[at], 0.0) ** 0.5
            usual = fitted.precision[at] ** -0.5 if fitted.precision[at] > 0.0 else math.inf
            value, middle = float(values[name]), float(expected[name])
            found.append(Free(candidate.effect, words, p.description, value, float(sd), p.unit, middle, float(usual)))
            at += 1
    return tuple(found)


# A thrust scale gives the same signals as two changes, mass and inertias by one factor, except for forces of the air.
HEAVIER = "weigh the drone: with {:.3g} times its mass and its inertias it would fly the same"


@dataclass(frozen=True)
class Answer:
    """The effects, the most probable first, look-alikes aside.

    Attributes:
        groups: names that these flights cannot tell apart.
        separate: what would separate them, in words.
    """

    effects: tuple[Named, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    separate: tuple[str, ...] = ()


def answer_of(
    data: Data,
    selection: Selection,
    remains: Unexplained,
    *,
    corroborated: frozenset[str],
    in_place: Mapping[str, tuple[Trial, Trial] | None],
    balance: Balance | None = None,
) -> Answer:
    """The answer with the selected effects.

    Args:
        remains: unexplained structure; beside it no effect is sure.
        corroborated: names that another signal separates from their look-alikes.
        in_place: effect -> its trial and the trial of its substitute (`alternatives.py`).
        balance: steady thrust and torque, which separates effects where a file has a trim.
    """
    if not selection.accepted:
        return Answer()
    point = selection.final
    _, _, all_covariance = _uncertainty(selection.fitted)
    numbers = numbers_of(data, selection, balance)
    found: list[tuple[tuple[float, float], Named]] = []
    groups: list[tuple[str, ...]] = []
    separate: list[str] = []
    at = 0
    taken = [s for s in selection.steps if s.taken]
    orders = selection.orders()
    for candidate, step, parameters, order in zip(selection.accepted, taken, numbers, orders, strict=True):
        assert step.taken is not None
        own = slice(at, at + len(candidate.free))
        at = own.stop
        covariance = all_covariance[own, own]
        rivals, steady = _steady_rivals(candidate, _rivals(candidate, step, selection, corroborated), balance)
        against = _against(remains, candidate, data, point)
        there = step.taken.presence(order)
        held = step.taken.held_out / step.taken.dispersion
        there *= confidence_factor(against, held) if step.taken.log_odds is None else 1.0
        confidence = there * preferred(step.taken, rivals)
        confidence /= 1.0 + sum(float(np.exp(-nats)) for nats in steady.values())
        # late inputs and late measurements are one model: fitted as the former, named by corroboration
        effect = CATALOGUE[candidate.effect]
        late = next((n for n in effect.same_as if n in corroborated), None)
        name, label = (late, late) if late else (candidate.effect, candidate.label)
        chosen = dict(effect.same_as[late] if late else candidate.fixed)
        odds = float(logit(there))
        named = Named(name, label, parameters, chosen, step.taken.held_out, confidence, candidate.effect, odds)
        found.append(((-there, -step.taken.evidence), named))
        equal = [
            *(t.candidate.effect for t in step.alike if t.candidate.effect in {r.candidate.effect for r in rivals}),
            *(name for name, nats in steady.items() if nats < SELECTION.separating),
            *(() if candidate.effect in corroborated else effect.same_as),
            *_in_place(candidate, in_place, selection),
            *_as_a_factor(candidate, step, point, covariance),
            *_by_turning_alone(candidate, data, selection),
        ]
        if equal:
            groups.append(tuple(dict.fromkeys([name, *equal])))
            separate += [CATALOGUE[n].separates for n in groups[-1] if CATALOGUE[n].separates]
        elif candidate.effect == LOAD:  # only its place separates it from weak rotors: no proof
            separate.append(effect.separates)
        elif effect.gain == "thrust":
            separate.append(HEAVIER.format(1.0 / candidate.values(point)["scale"]))
    found.sort(key=lambda entry: entry[0])
    return Answer(tuple(n for _, n in found), tuple(groups), tuple(dict.fromkeys(separate)))


def numbers_of(data: Data, selection: Selection, balance: Balance | None) -> list[dict[str, Value]]:
    """Values with intervals of the free parameters of each selected effect, in the order of the effects."""
    sd, width, _ = _uncertainty(selection.fitted)
    never = systematic_sd(data, selection.final)
    never |= {
        name: float(np.hypot(never.get(name, 0.0), off)) for name, off in error_by_lag(data, selection.fitted).items()
    }
    found, at = [], 0
    for candidate in selection.accepted:
        own = slice(at, at + len(candidate.free))
        at = own.stop
        by_day = _by_the_day(candidate, selection.final, balance)
        found.append(by_day if by_day else _numbers(candidate, selection.final, sd[own], width[own], never))
    return found


def strongest_first(effects: Sequence[Named], beside: Sequence[Named]) -> tuple[Named, ...]:
    """The effects in their order, with the effects `beside` inserted, which the selection cannot test (gusts, a tilted
    accelerometer, lag and delay of measured rotors). Each comes before the first effect with a smaller held-out gain.
    """
    ordered = list(effects)
    for one in beside:
        at = next((i for i, e in enumerate(ordered) if e.held_out_nats < one.held_out_nats), len(ordered))
        ordered.insert(at, one)
    return tuple(ordered)


def _against(remains: Unexplained, candidate: Candidate, data: Data, point: Point) -> Unexplained:
    """The part of the unexplained structure that counts against an effect."""
    effect = CATALOGUE[candidate.effect]
    coarse = data.coarse and not effect.slow_torque
    if coarse or _of_pose(candidate, data, point):
        remains = remains.of_forces()
    if effect.steady_force:
        return remains.without_random_rotor()
    if effect.imbalance == "rotor":  # a cut propeller is out of balance, too
        return remains.without_random_rotor(int(dict(candidate.fixed)["rotor"]))
    return remains


def _of_pose(candidate: Candidate, data: Data, point: Point) -> bool:
    """Whether an effect changes measured poses and velocities alone: then it imitates no torque."""
    slopes = data.models[0].slopes(point, candidate.columns(point), data.workers)
    return all(c.acting is None and c.showing is not None and not c.showing[:, 9:].any() for c in slopes)


def _uncertainty(fitted: Fitted) -> tuple[NDArray, NDArray, NDArray]:
    """Standard deviations (k,) of all free parameters, half-widths of 95 % intervals in standard deviations (k,), and
    covariance (k, k).

    By the scatter of blocks, or by the scatter of flights where the latter makes the interval wider.
    """
    solution, used = solved(fitted, wide=True)
    sd = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
    width = np.full(sd.size, stats.t.ppf(0.975, max(len(fitted.gram.score) - used, 3)))
    apart, freedom = fitted.gram.by_flights(solution.theta, fitted.precision)
    if not freedom:
        return sd, width, solution.covariance
    wider = stats.t.ppf(0.975, freedom) * apart > width * sd
    width = np.where(wider, stats.t.ppf(0.975, freedom), width)
    larger = np.where(wider, np.maximum(apart / np.maximum(sd, 1e-300), 1.0), 1.0)
    return sd * larger, width, solution.covariance * np.outer(larger, larger)


def _numbers(
    candidate: Candidate, point: Point, sd: NDArray, width: NDArray, never: Mapping[tuple[str, str], float]
) -> dict[str, Value]:
    """Values of the free parameters with `sd` (k,) and intervals of `width` (k,) times sd each side, cut to the range.
    `never`: (effect, parameter) -> systematic standard deviation, which no flight reduces."""
    values, out = candidate.values(point), {}
    for name, own, many in zip(candidate.free, sd, width, strict=True):
        p = candidate.parameter(name)
        error = float(np.hypot(own, never.get((candidate.effect, name), 0.0)))
        least, most = candidate.range_of(name)
        if values[name] in (least, most) and values[name] != p.neutral:  # at an end: sd of a uniform distribution
            error = max(error, (most - least) / 12**0.5)
        low, high = values[name] - many * error, values[name] + many * error
        out[name] = Value(values[name], p.unit, error, (max(low, least), min(high, most)))
    return out


def _by_the_day(candidate: Candidate, point: Point, balance: Balance | None) -> dict[str, Value] | None:
    """Values of a weak rotor or a load by the balance; None for other effects and without a balance. Differences
    between days are the largest part of the error."""
    if balance is not None and candidate.effect == LOAD and decided_by_balance(point.vehicle, candidate):
        return _load_by_the_day(candidate, point, balance)
    if balance is None or CATALOGUE[candidate.effect].imbalance != "rotor" or not steadily(candidate):
        return None
    scale = float(candidate.values(point)["scale"])
    sd = rotor_loss(balance, int(dict(candidate.fixed)["rotor"]))[1]
    reach = sd * float(stats.t.ppf(0.975, balance.freedom))
    value = Value(scale, candidate.parameter("scale").unit, sd, (max(scale - reach, 0.0), scale + reach))
    return {"scale": value}


def _load_by_the_day(candidate: Candidate, point: Point, balance: Balance) -> dict[str, Value]:
    """A load's mass and place, with the errors of thrust and trim from day to day; its height is unknown."""
    values, whole = candidate.values(point), point.vehicle.mass + float(candidate.values(point)["mass"])
    share = float(values["mass"]) / whole
    thrust, about_x, about_y = np.sqrt(np.diag(balance.covariance))[:3]
    known = thrust**-2.0
    for axis, torque in (("x", about_y), ("y", about_x)):  # at the edge, the torque determines the weight, too
        known += (
            (ON_BOARD / torque) ** 2.0
            if math.isclose(abs(values[axis]), LOADS.max_place * ON_BOARD, rel_tol=1e-6)
            else 0.0
        )
    far = max(share, 1e-9)
    sds = {"mass": known**-0.5 * whole / (1.0 - share), "x": about_y / far, "y": about_x / far}
    found = {}
    for name in candidate.free:
        low, high = candidate.range_of(name)
        sd = float(sds.get(name, (high - low) / 12**0.5))
        reach = sd * float(stats.t.ppf(0.975, balance.freedom))
        value = float(values[name])
        found[name] = Value(
            value, candidate.parameter(name).unit, sd, (max(value - reach, low), min(value + reach, high))
        )
    return found


def _steady_rivals(
    candidate: Candidate, rivals: Sequence[Trial], balance: Balance | None
) -> tuple[list[Trial], dict[str, float]]:
    """The rivals that the balance cannot judge, and the nats by which it prefers the candidate to the others."""
    if balance is None:
        return list(rivals), {}
    said = [(t, log_odds_by_balance(balance, candidate, t.candidate)) for t in rivals]
    nats: dict[str, float] = {}
    for trial, margin in said:
        if margin is not None:
            nats[trial.candidate.effect] = min(margin, nats.get(trial.candidate.effect, np.inf))
    return [t for t, margin in said if margin is None], nats


def _rivals(candidate: Candidate, step: Step, selection: Selection, corroborated: frozenset[str]) -> list[Trial]:
    """Other explanations of what the effect explains, except those that another signal separates from it.

    Two effects that the final model needs beside each other are no rivals. Nor is the torque scale a rival of an effect
    beside inertias, which can be such a factor themselves.
    """
    found = {c.effect for c in selection.accepted}
    found |= {CATALOGUE[n].common_factor for n in found if n != candidate.effect}
    others = {candidate.effect, *step.beside, *found} | (
        corroborated if candidate.effect in corroborated else frozenset()
    )
    return [t for t in step.explanations() if t.candidate.effect not in others]


def _in_place(
    candidate: Candidate, in_place: Mapping[str, tuple[Trial, Trial] | None], selection: Selection
) -> Sequence[str]:
    """Substitutes of a load, or the load as a substitute, where neither explains more."""
    pair = in_place.get(candidate.effect)
    if pair is None or distinguishable(*pair):
        return ()
    return [c.effect for c in load_substitutes(selection.final.vehicle)] if candidate.effect == LOAD else [LOAD]


def _as_a_factor(candidate: Candidate, step: Step, point: Point, covariance: NDArray) -> Sequence[str]:
    """The torque scale for inertias with one common factor, unless this turn of the selection tried it."""
    factor = CATALOGUE[candidate.effect].common_factor
    if not factor or any(t.candidate.effect == factor for t in step.trials):
        return ()
    values, neutral = candidate.values(point), candidate.neutral(point)
    here, before = (np.array([v[n] for n in candidate.free]) for v in (values, neutral))
    return [factor] if one_factor(here, before, covariance) else ()


def _by_turning_alone(candidate: Candidate, data: Data, selection: Selection) -> Sequence[str]:
    """A load for weak rotors, or weak rotors for a load, where only torques separate them and are not determined.

    Two weak rotors beside each other lack thrust and tilt the drone as a weight on their side does, with no torque
    about z. Only the rotation separates them, and a trim that changes from day to day hides the difference.
    """
    if candidate.effect == LOAD and TRIM in selection.final.vehicle.effects:
        return [ROTOR_FAULT.name]
    return [LOAD] if candidate.effect == WEAKER.effect and data.coarse else ()
