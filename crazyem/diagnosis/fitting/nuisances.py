"""What a vehicle file never says exactly, and is therefore always free, with priors; fits that leave it free."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate, of_recordings
from crazyem.diagnosis.fitting.conditions import conditions_of
from crazyem.diagnosis.fitting.days import trim_known
from crazyem.diagnosis.fitting.fit import Data, DivergedError, Fitted, bounds_of, refine, remembering, remembering_anew
from crazyem.diagnosis.fitting.gram import Solution, used
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.flights.flight import Flight
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect
from crazyem.physics.effects.prior import Prior
from crazyem.physics.effects.timing import MOTOR_LAG
from crazyem.vehicle import Vehicle

# s: fits find the rotors' lag off all the same: in sixteen more flights with nothing hidden 47 to 55 ms, 3.1 ms (rms),
# with inertias 3 % too small for each ms too long where the drone turns little.
LAG_OFF = 3e-3
SEVERAL = 3  # recordings whose commands are known, from which on each has a thrust of its own
COARSE_REASON = "the turning does not follow the commands as they were recorded: they are on another clock"
TRIM_REASON = "a shifted centre of mass is a trim, and that changes from day to day"
LEVEL_REASON = "no battery voltage is recorded, so how heavy or strong the drone is cannot be told"
Nuisances = list[tuple[Candidate, tuple[float, ...]]]  # with the precision of each free parameter


def nuisances(data: Data, point: Point, accepted: Sequence[Candidate]) -> Nuisances:
    """What is always free, with the precisions of its priors about neutral: the usual deviations of every effect."""
    facts = conditions_of(data.flights, point)
    taken = {c.effect for c in accepted} | data.constrained
    found: Nuisances = []
    for effect in CATALOGUE.values():
        prior, sizes = effect.prior, effect.prior.usual_in(facts)
        if not sizes or effect.own_likelihood or not taken.isdisjoint(effect.fixed_beside):
            continue
        if prior.each(facts):
            candidate: Candidate = of_recordings(effect.name, tuple(sizes), data.flights)
            precision = tuple(sd**-2 for sd in sizes.values()) * (len(candidate.free) // len(sizes))
        else:
            centre = tuple((n, c) for n, c in prior.centre_in(facts).items() if n in sizes)
            tails = prior.freedom_in(facts) if trim_known(point.vehicle) else math.inf
            candidate = Candidate(effect.name, centre, tuple(sizes), both_ways=prior.signed, freedom=tails)
            neutral = candidate.neutral(point)
            body = {"mass": point.vehicle.mass, "inertia": point.vehicle.inertia[0]}
            precision = tuple((sd * prior.share(n, **body, neutral=neutral[n])) ** -2.0 for n, sd in sizes.items())
        found.append((candidate, precision))
    return [(c, p) for c, p in found if c.effect not in taken]


def differing(flights: Sequence[Flight], kept_apart: Sequence[Flight], vehicle: Vehicle) -> list[list[Flight]]:
    """The flights, each with a thrust of its own where there are several: see `SEVERAL`.

    A trim has one already, and so has a voltage that was taken from the flight's own beginning (`level.py`).
    """
    commanded = not any(f.inputs.measured or f.levelled for f in (*flights, *kept_apart))
    own = len(flights) >= SEVERAL and commanded and TRIM not in vehicle.effects
    return [[replace(f, differs=own) for f in part] for part in (flights, kept_apart)]


def unlike_a_body(point: Point, accepted: Sequence[Candidate]) -> bool:
    """Whether the inertia, the lack of torque or the damping that was found is more than a drone of this mass and size
    can have.

    Streams that were put onto another clock by straight lines do not look white any more. Their torques explain so
    little of the turning that what is found in its place says nothing of the drone.
    """
    tests = [(CATALOGUE[c.effect].unphysical, c.values(point)) for c in accepted]
    return any(point.vehicle.arm) and any(test(values, point.vehicle) for test, values in tests if test)


def abstained(
    data: Data, point: Point, candidates: Sequence[Candidate], left_out: dict[str, str]
) -> tuple[list[Candidate], dict[str, str]]:
    """The candidates without those that such recordings cannot speak of, and the reasons with theirs."""
    gone = {}
    if TRIM in point.vehicle.effects:
        gone = {c.effect: TRIM_REASON for c in candidates if _only_shifts(CATALOGUE[c.effect])}
    if all(f.levelled for f in data.flights):
        gone |= {c.effect: LEVEL_REASON for c in candidates if CATALOGUE[c.effect].needs_voltage}
    if data.coarse:
        gone |= {c.effect: COARSE_REASON for c in candidates if _turns(CATALOGUE[c.effect])}
        candidates = [replace(c, free=_without_height(c)) for c in candidates]
    return [c for c in candidates if c.effect not in gone], {**left_out, **gone}


def _only_shifts(effect: Effect) -> bool:
    """Whether an effect moves the centre of mass and weighs nothing."""
    return effect.shifts_centre and not effect.lifts


def _turns(effect: Effect) -> bool:
    """Whether only torques tell of an effect: how thrust goes with the command, and how late, shows in forces, too."""
    before_rotors = effect.commanded is not None or effect.timing is not None
    return effect.steady_torque or (effect.needs_torques and not before_rotors)


def _without_height(candidate: Candidate) -> tuple[str, ...]:
    """What is fitted of a candidate whose height shows in torques that go with lateral acceleration, not in its
    weight."""
    return tuple(n for n in candidate.free if not CATALOGUE[candidate.effect].shifts_centre or n != "z")


def with_trim_noise(data: Data, point: Point) -> Point:
    """The point with the noise of a drone whose trim is unknown: what is steady must not pass for noise.

    A weak rotor is a steady torque many times that of a day's trim. Before it is found, noise scales would grow until
    it is noise, and then nothing asks for it any more. For a vehicle file with a trim only.
    """
    if TRIM not in point.vehicle.effects:
        return point
    free = [Candidate(TRIM, (), ("x", "y", "z")), THRUST]
    rest = [(c, p) for c, p in nuisances(data, point, free)]
    start = with_nuisances(point, [*rest, *((c, ()) for c in free)])
    found = start
    for _ in range(2):  # the first time the noise still holds what is steady
        found = refine(data, found, free, nuisances=rest, rounds=4).point
        white = replace(found.noise, disturbance=np.concatenate([found.noise.disturbance[:3], np.zeros(3)]))
        found = remembering(data, data.fit_noise(replace(found, noise=white)))
    return replace(point, noise=found.noise)


def solved(fitted: Fitted, *, wide: bool = False) -> tuple[Solution, float]:
    """The free parameters at the maximum with their covariance, and how many degrees of freedom they take.

    Some 15 things are always free, with a trim in the file 20, nearly as many as a flight of 20 s has blocks; most of
    them are what their priors say, and take none. `wide` for intervals: all take one (but with a trim, where too few
    would be left), because what priors leave out is more than scatter shows.
    """
    gram, precision = fitted.gram, fitted.precision
    if wide and TRIM not in fitted.point.vehicle.effects:
        return gram.solve(range(gram.size), precision=precision), gram.size
    solution = gram.solve(range(gram.size), precision=precision, effective=True)
    information = gram.total(range(gram.size))[1]
    return solution, used(information, information + np.diag(precision))


def by_gain(point: Point, gain: float, count: int, blocks: int, p_value: float) -> float:
    """The p-value of `count` parameters; with a trim in the file by `gain`, nats over their own dispersion.

    Some 20 things are free then, more than a short flight has blocks, so the scatter of the blocks' scores says nothing
    of what is left of a column once they are taken out.
    """
    if TRIM not in point.vehicle.effects:
        return p_value
    return float(stats.f.sf(2.0 * max(gain, 0.0) / count, count, max(blocks - 1, 1)))


def usual_named(candidate: Candidate) -> bool:
    """Whether an effect that is free beside all others is a finding all the same, where it explains more than none."""
    return candidate.effect in CATALOGUE and CATALOGUE[candidate.effect].prior.usual_named


def without(point: Point, effect: str) -> Point:
    """The point with an effect as the vehicle file has it, which is nothing for most."""
    rest = {n: v for n, v in point.effects.items() if n != effect}
    if effect in point.vehicle.effects:
        rest[effect] = dict(point.vehicle.effects[effect])
    return replace(point, effects=rest)


def systematic_sd(data: Data, point: Point) -> dict[tuple[str, str], float]:
    """(effect, parameter) -> standard deviation within which it is never known, whatever a fit says.

    That of what is always free, and of what the same log shows in another way.
    """
    free = {
        (c.effect, name): precision**-0.5
        for c, precisions in nuisances(data, point, ())
        for name, precision in zip(c.free, precisions, strict=True)
        if not usual_named(c)
    }
    known = {(e.name, n): sd for e in CATALOGUE.values() for n, sd in e.prior.systematic.items()}
    for name, here in point.effects.items():
        prior = CATALOGUE[name].prior if name in CATALOGUE else Prior()
        chaotic = prior.relative_error_chaotic and any(m.diverges(name, point.vehicle) for m in data.models)
        for n, share in {**prior.relative_error, **(prior.relative_error_chaotic if chaotic else {})}.items():
            known[name, n] = share * (point.vehicle.mass if prior.per.get(n) == "mass" else abs(float(here[n])))
    return {**known, **free}


def by_a_wrong_lag(data: Data, fitted: Fitted) -> dict[tuple[str, str], float]:
    """(effect, parameter) of what turns the drone -> how far it is off where the rotors' lag is off by `LAG_OFF`; where
    the lag is free beside them, but no finding."""
    rest = [c for c, _ in nuisances(data, fitted.point, fitted.candidates)]
    own = [(c.effect, name) for c in fitted.candidates for name in c.free]
    free = [(c.effect, name) for c in rest for name in c.free]
    lag, names = (MOTOR_LAG.name, "time_constant"), own + free
    if lag not in free or len(names) != fitted.gram.size:
        return {}
    at = names.index(lag)
    low, high = bounds_of([*fitted.candidates, *rest], fitted.point)
    others = [i for i in range(len(names)) if i != at and low[i] < 0.0 < high[i]]  # what is at a bound stays there
    a = fitted.gram.total(range(len(names)))[1] + np.diag(fitted.precision)
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    along = np.linalg.lstsq((a / np.outer(scale, scale))[np.ix_(others, others)], a[others, at] / scale[others])[0]
    moved = dict(zip((names[i] for i in others), np.abs(along / scale[others]) * LAG_OFF, strict=True))
    return {name: float(moved[name]) for name in own if CATALOGUE[name[0]].twins and name in moved}


def with_nuisances(point: Point, free: Nuisances) -> Point:
    """The point with all of them present, so that derivatives are taken at it."""
    for c, _ in free:
        if c.effect not in point.effects:
            point = point.with_effects({c.effect: c.neutral(point)})
    return point


def on_held_out(held_out: Data, point: Point, accepted: Sequence[Candidate], *, noise: bool = False) -> Fitted:
    """The model on flights kept apart: effects as they are, what is always free belongs to each flight, and so do noise
    scales where these are known (`as_held_out`), or are fitted with `noise`.

    Where an effect is of a kind that is always free, it is so about what was found: otherwise inertias as fitted would
    be compared with torques that come with inertias to each flight's liking.
    """
    free = nuisances(held_out, point, ())
    found = {c.effect for c in accepted}
    bare = point.with_effects({c.effect: c.neutral(point) for c, _ in free if c.effect not in found})
    start = bare
    if held_out.own is not None:
        own = {c.effect: held_out.own.effects.get(c.effect) for c, _ in free if c.effect not in found}
        start = replace(bare.with_effects({n: v for n, v in own.items() if v}), noise=held_out.own.noise)
    return refine(held_out, start, (), nuisances=free, about=bare, rounds=2, noise=noise)


def as_held_out(held_out: Data, point: Point, accepted: Sequence[Candidate]) -> Data:
    """A twin of flights kept apart that knows its noise scales and what is free of it by this model.

    Noise belongs to a recording: slow and fast flights differ by thousands of nats in it. Models that are compared
    begin where one of them ended, or maxima beside each other differ by ten. With a trim in the file noise stays that
    of the flights fitted: what is steady would pass for a torque with memory.
    """
    twin = held_out.twin()
    twin.own = None
    there = on_held_out(twin, point, accepted, noise=TRIM not in point.vehicle.effects).point
    gone = {c.effect for c in accepted}
    twin.own = replace(there, effects={n: v for n, v in there.effects.items() if n not in gone})
    return twin


def _let_go(point: Point, accepted: Sequence[Candidate], free: Nuisances) -> Point:
    """The point with what is free no longer (see `nuisances`) as the vehicle file has it, instead of where it was left:
    nobody is told of it, and a torque scale of 0.925 that stayed made a centre of mass 8 % too small."""
    kept = {c.effect for c in (*accepted, *(c for c, _ in free))}
    for name, effect in CATALOGUE.items():
        point = without(point, name) if effect.prior.conditional and name not in kept else point
    return point


def refine_base(
    data: Data, point: Point, accepted: Sequence[Candidate], *, rounds: int = 5, noise: bool = True
) -> Fitted:
    """`refine` with what is always free; with a trim, noise scales stay as they are (see `with_trim_noise`)."""
    noise = noise and TRIM not in point.vehicle.effects
    free = nuisances(data, point, accepted)
    point = _let_go(point, accepted, free)
    return refine(data, with_nuisances(point, free), accepted, nuisances=free, rounds=rounds, noise=noise)


def refine_anew(data: Data, point: Point, accepted: Sequence[Candidate], *, rounds: int = 5) -> Fitted:
    """`refine_base`, then once more with the memory of the disturbing torques chosen again; the better of both.

    Whether torques have a memory was told by a model that lacked what is found, and what is always free: of one flight
    the nominal model gained 58 nats by a second look, which a torque scale got for itself before.
    """
    once = refine_base(data, point, accepted, rounds=rounds)
    try:
        again = refine_base(data, remembering_anew(data, once.point), accepted, rounds=rounds)
    except DivergedError:  # a second look that leads nowhere takes nothing away
        again = once
    if again.loglik > once.loglik:
        return again
    data.settle(once.point)
    return once
