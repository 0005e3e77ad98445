"""A load against weaker rotors: one cause that looks like two, or like another.

A load of unknown weight lowers thrust over mass and shifts the centre of mass, and so do rotors that are all weaker on
a drone whose centre of mass was never where the file has it. One candidate is tried at a time, so the load wins by
explaining both; whether it is told apart from the two together is asked here. Only what else they change tells: weaker
rotors lack torque by the same factor, a load turns with the drone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import on_held_out, refine_base, without
from crazyem.diagnosis.naming.evidence import gain_of_both, known_by, tuning
from crazyem.diagnosis.naming.trials import Selection, Trial
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import CENTER_OF_MASS, PAYLOAD
from crazyem.vehicle import Vehicle

LOAD = PAYLOAD.name
HEAVIER = Candidate(LOAD, (), ("mass", "x", "y", "z"))
WEAKER = THRUST
SHIFTED = Candidate(CENTER_OF_MASS.name, (), ("x", "y", "z"))


def instead_of_a_load(vehicle: Vehicle) -> list[Candidate]:
    """Weaker rotors and a shifted centre; with a trim in the vehicle file, which is always free, the rotors alone."""
    return [WEAKER] if TRIM in vehicle.effects else [WEAKER, SHIFTED]


def as_two(data: Data, held_out: Data | None, selection: Selection) -> tuple[Trial, Trial] | None:
    """The load as a trial and the best of what may stand in its place as another, weaker rotors with a shifted centre
    and without, to be compared; None where no load was found, or where nothing can be fitted in its place.
    """
    load = next((c for c in selection.accepted if c.effect == LOAD), None)
    step = next((s for s in selection.steps if s.taken and s.taken.candidate is load), None)
    if load is None or step is None or step.taken is None:
        return None
    most = instead_of_a_load(selection.final.vehicle)
    try:
        value, blocks, known = refitted(data, held_out, selection.final, selection.accepted)
        others = [_in_place_of_a_load(data, held_out, selection, most[:n]) for n in range(1, len(most) + 1)]
    except DivergedError:
        return None
    taken = replace(step.taken, value=value, blocks=blocks, tuned=tuned_of(load, selection.accepted, known))
    return taken, max(others, key=lambda t: t.worth)


def _in_place_of_a_load(data: Data, held_out: Data | None, selection: Selection, instead: Sequence[Candidate]) -> Trial:
    """Some effects in the place of a load, as one trial; that there is a second one as well is no matter of course."""
    rest = [c for c in selection.accepted if c.effect not in {LOAD, *(t.effect for t in instead)}]
    bare = without(selection.final, LOAD)
    bare = bare.with_effects({c.effect: c.neutral(bare) for c in instead})
    value, blocks, known = refitted(data, held_out, bare, [*rest, *instead])
    free = tuple(f"{c.effect}.{n}" for c in instead for n in c.free)  # counted, and no more
    cost = tuning(instead, known[-len(free) :, -len(free) :]) + np.log(len(CATALOGUE)) * (len(instead) - 1)
    return _stands(Candidate(WEAKER.effect, (), free), value, blocks, float(cost))


def _stands(candidate: Candidate, value: float, blocks: NDArray, tuned: float) -> Trial:
    """A trial of what was fitted in the place of another, of which nothing but the comparison with it is asked."""
    return Trial(candidate, 0.0, 0.0, 1.0, 0.0, 0.0, blocks=blocks, value=value, tuned=tuned)


def as_load(data: Data, held_out: Data | None, selection: Selection) -> tuple[Trial, Trial] | None:
    """Weaker rotors as a trial and a load in their place as another; None where there are none, or where the load was
    tried beside them anyway.
    """
    weaker = next((c for c in selection.accepted if c.effect == WEAKER.effect), None)
    step = next((s for s in selection.steps if s.taken and s.taken.candidate is weaker), None)
    if weaker is None or step is None or step.taken is None or any(c.effect == LOAD for c in selection.accepted):
        return None
    share = weaker.values(selection.final)["scale"]
    if share >= 1.0 or any(t.candidate.effect == LOAD and t.fitted is not None for t in step.trials):
        return None
    rest = [c for c in selection.accepted if c is not weaker]
    bare = without(selection.final, WEAKER.effect)
    mass = selection.final.vehicle.mass * (1.0 / share - 1.0)
    loaded = bare.with_effects({LOAD: {**HEAVIER.neutral(bare), "mass": mass}})
    try:
        value, blocks, known = refitted(data, held_out, selection.final, selection.accepted)
        other, others, known_load = refitted(data, held_out, loaded, [*rest, HEAVIER])
    except DivergedError:
        return None
    taken = replace(step.taken, value=value, blocks=blocks, tuned=tuned_of(weaker, selection.accepted, known))
    return taken, _stands(HEAVIER, other, others, tuned_of(HEAVIER, [*rest, HEAVIER], known_load))


def refitted(
    data: Data, held_out: Data | None, start: Point, candidates: Sequence[Candidate]
) -> tuple[float, NDArray, NDArray]:
    """Log-likelihood as fitted to all flights, also by blocks; what is known of the candidates' parameters (k, k)."""
    here = data.twin()
    fitted = refine_base(here, start, candidates, noise=False)
    value, blocks = fitted.loglik, here.block_loglik(fitted.point)
    if held_out is None:
        return value, blocks, known_by(fitted, candidates)
    apart = held_out.twin()
    there = on_held_out(apart, fitted.point, candidates)
    more, beyond, known = gain_of_both(fitted, apart, there, candidates)
    return value + there.loglik + more, np.append(blocks, beyond), known


def tuned_of(one: Candidate, candidates: Sequence[Candidate], known: NDArray) -> float:
    """What the parameters of one of the candidates cost it, by what is known of all of them (k, k)."""
    begin = sum(len(c.free) for c in candidates[: [c is one for c in candidates].index(True)])
    own = slice(begin, begin + len(one.free))
    return tuning([one], known[own, own])
