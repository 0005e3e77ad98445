"""Effects that begin in mid-flight: one more variant for every block of the flight at which they may begin."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.posterior.evidence import Pass, Shared, scatter_of
from crazyem.diagnosis.posterior.members import Member, Slopes
from crazyem.diagnosis.posterior.study import Fit, Look, Study
from crazyem.physics.effects.catalogue import CATALOGUE

SCANS = ((1.2, 0.1), (0.12, 0.02))  # s to either side of an onset, and the step between those that are tried
FIRST, LAST = 2, 1  # blocks at the begin and at the end of a flight in which no onset is looked for


def onset_parameter(effect: str) -> str:
    """Of an effect that may begin in mid-flight; "" of others."""
    known = CATALOGUE.get(effect)
    return next((p.name for p in known.parameters if p.neutral is None and not p.chosen), "") if known else ""


@dataclass(frozen=True)
class Later:
    """A member that begins in mid-flight: log evidence over that of nothing, change (1,), and by how much its scores
    scatter then."""

    member: Member
    gain: float
    change: NDArray
    scatter: float


def begun_later(study: Study, fit: Fit, look: Look, member: Member) -> Later | None:
    """The likeliest onset of an effect with one amplitude; None where nothing may begin, or where several recordings
    have clocks of their own."""
    name = onset_parameter(member.effect)
    if not name or len(look.passes) != 1 or len(look.places[member.candidate]) != 1:
        return None
    at = look.places[member.candidate]
    one, flight = look.passes[0], fit.data[0].flights[0]
    own = [i for m in fit.members for i in look.places[m.candidate]]
    kept = sorted({*own, *np.flatnonzero(look.shared.usual[0] > 0).tolist()})
    onsets = range(FIRST, flight.blocks - LAST)
    if len(onsets) < 1:
        return None
    since = np.array([np.arange(flight.blocks) >= k for k in onsets]).T  # (b, onsets)
    j, n = at[0], len(kept)
    score = np.concatenate([one.score[:, kept], one.score[:, [j]] * since], axis=1)
    information = np.zeros((flight.blocks, n + len(onsets), n + len(onsets)))
    information[:, :n, :n] = one.information[:, kept][:, :, kept]
    information[:, :n, n:] = one.information[:, kept, j][:, :, None] * since[:, None, :]
    information[:, n:, :n] = np.transpose(information[:, :n, n:], (0, 2, 1))
    information[:, n:, n:] = one.information[:, j, j][:, None, None] * (since[:, :, None] & since[:, None, :])
    here = np.concatenate([one.here[kept], np.zeros(len(onsets))])
    usual = np.concatenate([look.shared.usual[:, kept], np.zeros((1, len(onsets)))], axis=1)
    shared = Shared([Pass(one.loglik, score, information, here)], usual)
    prior, places = study.prior((*fit.members, member)), [kept.index(i) for i in own]
    found = [shared.posterior([*places, n + k], prior) for k in range(len(onsets))]
    k = int(np.argmax([f.gain for f in found]))
    begin = float(flight.time[np.flatnonzero(flight.block == onsets[k])[0]])
    dated = replace(member.candidate, fixed=(*member.candidate.fixed, (name, begin)))
    later = replace(member, candidate=dated, odds=member.odds - math.log(len(onsets)))
    change = found[k].mean[-1:]
    rest = score[:, [n + k]] - information[:, n + k, n + k][:, None] * change
    scatter = float(scatter_of(rest, information[:, n + k, n + k].sum(keepdims=True))[0])
    return Later(later, found[k].gain, change, scatter)


def dated(study: Study, fit: Fit, near: Slopes) -> Fit:
    """The fit with the onset of its last member to some hundredths of a second, by the likelihood."""
    member = fit.members[-1]
    name = onset_parameter(member.effect)
    begin = dict(member.candidate.fixed).get(name) if name else None
    if begin is None:
        return fit
    for reach, step in SCANS:
        count = round(reach / step)
        tried = [begin + k * step for k in range(-count, count + 1)]
        points = [fit.points[0].with_effects({member.effect: {name: t}}) for t in tried]
        begin = tried[int(np.argmax([fit.data[0].twin().loglik(p) for p in points]))]
        fixed = tuple((n, begin if n == name else v) for n, v in member.candidate.fixed)
        members = (*fit.members[:-1], replace(member, candidate=replace(member.candidate, fixed=fixed)))
        start = fit.points[0].with_effects({member.effect: {name: begin}})
        fit = study.fit([d.twin() for d in fit.data], [start], members, fit.random, fit.phi, near)
        member = fit.members[-1]
    return fit
