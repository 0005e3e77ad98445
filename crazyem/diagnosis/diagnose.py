"""From recordings and a vehicle to a diagnosis: nominal model, where it fails, effects, fit, the unexplained."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate, candidates_for
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.fit import nominal as nominal_of
from crazyem.diagnosis.fitting.model import Point, deviations
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import (
    is_nonphysical,
    with_thrust_scales,
    with_trim_noise,
    without_unobservable,
)
from crazyem.diagnosis.fitting.sampling import with_zero_trim
from crazyem.diagnosis.flights import recording_nuisances as held_out_roles
from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.diagnosis.flights.frame import in_mean_frame
from crazyem.diagnosis.flights.recording_nuisances import RecordingNuisances, nuisances_of_recordings, with_common_floor
from crazyem.diagnosis.locating.heading import heading_by_place
from crazyem.diagnosis.locating.locate import Located, locate
from crazyem.diagnosis.locating.place import depends_on_place, pushes_away
from crazyem.diagnosis.naming.alternatives import with_better_rivals, with_replacement
from crazyem.diagnosis.naming.answer import Answer, Free, Named, answer_of, left_free, strongest_first
from crazyem.diagnosis.naming.balance import by_balance, hidden_by_daily_variation, steady_selection
from crazyem.diagnosis.naming.corroboration import false_speed, late_measurements
from crazyem.diagnosis.naming.determined import determined, without_undetermined
from crazyem.diagnosis.naming.load_or_rotors import LOAD, WEAKER, load_against_rotors, rotors_against_load
from crazyem.diagnosis.naming.other_likelihoods import late_rotors, other_likelihoods
from crazyem.diagnosis.naming.place_rivals import by_place
from crazyem.diagnosis.naming.prediction_check import with_accepted_effects, without_worse_predictions
from crazyem.diagnosis.naming.rotor_response import answers, unresponsive_rotor
from crazyem.diagnosis.naming.select import select
from crazyem.diagnosis.naming.steady import with_exact_torques, with_its_thrust, with_remaining_trim
from crazyem.diagnosis.naming.trials import Selection, Trial
from crazyem.diagnosis.naming.unexplained import Unexplained, unexplained
from crazyem.diagnosis.settings import SELECTION
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import ROTOR_FAULT
from crazyem.physics.effects.sensing import ROTOR_SENSOR
from crazyem.physics.effects.timing import INPUT_DELAY
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Say = Callable[[str], None]
WEAK, MISREAD = ROTOR_FAULT.name, ROTOR_SENSOR.name


@dataclass(frozen=True)
class Diagnosis:
    """All results; `document.py` turns them into JSON.

    Attributes:
        fitted_vehicle: the vehicle with the found effects of the drone; `as_flown` also has those of the recordings.
        free: nuisances beside the effects.
        swapped: whether `recordings` are those that were given as held out (see `flights/recording_nuisances.py`).
    """

    vehicle: Vehicle
    fitted_vehicle: Vehicle
    as_flown: Vehicle
    recordings: tuple[str, ...]
    held_out: tuple[str, ...]
    mismatch: bool
    before: Located
    after: Located
    effects: tuple[Named, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    would_separate: tuple[str, ...]
    unexplained: Unexplained
    selection: Selection
    left_out: dict[str, str]
    free: tuple[Free, ...]
    own: tuple[RecordingNuisances, ...]
    swapped: bool = False


def diagnose(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    *,
    held_out: Sequence[Recording] = (),
    wanted: Sequence[str] = (),
    withhold: Sequence[str] = (),
    strict: bool = False,
    jobs: int | None = 1,
    say: Say = lambda text: None,
) -> Diagnosis:
    """Find the physics that is missing from the model of a vehicle, from recordings.

    Args:
        held_out: flights that confirm the effects. If the recordings only hover and these do not, the roles are
            exchanged (`flights/recording_nuisances.py`), unless `strict`.
        jobs: threads that share the candidates; None: one for each core. The result is the same for any number.

    Raises:
        DataError: a recording cannot be used (no flight, no inputs, too short).
        UsageError: an unknown effect among those wanted.
    """
    request = _request_of(recordings, vehicle, held_out, wanted, withhold, strict=strict, say=say)
    workers = Workers(jobs)
    say(f"nominal model of {vehicle.name}: {sum(f.duration for f in request.flights):.0f} s of flight")
    chosen = _chosen(request, workers, say)
    data, apart = chosen.data, chosen.apart
    selection, pull = by_place(data, apart, chosen.selection, say)
    selection, corroborated = _corroborated(data, apart, selection, request.recordings)
    selection, balance = by_balance(data, with_exact_torques(data, selection))
    judges = request.held_out or request.recordings
    selection = without_worse_predictions(data, selection, request.vehicle, judges, withhold=withhold, say=say)
    extra = {c.effect for c in request.extra}
    selection, balance, unsure = without_undetermined(data, selection, balance, say, extra=extra)
    before, after = _located(data, selection, say)
    place = depends_on_place(data, apart, selection.final)
    remains = unexplained(data, selection, after, apart)
    for finding in (pull, place, heading_by_place(data, apart)):
        remains = remains.with_finding(finding) if finding else remains
    left_out = {**chosen.left_out, **selection.left_out}
    left_out |= hidden_by_daily_variation(data, selection, chosen.candidates)
    pulled = pull is not None or (place is not None and not pushes_away(place))
    beside = other_likelihoods(data, apart, selection.final, remains, wanted, left_out, pulled, say)
    if any(CATALOGUE[e.name].random for e in beside):
        remains = remains.without_force()
    answer = answer_of(
        data, selection, remains, corroborated=corroborated, in_place=_in_place(data, apart, selection), balance=balance
    )
    if request.flights[0].inputs.measured:
        answer, late, remains = _late_rotors(request, vehicle, answer, remains, left_out)
        beside += late
    effects, impossible = determined(strongest_first(answer.effects, beside), selection.final)
    as_flown = _with_effects(request.vehicle, selection, [e for e in effects if any(e.name == b.name for b in beside)])
    as_flown = with_its_thrust(as_flown, data, selection.final, selection.accepted)
    as_flown = _restored(
        with_remaining_trim(chosen.request.flights, as_flown, remains, workers),
        request.vehicle,
        impossible.keys() - extra,
    )
    of_recordings = {e.fitted_as or e.name for e in effects if e.of_recording}
    for name, reason in {**unsure, **impossible}.items():
        left_out[name] = "; ".join(filter(None, (reason, left_out.get(name))))
    return Diagnosis(
        vehicle=vehicle,
        fitted_vehicle=_restored(as_flown, request.vehicle, of_recordings),
        as_flown=as_flown,
        recordings=tuple(r.path for r in request.recordings),
        held_out=tuple(r.path for r in request.held_out),
        mismatch=bool(effects) or remains.found,
        before=before,
        after=after,
        effects=effects,
        indistinguishable=tuple(g for g in answer.groups if any(e.name in g for e in effects)),
        would_separate=_advice(answer.separate, [*request.recordings, *request.held_out]),
        unexplained=remains,
        selection=selection,
        left_out={n: reason for n, reason in left_out.items() if all(n != e.name for e in effects)},
        free=left_free(selection.fitted),
        own=nuisances_of_recordings(chosen.request.flights, chosen.request.held_out_flights, _strengths(selection)),
        swapped=request.swapped,
    )


@dataclass(frozen=True)
class _Request:
    """The task: recordings to fit and held-out ones, with their flights; the vehicle of the nominal model."""

    recordings: Sequence[Recording]
    held_out: Sequence[Recording]
    flights: Sequence[Flight]
    held_out_flights: Sequence[Flight]
    vehicle: Vehicle
    wanted: Sequence[str]
    extra: Sequence[Candidate]  # further candidates
    swapped: bool


@dataclass(frozen=True)
class _Chosen:
    """The selection: `request` with the flights as used, the selected effects, all candidates, and the effects that the
    flights cannot show, with the reasons."""

    request: _Request
    data: Data
    apart: Data | None
    selection: Selection
    candidates: list[Candidate]
    left_out: dict[str, str]


def _request_of(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    held_out: Sequence[Recording],
    wanted: Sequence[str],
    withhold: Sequence[str],
    *,
    strict: bool,
    say: Say,
) -> _Request:
    """The flights of the recordings, in one frame; roles are exchanged if the flights to fit only hover."""
    flights = [flight_of(r, vehicle, withhold=withhold) for r in recordings]
    held_out_flights = [flight_of(r, vehicle, withhold=withhold) for r in held_out]
    swapped = not strict and held_out_roles.swapped(flights, held_out_flights)
    if swapped:
        flights, held_out_flights, recordings, held_out = held_out_flights, flights, held_out, recordings
        say(held_out_roles.swap_sentence([r.path for r in recordings], [r.path for r in held_out]))
    assumed = with_zero_trim(flights, vehicle)
    untrimmed = assumed is not vehicle and not wanted  # then the trim is a candidate, too
    flights, held_out_flights = with_thrust_scales(
        *in_mean_frame(*with_common_floor(flights, held_out_flights)), assumed
    )
    extra = [Candidate(TRIM, (), ("x", "y", "z"))] if untrimmed else []
    return _Request(recordings, held_out, flights, held_out_flights, assumed, wanted, extra, swapped)


def _chosen(request: _Request, workers: Workers, say: Say) -> _Chosen:
    """The selection of effects, with final names and with effects that are needed beside these.

    If the result is no physical rigid body (`is_nonphysical`), the selection is repeated without fast effects.
    """
    chosen = _selected(request, workers, say)
    unresponsive = is_nonphysical(chosen.selection.final, chosen.selection.accepted)
    if unresponsive and not any(f.coarse for f in request.flights):
        say("the turning does not follow the commands as they were recorded: once more without what is fast")
        flights, held_out_flights = (
            [replace(f, coarse=True) for f in part] for part in (request.flights, request.held_out_flights)
        )
        chosen = _selected(replace(request, flights=flights, held_out_flights=held_out_flights), workers, say)
    selection = with_better_rivals(chosen.data, chosen.apart, chosen.selection, say)
    if {c.effect for c in selection.accepted} != {c.effect for c in chosen.selection.accepted}:
        # beside the new effect, others may be significant
        selection = select(
            chosen.data, selection.nominal, chosen.candidates, held_out=chosen.apart, begun=selection, say=say
        )
    return replace(chosen, selection=selection)


def _selected(request: _Request, workers: Workers, say: Say) -> _Chosen:
    """The selection from all candidates that the flights can show."""
    data, apart = (
        Data(request.flights, workers),
        Data(request.held_out_flights, workers) if request.held_out_flights else None,
    )
    vehicle = request.vehicle
    bare = Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, start_noise())
    nominal = nominal_of(data, bare)
    if apart:
        apart.settle(nominal)
        apart.leave_out_wild(nominal)
        apart.settle(nominal)
    candidates, left_out = candidates_for(
        nominal, data.signals, measured_speeds=request.flights[0].inputs.measured, wanted=request.wanted
    )
    candidates, left_out = without_unobservable(data, nominal, [*candidates, *request.extra], left_out)
    nominal = with_trim_noise(data, nominal)
    begun = steady_selection(data, apart, nominal, candidates, say)
    selection = select(data, nominal, candidates, held_out=apart, begun=begun, say=say)
    return _Chosen(request, data, apart, selection, candidates, left_out)


def _located(data: Data, selection: Selection, say: Say) -> tuple[Located, Located]:
    """Where the nominal model fails, and where the final model fails."""
    say("where the nominal model fails")
    data.settle(selection.nominal)
    before = locate(data, selection.nominal)
    if not selection.accepted:
        return before, before
    say("what remains")
    data.settle(selection.final)
    return before, locate(data, selection.final)


def _advice(texts: Sequence[str], recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Advice on further signals and flights, each once, without signals that every recording has."""
    recorded = set.intersection(*(set(r.signals) for r in recordings))
    of = {effect.separates: effect for effect in CATALOGUE.values()}
    return tuple(dict.fromkeys(of[text].advice(recorded) if text in of else text for text in texts))


def _in_place(data: Data, apart: Data | None, selection: Selection) -> dict[str, tuple[Trial, Trial] | None]:
    """For a load and for weaker rotors: the trials of this effect and of its alternative."""
    return {
        LOAD: load_against_rotors(data, apart, selection),
        # only torques distinguish weaker rotors from a load
        WEAKER.effect: None if data.coarse else rotors_against_load(data, apart, selection),
    }


def _late_rotors(
    request: _Request, vehicle: Vehicle, answer: Answer, remains: Unexplained, left_out: dict[str, str]
) -> tuple[Answer, list[Named], Unexplained]:
    """The answer, further effects and the unexplained, from the response of measured rotor speeds to commands."""
    here, there = answers(request.recordings, vehicle), answers(request.held_out, vehicle)
    # the body follows the measured speeds, so its effects stay as they are
    unresponsive = unresponsive_rotor([*here, *there])
    remains = remains.with_finding(unresponsive) if unresponsive else remains
    if any(e.name == INPUT_DELAY.name for e in answer.effects):
        return answer, [], remains
    late, alike = late_rotors(here, there, vehicle, request.wanted, left_out, unresponsive=unresponsive is not None)
    separate = (*answer.separate, *(CATALOGUE[n].separates for g in alike for n in g))
    answer = replace(answer, groups=(*answer.groups, *alike), separate=tuple(dict.fromkeys(separate)))
    return answer, late, remains


def _corroborated(
    data: Data, apart: Data | None, selection: Selection, recordings: Sequence[Recording]
) -> tuple[Selection, frozenset[str]]:
    """The selection with the evidence of other signals, and the names of effects that these distinguish from
    look-alikes.

    An accelerometer shows most when thrust sets in. Not every flight has that, so held-out flights are used, too.
    """
    corroborated: set[str] = set()
    punctual = replace(selection.nominal, effects={n: dict(v) for n, v in selection.nominal.vehicle.effects.items()})
    for candidate in selection.accepted:
        if candidate.effect == INPUT_DELAY.name:
            nats = late_measurements(data.together_with(apart), punctual, candidate.values(selection.final)["delay"])
            if nats is not None and abs(nats) > SELECTION.separating:
                corroborated |= {INPUT_DELAY.name, *(INPUT_DELAY.same_as if nats > 0 else ())}
        elif candidate.effect in (WEAK, MISREAD) and dict(candidate.fixed).get("onset_time") is None:
            nats, other, start = _misread_or_weak(candidate, selection, recordings)
            if nats is not None and abs(nats) > SELECTION.separating:
                corroborated |= {candidate.effect, other.effect}
                if nats > 0:
                    selection = with_replacement(data, selection, candidate, other, [start])
            weak = candidate.effect == WEAK
            for_sensor = (nats or 0.0) if weak else -(nats or 0.0)
            if for_sensor > (SELECTION.separating if weak else 0.0):
                # a weak rotor turns as fast as a healthy one, so evidence against its speed is evidence for the sensor
                name = other.effect if weak else candidate.effect
                if name in selection.taken:
                    taken = replace(selection.taken[name], other_evidence=for_sensor)
                    selection = selection.with_step(name, taken=taken, alike=())
    return selection, frozenset(corroborated)


def _misread_or_weak(
    candidate: Candidate, selection: Selection, recordings: Sequence[Recording]
) -> tuple[float | None, Candidate, float]:
    """The alternative of a weak rotor (a wrong sensor) or of a wrong sensor (a weak rotor): its evidence [nats] by
    commands, its candidate, and its start value."""
    rotor, scale = dict(candidate.fixed)["rotor"], candidate.values(selection.final)["scale"]
    weak = candidate.effect == WEAK
    reading = scale**-0.5 if weak else scale
    nats = false_speed(recordings, rotor, reading, selection.nominal.vehicle.motor_time_constant)
    fixed: tuple[tuple[str, Any], ...] = (("rotor", rotor),)
    if weak:
        return nats, Candidate(MISREAD, fixed, ("scale",)), reading
    return None if nats is None else -nats, Candidate(WEAK, fixed, ("scale",)), reading**-2


def _strengths(selection: Selection) -> dict[str, float]:
    """Recording -> its thrust over that of the fitted vehicle; empty if recordings have no thrust of their own."""
    shared = float(selection.final.effects.get(THRUST.effect, {}).get("scale", 1.0))
    found = deviations(selection.final.effects, THRUST.effect)
    return {name: 1.0 + own["scale"] / shared for name, own in found.items()}


def _with_effects(vehicle: Vehicle, selection: Selection, beside: Sequence[Named]) -> Vehicle:
    """The vehicle with the found effects; normal delays are left out."""
    fitted = with_accepted_effects(vehicle, selection, selection.accepted)
    return replace(
        fitted,
        effects={**fitted.effects, **{e.name: {n: v.value for n, v in e.parameters.items()} for e in beside}},
    )


def _restored(vehicle: Vehicle, before: Vehicle, names: Collection[str]) -> Vehicle:
    """The vehicle with some effects reset to those of `before`, which does not have most of them."""
    kept = {n: v for n, v in vehicle.effects.items() if n not in names}
    return replace(vehicle, effects=kept | {n: v for n, v in before.effects.items() if n in names})
