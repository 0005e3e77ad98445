"""Errors of open-loop simulation at fixed horizons, from starts all along a flight.

All models have the same starts, so that before and after a fit can be compared. `predict` decides which inputs a start
may use. The truth at the end of a horizon is the recorded state, interpolated if streams have different stamps.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import COLUMNS
from crazyem.diagnosis.prediction.bias_correction import Weights
from crazyem.diagnosis.prediction.predict import Recorded, start_rows
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.diagnosis.settings import PREDICTION, RECORDINGS
from crazyem.errors import DataError
from crazyem.physics.effects.effect import Effects
from crazyem.physics.rotations import quaternion_conjugate, quaternion_product
from crazyem.vehicle import Vehicle

HORIZONS = (0.01, 0.1, 0.5)  # s
UNITS = {"position": "m", "velocity": "m/s", "attitude": "rad", "body_rate": "rad/s"}


@dataclass(frozen=True)
class HorizonErrors:
    """Open-loop errors by quantity: position [m], velocity [m/s], attitude [rad, geodesic], body_rate [rad/s].

    Attributes:
        horizons: s.
        starts: number of starts.
        rms: quantity -> root mean square of the length of the error at each horizon; NaN where not measured, inf where
            the model left the range of numbers.
        mean: quantity -> mean length.
    """

    horizons: tuple[float, ...]
    starts: int
    rms: Mapping[str, tuple[float, ...]]
    mean: Mapping[str, tuple[float, ...]]

    def to_json(self) -> dict[str, Any]:
        """The errors for the result document; numbers that are not finite become None."""
        found: dict[str, Any] = {"horizon_s": list(self.horizons), "starts": self.starts}
        for name, unit in UNITS.items():
            found[name] = {"unit": unit, "rms": _plain(self.rms[name]), "mean": _plain(self.mean[name])}
        return found


@dataclass(frozen=True, eq=False)
class Windows:
    """Starts and ends of open-loop runs along a flight; the same for every model.

    Attributes:
        rows: (n,) rows of `Recorded` at the starts.
        times: (n, 1 + h) s, of the start, and of the recorded sample next to the end of each horizon.
        truth: (n, h, 13) recorded states there; NaN where not recorded.
        horizons: (h,) s.
    """

    rows: NDArray
    times: NDArray
    truth: NDArray
    horizons: tuple[float, ...]


def windows(
    shown: Recorded,
    *,
    horizons: Sequence[float] = HORIZONS,
    spacing: float = PREDICTION.spacing,
) -> Windows:
    """The starts of open-loop runs and the recorded states at their ends.

    Args:
        shown: the recording.
        horizons: s, increasing.
        spacing: s from start to start.

    Raises: DataError if there is no such run.
    """
    firsts = [np.arange(begin, end - horizons[-1] - 1e-9, spacing) for begin, end in shown.flights]
    parts = [np.unique(np.searchsorted(shown.time, first - 1e-9)) for first in firsts]
    rows = np.concatenate([np.empty(0, np.int64), *(rows[rows < shown.time.size] for rows in parts)])
    ends = shown.time[rows][:, None] + np.asarray(horizons)
    at = np.clip(np.searchsorted(shown.time, ends), 1, shown.time.size - 1)
    at -= (ends - shown.time[at - 1]) < (shown.time[at] - ends)
    at = np.maximum(at, rows[:, None] + 1)  # a horizon shorter than a sample ends with the next one
    good = np.isfinite(shown.state[rows]).all(axis=1)
    good &= start_rows(shown, rows, horizon=1, step=horizons[-1] + shown.period)
    good &= (np.diff(at, axis=1) > 0).all(axis=1) & (at[:, -1] < shown.time.size)
    age = shown.age[rows]
    if good.any():  # fresh states only; if streams never coincide, states of usual age
        good &= age <= max(RECORDINGS.same_time, float(np.median(age[good])) + RECORDINGS.same_time)
    if not good.any():
        raise DataError(
            f"{shown.path}: no stretch of flight is long enough for {horizons[-1]:g} s of open-loop simulation"
        )
    rows, at = rows[good], at[good]
    times = np.concatenate([shown.time[rows][:, None], shown.time[at]], axis=1)
    truth = np.stack([recorded_at(shown, times[:, k]) for k in range(1, times.shape[1])], axis=1)
    return Windows(rows, times, truth, tuple(horizons))


def open_loop(
    shown: Recorded,
    at: Windows,
    *,
    vehicle: Vehicle | None = None,
    effects: Effects | None = None,
    measured_attitude: bool = False,
    weights: Weights | None = None,
    substep: float = PREDICTION.substep,
) -> NDArray:
    """(n, h, 13) predictions for windows.

    Args:
        shown: the recording.
        at: starts and ends.
        vehicle: other constants than those of the inputs (mass, inertia, arm, lag; not the thrust curve).
        effects: None: those of the vehicle.
        measured_attitude: follow the recorded attitude and rate, so that only forces are tested.
        weights: corrections of each start (see `bias_correction.py`); None: the model alone.
        substep: largest step of the integration [s].
    """
    simulator = Simulator(shown.inputs, effects, vehicle=vehicle)
    swings = simulator.swings(shown.time, shown.state, shown.airborne)
    return simulator.run(
        shown.state[at.rows],
        at.times,
        swing=None if swings is None else swings[at.rows],
        given=at.times[:, -1] - shown.period,  # as in `predict` with recorded steps
        attitude=(lambda time: recorded_attitude(shown, time)) if measured_attitude else None,
        substep=substep,
        weights=weights,
    )


def error_lengths(prediction: NDArray, at: Windows) -> dict[str, NDArray]:
    """Quantity -> (n, h) lengths of the errors of predictions (n, h, 13); NaN where not measured, inf where the model
    left the range of numbers."""
    found = {}
    for name, columns in COLUMNS.items():
        length = lengths(prediction[..., columns], at.truth[..., columns], attitude=name == "attitude")
        known = np.isfinite(at.truth[..., columns]).all(axis=2)
        found[name] = np.where(known, np.where(np.isfinite(length), length, np.inf), np.nan)
    return found


def errors(prediction: NDArray, at: Windows) -> HorizonErrors:
    """Errors of predictions (n, h, 13) against the recorded states."""
    rms: dict[str, tuple[float, ...]] = {}
    mean: dict[str, tuple[float, ...]] = {}
    for name, length in error_lengths(prediction, at).items():
        rms[name] = tuple(math.sqrt(_mean(np.square(column))) for column in length.T)
        mean[name] = tuple(_mean(column) for column in length.T)
    return HorizonErrors(at.horizons, len(at.rows), rms, mean)


def worse(pairs: Sequence[tuple[Mapping[str, NDArray], Mapping[str, NDArray]]]) -> list[dict[str, Any]]:
    """Quantities that one model predicts visibly and significantly worse than another, over the same windows.

    Entries of the result document: quantity, horizon [s], and by how many standard errors (None if the model left the
    range of numbers).

    Args:
        pairs: `error_lengths` (n, h) of the model before and after, one pair a flight, at `HORIZONS` from starts every
            `PREDICTION.spacing`.
    """
    found = []
    for name in UNITS if pairs else ():
        for k, horizon in enumerate(HORIZONS):
            squares = [(np.square(before[name][:, k]), np.square(after[name][:, k])) for before, after in pairs]
            first, second = (np.concatenate([s[i] for s in squares]) for i in (0, 1))
            grown = [after - before for before, after in squares]
            sigmas = _standard_errors(grown, max(1, math.ceil(horizon / PREDICTION.spacing - 1e-9)))
            if sigmas > PREDICTION.beyond_chance and _mean(second) > PREDICTION.min_ratio**2 * _mean(first):
                [size] = _plain([sigmas])
                found.append({"quantity": name, "horizon_s": horizon, "standard_errors": size})
    return found


def _standard_errors(differences: Sequence[NDArray], overlapping: int) -> float:
    """Mean of differences (n,), one part for each flight, over its standard error; `overlapping` neighbours count as
    one."""
    means = []
    for part in differences:
        known = part[~np.isnan(part)]
        means += [float(known[i : i + overlapping].mean()) for i in range(0, known.size, overlapping)]
    if any(math.isinf(m) for m in means):
        return math.inf
    if len(means) < PREDICTION.min_windows:
        return 0.0
    error = float(np.std(means, ddof=1)) / math.sqrt(len(means))
    return float(np.mean(means)) / error if error > 0.0 else 0.0


def lengths(prediction: NDArray, truth: NDArray, *, attitude: bool) -> NDArray:
    """(...,) length of the difference of (..., 3) vectors, or the angle [rad] between (..., 4) attitudes."""
    with np.errstate(invalid="ignore", over="ignore"):
        if not attitude:
            return np.linalg.norm(prediction - truth, axis=-1)
        between = quaternion_product(quaternion_conjugate(truth), prediction)
        return 2.0 * np.arctan2(np.linalg.norm(between[..., :3], axis=-1), np.abs(between[..., 3]))


def recorded_at(shown: Recorded, time: NDArray) -> NDArray:
    """(n, 13) recorded states at (n,) s: samples, or interpolated between samples that are close enough."""
    found = np.full((time.size, 13), np.nan)
    for name, columns in COLUMNS.items():
        when, value = shown.parts[name]
        if when.size < 2:
            continue
        after = np.clip(np.searchsorted(when, time - 1e-9), 1, when.size - 1)
        before, mixed = after - 1, _interpolated(when, value, time, after)
        there = np.minimum(np.abs(time - when[before]), np.abs(time - when[after])) < 1e-6
        inside = (
            (when[after] - when[before] <= PREDICTION.max_period)
            & (time >= when[before] - RECORDINGS.same_time)
            & (time <= when[after] + RECORDINGS.same_time)
        )
        known = there | inside
        found[known, columns] = mixed[known]
    return found


def recorded_attitude(shown: Recorded, time: NDArray) -> tuple[NDArray, NDArray]:
    """Attitude (n, 4) and body rate (n, 3) at (n,) s, interpolated between samples of any distance."""
    when, value = shown.parts["attitude"]
    attitude = _interpolated(when, value, time, np.clip(np.searchsorted(when, time), 1, when.size - 1))
    when, rate = shown.parts["body_rate"]
    return attitude, np.stack([np.interp(time, when, rate[:, c]) for c in range(3)], axis=1)


def _interpolated(when: NDArray, value: NDArray, time: NDArray, after: NDArray) -> NDArray:
    """Values (n, 3 or 4) at (n,) s between the samples before `after` (n,) and there; four columns are attitudes."""
    first, second, gap = value[after - 1], value[after], when[after] - when[after - 1]
    share = np.clip((time - when[after - 1]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)[:, None]
    if value.shape[1] < 4:
        return (1 - share) * first + share * second
    second = np.where(np.sum(first * second, axis=1, keepdims=True) < 0, -second, second)
    mixed = (1 - share) * first + share * second
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def _mean(values: NDArray) -> float:
    """Mean of the known values; NaN if none is known."""
    known = values[~np.isnan(values)]
    with np.errstate(over="ignore"):
        return float(known.mean()) if known.size else math.nan


def _plain(values: Sequence[float]) -> list[float | None]:
    return [v if math.isfinite(v) else None for v in values]
