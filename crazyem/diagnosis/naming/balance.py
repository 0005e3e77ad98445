"""A drone's balance: steady thrust and torque that flights need beyond the file, against the differences between days.

Where a file has a trim, steady thrust and torque separate a weak rotor, a load and a wind: a weak rotor lacks thrust,
torque and drag torque in one ratio, and a load has no torque about z. Differences between days are the largest error.
The filter's likelihood is overconfident of steady parts: its scores scatter up to 13 times as much as the model says,
so the prior of a day has no weight beside it. So the four steady numbers are fitted without any effect, and are judged
here by their covariance from day to day.

The balances of all flights give the posterior odds of a weak rotor or a load on board. Both are the same in all
flights; the trim of a day is not. The trim is free in the filter's likelihood, with heavy tails (`Prior.freedom`), so
this likelihood says little of steady effects.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import lsq_linear, minimize, minimize_scalar
from scipy.special import logit, logsumexp

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_freedom, day_sd, trim_known
from crazyem.diagnosis.fitting.fit import Data, DivergedError, refine
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, solved, with_nuisances
from crazyem.diagnosis.naming.alternatives import with_replacement
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import CONFIDENCE, LOADS, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import ON_BOARD, PAYLOAD
from crazyem.physics.effects.rotors import ROTOR_FAULT
from crazyem.physics.rotors import wrench
from crazyem.vehicle import Vehicle

# `Effect.imbalance` -> number of parameters that count. A rotor moves all four numbers in one ratio; a load moves three
# within the bounds of its place.
FREE = {"rotor": 1, "thrust": 1, "mean thrust": 1, "air": 3, "load": 3}


@dataclass(frozen=True, eq=False)
class Balance:
    """Steady thrust and torque that flights need beyond the file.

    Attributes:
        lack: (4,) missing thrust, relative; additional torque over thrust about x, y, z [m], body.
        covariance: (4, 4) of `lack`: differences between days and error of the fit.
        rotors: (4, 4) rows: `lack` if this rotor had no thrust.
        freedom: degrees of freedom of the t distribution from day to day.
    """

    lack: NDArray
    covariance: NDArray
    rotors: NDArray
    freedom: float


def balance_of(data: Data, point: Point) -> Balance:
    """The balance of flights; `point` is a model with the noise scales, of a vehicle whose file has a trim."""
    point = replace(point, effects={n: dict(v) for n, v in point.vehicle.effects.items()})
    free = [THRUST, Candidate(TRIM, (), ("x", "y", "z"))]
    rest = nuisances(data, point, free)
    start = with_nuisances(point, [*rest, *((c, ()) for c in free)])
    fitted = refine(data.twin(), start, free, nuisances=rest, rounds=4, noise=False)
    found, filed = (
        np.array([p.effects[c.effect][n] for c in free for n in c.free], float) for p in (fitted.point, start)
    )
    as_lack = np.diag([-1.0 / filed[0], 1.0, 1.0, 1.0])  # a larger scale is a smaller lack
    own = as_lack @ solved(fitted)[0].covariance[:4, :4] @ as_lack
    covariance = own + np.diag(np.square(day_sd(point.vehicle)))
    return Balance(as_lack @ (found - filed), covariance, rotor_signatures(data, point), day_freedom(point.vehicle))


def rotor_signatures(data: Data, point: Point) -> NDArray:
    """(4, 4) rows: missing thrust, relative, and torque over thrust [m] without one rotor, by the mean commands."""
    vehicle = point.vehicle
    thrust = np.concatenate([
        f.inputs.thrust[(f.inputs.time > f.time[0]) & (f.inputs.time < f.time[-1])] for f in data.flights
    ]).mean(0)  # fmt: skip
    lost = wrench(-np.diag(thrust), arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust) / thrust.sum()
    return np.column_stack([-lost[:, 0], lost[:, 1:]])


def balance_loglik(balance: Balance, effect: str, fixed: Mapping[str, Any]) -> float | None:
    """Largest log-likelihood [nats] of the balance with an effect, less the number of its parameters (`FREE`); None if
    the influence of the effect is not known."""
    kind = CATALOGUE[effect].imbalance
    if not kind:
        return None
    root = np.linalg.cholesky(np.linalg.inv(balance.covariance)).T
    lack = root @ balance.lack
    if kind == "rotor":
        moved = root @ balance.rotors[int(fixed["rotor"]) - 1]
        rest = lack - moved * np.clip(moved @ lack / (moved @ moved), 0.0, 1.0)
        return likely(float(rest @ rest), balance.freedom) - FREE[kind]
    if kind == "load":
        return likely(_loaded(root, lack), balance.freedom) - FREE[kind]
    moves = root[:, 1:3] if kind == "air" else root[:, [0]]
    rest = lack - moves @ np.linalg.lstsq(moves, lack, rcond=None)[0]
    return likely(float(rest @ rest), balance.freedom) - FREE[kind]


def likely(distance: float, freedom: float) -> float:
    """Log-likelihood of four numbers with this squared distance by a t distribution, up to a constant."""
    return -0.5 * (freedom + 4.0) * float(np.log1p(distance / freedom))


def _loaded(root: NDArray, lack: NDArray) -> float:
    """Squared distance between the balance and that of the best load."""

    def distance(share: float) -> float:
        """With a load of this share of the whole weight: it takes thrust and moves the centre of mass to its side."""
        most = np.full(2, share * ON_BOARD)
        rest = lack - root[:, 0] * share
        if share <= 0.0:
            return float(rest @ rest)
        return 2.0 * float(lsq_linear(root[:, 1:3], rest, (-most, most)).cost)

    return float(minimize_scalar(distance, bounds=(0.0, LOADS.max_load / (1.0 + LOADS.max_load)), method="bounded").fun)


def log_odds_by_balance(balance: Balance, one: Candidate, other: Candidate) -> float | None:
    """Nats by which the balance prefers one effect to the other; None where it cannot judge one of them."""
    mine, its = (balance_loglik(balance, c.effect, dict(c.fixed)) if steady(c) else None for c in (one, other))
    return None if mine is None or its is None else mine - its


def steady(candidate: Candidate) -> bool:
    """Whether the effect acts all the time."""
    return dict(candidate.fixed).get("onset_time") is None


def _kind(candidate: Candidate) -> str:
    """The influence of an effect on the balance; "" if it is not known."""
    return CATALOGUE[candidate.effect].imbalance


def rotor_loss(balance: Balance, rotor: int) -> tuple[float, float]:
    """Share of its thrust that rotor 1 to 4 lacks by the balance if it alone is weak, and the standard deviation."""
    root = np.linalg.cholesky(np.linalg.inv(balance.covariance)).T
    moved = root @ balance.rotors[rotor - 1]
    return float(moved @ root @ balance.lack / (moved @ moved)), float(1.0 / np.linalg.norm(moved))


def hidden_by_daily_variation(data: Data, selection: Selection, asked: Sequence[Candidate]) -> dict[str, str]:
    """Effect -> how large a weak rotor the differences between days hide, in a sentence, if no steady effect was found.

    Empty without a trim in the file, with a steady effect, or if weak rotors were not among the candidates `asked`.
    """
    steadied = TRIM in selection.nominal.vehicle.effects and not any(map(_kind, selection.accepted))
    if not steadied or all(c.effect != ROTOR_FAULT.name for c in asked):
        return {}
    try:
        balance = balance_of(data, selection.nominal)
    except (DivergedError, np.linalg.LinAlgError):
        reason = "not asked: what is steady in this flight fits no model"
        return {ROTOR_FAULT.name: reason, PAYLOAD.name: reason}
    lacks = [rotor_loss(balance, rotor) for rotor in (1, 2, 3, 4)]
    reach = float(stats.t.ppf(0.975, balance.freedom)) * max(sd for _, sd in lacks)
    each = ", ".join(str(round(100 * lack)) for lack, _ in lacks)
    text = (
        f"what changes from day to day hides a rotor that lacks up to {100 * reach:.0f} % of its thrust; by what is "
        f"steady rotors 1 to 4 lack {each} %, each +- {100 * reach:.0f} (95 %), as if it alone were weak"
    )
    return {ROTOR_FAULT.name: text}


def by_balance(data: Data, selection: Selection) -> tuple[Selection, Balance | None]:
    """The selection with a steady effect that is named and sized by the balance, and this balance.

    An effect that the balance prefers replaces the selected one. Among effects that it does not separate, the simplest
    gives the name. The balance is None where it does not apply: no trim in the vehicle file, or not exactly one effect
    with a steady force or torque.
    """
    names = {c.effect for c in selection.accepted}
    decided = {t.candidate: t.size for t in selection.taken.values() if t.log_odds is not None}
    mine = next((c for c in selection.accepted if c in decided), None)
    mine = mine or next((c for c in selection.accepted if _kind(c)), None)
    single = mine in decided or (sum(bool(CATALOGUE[n].imbalance) for n in names) == 1 and TRIM not in names)
    if TRIM not in selection.nominal.vehicle.effects or mine is None or not single or not steady(mine):
        return selection, None
    try:
        balance = balance_of(data, selection.nominal)
        if mine in decided:
            return _sized(data, selection, mine, {n: decided[mine][n] for n in mine.free}), balance
        selection, mine = _named(data, selection, mine, balance)
        if CATALOGUE[mine.effect].imbalance == "rotor":
            lack = rotor_loss(balance, int(dict(mine.fixed)["rotor"]))[0]
            if 0.0 < lack < 1.0:
                selection = _sized(data, selection, mine, {"scale": 1.0 - lack})
    except (DivergedError, np.linalg.LinAlgError):  # then the filter's likelihood decides alone
        return selection, None
    return selection, balance


def _named(data: Data, selection: Selection, mine: Candidate, balance: Balance) -> tuple[Selection, Candidate]:
    """The selection with the effect that the balance prefers, else with the simplest of those that it does not separate
    from the selected one; and the candidate of this effect."""
    step = next(s for s in selection.steps if s.taken and s.taken.candidate.effect == mine.effect)
    rivals: list[tuple[float, Trial]] = []
    for trial in step.explanations():
        nats = log_odds_by_balance(balance, mine, trial.candidate)
        if nats is not None and trial.fitted is not None:
            rivals.append((nats, trial))
    beaten = [r for r in rivals if r[0] < -SELECTION.separating]
    simpler = [r for r in rivals if r[0] < SELECTION.separating and FREE[_kind(r[1].candidate)] < FREE[_kind(mine)]]
    if not beaten and not simpler:
        return selection, mine
    best = min(beaten or simpler, key=lambda entry: entry[0])[1]
    return _instead(data, selection, mine, best), best.candidate


def _instead(data: Data, selection: Selection, old: Candidate, trial: Trial) -> Selection:
    """The selection with an effect replaced by another trial of the same turn."""
    assert trial.fitted is not None
    values = [float(trial.candidate.values(trial.fitted.point)[n]) for n in trial.candidate.free]
    found = with_replacement(data, selection, old, trial.candidate, values)
    return found.with_step(trial.candidate.effect, taken=trial)


def _sized(data: Data, selection: Selection, candidate: Candidate, values: Mapping[str, float]) -> Selection:
    """The selection with an effect of this size; the other effects and the nuisances are fitted beside it."""
    there = selection.final.with_effects({candidate.effect: values})
    rest = [c for c in selection.accepted if c is not candidate]
    free = nuisances(data, there, selection.accepted)
    fitted = refine(data, with_nuisances(there, free), rest, nuisances=free, rounds=4, noise=False)
    fitted = refine(data, fitted.point, selection.accepted, nuisances=free, rounds=0, noise=False)
    return replace(selection, final=fitted.point, fitted=fitted)


Lack = Callable[[NDArray, Balance], NDArray]  # (numbers of an effect, balance) -> part of `lack` by the effect


def _rotor(index: int) -> Lack:
    return lambda x, balance: x[0] * balance.rotors[index]


def _load(x: NDArray, balance: Balance) -> NDArray:
    """Numbers of a load: share of the whole weight; lever arms about x and y, over the furthest place on board."""
    return np.array([x[0], x[0] * ON_BOARD * x[1], x[0] * ON_BOARD * x[2], 0.0])


def explanations(balances: Sequence[Balance]) -> dict[tuple[str, int], tuple[float, NDArray]]:
    """(`Effect.imbalance`, rotor or 0) -> log posterior weight [nats] and numbers; ("", 0): no effect, only the days.

    The weight is the log prior and the largest log-likelihood of all balances together, less one nat a number (`FREE`).
    """
    place = (-LOADS.max_place, LOADS.max_place)
    asked: dict[tuple[str, int], tuple[Lack, list[tuple[float, float]]]] = {
        **{("rotor", r): (_rotor(r - 1), [(0.0, 1.0)]) for r in (1, 2, 3, 4)},
        ("load", 0): (_load, [(0.0, LOADS.max_load / (1.0 + LOADS.max_load)), place, place]),
        ("thrust", 0): (lambda x, _: np.array([x[0], 0.0, 0.0, 0.0]), [(-1.0, 1.0)]),
        ("air", 0): (lambda x, _: np.array([0.0, x[0], x[1], 0.0]), [(-ON_BOARD, ON_BOARD)] * 2),
    }
    roots = [np.linalg.cholesky(np.linalg.inv(b.covariance)).T for b in balances]

    def loglik(moves: Callable[[Balance], NDArray]) -> float:
        rest = [root @ (b.lack - moves(b)) for root, b in zip(roots, balances, strict=True)]
        return sum(likely(float(r @ r), b.freedom) for r, b in zip(rest, balances, strict=True))

    found = {("", 0): (np.log1p(-CONFIDENCE.file_lacks) + loglik(lambda b: np.zeros(4)), np.zeros(0))}
    for (kind, rotor), (lack, ends) in asked.items():
        starts = [np.array([0.1 * high, *(0.0 for _ in ends[1:])]) for high in (ends[0][1], 3.0 * ends[0][1])]
        fits = [
            minimize(lambda x, f=lack: -loglik(lambda b: f(x, b)), start, bounds=ends, method="L-BFGS-B")
            for start in starts
        ]
        best = min(fits, key=lambda r: float(r.fun))
        prior = np.log(CONFIDENCE.file_lacks / sum(k == kind for k, _ in asked))
        found[kind, rotor] = (prior - float(best.fun) - FREE[kind], best.x)
    return found


def steady_selection(
    data: Data, apart: Data | None, nominal: Point, asked: Sequence[Candidate], say: Callable[[str], None]
) -> Selection | None:
    """A selection that starts with a weak rotor or a load, if the balances of all flights make it probable.

    None if its probability is less than `CONFIDENCE.min_probability`, or if the vehicle file has no known trim.
    """
    mine = [c for c in asked if decided_by_balance(nominal.vehicle, c)]
    if not mine:
        return None
    try:
        flights = [*data.each(), *(apart.each() if apart is not None else ())]
        found = explanations([balance_of(one, nominal) for one in flights])
        total = float(logsumexp([weight for weight, _ in found.values()]))
        chance = {name: float(np.exp(weight - total)) for name, (weight, _) in found.items()}
        best = max(chance, key=lambda name: chance[name])
        candidate = next((c for c in mine if _is(c, best)), None)
        if candidate is None or chance[best] < CONFIDENCE.min_probability:
            return None
        say(f"by what is steady in all flights: {candidate.label} with {chance[best]:.2f}")
        before = refine_base(data.twin(), nominal, ())
        size = _values(candidate, found[best][1], nominal)
        start = nominal.with_effects({candidate.effect: size})
        fitted = refine_base(data, start, [candidate])
    except (DivergedError, np.linalg.LinAlgError):  # `hidden_by_daily_variation` reports this
        say("what is steady in these flights fits no model: neither a weak rotor nor a load is asked for")
        return None
    odds = float(logit(min(chance[best], 1.0 - 1e-12)))
    gain = fitted.loglik - before.loglik
    trial = Trial(candidate, gain, max(odds, 0.0), 1.0, odds, fitted, admissible=True, log_odds=odds, size=size)
    alike = tuple(
        replace(trial, candidate=other, fitted=None)
        for other in asked
        if other.effect != candidate.effect
        and any(_is(other, name) and p > CONFIDENCE.min_look_alike for name, p in chance.items())
    )
    step = Step((trial, *alike), trial, alike)
    return Selection(before.point, fitted.point, (step,), (candidate,), fitted)


def decided_by_balance(vehicle: Vehicle, candidate: Candidate) -> bool:
    """Whether the balance alone decides on a candidate: a weak rotor or a load, if the vehicle's trim is known."""
    return trim_known(vehicle) and CATALOGUE[candidate.effect].imbalance in ("rotor", "load") and steady(candidate)


def _is(candidate: Candidate, name: tuple[str, int]) -> bool:
    kind, rotor = CATALOGUE[candidate.effect].imbalance, dict(candidate.fixed).get("rotor", 0)
    return bool(kind) and (kind, rotor) == name and steady(candidate)


def _values(candidate: Candidate, numbers: NDArray, point: Point) -> Mapping[str, float]:
    """Parameters of the effect from its numbers in `explanations`."""
    values = candidate.neutral(point)
    if CATALOGUE[candidate.effect].imbalance == "rotor":
        return {**values, "scale": 1.0 - float(numbers[0])}
    mass = point.vehicle.mass * float(numbers[0]) / (1.0 - float(numbers[0]))
    # torque of a load at (x, y) over its weight: -y about x, x about y
    return {**values, "mass": mass, "x": ON_BOARD * float(numbers[2]), "y": -ON_BOARD * float(numbers[1])}
