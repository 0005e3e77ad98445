"""Second comparison of each selected effect with its rivals, beside all the other selected effects.

The selection finds one effect after the other. When it takes the first, the second still counts as noise, or a
parameter of a wrong effect absorbs it. Example: a load off the centre wins over weaker rotors, because a flapping
moment that is found later looks like the offset.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.nuisances import refine_base, refine_with_memory, without
from crazyem.diagnosis.naming.evidence import exceeds_limit, is_implausible
from crazyem.diagnosis.naming.load_or_rotors import occam_cost_of, refitted
from crazyem.diagnosis.naming.trials import Selection, Step, Trial, distinguishable, margin
from crazyem.diagnosis.settings import SELECTION


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
