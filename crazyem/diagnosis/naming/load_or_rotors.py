"""Comparison of a load with weaker rotors: one effect that looks like two, or like another.

A load of unknown weight lowers thrust over mass and shifts the centre of mass. Weaker rotors on a drone with a shifted
centre of mass do the same. The selection tries one candidate at a time, so the load wins, because it explains both.
Here it is compared with the two together. Only the torques separate them: weaker rotors lack torque by the same factor,
and a load adds inertia.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import held_out_fit, refine_base, without
from crazyem.diagnosis.naming.evidence import accepted_covariance, joint_gain, occam_cost
from crazyem.diagnosis.naming.trials import Selection, Trial
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.mass_properties import CENTER_OF_MASS, PAYLOAD
from crazyem.vehicle import Vehicle

LOAD = PAYLOAD.name
HEAVIER = Candidate(LOAD, (), ("mass", "x", "y", "z"))
WEAKER = THRUST
SHIFTED = Candidate(CENTER_OF_MASS.name, (), ("x", "y", "z"))


def load_substitutes(vehicle: Vehicle) -> list[Candidate]:
    """Weaker rotors and a shifted centre of mass; with a trim in the vehicle file, a nuisance, the rotors alone."""
    return [WEAKER] if TRIM in vehicle.effects else [WEAKER, SHIFTED]


def load_against_rotors(data: Data, held_out: Data | None, selection: Selection) -> tuple[Trial, Trial] | None:
    """Trials of the load and of its best substitute, weaker rotors with or without a shifted centre of mass; None if no
    load was found or a fit diverges.
    """
    load = next((c for c in selection.accepted if c.effect == LOAD), None)
    step = next((s for s in selection.steps if s.taken and s.taken.candidate is load), None)
    if load is None or step is None or step.taken is None:
        return None
    most = load_substitutes(selection.final.vehicle)
    try:
        value, blocks, known = refitted(data, held_out, selection.final, selection.accepted)
        others = [_substitute_trial(data, held_out, selection, most[:n]) for n in range(1, len(most) + 1)]
    except DivergedError:
        return None
    taken = replace(
        step.taken, value=value, blocks=blocks, parameter_cost=occam_cost_of(load, selection.accepted, known)
    )
    return taken, max(others, key=lambda t: t.worth)


def _substitute_trial(data: Data, held_out: Data | None, selection: Selection, instead: Sequence[Candidate]) -> Trial:
    """Effects in the place of a load, as one trial; a second effect costs the log of the number of effects."""
    rest = [c for c in selection.accepted if c.effect not in {LOAD, *(t.effect for t in instead)}]
    bare = without(selection.final, LOAD)
    bare = bare.with_effects({c.effect: c.neutral(bare) for c in instead})
    value, blocks, known = refitted(data, held_out, bare, [*rest, *instead])
    free = tuple(f"{c.effect}.{n}" for c in instead for n in c.free)  # only their number is used
    cost = occam_cost(instead, known[-len(free) :, -len(free) :]) + np.log(len(CATALOGUE)) * (len(instead) - 1)
    return _comparison_trial(Candidate(WEAKER.effect, (), free), value, blocks, float(cost))


def _comparison_trial(candidate: Candidate, value: float, blocks: NDArray, parameter_cost: float) -> Trial:
    """A trial of effects in the place of another effect, used for the comparison with it alone."""
    return Trial(candidate, 0.0, 0.0, 1.0, 0.0, blocks=blocks, value=value, parameter_cost=parameter_cost)


def rotors_against_load(data: Data, held_out: Data | None, selection: Selection) -> tuple[Trial, Trial] | None:
    """Trials of weaker rotors and of a load in their place; None without weaker rotors, if the selection found or
    fitted a load anyway, or if a fit diverges.
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
    taken = replace(
        step.taken, value=value, blocks=blocks, parameter_cost=occam_cost_of(weaker, selection.accepted, known)
    )
    return taken, _comparison_trial(HEAVIER, other, others, occam_cost_of(HEAVIER, [*rest, HEAVIER], known_load))


def refitted(
    data: Data, held_out: Data | None, start: Point, candidates: Sequence[Candidate]
) -> tuple[float, NDArray, NDArray]:
    """Log-likelihood as fitted to all flights, also by blocks; covariance (k, k) of the candidates' parameters."""
    here = data.twin()
    fitted = refine_base(here, start, candidates, noise=False)
    value, blocks = fitted.loglik, here.block_loglik(fitted.point)
    if held_out is None:
        return value, blocks, accepted_covariance(fitted, candidates)
    apart = held_out.twin()
    there = held_out_fit(apart, fitted.point, candidates)
    joint = joint_gain(fitted, apart, there, candidates)
    return value + there.loglik + joint.gain, np.append(blocks, joint.blocks), joint.covariance


def occam_cost_of(one: Candidate, candidates: Sequence[Candidate], known: NDArray) -> float:
    """Cost of the parameters of one candidate [nats], by the covariance (k, k) of those of all candidates."""
    begin = sum(len(c.free) for c in candidates[: [c is one for c in candidates].index(True)])
    own = slice(begin, begin + len(one.free))
    return occam_cost([one], known[own, own])
