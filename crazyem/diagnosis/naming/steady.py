"""Steady torques: a trim and its look-alikes, the trim of a fitted vehicle, and the centre of mass by exact torques.

A real drone needs a steady torque to hover, because its rotors are neither equal nor upright. A steady torque without
an effect stays unexplained, but the written file contains it, so that a simulator flies like the drone. The next
diagnosis treats this file as that of a real drone, whose trim, thrust and flapping differ from day to day. The thrust
of this day is written, too: with an unknown error of 4 %, a weak rotor looks weaker, and its drone stronger, than the
differences between days allow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, nominal, refine
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, with_nuisances, with_trim_noise, without
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.naming.onset import ONSET
from crazyem.diagnosis.naming.trials import Selection, Trial, distinguishable
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import TORQUE_SCALE
from crazyem.vehicle import Vehicle


def with_remaining_trim(flights: Sequence[Flight], vehicle: Vehicle, remains: Unexplained, workers: Workers) -> Vehicle:
    """The fitted vehicle with the trim of these flights, if a steady torque is unexplained and the file has no trim."""
    steady = any(f.signal == "torque" and not f.variable for f in remains.findings)
    if not steady or TRIM in vehicle.effects or all(f.coarse for f in flights):  # commands lack torques
        return vehicle
    trim = Candidate(TRIM, (), ("x", "y", "z"))
    untrimmed = replace(vehicle, effects={**vehicle.effects, TRIM: dict.fromkeys(trim.free, 0.0)})
    data = Data(flights, workers)
    point = nominal(data, Point(untrimmed, {n: dict(v) for n, v in untrimmed.effects.items()}, start_noise()))
    found = refine_base(data, with_trim_noise(data, point), [trim, THRUST]).point.effects
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
