"""Detection limits of effects, and ends of their physical ranges."""

from collections.abc import Mapping

import numpy as np

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.conditions import conditions_of
from crazyem.diagnosis.fitting.days import day_sd
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.settings import LOADS
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
