"""From recordings and a vehicle to a diagnosis: nominal model, where it fails, which effects, the fit, what remains."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from crazyem.diagnosis.always import TRIM, abstained, solved, steadied, unlike_a_body, unsure
from crazyem.diagnosis.beside import beside_the_regression, late_rotors
from crazyem.diagnosis.candidates import Candidate, candidates_for
from crazyem.diagnosis.exchange import exchanged, named_again
from crazyem.diagnosis.fit import Data
from crazyem.diagnosis.fit import nominal as nominal_of
from crazyem.diagnosis.flight import Flight, flight_of
from crazyem.diagnosis.heading import heading_by_place
from crazyem.diagnosis.imitated import by_place
from crazyem.diagnosis.locate import Located, locate
from crazyem.diagnosis.model import Point
from crazyem.diagnosis.named import DOUBTFUL, Named, Value, one_factor, share, trust
from crazyem.diagnosis.noise import first_guess
from crazyem.diagnosis.place import depends_on_place
from crazyem.diagnosis.select import select
from crazyem.diagnosis.split import LOAD, WEAKER, as_load, as_two, instead_of_a_load
from crazyem.diagnosis.trials import Selection, Trial, preferred, told_apart, wald
from crazyem.diagnosis.unexplained import Unexplained, unexplained
from crazyem.diagnosis.witness import false_speed, late_measurements
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Say = Callable[[str], None]


@dataclass(frozen=True)
class Diagnosis:
    """All that was found; `document.py` turns it into JSON."""

    vehicle: Vehicle
    fitted_vehicle: Vehicle
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
    explained: float


def diagnose(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    *,
    held_out: Sequence[Recording] = (),
    wanted: Sequence[str] = (),
    withhold: Sequence[str] = (),
    jobs: int | None = 1,
    say: Say = lambda text: None,
) -> Diagnosis:
    """Which physics is missing from a vehicle's model, by its recordings.

    Args:
        jobs: threads that share the candidates; None: one a core. The result is the same for any number.

    Raises:
        DataError: a recording cannot be used (no flight, no inputs, too short).
        UsageError: an unknown effect among those wanted.
    """
    flights = [flight_of(r, vehicle, withhold=withhold) for r in recordings]
    kept_apart = [flight_of(r, vehicle, withhold=withhold) for r in held_out]
    workers = Workers(jobs)
    say(f"nominal model of {vehicle.name}: {sum(f.duration for f in flights):.0f} s of flight")
    data, apart, selection, candidates, left_out = _selected(flights, kept_apart, vehicle, wanted, workers, say)
    if unlike_a_body(selection.final, selection.accepted) and not any(f.coarse for f in flights):
        say("the turning does not follow the commands as they were recorded: once more without what is fast")
        flights, kept_apart = ([replace(f, coarse=True) for f in part] for part in (flights, kept_apart))
        data, apart, selection, candidates, left_out = _selected(flights, kept_apart, vehicle, wanted, workers, say)
    named = selection.accepted
    selection = named_again(data, apart, selection, say)
    if {c.effect for c in selection.accepted} != {c.effect for c in named}:
        # beside the new name there may be room for others
        selection = select(data, selection.nominal, candidates, held_out=apart, begun=selection, say=say)
    selection, pull = by_place(data, apart, selection, say)
    selection, told = _asked(data, selection, recordings)
    say("where the nominal model fails")
    data.settle(selection.nominal)
    before = locate(data, selection.nominal)
    after = before
    if selection.accepted:
        say("what remains")
        data.settle(selection.final)
        after = locate(data, selection.final)
    place = depends_on_place(data, apart, selection.final)
    remains = unexplained(data, selection, after, apart)
    for finding in (pull, place and place.finding, heading_by_place(data, apart)):
        remains = remains.beside(finding) if finding else remains
    pulled = pull is not None or (place is not None and not place.pushed)
    beside = beside_the_regression(data, apart, selection.final, remains, wanted, left_out, pulled, say)
    if any(e.name == "gusts" for e in beside):
        remains = remains.without_force()
    in_place = {
        LOAD: as_two(data, apart, selection),
        # only torques would tell weaker rotors from a load
        WEAKER.effect: None if data.coarse else as_load(data, apart, selection),
    }
    effects, groups, separate = _named(data, selection, remains, told, in_place)
    if flights[0].inputs.measured and not any(e.name == "input_delay" for e in effects):
        late, alike = late_rotors(recordings, held_out, vehicle, wanted, left_out)
        beside += late
        groups = (*groups, *alike)
        separate = tuple(dict.fromkeys((*separate, *(CATALOGUE[n].separates for g in alike for n in g))))
    effects = (*effects, *beside)
    left_out = {n: reason for n, reason in left_out.items() if all(n != e.name for e in effects)}
    fitted_vehicle = _with_effects(vehicle, selection, beside)
    mismatch = bool(effects) or remains.found
    return Diagnosis(
        vehicle, fitted_vehicle, tuple(r.path for r in recordings), tuple(r.path for r in held_out), mismatch,
        before, after, effects, groups, separate, remains, selection, left_out, remains.explained,
    )  # fmt: skip


def _selected(
    flights: Sequence[Flight],
    kept_apart: Sequence[Flight],
    vehicle: Vehicle,
    wanted: Sequence[str],
    workers: Workers,
    say: Say,
) -> tuple[Data, Data | None, Selection, list[Candidate], dict[str, str]]:
    """The flights, those kept apart, what they ask for, what was asked, and what they cannot speak of and why."""
    data, apart = Data(flights, workers), Data(kept_apart, workers) if kept_apart else None
    bare = Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, first_guess())
    nominal = nominal_of(data, bare)
    if apart:
        apart.settle(nominal)
        apart.leave_out_wild(nominal)
        apart.settle(nominal)
    candidates, left_out = candidates_for(
        nominal, data.signals, measured_speeds=flights[0].inputs.measured, wanted=wanted
    )
    candidates, left_out = abstained(data, nominal, candidates, left_out)
    nominal = steadied(data, nominal)
    return data, apart, select(data, nominal, candidates, held_out=apart, say=say), candidates, left_out


def _asked(data: Data, selection: Selection, recordings: Sequence[Recording]) -> tuple[Selection, frozenset[str]]:
    """The selection after the witnesses were heard, and the names of effects that they told from their look-alikes."""
    told: set[str] = set()
    punctual = replace(selection.nominal, effects={n: dict(v) for n, v in selection.nominal.vehicle.effects.items()})
    for candidate in selection.accepted:
        chosen, values = dict(candidate.fixed), candidate.values(selection.final)
        if candidate.effect == "input_delay":
            nats = late_measurements(data, punctual, values["delay"])
            if nats is not None and abs(nats) > TELLING:
                told |= {MEASURED_LATE if nats > 0 else "input_delay", "input_delay"}
            continue
        if candidate.effect in WEAK_OR_MISREAD and chosen.get("onset_time") is None:
            fault, rotor = candidate.effect == "rotor_fault", chosen["rotor"]
            reading = values["scale"] ** -0.5 if fault else values["scale"]
            nats = false_speed(recordings, rotor, reading, selection.nominal.vehicle.motor_time_constant)
            fixed: tuple[tuple[str, Any], ...] = (("rotor", rotor),)
            other, start = Candidate("rotor_sensor", fixed, ("scale",)), reading
            if not fault:
                nats = None if nats is None else -nats
                other, start = Candidate("rotor_fault", fixed, ("scale",)), reading**-2
        else:
            continue
        if nats is not None and abs(nats) > TELLING:
            told |= {candidate.effect, other.effect}
            if nats > 0:
                selection = exchanged(data, selection, candidate, other, [start])
    return selection, frozenset(told)


def _with_effects(vehicle: Vehicle, selection: Selection, beside: Sequence[Named]) -> Vehicle:
    """The vehicle with what was found; delays within what is normal are left out."""
    kept = {n: dict(v) for n, v in vehicle.effects.items()}
    accepted = {c.effect for c in selection.accepted}
    for name, values in selection.final.effects.items():
        if name in accepted:
            kept[name] = {k: v for k, v in values.items() if v is not None}
    for named in beside:
        kept[named.name] = {n: v.value for n, v in named.parameters.items()}
    return replace(vehicle, effects=kept)


def _named(
    data: Data,
    selection: Selection,
    remains: Unexplained,
    told: frozenset[str],
    in_place: Mapping[str, tuple[Trial, Trial] | None],
) -> tuple[tuple[Named, ...], tuple[tuple[str, ...], ...], tuple[str, ...]]:
    fitted = selection.fitted
    if not selection.accepted:
        return (), (), ()
    solution, used = solved(fitted, wide=True)
    sd = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
    freedom = max(len(fitted.gram.score) - used, 3)
    width = float(stats.t.ppf(0.975, freedom))
    named, groups, separate = [], [], []
    at, never = 0, unsure(data, selection.final)
    for candidate, step in zip(selection.accepted, (s for s in selection.steps if s.taken), strict=True):
        # late inputs and late measurements are one model, so it is fitted as the first, whatever it is called
        late = candidate.effect == "input_delay" and MEASURED_LATE in told
        values, neutral = candidate.values(selection.final), candidate.neutral(selection.final)
        parameters, own = {}, slice(at, at + len(candidate.free))
        for name in candidate.free:
            p = candidate.parameter(name)
            error = float(np.hypot(sd[at], never.get((candidate.effect, name), 0.0)))
            low, high = values[name] - width * error, values[name] + width * error
            parameters[name] = Value(values[name], p.unit, error, (max(low, p.low), min(high, p.high)))
            at += 1
        taken = step.taken
        assert taken is not None
        others = {candidate.effect, *step.beside}
        rivals = [t for t in step.explanations() if t.candidate.effect not in others]
        if candidate.effect in told:
            rivals = [t for t in rivals if t.candidate.effect not in told]
        alike = [t for t in step.alike if t.candidate.effect in {r.candidate.effect for r in rivals}]
        confidence = trust(remains) * share(taken.evidence, []) * preferred(taken, rivals)
        away = np.array([values[n] - neutral[n] for n in candidate.free])
        if wald(away, solution.covariance[own, own], fitted.gram, used) > WITHIN:
            confidence = min(confidence, DOUBTFUL)
        if candidate.effect in selection.doubted:
            confidence = min(confidence, DOUBTFUL)
            separate.append(SHAKES)
        equal = () if candidate.effect in told else SAME.get(candidate.effect, ())
        pair = in_place.get(candidate.effect)
        if pair is not None and not told_apart(*pair):
            instead = [c.effect for c in instead_of_a_load(selection.final.vehicle)]
            equal = (*equal, *(instead if candidate.effect == LOAD else [LOAD]))
        if candidate.effect == "inertia" and all(t.candidate.effect != "torque_scale" for t in step.trials):
            # not asked beside what was found before it
            before = np.array([neutral[n] for n in candidate.free])
            if one_factor(before + away, before, solution.covariance[own, own]):
                equal = (*equal, "torque_scale")
        if candidate.effect == LOAD and TRIM in selection.final.vehicle.effects:
            equal = (*equal, TWO_WEAK)
        if candidate.effect == WEAKER.effect and data.coarse:
            equal = (*equal, LOAD)  # nothing but torques tells them apart
        p_value = min(1.0, taken.p_value * max(1, selection.tried))
        name, label, chosen = candidate.effect, candidate.label, dict(candidate.fixed)
        if late:
            name, label, chosen = MEASURED_LATE, MEASURED_LATE, {"streams": ("state", "gyro")}
        named.append(Named(name, label, parameters, chosen, taken.held_out, p_value, confidence))
        if alike or equal:
            group = tuple(dict.fromkeys([candidate.effect, *(t.candidate.effect for t in alike), *equal]))
            groups.append(group)
            separate += [CATALOGUE[n].separates for n in group if CATALOGUE[n].separates]
        elif candidate.effect == "thrust_scale":
            separate.append(HEAVIER.format(1.0 / values["scale"]))
    order = sorted(range(len(named)), key=lambda i: -_evidence(selection, i))
    return tuple(named[i] for i in order), tuple(groups), tuple(dict.fromkeys(separate))


def _evidence(selection: Selection, i: int) -> float:
    taken = [s.taken for s in selection.steps if s.taken][i]
    assert taken is not None
    return taken.evidence


WITHIN = 0.05  # p-value from which an effect's own uncertainty holds that there is none of it
SHAKES = "hold the drone with its rotors turning: what shakes then is not the loop that swings with a wrong model"
# Exactly the same to every signal, but for forces of the air: two things at once, more mass and inertias to match.
HEAVIER = "weigh the drone: with {:.3g} times its mass and its inertias it would fly the same"
TELLING = 3.0  # nats by which a witness tells two effects apart
MEASURED_LATE = "measurement_delay"
WEAK_OR_MISREAD = ("rotor_fault", "rotor_sensor")
# Two weak rotors beside each other lack thrust and tilt the drone as a weight on their side does, with no torque about
# z; only what turns tells, which a drone whose trim changes from day to day does not show.
TWO_WEAK = "rotor_fault"
# Exactly the same to every signal: inputs that act late, and measurements that are all late together.
SAME = {"input_delay": ("measurement_delay",)}
