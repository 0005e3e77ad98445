"""Nuisances: parameters that no vehicle file gives exactly, so they are always free, with priors; fits with them."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate, of_recordings
from crazyem.diagnosis.fitting.days import day_freedom, day_sd, trim_known
from crazyem.diagnosis.fitting.fit import (
    Data,
    DivergedError,
    Fitted,
    bounds_of,
    refine,
    with_torque_memory,
    with_torque_memory_refit,
)
from crazyem.diagnosis.fitting.gram import Solution, used
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.sampling import interval, unlogged_share
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import FITTING
from crazyem.physics.effects import rotors
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect
from crazyem.physics.effects.prior import Conditions, Prior
from crazyem.physics.effects.sensing import GYRO_BIAS
from crazyem.physics.effects.timing import MOTOR_LAG
from crazyem.vehicle import Vehicle


def conditions_of(flights: Sequence[Flight], point: Point) -> Conditions:
    """The conditions of some flights under a model."""
    vehicle = point.vehicle
    days = day_sd(vehicle)
    moving = [np.nanmean(np.square(f.y[:, 3:6]), axis=0) for f in flights if np.isfinite(f.y[:, 3]).any()]
    return Conditions(
        signals=frozenset.intersection(*(f.signals for f in flights)),
        measured_speeds=flights[0].inputs.measured,
        onboard=any(f.fused for f in flights),
        inferred_attitude=any(np.isfinite(f.y[:, 6]).any() for f in flights),
        no_voltage=all(f.levelled for f in flights),
        own_battery=all(f.differs for f in flights),
        file_effects=frozenset(vehicle.effects),
        arm=vehicle.arm,
        lag=vehicle.motor_time_constant,
        days=(days[0], days[1], days[2], days[3], day_freedom(vehicle)),
        speed=np.sqrt(np.mean(moving, axis=0)) if moving else np.zeros(3),
        period=max(interval(f) for f in flights),
        unlogged_share=unlogged_share(flights, vehicle),
        other_clock=all(f.coarse for f in flights),
        rotor_inertia=float(point.effects.get(rotors.ROTOR_INERTIA.name, {}).get("inertia", 0.0)),
        gyro_bias=float(np.linalg.norm([float(v) for v in point.effects.get(GYRO_BIAS.name, {}).values()])),
    )


COARSE_REASON = "the turning does not follow the commands as they were recorded: they are on another clock"
TRIM_REASON = "a shifted centre of mass is a trim, and that changes from day to day"
LEVEL_REASON = "no battery voltage is recorded, so how heavy or strong the drone is cannot be told"
Nuisances = list[tuple[Candidate, tuple[float, ...]]]  # with the precision of each free parameter


def nuisances(data: Data, point: Point, accepted: Sequence[Candidate]) -> Nuisances:
    """The nuisances with the precisions of their priors about neutral: the usual deviations of every effect.

    Effects that are accepted or constrained are left out.
    """
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


def with_thrust_scales(flights: Sequence[Flight], kept_apart: Sequence[Flight], vehicle: Vehicle) -> list[list[Flight]]:
    """The flights, each with a thrust scale of its own if there are enough of them (`FITTING.min_thrust_flights`).

    A vehicle file with a trim already has such a free thrust. So does a voltage from the start of the flight
    (`inputs.level_of`).
    """
    commanded = not any(f.inputs.measured or f.levelled for f in (*flights, *kept_apart))
    own = len(flights) >= FITTING.min_thrust_flights and commanded and TRIM not in vehicle.effects
    return [[replace(f, differs=own) for f in part] for part in (flights, kept_apart)]


def is_nonphysical(point: Point, accepted: Sequence[Candidate]) -> bool:
    """Whether an inertia, a lack of torque or a damping in the model is larger than a drone of this mass and size can
    have.

    Streams that were interpolated onto another clock do not look white. Their torques explain little of the rotation,
    and effects that explain the rest say nothing about the drone.
    """
    tests = [(CATALOGUE[c.effect].unphysical, c.values(point)) for c in accepted]
    return any(point.vehicle.arm) and any(test(values, point.vehicle) for test, values in tests if test)


def without_unobservable(
    data: Data, point: Point, candidates: Sequence[Candidate], left_out: dict[str, str]
) -> tuple[list[Candidate], dict[str, str]]:
    """The candidates without those that such recordings cannot show, and `left_out` with the reasons of these."""
    gone = {}
    if TRIM in point.vehicle.effects:
        shifts_only = (c for c in candidates if CATALOGUE[c.effect].shifts_centre and not CATALOGUE[c.effect].lifts)
        gone = {c.effect: TRIM_REASON for c in shifts_only}
    if all(f.levelled for f in data.flights):
        gone |= {c.effect: LEVEL_REASON for c in candidates if CATALOGUE[c.effect].needs_voltage}
    if data.coarse:
        gone |= {c.effect: COARSE_REASON for c in candidates if _turns(CATALOGUE[c.effect])}
        # the height of a centre of mass shows in torques alone
        candidates = [
            replace(c, free=tuple(n for n in c.free if n != "z")) if CATALOGUE[c.effect].shifts_centre else c
            for c in candidates
        ]
    return [c for c in candidates if c.effect not in gone], {**left_out, **gone}


def _turns(effect: Effect) -> bool:
    """Whether only torques show an effect. The curve of thrust over command and its delay show in forces, too."""
    before_rotors = effect.commanded is not None or effect.timing is not None
    return effect.steady_torque or (effect.needs_torques and not before_rotors)


def with_trim_noise(data: Data, point: Point) -> Point:
    """The point with noise that was fitted with a free trim, so that a steady torque is not fitted as noise.

    The steady torque of a weak rotor is many times the trim of a day. Without the effect in the model, the noise scales
    would grow until they explain this torque, and the effect would gain little. For a vehicle file with a trim
    only.
    """
    if TRIM not in point.vehicle.effects:
        return point
    free = [Candidate(TRIM, (), ("x", "y", "z")), THRUST]
    rest = [(c, p) for c, p in nuisances(data, point, free)]
    start = with_nuisances(point, [*rest, *((c, ()) for c in free)])
    found = start
    for _ in range(2):  # in the first turn, the noise still explains steady torques
        found = refine(data, found, free, nuisances=rest, rounds=4).point
        white = replace(found.noise, disturbance=np.concatenate([found.noise.disturbance[:3], np.zeros(3)]))
        found = with_torque_memory(data, data.fit_noise(replace(found, noise=white)))
    return replace(point, noise=found.noise)


def solved(fitted: Fitted, *, wide: bool = False) -> tuple[Solution, float]:
    """The free parameters at the maximum with their covariance, and the degrees of freedom that they use.

    There are some 15 nuisances, with a trim in the file 20: nearly as many as blocks in a flight of 20 s. The priors
    determine most of them, so these use no degree of freedom. `wide`, for intervals: each uses one, because the scatter
    shows less error than there is. With a trim, too few would remain, and `wide` changes nothing.
    """
    gram, precision = fitted.gram, fitted.precision
    if wide and TRIM not in fitted.point.vehicle.effects:
        return gram.solve(range(gram.size), precision=precision), gram.size
    solution = gram.solve(range(gram.size), precision=precision, effective=True)
    information = gram.total(range(gram.size))[1]
    return solution, used(information, information + np.diag(precision))


def can_be_finding(candidate: Candidate) -> bool:
    """Whether an effect can be a finding although it is a nuisance."""
    return candidate.effect in CATALOGUE and CATALOGUE[candidate.effect].prior.usual_named


def without(point: Point, effect: str) -> Point:
    """The point with the effect at its values of the vehicle file; most files do not have it."""
    rest = {n: v for n, v in point.effects.items() if n != effect}
    if effect in point.vehicle.effects:
        rest[effect] = dict(point.vehicle.effects[effect])
    return replace(point, effects=rest)


def systematic_sd(data: Data, point: Point) -> dict[tuple[str, str], float]:
    """(effect, parameter) -> least standard deviation of the parameter, which no fit can reduce.

    It is that of the prior of a nuisance, or a systematic or relative error of the effect (`Prior`).
    """
    free = {
        (c.effect, name): precision**-0.5
        for c, precisions in nuisances(data, point, ())
        for name, precision in zip(c.free, precisions, strict=True)
        if not can_be_finding(c)
    }
    known = {(e.name, n): sd for e in CATALOGUE.values() for n, sd in e.prior.systematic.items()}
    for name, here in point.effects.items():
        prior = CATALOGUE[name].prior if name in CATALOGUE else Prior()
        chaotic = prior.relative_error_chaotic and any(m.diverges(name, point.vehicle) for m in data.models)
        for n, share in {**prior.relative_error, **(prior.relative_error_chaotic if chaotic else {})}.items():
            whole = point.vehicle.mass if prior.per.get(n) == "mass" else abs(float(here.get(n, 0.0)))
            known[name, n] = math.hypot(known.get((name, n), 0.0), share * whole)
    return {**known, **free}


def error_by_lag(data: Data, fitted: Fitted) -> dict[tuple[str, str], float]:
    """(effect, parameter) -> error that an error `FITTING.lag_error` of the rotor lag causes.

    For effects with twins (`Effect.twins`), if the lag is a nuisance.
    """
    rest = [c for c, _ in nuisances(data, fitted.point, fitted.candidates)]
    own = [(c.effect, name) for c in fitted.candidates for name in c.free]
    free = [(c.effect, name) for c in rest for name in c.free]
    lag, names = (MOTOR_LAG.name, "time_constant"), own + free
    if lag not in free or len(names) != fitted.gram.size:
        return {}
    at = names.index(lag)
    low, high = bounds_of([*fitted.candidates, *rest], fitted.point)
    others = [i for i in range(len(names)) if i != at and low[i] < 0.0 < high[i]]  # parameters at a bound stay there
    a = fitted.gram.total(range(len(names)))[1] + np.diag(fitted.precision)
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    along = np.linalg.lstsq((a / np.outer(scale, scale))[np.ix_(others, others)], a[others, at] / scale[others])[0]
    moved = dict(zip((names[i] for i in others), np.abs(along / scale[others]) * FITTING.lag_error, strict=True))
    return {name: float(moved[name]) for name in own if CATALOGUE[name[0]].twins and name in moved}


def with_nuisances(point: Point, free: Nuisances) -> Point:
    """The point with all nuisances present, so that their derivatives are taken at the point."""
    for c, _ in free:
        if c.effect not in point.effects:
            point = point.with_effects({c.effect: c.neutral(point)})
    return point


def held_out_fit(held_out: Data, point: Point, accepted: Sequence[Candidate], *, noise: bool = False) -> Fitted:
    """The model on held-out flights: with its effects, and with nuisances fitted to these flights.

    The noise scales are those of `held_out.own` (`held_out_twin`), if known; with `noise`, they are fitted. An accepted
    effect that is also a nuisance is free about its fitted value. Otherwise a model with fixed inertias would be
    compared with a torque scale beside free inertias.
    """
    free = nuisances(held_out, point, ())
    found = {c.effect for c in accepted}
    bare = point.with_effects({c.effect: c.neutral(point) for c, _ in free if c.effect not in found})
    start = bare
    if held_out.own is not None:
        own = {c.effect: held_out.own.effects.get(c.effect) for c, _ in free if c.effect not in found}
        start = replace(bare.with_effects({n: v for n, v in own.items() if v}), noise=held_out.own.noise)
    return refine(held_out, start, (), nuisances=free, about=bare, rounds=2, noise=noise)


def held_out_twin(held_out: Data, point: Point, accepted: Sequence[Candidate]) -> Data:
    """A twin of held-out flights with its own noise scales and nuisances, fitted under this model.

    Noise belongs to a recording: between slow and fast flights, it makes thousands of nats. All models that are
    compared start from the same fit; otherwise they end at different local maxima, which differ by ten nats. With a
    trim in the file, the noise is that of the fitted flights, so that a steady torque does not become torque noise with
    memory.
    """
    twin = held_out.twin()
    twin.own = None
    there = held_out_fit(twin, point, accepted, noise=TRIM not in point.vehicle.effects).point
    gone = {c.effect for c in accepted}
    twin.own = replace(there, effects={n: v for n, v in there.effects.items() if n not in gone})
    return twin


def held_out_value(held_out: Data | None, point: Point, accepted: Sequence[Candidate]) -> tuple[Data | None, float]:
    """The held-out flights with the nuisances of this model, and its log-likelihood there."""
    if held_out is None:
        return None, 0.0
    apart = held_out_twin(held_out, point, accepted)
    return apart, held_out_fit(apart, point, accepted).loglik


def _reset_conditional(point: Point, accepted: Sequence[Candidate], free: Nuisances) -> Point:
    """The point with effects that are not free in this model (`Prior.conditional`) reset to the vehicle file.

    Otherwise a value of an earlier fit would stay in the model unreported, and would bias other effects.
    """
    kept = {c.effect for c in (*accepted, *(c for c, _ in free))}
    for name, effect in CATALOGUE.items():
        point = without(point, name) if effect.prior.conditional and name not in kept else point
    return point


def refine_base(
    data: Data, point: Point, accepted: Sequence[Candidate], *, rounds: int = 5, noise: bool = True
) -> Fitted:
    """`refine` with the nuisances; with a trim, the noise scales stay (see `with_trim_noise`)."""
    noise = noise and TRIM not in point.vehicle.effects
    free = nuisances(data, point, accepted)
    point = _reset_conditional(point, accepted, free)
    return refine(data, with_nuisances(point, free), accepted, nuisances=free, rounds=rounds, noise=noise)


def refine_with_memory(data: Data, point: Point, accepted: Sequence[Candidate], *, rounds: int = 5) -> Fitted:
    """`refine_base`, then again with a new choice of the memory of disturbing torques; the better of both.

    The memory was chosen under a model without the effects and nuisances. If it is wrong, an effect such as a torque
    scale gets the gain that belongs to the noise (58 nats in a flight).
    """
    once = refine_base(data, point, accepted, rounds=rounds)
    try:
        again = refine_base(data, with_torque_memory_refit(data, once.point), accepted, rounds=rounds)
    except DivergedError:  # then the first fit stays
        again = once
    if again.loglik > once.loglik:
        return again
    data.settle(once.point)
    return once
