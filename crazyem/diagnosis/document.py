"""A diagnosis as its JSON document, with the open-loop errors before and after, and the pictures of its report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.diagnosis.diagnose import Diagnosis
from crazyem.diagnosis.flights import roles
from crazyem.diagnosis.flights.flight import without
from crazyem.diagnosis.flights.own import Own
from crazyem.diagnosis.locating.locate import Finding, strongest
from crazyem.diagnosis.naming.named import Named
from crazyem.diagnosis.prediction.horizon import HorizonErrors, Windows, errors, open_loop, windows
from crazyem.diagnosis.prediction.predict import NAMES, Recorded, recorded
from crazyem.diagnosis.report import Series
from crazyem.errors import DataError
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

SHOWN = ("position", "velocity", "attitude", "body_rate")


def document_of(
    diagnosis: Diagnosis,
    recordings: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    withhold: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, Series]]:
    """The JSON document of a diagnosis (names as in docs/diagnosis.md), and pictures.

    Args:
        recordings, held_out: as they were given to `diagnose`.
    """
    if diagnosis.swapped:
        recordings, held_out = held_out, recordings
    train, pictures = _compared(diagnosis, [without(r, withhold) for r in recordings], draw=True)
    apart, _ = _compared(diagnosis, [without(r, withhold) for r in held_out], draw=False)
    left = diagnosis.unexplained
    where = strongest(diagnosis.before.findings)
    document: dict[str, Any] = {
        "format": "crazyem-diagnosis",
        "version": 1,
        "recordings": list(diagnosis.recordings),
        "held_out_recordings": list(diagnosis.held_out),
        "swapped": diagnosis.swapped,
        "vehicle": diagnosis.vehicle.name,
        "mismatch": diagnosis.mismatch,
        "where": [_finding(f) for f in where] if diagnosis.mismatch else [],
        "effects": [_effect(e) for e in diagnosis.effects],
        "indistinguishable": [list(g) for g in diagnosis.indistinguishable],
        "would_separate": list(diagnosis.would_separate),
        "unexplained": {
            "found": left.found,
            "nats": _number(left.nats),
            "explained_share": _number(left.explained),
            "where": [_finding(f) for f in left.findings],
        },
        "fit": {
            "train": _before_after(train),
            "held_out": _before_after(apart) if held_out else {},
            "whiteness": {"before": diagnosis.before.whiteness, "after": diagnosis.after.whiteness},
            "gap_closed": _gap_closed(apart or train),
        },
        "not_identifiable": [{"name": n, "reason": r} for n, r in diagnosis.left_out.items()],
        "ranking": _ranking(diagnosis),
        "of_recordings": [own.to_json() for own in diagnosis.own],
        "notices": [*_roles(diagnosis.swapped, diagnosis.recordings, diagnosis.held_out), *notices_of(diagnosis.own)],
    }
    return document, {**disturbance_pictures(diagnosis), **pictures}


def _roles(swapped: bool, fitted: Sequence[str], kept_apart: Sequence[str]) -> list[str]:
    return [roles.told(fitted, kept_apart)] if swapped else []


def notices_of(own: Sequence[Own]) -> list[str]:
    """What is told of each recording, with its name where there are several."""
    return [_named(o.recording, text, len(own) > 1) for o in own for text in o.notices]


def _named(recording: str, text: str, several: bool) -> str:
    return f"{Path(recording).name}: {text}" if several else text


def _effect(effect: Named) -> dict[str, Any]:
    parameters: dict[str, Any] = {
        n: {"value": _number(v.value), "unit": v.unit, "sd": _number(v.sd), "ci95": [_number(x) for x in v.ci95]}
        for n, v in effect.parameters.items()
    }
    for name, chosen in effect.chosen.items():
        parameters[name] = {"value": list(chosen) if isinstance(chosen, tuple) else chosen, "chosen": True}
    return {
        "name": effect.name,
        "label": effect.label,
        "parameters": parameters,
        "evidence": {"held_out_nats": _number(effect.held_out_nats), "p_value": _number(effect.p_value)},
        "confidence": _number(effect.confidence),
    }


def _finding(f: Finding) -> dict[str, Any]:
    return {
        "signal": f.signal, "axis": f.axis, "regime": f.regime, "interval": [round(t, 3) for t in f.interval],
        "effect_size": _number(f.effect_size), "sd": _number(f.sd), "unit": f.unit, "p_value": _number(f.p_value),
        "nats": _number(f.nats),
    }  # fmt: skip


def _ranking(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """All that was tried in the first turn, best first."""
    if not diagnosis.selection.steps:
        return []
    found, seen = [], set()
    for trial in diagnosis.selection.steps[0].trials:
        if trial.candidate.label in seen:
            continue
        seen.add(trial.candidate.label)
        found.append({
            "name": trial.candidate.effect, "label": trial.candidate.label, "gain_nats": _number(trial.gain),
            "held_out_nats": _number(trial.held_out), "p_value": _number(trial.p_value),
            "evidence_nats": _number(trial.evidence), "note": "" if trial.fitted else "not fitted: linear estimate",
        })  # fmt: skip
    return found


def _compared(
    diagnosis: Diagnosis, recordings: Sequence[Recording], *, draw: bool
) -> tuple[list[tuple[HorizonErrors, HorizonErrors]], dict[str, Series]]:
    """Open-loop errors before and after, a pair a recording; none where a recording has no whole states."""
    pairs: list[tuple[HorizonErrors, HorizonErrors]] = []
    pictures: dict[str, Series] = {}
    for recording in recordings:
        try:
            before = recorded(recording, diagnosis.vehicle)
            at = windows(before)
            after = recorded(recording, diagnosis.fitted_vehicle)
            first, second = open_loop(before, at), open_loop(after, at)
        except DataError:
            continue
        pairs.append((errors(first, at), errors(second, at)))
        if draw and not pictures:
            pictures = overlay_pictures(before, at, first, second)
    return pairs, pictures


def _before_after(pairs: Sequence[tuple[HorizonErrors, HorizonErrors]]) -> dict[str, Any]:
    return {"before": _pooled([p[0] for p in pairs]), "after": _pooled([p[1] for p in pairs])} if pairs else {}


def _pooled(found: Sequence[HorizonErrors]) -> dict[str, Any]:
    """Errors of several flights together: the root of the mean square over all starts."""
    if len(found) == 1:
        return found[0].to_json()
    weights = np.array([f.starts for f in found], float)
    weights /= weights.sum()
    rms = {n: tuple(np.sqrt(np.square([f.rms[n] for f in found]).T @ weights)) for n in found[0].rms}
    mean = {n: tuple(np.array([f.mean[n] for f in found]).T @ weights) for n in found[0].mean}
    return replace(found[0], starts=sum(f.starts for f in found), rms=rms, mean=mean).to_json()


def _gap_closed(pairs: Sequence[tuple[HorizonErrors, HorizonErrors]]) -> dict[str, float | None]:
    """Share of the mean square error at the longest horizon that the fit took away, by quantity."""
    closed: dict[str, float | None] = {}
    for name in SHOWN:
        before = sum(p[0].rms[name][-1] ** 2 * p[0].starts for p in pairs)
        after = sum(p[1].rms[name][-1] ** 2 * p[1].starts for p in pairs)
        closed[name] = _number(1.0 - after / before) if pairs and before > 0 else None
    return closed


def disturbance_pictures(diagnosis: Diagnosis) -> dict[str, Series]:
    """Missing force and torque in time, before and after."""
    pictures = {}
    before, after = diagnosis.before.disturbances[0], diagnosis.after.disturbances[0]
    for i, axis in enumerate("xyz"):
        for offset, what, unit in ((0, "force", "mN"), (3, "torque", "uN m")):
            scale = 1e3 if offset == 0 else 1e6
            lines = {"before": before.value[:, offset + i] * scale}
            if diagnosis.effects:
                lines["after"] = after.value[:, offset + i] * scale
            level = float(np.median(before.sd[:, offset + i]) * scale) * 2
            pictures[f"{what} {axis}"] = Series(
                f"Missing {what} along body {axis}", before.time, lines, y_label=f"{unit}", level=level
            )
    order = ["force x", "force y", "force z", "torque x", "torque y", "torque z"]
    return {name: pictures[name] for name in order}


def overlay_pictures(shown: Recorded, at: Windows, before: Any, after: Any) -> dict[str, Series]:
    """What open-loop runs of half a second come to, beside what was recorded then."""
    time = at.times[:, -1]
    pictures = {}
    for column, unit in ((2, "m"), (3, "m/s"), (4, "m/s"), (5, "m/s"), (10, "rad/s"), (11, "rad/s")):
        truth = at.truth[:, -1, column]
        pictures[NAMES[column]] = Series(
            f"{NAMES[column]} after 0.5 s of open loop, error", time,
            {"before": before[:, -1, column] - truth, "after": after[:, -1, column] - truth},
            y_label=unit, section="fit",
        )  # fmt: skip
    return pictures


def text_of(document: Mapping[str, Any]) -> str:
    """The diagnosis for a terminal."""
    from crazyem.diagnosis.report.html import verdict

    lines = [verdict(document)]
    if not document["mismatch"]:
        lines += [f"  it could not reveal: {text}" for text in _hidden(document["not_identifiable"])]
    for f in document["where"][:6]:
        size = f"{_short(f['effect_size'], '+.3g')} +- {_short(f['sd'], '.2g')} {f['unit']}"
        lines.append(f"  where: {f['signal']} {f['axis']}, {f['regime']}: {size}")
    for e in document["effects"]:
        held = e["evidence"]["held_out_nats"]
        sure = _short(e["confidence"], ".2f")
        lines.append(f"  {e['label']}  (confidence {sure}, held out {_short(held, '.1f')} nats)")
        for name, p in e["parameters"].items():
            if "ci95" in p:
                value, low, high = (_short(v, ".5g") for v in (p["value"], *p["ci95"]))
                lines.append(f"    {name:16s} {value} {p['unit']}  (95 %: {low} to {high})")
            else:
                lines.append(f"    {name:16s} {p['value']}")
    for group in document["indistinguishable"]:
        lines.append(f"  cannot be told apart: {', '.join(group)}")
    words = "would separate them" if document["indistinguishable"] else "would tell more"
    lines += [f"    {words}: {text}" for text in document["would_separate"]]
    if document["unexplained"]["found"]:
        for f in document["unexplained"]["where"][:4]:
            size = f"{_short(f['effect_size'], '+.3g')} {f['unit']}"
            lines.append(f"  unexplained: {f['signal']} {f['axis']}, {f['regime']}: {size}")
    swapped = _roles(document["swapped"], document["recordings"], document["held_out_recordings"])
    lines += [f"  note: {text}" for text in swapped]
    several = len(document["of_recordings"]) > 1
    for own in document["of_recordings"]:
        lines += [f"  note: {_named(own['recording'], text, several)}" for text in own["notices"]]
    for part, title in (("train", "fitted flight"), ("held_out", "held-out flight")):
        both = document["fit"][part]
        if both:
            for name in SHOWN:
                one, two = both["before"][name], both["after"][name]
                pairs = ", ".join(
                    f"{1e3 * h:.0f} ms {_short(b)} -> {_short(a)}"
                    for h, b, a in zip(both["before"]["horizon_s"], one["rms"], two["rms"], strict=True)
                )
                lines.append(f"  {title}, open-loop rms {name} [{one['unit']}]: {pairs}")
    return "\n".join(lines)


def _hidden(missing: Sequence[Mapping[str, str]]) -> list[str]:
    """Names and reasons of what is not identifiable, a line for each reason."""
    reasons = dict.fromkeys(m["reason"] for m in missing)
    return [f"{', '.join(m['name'] for m in missing if m['reason'] == reason)}: {reason}" for reason in reasons]


def _short(value: float | None, how: str = ".3g") -> str:
    """A number of the document, which has null for what is not finite."""
    return "-" if value is None else format(value, how)


def _number(value: Any) -> float | None:
    value = float(value)
    return value if math.isfinite(value) else None


def saved_vehicle(diagnosis: Diagnosis, name: str) -> Vehicle:
    """The fitted vehicle under a name of its own; how sure the old file was of its values says nothing of these."""
    fitted = diagnosis.fitted_vehicle
    return replace(fitted, name=name, mass_sd=None, inertia_sd=None, motor_time_constant_sd=None)
