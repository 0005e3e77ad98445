"""Effects that may imitate a force by place: wind and ground effect against a constant force with slopes by x, y, z.

A cable pulls the drone to one side, and down the more the higher the drone is. This looks like lift near the floor, and
like wind on average. Such effects, all together, are compared with a force by place. If the force explains all flights
better, the held-out ones included, the effects are removed.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import stats

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, Fitted, with_torque_memory_refit
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import refine_base, solved, without
from crazyem.diagnosis.locating.locate import AXES, Finding
from crazyem.diagnosis.locating.place import left_by_place, slope_finding
from crazyem.diagnosis.naming.trials import Selection, scatter
from crazyem.diagnosis.settings import CONFIDENCE, LOCATION
from crazyem.physics.effects.external_force import FORCE_BY_PLACE

FORCE = Candidate(FORCE_BY_PLACE.name, (), tuple(p.name for p in FORCE_BY_PLACE.parameters))


def by_place(
    data: Data, held_out: Data | None, selection: Selection, say: Callable[[str], None] = lambda text: None
) -> tuple[Selection, Finding | None]:
    """The selection without effects that imitate a force by place, and the force as a finding; else as it was, None.

    The force stays in the final model, but is no selected effect and is never written to a file. With a trim in the
    vehicle file noise scales are fixed, and nothing is compared.
    """
    names = [c for c in selection.accepted if c.effect in FORCE_BY_PLACE.mistaken_for]
    if not names or "position" not in data.signals or TRIM in selection.final.vehicle.effects:
        return selection, None
    # an imitating effect has another shape: it leaves a force by place on the fitted or the held-out flights
    if (
        max(left_by_place(d.twin(), selection.final) for d in (data, held_out) if d is not None)
        < LOCATION.min_structure
    ):
        return selection, None
    rest = [c for c in selection.accepted if c not in names]
    bare = selection.final
    for c in names:
        bare = without(bare, c.effect)
    bare = bare.with_effects({FORCE.effect: FORCE.neutral(bare)})
    say(f"  asking again: {', '.join(c.label for c in names)}, or a force by place")

    def both(start: Point, candidates: list[Candidate], rounds: int) -> tuple[Fitted, Data]:
        together = data.together_with(held_out)  # a hover does not determine slopes
        for _ in range(rounds):  # the first noise scales are those without the force
            fit = refine_base(together, with_torque_memory_refit(together, start), candidates)
            start = fit.point
        return fit, together

    runs = [(selection.final, list(selection.accepted), 1), (bare, [*rest, FORCE], 2)]
    try:
        (named, flights), (instead, again) = data.workers.map(lambda run: both(*run), runs)
        theirs, ours = flights.block_loglik(named.point), again.block_loglik(instead.point)
        better = instead.loglik - named.loglik - len(FORCE.free) + sum(len(c.free) for c in names)
        chance = float(stats.norm.sf(better / scatter(ours - theirs)))
        if better < LOCATION.min_structure or chance > CONFIDENCE.min_look_alike:
            return selection, None
        finding = _finding(again, instead, better)
        if finding is None:
            return selection, None
        found = refine_base(data, with_torque_memory_refit(data, instead.point), [*rest, FORCE])
    except DivergedError:  # the model diverges without the effects: they stay
        return selection, None
    say("  it is a force by place")
    gone = {c.effect for c in names}
    steps = tuple(s for s in selection.steps if not (s.taken and s.taken.candidate.effect in gone))
    return replace(selection, final=found.point, fitted=found, accepted=tuple(rest), steps=steps), finding


def _finding(data: Data, found: Fitted, nats: float) -> Finding | None:
    k = len(AXES)
    end = sum(len(c.free) for c in found.candidates)  # the force is the last of them, its slopes after its constant
    sd = np.sqrt(np.maximum(np.diag(solved(found)[0].covariance), 0.0))[end - k * k : end].reshape(k, k)
    values = FORCE.values(found.point)
    slopes = np.array([[float(values[i + j]) for j in AXES] for i in AXES])
    return slope_finding(data, slopes, sd, nats, found.point.vehicle)
