"""Posterior odds of a weak rotor or a load on board, by the steady thrust and torque of every flight.

A trim that changes from day to day looks like both. So the trim is free in the filter's likelihood, with heavy tails
(`Prior.freedom`), and this likelihood says little of steady effects. Here the steady numbers of each flight
(`balance.py`) are compared with the differences between days: a weak rotor or a load is the same in all flights, the
trim of a day is not.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import logit, logsumexp

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.days import trim_known
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.naming.balance import FREE, Balance, balance_of, likely, steady
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import CONFIDENCE, LOADS
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import ON_BOARD
from crazyem.vehicle import Vehicle

Lack = Callable[[NDArray, Balance], NDArray]  # (numbers of an effect, balance) -> part of `lack` by the effect


def _rotor(index: int) -> tuple[Lack, list[tuple[float, float]]]:
    return (lambda x, balance: x[0] * balance.rotors[index]), [(0.0, 1.0)]


def _load(x: NDArray, balance: Balance) -> NDArray:
    """Numbers of a load: share of the whole weight; lever arms about x and y, over the furthest place on board."""
    return np.array([x[0], x[0] * ON_BOARD * x[1], x[0] * ON_BOARD * x[2], 0.0])


def _thrust(x: NDArray, balance: Balance) -> NDArray:
    return np.array([x[0], 0.0, 0.0, 0.0])


def _air(x: NDArray, balance: Balance) -> NDArray:
    return np.array([0.0, x[0], x[1], 0.0])


def explanations(balances: Sequence[Balance]) -> dict[tuple[str, int], tuple[float, NDArray]]:
    """(`Effect.imbalance`, rotor or 0) -> log posterior weight [nats] and numbers; ("", 0): no effect, only the days.

    The weight is the log prior and the largest log-likelihood of all balances together, less one nat a number (`FREE`).
    """
    asked: dict[tuple[str, int], tuple[Lack, list[tuple[float, float]]]] = {
        **{("rotor", r): _rotor(r - 1) for r in (1, 2, 3, 4)},
        ("load", 0): (
            _load,
            [
                (0.0, LOADS.max_load / (1.0 + LOADS.max_load)),
                (-LOADS.max_place, LOADS.max_place),
                (-LOADS.max_place, LOADS.max_place),
            ],
        ),
        ("thrust", 0): (_thrust, [(-1.0, 1.0)]),
        ("air", 0): (_air, [(-ON_BOARD, ON_BOARD)] * 2),
    }
    roots = [np.linalg.cholesky(np.linalg.inv(b.covariance)).T for b in balances]

    def loglik(moves: Callable[[Balance], NDArray]) -> float:
        rest = [root @ (b.lack - moves(b)) for root, b in zip(roots, balances, strict=True)]
        return sum(likely(float(r @ r), b.freedom) for r, b in zip(rest, balances, strict=True))

    found = {("", 0): (np.log1p(-CONFIDENCE.file_lacks) + loglik(lambda b: np.zeros(4)), np.zeros(0))}
    for (kind, rotor), (lack, ends) in asked.items():
        starts = [np.array([0.1 * high, *(0.0 for _ in ends[1:])]) for high in (ends[0][1], 3.0 * ends[0][1])]
        best = min(
            (
                minimize(lambda x, f=lack: -loglik(lambda b: f(x, b)), start, bounds=ends, method="L-BFGS-B")
                for start in starts
            ),
            key=lambda r: float(r.fun),
        )
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
    except (DivergedError, np.linalg.LinAlgError):  # `hidden_by_the_day` reports this
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
