"""Log evidence of an effect as if fitted to all flights: its gain and the cost of its parameters; detection limits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_sd
from crazyem.diagnosis.fitting.fit import (
    Data,
    DivergedError,
    Fitted,
    bounds_of,
    freedom_of,
    local_precision,
    nuisance_bounds,
    with_change,
)
from crazyem.diagnosis.fitting.gram import bounded
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import conditions_of, nuisances
from crazyem.diagnosis.settings import LOADS, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.external_force import GUSTS
from crazyem.physics.effects.prior import Conditions


def is_implausible(point: Point, candidate: Candidate) -> bool:
    """Whether an effect of one number is at an end of its range, or a drag is more than the air can cause."""
    here = candidate.values(point)
    most = CATALOGUE[candidate.effect].most_per_mass * point.vehicle.mass
    if any(abs(here[n]) > most for n in candidate.free):
        return True
    if len(candidate.free) != 1:
        return False
    name = candidate.free[0]
    return here[name] in candidate.range_of(name) and here[name] != candidate.neutral(point)[name]


def _weight_error(name: str) -> float:
    """Standard deviation of a load's weight by its swing, as a share of the drone's mass; 0: not given."""
    return CATALOGUE[name].prior.relative_error.get("mass", 0.0) if name in CATALOGUE else 0.0


def _other_load(point: Point, candidate: Candidate, here: Mapping[str, float], filed: Mapping[str, float]) -> bool:
    """Whether a load differs from the file's by more than the limit: in weight, or in the shift of the centre of mass.

    With a trim in the file the limit is the difference between days. With neither trim nor load in the file, only the
    weight counts.
    """
    daily = TRIM in point.vehicle.effects
    heavier = abs(here["mass"] - filed["mass"])
    least = LOADS.min_weight_sd * _weight_error(candidate.effect) or LOADS.min_load
    if heavier > (day_sd(point.vehicle)[0] if daily else least) * point.vehicle.mass:
        return True
    if "x" not in here or not (daily or filed["mass"] > 0.0):
        return False
    along_x, along_y = (here["mass"] * here[n] - filed["mass"] * filed[n] for n in "xy")
    drawn = float(np.hypot(along_x, along_y)) / point.vehicle.mass
    return drawn > (LOADS.min_trim_sd * day_sd(point.vehicle)[1] if daily else LOADS.min_shift)


def _outweighs(point: Point, candidate: Candidate, data: Data) -> bool:
    """Whether an effect that lifts is larger than the error of the weight of a load on a string by its swing.

    Lateral forces of flights that shake come out 1 % too small, as attitudes of onboard filters lag. So the load comes
    out too light, and the rest of its weight looks like another effect.
    """
    open_weight = max((_weight_error(name) for name in point.effects), default=0.0)
    if not CATALOGUE[candidate.effect].lifts or not open_weight:
        return True
    without = point.with_effects({candidate.effect: candidate.neutral(point)})
    up, before = (np.concatenate([model.accelerations(p)[0][:, 2] for model in data.models]) for p in (point, without))
    lifted = float(np.sqrt(np.mean((up - before) ** 2) / np.mean(before**2)))
    return lifted > LOADS.min_weight_sd * open_weight


def _conditions(point: Point, data: Data | None) -> Conditions:
    """Conditions of the flights to which an effect was fitted."""
    if data is None or not data.flights:
        return Conditions(file_effects=frozenset(point.vehicle.effects), onboard=False, speed=np.full(3, np.inf))
    return conditions_of(data.flights, point)


def usual_gusts(point: Point, data: Data | None = None) -> float:
    """Standard deviation of the air's speed [m/s] below which gusts are usual and no finding."""
    filed = float(point.vehicle.effects.get(GUSTS.name, {}).get("standard_deviation", 0.0))
    limit = GUSTS.prior.detection_limit_in({}, _conditions(point, data))["standard_deviation"][0]
    return max(LOADS.min_gust_ratio * filed, limit)


def exceeds_limit(point: Point, candidate: Candidate, data: Data | None = None) -> bool:
    """Whether the effect exceeds its detection limit and is not at an end of its range.

    Onboard filters and the sampling of a log look like smaller effects. At an end, an effect stands for something else.
    """
    here, neutral = candidate.values(point), candidate.neutral(point)
    if is_implausible(point, candidate) or (data is not None and not _outweighs(point, candidate, data)):
        return False
    effect, conditions = CATALOGUE[candidate.effect], _conditions(point, data)
    prior = effect.prior
    if effect.amplitude == "mass":
        return _other_load(point, candidate, here, neutral)
    if prior.finding is not None:
        return prior.finding(here, neutral, conditions)
    limit = prior.detection_limit_in(dict(candidate.fixed), conditions)
    if not limit:
        return True
    for name in candidate.free:
        share = prior.share(name, mass=point.vehicle.mass, inertia=point.vehicle.inertia[0], neutral=neutral[name])
        away = (here[name] - neutral[name]) / share
        if name in limit and not -limit[name][0] <= away <= limit[name][1]:
            return True
    return False


def occam_cost(candidates: Sequence[Candidate], covariance: NDArray) -> float:
    """Cost of the parameters (k, in order) of effects [nats]: the log ratio of prior to posterior volume.

    As in Laplace's approximation of the evidence (MacKay 1992). Example: a load that explains weak rotors must sit in
    the middle of the drone, which is improbable for a load that may be anywhere. A parameter that no flight determines
    costs nothing by this ratio. The cost is at least one nat for each parameter, because chance gains as much.

    Args:
        covariance: (k, k), with the usual spread as prior (`posterior_covariance`).
    """
    root = np.linalg.inv(np.linalg.cholesky(_prior_covariance(candidates)))
    left = np.linalg.eigvalsh(root @ covariance @ root.T)
    return max(float(len(root)), -0.5 * float(np.sum(np.log(np.clip(left, 1e-12, 1.0)))))


def posterior_covariance(candidates: Sequence[Candidate], curvature: NDArray) -> NDArray:
    """(k, k) covariance of the candidates' parameters, with their usual spread as prior and all else free.

    These parameters come first in the curvature (n, n)."""
    usual = _prior_covariance(candidates)
    with_prior = curvature.copy()
    with_prior[: len(usual), : len(usual)] += np.linalg.inv(usual)
    return _inverse(with_prior)[: len(usual), : len(usual)]


def _prior_covariance(candidates: Sequence[Candidate]) -> NDArray:
    """(k, k) prior covariance of the parameters about neutral."""
    width = np.array([c.parameter(n).width for c in candidates for n in c.free])
    which = np.repeat(np.arange(len(candidates)), [len(c.free) for c in candidates])
    alike = np.array([CATALOGUE[c.effect].alike for c in candidates])[which]
    together = np.where(which[:, None] == which, alike, 0.0)
    np.fill_diagonal(together, 1.0)
    covariance: NDArray = together * np.outer(width, width)
    return covariance


@dataclass(frozen=True)
class Joint:
    """Effects as if they were fitted to all flights.

    Attributes:
        gain: further gain if they were fitted to both sets of flights [nats].
        blocks: (b,) log-likelihood of the held-out flights then.
        covariance: (k, k) `posterior_covariance` of the accepted parameters by both sets.
    """

    gain: float
    blocks: NDArray
    covariance: NDArray


def expected_gain(information: NDArray, own: slice, away: NDArray, spread: NDArray) -> float:
    """Mean gain of a real effect [nats]: z'Az/2, all else profiled out.

    A hover says nothing of a damping, real or not. The bounds of nuisances are left out, so the value is rather too
    small: an order of magnitude.

    Args:
        information: (n, n) of all free columns, with the precisions of their priors.
        own: the columns (k) of the effect.
        away: (k,) its size.
        spread: (k,) usual deviations of its parameters, 0 without one: a nuisance gains this part without the effect.
    """
    rest = np.setdiff1d(np.arange(len(information)), np.arange(len(information))[own])
    across = information[np.ix_(rest, rest)], information[rest, own]
    inner = information[own, own] - across[1].T @ np.linalg.lstsq(*across, rcond=1e-12)[0]
    inner = inner @ np.linalg.inv(np.eye(len(away)) + np.diag(np.square(spread)) @ inner)
    return 0.5 * float(away @ inner @ away)


def joint_gain(fitted: Fitted, held_out: Data, there: Fitted, accepted: Sequence[Candidate]) -> Joint:
    """The accepted effects as if they were fitted to all flights.

    One step starts at `there`, the fit of the held-out flights with the effect as `fitted`. The curvature at `fitted`
    is the prior of the effect's parameters. A parameter that is also a nuisance may differ between the two sets, by its
    prior in each. `there` has moved such parameters already; the cost of their prior there is added back. An effect is
    admitted by the size that was fitted. A comparison must not depend on how precisely the fitted flights determine the
    effects: otherwise uninformative flights always prefer fewer parameters.
    """
    free = nuisances(held_out, there.point, accepted)
    own, parts = sum(len(c.free) for c in accepted), [*accepted, *(c for c, _ in free)]
    columns = [x for c in parts for x in c.columns(there.point)]
    score, information = held_out.gram(there.point, columns).total(range(len(columns)))
    apart = {(c.effect, n): w for c, p in nuisances(held_out, there.point, ()) for n, w in zip(c.free, p, strict=True)}
    paid = np.array([apart.get((c.effect, n), 0.0) for c in accepted for n in c.free])
    away = np.array([
        *(c.values(there.point)[n] - c.values(fitted.point)[n] for c in accepted for n in c.free),
        *(c.values(there.point)[n] - c.neutral(there.point)[n] for c, _ in free for n in c.free),
    ])  # fmt: skip
    freedom = np.append(np.full(own, np.inf), freedom_of([c for c, _ in free]))
    usual = np.array([*np.zeros(own), *(w for _, precision in free for w in precision)])
    known = np.diag(local_precision(away, usual, freedom))
    differing = np.divide(1.0, paid, out=np.zeros(own), where=paid > 0.0)
    curvature = fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision)
    known[:own, :own] = _inverse(_inverse(curvature)[:own, :own] + np.diag(2.0 * differing))
    back = 0.5 * float(paid @ np.square(away[:own]) - away[:own] @ known[:own, :own] @ away[:own])
    rest = score - known @ away
    near = np.diag(known) * (np.arange(len(away)) >= own)
    low, high = nuisance_bounds(*bounds_of(parts, there.point), away, near, freedom)
    step = bounded(information + known, rest, low, high)
    gain = float(rest @ step - 0.5 * step @ (information + known) @ step)
    blocks, covariance = held_out.block_loglik(there.point), posterior_covariance(accepted, information + known)
    if gain < SELECTION.linear_gain:
        return Joint(back + gain, blocks, covariance)
    # a linear gain this large is unreliable: the likelihood after the step decides
    looked = held_out.twin()
    begin, best = looked.loglik(there.point) - 0.5 * float(away @ known @ away), 0.0
    for part in (1.0, 0.5, 0.25):
        moves = part * step
        point = with_change(there.point, parts, moves)
        with np.errstate(over="ignore", invalid="ignore"):
            brought = looked.loglik(point, passes=2) - begin
        brought -= 0.5 * float((away + moves) @ known @ (away + moves))
        if np.isfinite(brought) and brought > best:
            # the scatter of a comparison is that after the step: a right drag fitted to a hover fits quick flight so
            # badly that all rivals would be its look-alikes
            best, blocks = brought, looked.block_loglik(point)
    return Joint(back + min(best, gain), blocks, covariance)


def accepted_covariance(fitted: Fitted, accepted: Sequence[Candidate]) -> NDArray:
    """(k, k) covariance of the accepted parameters at the maximum (`posterior_covariance`)."""
    return posterior_covariance(accepted, fitted.gram.total(range(fitted.gram.size))[1] + np.diag(fitted.precision))


def _inverse(matrix: NDArray) -> NDArray:
    """Inverse of a covariance or curvature (k, k) of parameters of very different sizes; 0 for one without information.

    Raises:
        DivergedError: an element is not finite.
    """
    if not np.isfinite(matrix).all():
        raise DivergedError("the curvature of a fit is not finite")
    inverse, informed = np.zeros_like(matrix), np.flatnonzero(np.diag(matrix) > 0.0)
    scale = np.sqrt(np.diag(matrix)[informed])
    unit = np.outer(scale, scale)
    part = np.ix_(informed, informed)
    inverse[part] = np.linalg.pinv(matrix[part] / unit, rcond=1e-9, hermitian=True) / unit
    return inverse
