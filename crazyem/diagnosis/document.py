"""A diagnosis as its JSON document, with the open-loop errors before and after, and the pictures of its report.

Standard deviations of the joint posterior of a fitted vehicle file are those of the document, which contain systematic
errors, too. Correlations are those of the fit. Nuisances of the drone are part of the posterior, because no file gives
them exactly.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.diagnose import Diagnosis
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.diagnosis.flights import recording_nuisances as held_out_roles
from crazyem.diagnosis.flights.flight import without
from crazyem.diagnosis.flights.recording_nuisances import RecordingNuisances
from crazyem.diagnosis.locating.locate import Finding, strongest
from crazyem.diagnosis.naming.answer import Named
from crazyem.diagnosis.prediction.horizon import (
    UNITS,
    HorizonErrors,
    Windows,
    error_lengths,
    errors,
    open_loop,
    windows,
    worse,
)
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.diagnosis.report.content import text_of
from crazyem.diagnosis.report.pictures import Series
from crazyem.diagnosis.report.verdict import joined, prefixed
from crazyem.errors import DataError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording
from crazyem.signals.sample import SIGNALS
from crazyem.vehicle import Posterior, Vehicle


def posterior_of(diagnosis: Diagnosis) -> Posterior | None:
    """The joint posterior of the parameters of the drone; None if nothing is fitted."""
    mean: dict[str, float] = {}
    sd: dict[str, float] = {}
    for effect in diagnosis.effects:
        if effect.of_recording or effect.name not in diagnosis.fitted_vehicle.effects:
            continue
        for name, value in effect.parameters.items():
            if math.isfinite(value.value) and math.isfinite(value.sd) and value.sd > 0.0:
                mean[f"{effect.name}.{name}"], sd[f"{effect.name}.{name}"] = float(value.value), float(value.sd)
    correlation: dict[tuple[str, str], float] = {}
    fitted = diagnosis.selection.fitted
    covariance = solved(fitted)[0].covariance
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    columns = list(_columns(diagnosis))
    for i, (key, number) in enumerate(columns):
        if key and key not in mean and spread[i] > 0.0:
            mean[key], sd[key] = number, float(spread[i])
    for i, (first, _) in enumerate(columns):
        for j, (second, _) in enumerate(columns):
            if first in mean and second in mean and spread[i] * spread[j] > 0.0:
                correlation[first, second] = float(covariance[i, j] / (spread[i] * spread[j]))
    if not mean:
        return None
    names = tuple(mean)
    matrix = np.array([[correlation.get((a, b), float(a == b)) for b in names] for a in names])
    np.fill_diagonal(matrix, 1.0)
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    matrix = (vectors * np.maximum(values, 1e-9)) @ vectors.T
    scale = np.array([sd[n] for n in names])
    joint = matrix * np.outer(scale, scale)
    return Posterior(names, tuple(mean[n] for n in names), tuple(tuple(float(v) for v in row) for row in joint))


def _columns(diagnosis: Diagnosis) -> Iterator[tuple[str, float]]:
    """The columns of the fit: "effect.parameter" for parameters of the drone, else ""; and the value."""
    fitted = diagnosis.selection.fitted
    seen = set()
    for candidate in (*fitted.candidates, *fitted.nuisances):
        values = candidate.values(fitted.point)
        effect = CATALOGUE.get(candidate.effect)
        for name in candidate.free:
            key = f"{candidate.effect}.{name}"
            of_drone = effect is not None and effect.belongs_to == "vehicle"
            yield (key if of_drone and key not in seen else ""), float(values[name])
            seen.add(key)


COMPARED = ("position", "velocity", "attitude", "body_rate", "motor_command", "rotor_speed", "voltage")


def compare(recording: Recording, simulated: Recording) -> dict[str, Any]:
    """Differences of the signals that both recordings have, aligned at take-off.

    Raises:
        DataError: one of them holds no flight.
    """
    begins, lasts = [], []
    for one in (recording, simulated):
        air = airtime(one)
        if not air.flown:
            raise DataError(f"{one.path}: nothing was flown in this recording, so there is nothing to compare")
        begins.append(air.flown[0][0])
        lasts.append(air.flown[-1][1] - air.flown[0][0])
    seconds = min(lasts)
    found: dict[str, Any] = {"simulated": simulated.path, "seconds": seconds, "signals": {}}
    for name in COMPARED:
        if name not in recording.signals or name not in simulated.signals:
            continue
        (t, value), (t_sim, value_sim) = ordered(recording.signals[name]), ordered(simulated.signals[name])
        t, t_sim = t - begins[0], t_sim - begins[1]
        rows = (t >= 0) & (t <= seconds)
        if not rows.any() or t_sim.size < 2:
            continue
        theirs = np.stack([np.interp(t[rows], t_sim, column) for column in value_sim.T], 1)
        mine = value[rows]
        if name == "attitude":
            dot = np.abs(np.sum(mine * theirs, axis=1)) / np.linalg.norm(theirs, axis=1)
            size, unit = 2 * np.arccos(np.clip(dot, 0.0, 1.0)), "rad"
        else:
            size, unit = np.linalg.norm(mine - theirs, axis=1), SIGNALS[name][1]
        found["signals"][name] = {
            "rms": float(np.sqrt(np.mean(size**2))), "largest": float(size.max()),
            "when": float(t[rows][int(np.argmax(size))]), "unit": unit,
        }  # fmt: skip
    return found


__all__ = ["document_of", "notices_of", "saved_vehicle", "text_of"]
MOST_PICTURES = 4  # of signals with findings


def document_of(
    diagnosis: Diagnosis,
    recordings: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    withhold: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, Series]]:
    """The JSON document of a diagnosis (names as in docs/reference/json.md), and pictures.

    Args:
        recordings, held_out: as given to `diagnose`.
    """
    if diagnosis.swapped:
        recordings, held_out = held_out, recordings
    vehicle, drone, as_flown = diagnosis.vehicle, diagnosis.fitted_vehicle, diagnosis.as_flown
    # effects of sensors belong to the fitted recordings, so held-out ones are predicted by the drone alone
    models = [vehicle, as_flown] + ([] if drone == as_flown else [drone])
    train = _compared([without(r, withhold) for r in recordings], models)
    apart = _compared([without(r, withhold) for r in held_out], [vehicle, drone])
    fitted, confirmed = _before_after(train), _before_after(apart)
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
            "train": fitted,
            "held_out": confirmed,
            "whiteness": {"before": diagnosis.before.whiteness, "after": diagnosis.after.whiteness},
            "gap_closed": _gap_closed(confirmed or fitted),
        },
        "not_identifiable": [{"name": n, "reason": r} for n, r in diagnosis.left_out.items()],
        "ranking": _ranking(diagnosis),
        "of_recordings": [own.to_json() for own in diagnosis.own],
        "left_free": _left_free(diagnosis),
        "notices": [
            *([held_out_roles.swap_sentence(diagnosis.recordings, diagnosis.held_out)] if diagnosis.swapped else []),
            *_of_recordings(diagnosis.effects),
            *notices_of(diagnosis.own),
        ],
    }
    first = train[0] if train else None
    return document, accused_pictures(diagnosis, first) | (error_pictures(first) if first else {})


def _left_free(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Free parameters beside the effects: of the fit, of each recording, and written into the vehicle unnamed."""
    found = [asdict(free) for free in diagnosis.free]
    for own in diagnosis.own:
        found += own.free()
    named = {e.fitted_as or e.name for e in diagnosis.effects}
    for name, values in diagnosis.fitted_vehicle.effects.items():
        if name not in named and values != diagnosis.vehicle.effects.get(name):
            effect = CATALOGUE[name]
            words = f"{effect.description({})}, written into the vehicle"
            found += [
                {"name": name, "words": words, "parameter": p.description, "value": values[p.name],
                 "sd": None, "unit": p.unit, "expected": p.neutral, "usual": None}
                for p in effect.parameters if p.name in values
            ]  # fmt: skip
    return [{k: _number(v) if isinstance(v, float) else v for k, v in entry.items()} for entry in found]


def _of_recordings(effects: Sequence[Named]) -> list[str]:
    """Notice that some effects are no property of the drone."""
    names = [e.words for e in effects if e.of_recording]
    if not names:
        return []
    return [
        f"{joined(names)}: of the recording and not of the drone, so --write-vehicle leaves that out, and so do the "
        "errors on flight that was held out"
    ]


def notices_of(own: Sequence[RecordingNuisances]) -> list[str]:
    """The notices of each recording, with its name if there are several."""
    return [f"{Path(o.recording).name}: {text}" if len(own) > 1 else text for o in own for text in o.notices]


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
        "words": effect.words,
        "parameters": parameters,
        "evidence": {
            "held_out_nats": _number(effect.held_out_nats),
            "p_value": None,  # not computed; the key goes with the next release
            "log_odds": None if effect.log_odds is None else _number(effect.log_odds),
        },
        "confidence": _number(effect.confidence),
    }


def _finding(f: Finding) -> dict[str, Any]:
    return {
        "signal": f.signal, "axis": f.axis, "regime": f.regime, "interval": [round(t, 3) for t in f.interval],
        "effect_size": _number(f.effect_size), "sd": _number(f.sd), "unit": f.unit, "p_value": _number(f.p_value),
        "nats": _number(f.nats),
    }  # fmt: skip


def _ranking(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """All candidates of the first turn, best first."""
    found, seen = [], set()
    for trial in diagnosis.selection.steps[0].trials if diagnosis.selection.steps else ():
        if trial.candidate.label in seen:
            continue
        seen.add(trial.candidate.label)
        found.append({
            "name": trial.candidate.effect, "label": trial.candidate.label, "words": _words(trial.candidate),
            "gain_nats": _number(trial.gain),
            "held_out_nats": _number(trial.held_out), "p_value": None,
            "evidence_nats": _number(trial.evidence), "note": "" if trial.fitted else "not fitted: linear estimate",
        })  # fmt: skip
    return found


def _words(candidate: Candidate) -> str:
    """Words for a candidate: with its discrete choices, and with its free parameters if there are alternatives."""
    effect = CATALOGUE[candidate.effect]
    return effect.description(
        {**dict(candidate.fixed), **(dict.fromkeys(candidate.free, 0.0) if effect.alternatives else {})}
    )


@dataclass(frozen=True, eq=False)
class Compared:
    """Open-loop predictions of one recording before and after the fit, and by the fitted vehicle without effects of the
    recording, if there are any."""

    at: Windows
    runs: tuple[NDArray, ...]  # before, after, and by the fitted vehicle


def _compared(recordings: Sequence[Recording], vehicles: Sequence[Vehicle]) -> list[Compared]:
    """Predictions of every recording with complete states, by each vehicle over the same windows."""
    found = []
    for recording in recordings:
        try:
            shown = [recorded(recording, vehicle) for vehicle in vehicles]
            at = windows(shown[0])
            found.append(Compared(at, tuple(open_loop(one, at) for one in shown)))
        except DataError:
            continue
    return found


def _before_after(compared: Sequence[Compared]) -> dict[str, Any]:
    """Errors before and after the fit, and by the fitted vehicle if predicted; and quantities that are worse."""
    if not compared:
        return {}
    by_model = zip(*([errors(run, c.at) for run in c.runs] for c in compared), strict=True)
    found: dict[str, Any] = dict(zip(("before", "after", "vehicle"), map(_pooled, by_model), strict=False))
    lengths = [(error_lengths(c.runs[0], c.at), error_lengths(c.runs[1], c.at)) for c in compared]
    return {**found, "worse": worse(lengths)}


def _pooled(found: Sequence[HorizonErrors]) -> dict[str, Any]:
    """Errors of several flights together: the root of the mean square over all starts."""
    if len(found) == 1:
        return found[0].to_json()
    weights = np.array([f.starts for f in found], float)
    weights /= weights.sum()
    rms = {n: tuple(np.sqrt(np.square([f.rms[n] for f in found]).T @ weights)) for n in found[0].rms}
    mean = {n: tuple(np.array([f.mean[n] for f in found]).T @ weights) for n in found[0].mean}
    return replace(found[0], starts=sum(f.starts for f in found), rms=rms, mean=mean).to_json()


def _gap_closed(errors_of: Mapping[str, Any]) -> dict[str, float | None]:
    """Share of the mean square error at the longest horizon that the fit removes, by quantity."""
    closed: dict[str, float | None] = {}
    for name in UNITS:
        before, after = (errors_of[k][name]["rms"][-1] if errors_of else None for k in ("before", "after"))
        closed[name] = 1.0 - (after / before) ** 2 if before and after is not None else None
    return closed


def accused_pictures(diagnosis: Diagnosis, compared: Compared | None) -> dict[str, Series]:
    """Pictures of signals with findings, strongest first: the missing disturbance over time, before and after.

    A body rate has no such series. Its picture is the error one sample ahead, else the torque about its axis.
    """
    accused = [*(strongest(diagnosis.before.findings) if diagnosis.mismatch else ()), *diagnosis.unexplained.findings]
    found: dict[str, Series] = {}
    for finding in accused:
        name = f"{finding.signal} {finding.axis}"
        if name in found or len(found) == MOST_PICTURES:
            continue
        series = _missing(diagnosis, name, finding) or _rate_error(compared, finding)
        series = series or _missing(diagnosis, f"torque {finding.axis}", finding)
        if series is not None:
            found[name] = series
    return found


def _missing(diagnosis: Diagnosis, name: str, finding: Finding) -> Series | None:
    """Picture of a missing disturbance, with the interval of a finding; None if there is no series of that name."""
    before, after = diagnosis.before.disturbances[0], diagnosis.after.disturbances[0]
    if name not in before.names:
        return None
    k = before.names.index(name)
    factor, unit = prefixed(float(np.nanmax(np.abs(before.value[:, k]))), before.units[k])
    lines = {"before": factor * before.value[:, k]}
    if diagnosis.effects:
        lines["after"] = factor * after.value[:, k]
    here = finding.variable == "time" and len(diagnosis.before.disturbances) == 1
    title = f"Missing from the model: {name.replace('_', ' ')} (band: two standard deviations)"
    return Series(
        title, before.time, lines, y_label=unit,
        level=2.0 * factor * float(np.median(before.sd[:, k])), shaded=(finding.interval,) if here else (),
    )  # fmt: skip


def _rate_error(compared: Compared | None, finding: Finding) -> Series | None:
    """Picture of the error of a body rate one sample ahead, about one axis."""
    if compared is None or finding.signal != "body_rate" or finding.axis not in "xyz":
        return None
    column = 10 + "xyz".index(finding.axis)
    before, after = (run[:, 0, column] - compared.at.truth[:, 0, column] for run in compared.runs[:2])
    title = f"Error of the body rate {finding.axis}, {1e3 * compared.at.horizons[0]:g} ms ahead"
    return Series(title, compared.at.times[:, 1], {"before": before, "after": after}, y_label="rad/s")


def error_pictures(compared: Compared) -> dict[str, Series]:
    """Pictures of the errors of open-loop predictions, for each quantity."""
    before, after = (error_lengths(run, compared.at) for run in compared.runs[:2])
    title = f"error {compared.at.horizons[-1]:g} s ahead"
    return {
        f"error {name}": Series(
            f"{name.replace('_', ' ').capitalize()}, {title}", compared.at.times[:, -1],
            {"before": before[name][:, -1], "after": after[name][:, -1]}, y_label=unit, section="fit",
        )
        for name, unit in UNITS.items()
    }  # fmt: skip


def _number(value: Any) -> float | None:
    value = float(value)
    return value if math.isfinite(value) else None


def saved_vehicle(diagnosis: Diagnosis, name: str) -> Vehicle:
    """The fitted vehicle under a new name, with the joint posterior instead of standard deviations of the old file."""
    fitted = diagnosis.fitted_vehicle
    return replace(
        fitted, name=name, mass_sd=None, inertia_sd=None, motor_time_constant_sd=None, posterior=posterior_of(diagnosis)
    )
