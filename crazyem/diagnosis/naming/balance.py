"""A drone's balance: steady thrust and torque that flights need beyond the file, against the differences between days.

Where a file has a trim, steady thrust and torque separate a weak rotor, a load and a wind: a weak rotor lacks thrust,
torque and drag torque in one ratio, and a load has no torque about z. Differences between days are the largest error.
The filter's likelihood is overconfident of steady parts: its scores scatter up to 13 times as much as the model says,
so the prior of a day has no weight beside it. So the four steady numbers are fitted without any effect, and are judged
here by their covariance from day to day.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import lsq_linear, minimize_scalar

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_freedom, day_sd
from crazyem.diagnosis.fitting.fit import Data, DivergedError, refine
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import nuisances, solved, with_nuisances
from crazyem.diagnosis.naming.alternatives import with_replacement
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import LOADS, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import ON_BOARD, PAYLOAD
from crazyem.physics.effects.rotors import ROTOR_FAULT
from crazyem.physics.rotors import wrench

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


def _unbalances(candidate: Candidate) -> bool:
    """Whether the influence of the effect on the balance is known."""
    return bool(CATALOGUE[candidate.effect].imbalance)


def _numbers(candidate: Candidate) -> int:
    """Number of parameters that count for the effect (`FREE`)."""
    return FREE[CATALOGUE[candidate.effect].imbalance]


def rotor_loss(balance: Balance, rotor: int) -> tuple[float, float]:
    """Share of its thrust that rotor 1 to 4 lacks by the balance if it alone is weak, and the standard deviation."""
    root = np.linalg.cholesky(np.linalg.inv(balance.covariance)).T
    moved = root @ balance.rotors[rotor - 1]
    return float(moved @ root @ balance.lack / (moved @ moved)), float(1.0 / np.linalg.norm(moved))


def hidden_by_daily_variation(data: Data, selection: Selection, asked: Sequence[Candidate]) -> dict[str, str]:
    """Effect -> how large a weak rotor the differences between days hide, in a sentence, if no steady effect was found.

    Empty without a trim in the file, with a steady effect, or if weak rotors were not among the candidates `asked`.
    """
    steadied = TRIM in selection.nominal.vehicle.effects and not any(map(_unbalances, selection.accepted))
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
    decided = {s.taken.candidate: s.taken.size for s in selection.steps if s.taken and s.taken.log_odds is not None}
    mine = next((c for c in selection.accepted if c in decided), None)
    mine = mine or next((c for c in selection.accepted if _unbalances(c)), None)
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
    simpler = [r for r in rivals if r[0] < SELECTION.separating and _numbers(r[1].candidate) < _numbers(mine)]
    if not beaten and not simpler:
        return selection, mine
    best = min(beaten or simpler, key=lambda entry: entry[0])[1]
    return _instead(data, selection, step, mine, best), best.candidate


def _instead(data: Data, selection: Selection, step: Step, old: Candidate, trial: Trial) -> Selection:
    """The selection with an effect replaced by another trial of the same turn."""
    assert trial.fitted is not None
    values = [float(trial.candidate.values(trial.fitted.point)[n]) for n in trial.candidate.free]
    found = with_replacement(data, selection, old, trial.candidate, values)
    steps = tuple(replace(s, taken=trial) if s is step else s for s in selection.steps)
    return replace(found, steps=steps)


def _sized(data: Data, selection: Selection, candidate: Candidate, values: Mapping[str, float]) -> Selection:
    """The selection with an effect of this size; the other effects and the nuisances are fitted beside it."""
    there = selection.final.with_effects({candidate.effect: values})
    rest = [c for c in selection.accepted if c is not candidate]
    free = nuisances(data, there, selection.accepted)
    fitted = refine(data, with_nuisances(there, free), rest, nuisances=free, rounds=4, noise=False)
    fitted = refine(data, fitted.point, selection.accepted, nuisances=free, rounds=0, noise=False)
    return replace(selection, final=fitted.point, fitted=fitted)
