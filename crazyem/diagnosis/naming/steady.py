"""Steady torques: a trim among its look-alikes, what is left of one in the vehicle that was fitted, and the centre of
mass that whole torques balance.

A torque that acts all the time and that no effect explains is what a real drone needs to hover: rotors that are not
equal, nor upright. It stays unexplained, but the file that is written has it, so that a simulator flies as the drone
does, and the next diagnosis by that file takes it for the file of a real drone, whose trim, thrust and flapping differ
from day to day. Its thrust on this day is written with it: 4 % that nobody was told of, and a weak rotor looks weaker
and its drone stronger than the day allows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, nominal, refine
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import first_guess
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, with_nuisances, with_trim_noise, without
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.naming.onset import ONSET
from crazyem.diagnosis.naming.trials import Selection, Trial, distinguishable
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import TORQUE_SCALE
from crazyem.vehicle import Vehicle


def left_as_trim(flights: Sequence[Flight], vehicle: Vehicle, remains: Unexplained, workers: Workers) -> Vehicle:
    """The fitted vehicle with the trim that these flights ask for, if a steady torque is left and it has none."""
    steady = any(f.signal == "torque" and not f.variable for f in remains.findings)
    if not steady or TRIM in vehicle.effects or all(f.coarse for f in flights):  # such torques are not to be written
        return vehicle
    trim = Candidate(TRIM, (), ("x", "y", "z"))
    untrimmed = replace(vehicle, effects={**vehicle.effects, TRIM: dict.fromkeys(trim.free, 0.0)})
    data = Data(flights, workers)
    point = nominal(data, Point(untrimmed, {n: dict(v) for n, v in untrimmed.effects.items()}, first_guess()))
    found = refine_base(data, with_trim_noise(data, point), [trim, THRUST]).point.effects
    steady_now = {TRIM: {n: float(found[TRIM][n]) for n in trim.free}, THRUST.effect: _scale_of(found)}
    return replace(vehicle, effects={**vehicle.effects, **steady_now})


def with_its_thrust(vehicle: Vehicle, data: Data, point: Point, accepted: Sequence[Candidate]) -> Vehicle:
    """The vehicle with the thrust that is fitted beside a trim that was found, if one was."""
    names = {c.effect for c in accepted}
    if TRIM not in names or THRUST.effect in names:
        return vehicle
    found = refine_base(data, point, [*accepted, THRUST]).point.effects
    return replace(vehicle, effects={**vehicle.effects, THRUST.effect: _scale_of(found)})


def _scale_of(effects: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """The thrust scale among the effects of a model, as a file has it."""
    return {"scale": float(effects[THRUST.effect]["scale"])}


def with_exact_torques(data: Data, selection: Selection) -> Selection:
    """The selection fitted with the rotors' torques as the file has them, where a centre of mass is to be known.

    All torques are free within 3 %, because what acts between two logged commands makes quick ones look wrong. A drone
    at rest is balanced by whole ones: in 19 simulated drones with a load or a shifted centre (seeds 2039 and 2040) that
    freedom, -3 to +5 %, moved the centre by as much, 37 um (rms) of 220 to 3300; without it, it is wrong by 6.
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


def as_steady(trim: Trial, rivals: Sequence[Trial]) -> tuple[Trial, ...]:
    """What explains a steady torque as well as a trim or better: with a trim that nobody knows it is not told from it.

    So a trim is taken first where it is asked for: every real drone has one, and a weak rotor or a load beside the
    middle is told by a file that knows it, which a flight of the healthy drone gives.
    """
    others = (t for t in rivals if CATALOGUE[t.candidate.effect].steady_torque)
    return tuple(t for t in others if not distinguishable(trim, t))


def without_trim_rivals(candidates: Sequence[Candidate], accepted: Sequence[Candidate]) -> list[Candidate]:
    """The candidates without what a fitted trim is, too: a torque from the start on, of which only an amplitude that
    shows otherwise is left (how heavy a load is)."""
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


def by_onsets(point: Point, p_value: float, blocks: int) -> float:
    """The p-value of an onset that was looked for among the blocks: with a trim in the file nothing asks again."""
    return min(1.0, p_value * blocks) if TRIM in point.vehicle.effects else p_value
