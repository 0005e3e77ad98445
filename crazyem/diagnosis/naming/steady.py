"""Steady torques: a trim and its look-alikes, trim and thrust of a vehicle, the centre of mass by exact torques.

A real drone needs a steady torque to hover, because its rotors are neither equal nor upright. A steady torque without
an effect stays unexplained, but the written file contains it, so that a simulator flies like the drone. The next
diagnosis treats this file as that of a real drone, whose trim, thrust and flapping differ from day to day. The thrust
of this day is written, too: with an unknown error of 4 %, a weak rotor looks weaker, and its drone stronger, than the
differences between days allow. Healthy flights show how much they differ.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_sd
from crazyem.diagnosis.fitting.fit import Data, DivergedError, refine
from crazyem.diagnosis.fitting.fit import nominal as nominal_of
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, with_nuisances, with_trim_noise, without
from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.diagnosis.naming.balance import balance_of
from crazyem.diagnosis.naming.starting_points import ONSET
from crazyem.diagnosis.naming.trials import Selection, Trial, distinguishable
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import FITTING
from crazyem.diagnosis.workers import Workers
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import TORQUE_SCALE
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Days, Vehicle


def with_remaining_trim(flights: Sequence[Flight], vehicle: Vehicle, remains: Unexplained, workers: Workers) -> Vehicle:
    """The fitted vehicle with the trim of these flights, if a steady torque is unexplained and the file has no trim."""
    steady = any(f.signal == "torque" and not f.variable for f in remains.findings)
    if not steady or TRIM in vehicle.effects or all(f.coarse for f in flights):  # commands lack torques
        return vehicle
    trim = Candidate(TRIM, (), ("x", "y", "z"))
    untrimmed = replace(vehicle, effects={**vehicle.effects, TRIM: dict.fromkeys(trim.free, 0.0)})
    data = Data(flights, workers)
    found = refine_base(data, _nominal(data, untrimmed), [trim, THRUST]).point.effects
    steady_now = {TRIM: {n: float(found[TRIM][n]) for n in trim.free}, THRUST.effect: _scale_of(found)}
    return replace(vehicle, effects={**vehicle.effects, **steady_now})


def with_its_thrust(vehicle: Vehicle, data: Data, point: Point, accepted: Sequence[Candidate]) -> Vehicle:
    """The vehicle with the thrust scale fitted beside a found trim, if there is one."""
    names = {c.effect for c in accepted}
    if TRIM not in names or THRUST.effect in names:
        return vehicle
    found = refine_base(data, point, [*accepted, THRUST]).point.effects
    return replace(vehicle, effects={**vehicle.effects, THRUST.effect: _scale_of(found)})


def _scale_of(effects: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """The thrust scale of a model, as in a vehicle file."""
    return {"scale": float(effects[THRUST.effect]["scale"])}


def with_exact_torques(data: Data, selection: Selection) -> Selection:
    """The selection fitted with the torque scale of the file, if a selected effect shifts the centre of mass.

    As a nuisance the torque scale is free within 3 %, because unlogged commands between two samples make quick torques
    look wrong. Steady torques are exact. In 19 simulated drones with a load or a shifted centre (seeds 2039 and 2040),
    a free scale of -3 to +5 % moves the centre by as much, 37 um (rms) of 220 to 3300; the fixed scale leaves 6.
    """
    names = {c.effect for c in selection.accepted}
    centred = any(CATALOGUE[n].shifts_centre for n in names)
    if not centred or TORQUE_SCALE.name in names or TRIM in selection.final.vehicle.effects:
        return selection
    point = without(selection.final, TORQUE_SCALE.name)
    free = [(c, p) for c, p in nuisances(data, point, selection.accepted) if c.effect != TORQUE_SCALE.name]
    try:
        start = with_nuisances(point, free)
        fitted = refine(data, start, selection.accepted, nuisances=free, rounds=4, noise=False)
    except DivergedError:
        return selection
    return replace(selection, final=fitted.point, fitted=fitted)


def steady_rivals(trim: Trial, rivals: Sequence[Trial]) -> tuple[Trial, ...]:
    """Rivals that explain a steady torque as well as a trim or better: an unknown trim is their look-alike.

    So a trim is taken first if it is a candidate: every real drone has one. Only a file with the known trim, from a
    flight of the healthy drone, separates a weak rotor or a load off the centre from it.
    """
    others = (t for t in rivals if CATALOGUE[t.candidate.effect].steady_torque)
    return tuple(t for t in others if not distinguishable(trim, t))


def without_trim_rivals(candidates: Sequence[Candidate], accepted: Sequence[Candidate]) -> list[Candidate]:
    """The candidates without steady torques that a fitted trim explains. Of these effects only the amplitude remains,
    if there is one, because other signs determine it (the weight of a load)."""
    if all(c.effect != TRIM for c in accepted):
        return list(candidates)
    kept = []
    for c in candidates:
        effect = CATALOGUE[c.effect]
        if not effect.steady_torque or dict(c.fixed).get(ONSET) is not None:
            kept.append(c)
        elif effect.amplitude:
            kept.append(replace(c, free=(effect.amplitude,)))
    return kept


def with_baseline(
    vehicle: Vehicle, recordings: Sequence[Recording], say: Callable[[str], None] = lambda text: None
) -> Vehicle:
    """The vehicle with mean trim and thrust of healthy flights, their spread (`Days`), and the aerodynamics of the
    rotors (`Effect.of_healthy_rotors`) fitted to all flights together.

    Args:
        recordings: flights of this drone without a fault, of several days.

    Raises:
        UsageError: fewer than two flights. DataError: a recording cannot be used.
    """
    if len(recordings) < 2:
        raise UsageError("--baseline needs two healthy flights or more: one does not say how days differ.")
    trim = {"x": 0.0, "y": 0.0, "z": 0.0, **vehicle.effects.get(TRIM, {})}
    known = replace(vehicle, effects={**vehicle.effects, TRIM: trim}, days=None)
    lacks, flights = [], []
    for recording in recordings:
        say(f"healthy flight {recording.path}")
        flights.append(flight_of(recording, known))
        data = Data(flights[-1:])
        lacks.append(balance_of(data, _nominal(data, known)).lack)
    data = Data(flights)
    together = refine_base(data, _nominal(data, known), ()).point
    mean, sd = spread_of(np.array(lacks), np.array(day_sd(known)))
    thrust = float(known.effects.get(THRUST.effect, {}).get("scale", 1.0)) * (1.0 - float(mean[0]))
    own = {axis: float(trim[axis] + m) for axis, m in zip("xyz", mean[1:], strict=True)}
    effects = {**known.effects, **rotor_aerodynamics(data, together), TRIM: own, THRUST.effect: {"scale": thrust}}
    days = Days(len(recordings), float(sd[0]), (float(sd[1]), float(sd[2]), float(sd[3])))
    return replace(known, effects=effects, days=days)


def rotor_aerodynamics(data: Data, point: Point) -> dict[str, dict[str, float]]:
    """Drag and flapping as fitted; a number at the end of its prior's reach is that of the vehicle file."""
    found = {}
    for candidate, precisions in nuisances(data, point, ()):
        if candidate.effect in CATALOGUE and CATALOGUE[candidate.effect].of_healthy_rotors:
            filed, here = candidate.neutral(point), candidate.values(point)
            found[candidate.effect] = {
                name: float(
                    here[name]
                    if abs(here[name] - filed[name]) < FITTING.within_reach * FITTING.max_deviation * w**-0.5
                    else filed[name]
                )
                for name, w in zip(candidate.free, precisions, strict=True)
            }
    return found


def _nominal(data: Data, vehicle: Vehicle) -> Point:
    """The vehicle's model with the noise of these flights."""
    bare = Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, start_noise())
    return with_trim_noise(data, nominal_of(data, bare))


def spread_of(found: NDArray, usual: NDArray) -> tuple[NDArray, NDArray]:
    """(k,) means of numbers of flights (n, k), and (k,) scales of the t distribution for the next flight.

    usual: (k,) standard deviations for any drone, which count as p = `FITTING.prior_flights` flights: the conjugate
    prior of a variance (Gelman et al., Bayesian Data Analysis, 3.3). Degrees of freedom: p + n - 1.
    """
    n, mean = len(found), found.mean(axis=0)
    squares = FITTING.prior_flights * np.square(usual) + np.square(found - mean).sum(axis=0)
    return mean, np.sqrt(squares / (FITTING.prior_flights + n - 1.0) * (1.0 + 1.0 / n))
