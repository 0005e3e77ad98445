"""The ideal observer, who knows the true parameters: log-likelihood ratio of the truth, and true prediction error.

Both use the tool's own likelihood and predictor. If the ratio is not available, a case counts as detectable.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted, nominal, with_torque_memory_refit
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording
from crazyem.vehicle import Vehicle

ASIDE = {"gusts", "accelerometer_misalignment", "measurement_delay"}  # the last changes the onboard estimate, too
BEFORE_ROTORS = {"motor_lag", "input_delay"}
HORIZON = 50  # steps of the recording's 100 Hz: 0.5 s
EVERY = 10  # samples between starts


def ideal_nats(
    recording: Path, vehicle: Vehicle, effects: Mapping[str, Mapping[str, Any]], *, mapping: Path | None = None
) -> float | None:
    """Log-likelihood of the recording under the true effects less that under the nominal vehicle; None: not available.

    `vehicle` has all true properties that are not hidden, whether the diagnosis knows them or not.

    In either model, unknown quantities have their best values: noise scales, a memory of the torques or none, and the
    nuisances. None if the likelihood of the flight does not show the effect: accelerometer, gusts, and effects before
    rotors whose speeds are measured.
    """
    seen = open_recording(str(recording), options_of(mapping))
    if _beyond(effects, seen):
        return None
    data = Data([flight_of(seen, vehicle)])
    without = best_fit(data, nominal(data, Point(vehicle, known_effects(vehicle), start_noise())), ())
    return _under(data, without.point, effects) - without.loglik


def ideal_nats_of_each(
    recording: Path, vehicle: Vehicle, effects: Mapping[str, Mapping[str, Any]], *, mapping: Path | None = None
) -> dict[str, float | None]:
    """By effect: log-likelihood of the recording under all true effects less that without this effect, as above; None:
    not available. An ideal observer may detect a pair and still only one of its effects."""
    seen = open_recording(str(recording), options_of(mapping))
    if _beyond(effects, seen):
        return dict.fromkeys(effects)
    data = Data([flight_of(seen, vehicle)])
    start = best_fit(data, nominal(data, Point(vehicle, known_effects(vehicle), start_noise())), ()).point
    whole = _under(data, start, effects)
    return {
        name: whole - _under(data, start, {other: table for other, table in effects.items() if other != name})
        for name in effects
    }


def _beyond(effects: Mapping[str, Mapping[str, Any]], seen: Recording) -> bool:
    """Whether the likelihood of the flight does not show these effects."""
    return bool(ASIDE & set(effects) or (BEFORE_ROTORS & set(effects) and "rotor_speed" in seen.signals))


def _under(data: Data, start: Point, effects: Mapping[str, Mapping[str, Any]]) -> float:
    """Log-likelihood under known effects."""
    point = replace(start, effects={**known_effects(start.vehicle), **{n: dict(table) for n, table in effects.items()}})
    data.settle(point)
    return best_fit(data, point, effects).loglik


def known_effects(vehicle: Vehicle) -> dict[str, dict[str, Any]]:
    """The vehicle's effects that are not hidden, as effects of a model."""
    return {name: dict(table) for name, table in vehicle.effects.items()}


def options_of(mapping: Path | None) -> ReadOptions:
    """How to read a recording that comes with a mapping."""
    return ReadOptions(None if mapping is None else str(mapping))


def best_fit(data: Data, point: Point, hidden: Iterable[str]) -> Fitted:
    """The best fit of the quantities beside the hidden effects: noise scales, memory of the torques or none, nuisances
    such as the trim of the day."""
    known = [Candidate(name, (), ()) for name in hidden]
    once = refine_base(data, point, known)
    again = refine_base(data, with_torque_memory_refit(data, once.point), known)
    return max(once, again, key=lambda f: f.loglik)


def held_out_error(recording: Path, vehicle_file: str, *, mapping: Path | None = None) -> dict[str, float] | None:
    """RMS error of `crazyem predict` after 0.5 s, between lift-off and landing: position m, velocity m/s, attitude rad,
    body_rate rad/s; None if the command fails."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "prediction.npz"
        words = ["predict", str(recording), "--vehicle", vehicle_file, "--horizon", str(HORIZON), "--every", str(EVERY)]
        words += [] if mapping is None else ["--map", str(mapping)]
        done = subprocess.run(
            [sys.executable, "-m", "crazyem", *words, "-o", str(out)], capture_output=True, text=True, check=False
        )
        if done.returncode or not out.is_file():
            return None
        with np.load(out) as file:
            prediction, start, step = file["prediction"], file["start_time"], float(file["step"])
    return errors_of(recording, np.asarray(prediction)[:, -1], np.asarray(start) + HORIZON * step, mapping=mapping)


def errors_of(
    recording: Path, predicted: np.ndarray, time: np.ndarray, *, mapping: Path | None = None
) -> dict[str, float]:
    """RMS errors of predicted states (n, 13) against the recorded state nearest to each time (n,), in the air only."""
    signals = open_recording(str(recording), options_of(mapping)).signals
    columns = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}
    heights = signals["position"]
    up = np.interp(time, heights.time, np.asarray(heights.value)[:, 2])
    flying = (up > 0.15) & np.all(np.isfinite(predicted), axis=1)
    out = {}
    for name, where in columns.items():
        if name not in signals:
            continue
        signal = signals[name]
        nearest = np.clip(np.searchsorted(signal.time, time), 1, len(signal.time) - 1)
        nearest -= (time - signal.time[nearest - 1]) < (signal.time[nearest] - time)
        true, guess = np.asarray(signal.value)[nearest], predicted[:, where]
        if name == "attitude":
            aligned = np.clip(np.abs(np.sum(true * guess, axis=1)), 0.0, 1.0)
            distance = 2.0 * np.arccos(aligned)
        else:
            distance = np.linalg.norm(true - guess, axis=1)
        use = flying & (np.abs(signal.time[nearest] - time) < 0.006)
        out[name] = float(np.sqrt(np.mean(distance[use] ** 2))) if use.any() else float("nan")
    return out
