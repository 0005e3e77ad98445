"""Second comparison of each selected effect with its rivals, beside all the other selected effects.

The selection finds one effect after the other. When it takes the first, the second still counts as noise, or a
parameter of a wrong effect absorbs it. Example: a load off the centre wins over weaker rotors, because a flapping
moment that is found later looks like the offset.

A load of unknown weight lowers thrust over mass and shifts the centre of mass. Weaker rotors on a drone with a shifted
centre of mass do the same. The selection tries one candidate at a time, so the load wins, because it explains both.
Here it is compared with the two together. Only the torques separate them: weaker rotors lack torque by the same factor,
and a load adds inertia.

A cable pulls the drone to one side, and down the more the higher the drone is. This looks like lift near the floor, and
like wind on average. Such effects, all together, are compared with a force by place: a constant, and slopes by x, y, z.
If the force explains all flights better, the held-out ones included, the effects are removed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.fitting.candidates import THRUST, TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, Fitted, with_torque_memory_refit
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import held_out_fit, refine_base, refine_with_memory, solved, without
from crazyem.diagnosis.locating.locate import AXES, Finding
from crazyem.diagnosis.locating.place import left_by_place, slope_finding
from crazyem.diagnosis.naming.evidence import accepted_covariance, exceeds_limit, is_implausible, joint_gain, occam_cost
from crazyem.diagnosis.naming.trials import Selection, Step, Trial, distinguishable, margin, scatter
from crazyem.diagnosis.settings import CONFIDENCE, LOCATION, SELECTION
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.external_force import FORCE_BY_PLACE
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


def with_better_rivals(
    data: Data, held_out: Data | None, selection: Selection, say: Callable[[str], None] = lambda text: None
) -> Selection:
    """The selection in which a rival replaces each effect if it explains more, or as much with fewer parameters.

    A single effect is not compared again. Nor is any with a trim in the vehicle file: noise scales are fixed there.
    """
    if len(selection.accepted) < 2 or TRIM in selection.final.vehicle.effects:
        return selection
    for name in [c.effect for c in selection.accepted]:
        try:
            selection = _reselected(data, held_out, selection, name, say)
        except DivergedError:  # the fit of a rival diverges: the effect stays
            continue
    return selection


def close_alternatives(
    step: Step, accepted: Sequence[Candidate], *, near: float = SELECTION.rival_difference
) -> list[Trial]:
    """Admissible rivals within `near` nats of the effect when it was taken, which are not in the model now."""
    taken, names = step.taken, {c.effect for c in accepted}
    assert taken is not None
    tried = [t for t in step.trials if t.fitted is not None and t.blocks.size == taken.blocks.size]
    return [t for t in tried if t.candidate.effect not in names and t.admissible and margin(taken, t)[0] < near]


def _reselected(
    data: Data, held_out: Data | None, selection: Selection, name: str, say: Callable[[str], None]
) -> Selection:
    step = next(s for s in selection.steps if s.taken and s.taken.candidate.effect == name)
    mine = next(c for c in selection.accepted if c.effect == name)
    ended = is_implausible(selection.final, mine)  # then it stands for something else, whatever its evidence
    others = close_alternatives(step, selection.accepted, near=np.inf if ended else SELECTION.rival_difference)
    if not others:
        return selection
    say(f"  asking again: {mine.label} or {', '.join(t.candidate.label for t in others)}")
    assert step.taken is not None
    bare = without(selection.final, name)
    starts = [(selection.final, list(selection.accepted))]
    for rival in others:
        assert rival.fitted is not None
        point = bare.with_effects({rival.candidate.effect: rival.candidate.values(rival.fitted.point)})
        starts.append((point, _in_place(selection.accepted, mine, rival.candidate)))
    found = data.workers.map(lambda start: refitted(data, held_out, *start), starts)
    tried = [
        replace(trial, candidate=c, value=value, blocks=blocks, parameter_cost=occam_cost_of(c, accepted, known))
        for trial, c, (_, accepted), (value, blocks, known) in zip(
            [step.taken, *others], [mine, *(t.candidate for t in others)], starts, found, strict=True
        )
    ]
    now, tried = tried[0], tried[1:]
    asked = tried if ended else [now, *tried]
    best = max(asked, key=lambda t: t.worth)
    rest = [t for t in step.trials if t is not step.taken and all(t.candidate is not r.candidate for r in tried)]
    alike = [t for t in asked if t is not best and not distinguishable(best, t)]
    alike = [t for t in alike if t.candidate.effect != best.candidate.effect]
    # an effect at the end of its range is no rival
    again = selection.with_step(name, taken=best, trials=(*asked, *rest), alike=tuple(alike))
    if best is now:
        return again
    accepted = _in_place(selection.accepted, mine, best.candidate)
    assert best.fitted is not None
    values = {best.candidate.effect: best.candidate.values(best.fitted.point)}
    fitted = refine_with_memory(data, without(selection.final, name).with_effects(values), accepted)
    if not exceeds_limit(fitted.point, best.candidate, data):
        return selection
    say(f"  beside the others it is {best.candidate.label}")
    return replace(again, final=fitted.point, fitted=fitted, accepted=tuple(accepted))


def with_replacement(
    data: Data, selection: Selection, old: Candidate, new: Candidate, values: Sequence[float]
) -> Selection:
    """The selection fitted with the effect `new` in the place of `old`; its free parameters start at `values`."""
    bare = without(selection.final, old.effect)
    point = bare.with_effects({new.effect: {**new.neutral(bare), **dict(zip(new.free, values, strict=True))}})
    accepted = tuple(new if c is old else c for c in selection.accepted)
    fitted = refine_base(data, point, accepted, rounds=3, noise=False)
    taken = replace(selection.taken[old.effect], candidate=new, log_odds=None, size={})
    found = selection.with_step(old.effect, taken=taken)
    return replace(found, final=fitted.point, fitted=fitted, accepted=accepted)


def _in_place(accepted: Sequence[Candidate], old: Candidate, new: Candidate) -> list[Candidate]:
    return [new if c is old else c for c in accepted]


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
