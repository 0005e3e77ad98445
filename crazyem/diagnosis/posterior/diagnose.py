"""From recordings and a vehicle to a diagnosis, by one posterior over sets of effects."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from crazyem.diagnosis.diagnose import Diagnosis
from crazyem.diagnosis.fitting.fit import DivergedError
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.flights.floor import on_one_floor
from crazyem.diagnosis.flights.frame import alike as in_one_frame
from crazyem.diagnosis.flights.recording_nuisances import owned
from crazyem.diagnosis.naming.determined import determined
from crazyem.diagnosis.naming.named import Named
from crazyem.diagnosis.posterior.accelerometer import accelerometer_effects
from crazyem.diagnosis.posterior.answer import PosteriorAnswer, answer_of, fitted_vehicle, left_free, named, ranking
from crazyem.diagnosis.posterior.remains import located, remains
from crazyem.diagnosis.posterior.search import Search
from crazyem.diagnosis.posterior.study import Fit, Study
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Say = Callable[[str], None]


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
        held_out: flights by which the fitted vehicle is judged; nothing is fitted to them.
        wanted: effects to look for; all where empty.
        jobs: threads that share the work; None: one a core.

    Raises:
        DataError: a recording cannot be used (no flight, no inputs, too short).
        UsageError: an unknown effect among those wanted.
    """
    flights = [flight_of(r, vehicle, withhold=withhold) for r in recordings]
    apart = [flight_of(r, vehicle, withhold=withhold) for r in held_out]
    flights, apart = in_one_frame(*on_one_floor(flights, apart))
    say(f"nominal model of {vehicle.name}: {sum(f.duration for f in flights):.0f} s of flight")
    study = Study(flights, vehicle, Workers(jobs), wanted=wanted)
    search = Search(study, say)
    models = search.run()
    best, nothing = models[0], search.visited[frozenset()]
    found = answer_of(study, models, accelerometer_effects(study, best))
    say("where the nominal model fails")
    before = located(nothing)
    say("what remains")
    after = located(best) if best is not nothing else before
    left = remains(study, best, nothing, after)
    effects, impossible = determined(found.effects, study.points[0])
    found = _kept(found, impossible)
    drone, flown = (
        replace(vehicle, effects=fitted_vehicle(vehicle, effects, kinds))
        for kinds in (("vehicle",), ("vehicle", "recording"))
    )
    by_others: tuple[Vehicle, ...] = ()
    if effects and len(flights) > 1 and not apart:
        say("each recording by the others")
        by_others = tuple(_by_others(study, models, i, effects) for i in range(len(flights)))
    return Diagnosis(
        vehicle=vehicle,
        fitted_vehicle=drone,
        as_flown=flown,
        recordings=tuple(r.path for r in recordings),
        held_out=tuple(r.path for r in held_out),
        mismatch=bool(effects) or left.found,
        before=before,
        after=after,
        effects=effects,
        indistinguishable=found.groups,
        would_separate=tuple(_advice(found.separate, [*recordings, *held_out])),
        unexplained=left,
        selection=None,
        left_out={**study.pool.left_out, **impossible},
        explained=left.explained,
        free=left_free(study, best),
        own=owned(flights, apart),
        ranking=ranking(models, search.neighbours(nothing)),
        by_others=by_others,
    )


def _by_others(study: Study, models: Sequence[Fit], index: int, effects: Sequence[Named]) -> Vehicle:
    """The vehicle with what was named, fitted to all recordings but one."""
    try:
        again = study.without_flight(models[0], index)
    except DivergedError:
        return study.vehicle
    known = [named(study, again, e.name) for e in effects if e.name in again.effects]
    return replace(study.vehicle, effects=fitted_vehicle(study.vehicle, known, ("vehicle",)))


def _kept(found: PosteriorAnswer, impossible: dict[str, str]) -> PosteriorAnswer:
    """Without groups of names that are not told."""
    return replace(found, groups=tuple(g for g in found.groups if g[0] not in impossible))


def _advice(texts: Sequence[str], recordings: Sequence[Recording]) -> list[str]:
    """What would tell more, without asking for signals that every recording holds."""
    recorded = set.intersection(*(set(r.signals) for r in recordings))
    of = {effect.separates: effect for effect in CATALOGUE.values()}
    return [of[text].advice(recorded) for text in texts]
