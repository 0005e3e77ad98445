"""Noise scales of a model: Fisher scoring on the innovations of the flight.

The score is exact (`noise_score.py`). The information is sum 1/2 (ds/s)^2 + de^2/s, with de, ds by differences
(Cavanaugh and Shumway 1996, for a Gaussian innovations form). It costs a pass of the filter for each scale. So it is
computed once, and each step updates it (BFGS; Nocedal and Wright, Numerical Optimization, ch. 6).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.sweeps import Noise, Swept, run_sweep, scored_sweep
from crazyem.diagnosis.flights.flight import COLUMNS, Flight
from crazyem.diagnosis.settings import NOISE
from crazyem.diagnosis.workers import Workers

FIRST = tuple(c.start for c in COLUMNS.values())  # first columns of the signals in `Flight.y`
RECALL = np.array(NOISE.recall)


def _scales(
    impulse: Sequence[float], measurement: Sequence[float], disturbance: Sequence[float], recall: NDArray
) -> Noise:
    """Noise that is alike in all axes; coloured errors as large as those of measurements."""
    disturbances = np.repeat(disturbance, 3)
    errors = np.array(measurement)
    return Noise(np.repeat(impulse, 3), errors, disturbances, coloured=errors, recall=recall)


TYPICAL = _scales(NOISE.impulse, NOISE.measurement, NOISE.disturbance, RECALL)
SMALLEST = _scales(NOISE.min_impulse, NOISE.min_measurement, NOISE.min_disturbance, NOISE.min_recall * RECALL)
LOG_SD = np.append(np.full(20, NOISE.log_sd), NOISE.log_recall_sd)  # of all scales about typical ones


def logs_of(noise: Noise) -> NDArray:
    """(24,) logarithms: impulses, measurements, disturbances, coloured errors (of 0: -inf), their correlation times."""
    with np.errstate(divide="ignore"):
        scales = [noise.impulse, noise.measurement, noise.disturbance, noise.coloured, noise.recall]
        return np.log(np.concatenate(scales))


def noise_of(logs: NDArray, like: Noise) -> Noise:
    """Inverse of `logs_of`; the rest is that of `like`."""
    scales = np.exp(logs)
    return replace(like, impulse=scales[:6], measurement=scales[6:10], disturbance=scales[10:16],
                   coloured=scales[16:20], recall=scales[20:])  # fmt: skip


def coloured(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """The noise with as much coloured as white error, for quantities that are sampled fast enough to show it.

    If both position and velocity get one, they come from one estimate, and the error of the position integrates that of
    the velocity (`kernel.py`).
    """
    periods = np.array([_period(flights, c) for c in FIRST])
    lasting = periods < NOISE.white_period * RECALL
    return replace(noise, coloured=np.where(lasting, noise.measurement, 0.0), recall=RECALL.copy())


def without_negligible(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """The noise without coloured errors that are negligible at all frequencies: each costs time in every pass."""
    periods = np.array([_period(flights, c) for c in FIRST])
    density = noise.coloured * np.sqrt(1.0 + 2.0 * noise.recall / periods)
    kept = density >= NOISE.min_coloured * noise.measurement
    kept[0] |= kept[1]  # the error of the position integrates that of the velocity
    return replace(noise, coloured=np.where(kept, noise.coloured, 0.0))


def _period(flights: Sequence[Flight], column: int) -> float:
    """Shortest sampling period [s] of a column among the flights; infinite without measurements."""
    times = [f.time[np.isfinite(f.y[:, column])] for f in flights]
    return min((float(np.median(np.diff(t))) for t in times if t.size > 1), default=np.inf)


def sample_rows(flight: Flight, *, rows: int = NOISE.rows, stretch: int = NOISE.stretch) -> NDArray:
    """(n,) bool: stretches spread over the flight, for the fit of the noise."""
    n = flight.time.size
    if n <= rows:
        return np.ones(n, bool)
    keep = np.zeros(n, bool)
    for begin in np.linspace(0, n - stretch, rows // stretch).astype(int):
        keep[begin : begin + stretch] = True
    return keep


def start_noise() -> Noise:
    """Start values of scoring."""
    return Noise(np.array([0.3, 0.3, 0.5, 5.0, 5.0, 5.0]), np.array([3e-3, 3e-2, 1e-2, 3e-2]))


Curvatures = dict[tuple[object, ...], NDArray]  # (k, k) by the noise scales, for sets of flights and of free scales
Part = tuple[Flight, NDArray, NDArray]  # a flight, its accelerations (n, 6) and offsets (n, 12)


def fit_noise(
    parts: list[Part],
    start: Noise,
    *,
    near: bool = False,
    tolerance: float = 0.2,
    workers: Workers | None = None,
    curvatures: Curvatures | None = None,
) -> Noise:
    """Noise scales of highest posterior density, for given accelerations (n, 6) and offsets (n, 12) of each flight.

    Scales of quantities that are not measured stay. Disturbances are fitted where they start above 0. Unless the start
    is `near`, a rough fit to few rows comes first.
    """
    workers, curvatures = workers or Workers(1), {} if curvatures is None else curvatures
    if not near and any(f.time.size > NOISE.rough_rows for f, _, _ in parts):
        few = [
            (f.rows(k), a[k], o[k])
            for f, a, o in parts
            for k in (sample_rows(f, rows=NOISE.rough_rows, stretch=NOISE.rough_stretch),)
        ]
        start = _scored(few, start, 5 * tolerance, workers, {})
    chosen = [(f.rows(keep), a[keep], o[keep]) for f, a, o in parts for keep in (sample_rows(f, rows=NOISE.rows),)]
    return _scored(chosen, start, tolerance, workers, curvatures)


def _scored(chosen: list[Part], start: Noise, tolerance: float, workers: Workers, curvatures: Curvatures) -> Noise:
    measured = np.zeros(4, bool)
    for flight, _, _ in chosen:
        measured |= np.array([np.isfinite(flight.y[:, c]).any() for c in FIRST])
    lasting = measured & (start.coloured > 0)
    free = np.concatenate([np.ones(6, bool), measured, start.disturbance > 0, lasting, lasting])
    logs, floor = logs_of(start), logs_of(SMALLEST)
    if any("attitude" not in f.signals and np.isfinite(f.y[:, 6]).any() for f, _, _ in chosen):
        floor[8] = np.log(NOISE.min_attitude)
    logs = np.maximum(logs, np.where(free, floor, -np.inf))
    typical, index = logs_of(TYPICAL), np.flatnonzero(free)
    weight = LOG_SD[index] ** -2.0
    sizes, memories = (f.time.size for f, _, _ in chosen), np.atleast_1d(start.memory).tolist()
    key = (*sizes, *index.tolist(), *memories, start.thrust_only)

    def look(at: NDArray) -> tuple[float, NDArray, list[Swept]]:
        """Log posterior density, its score and the passes of the flights."""
        found = workers.map(lambda part: scored_sweep(*part, noise_of(at, start)), chosen)
        away = (at - typical)[index]
        value = sum(swept.loglik for swept, _ in found) - 0.5 * float(weight @ np.square(away))
        slope = np.sum([score[index] for _, score in found], axis=0) - weight * away
        return value, slope, [swept for swept, _ in found]

    value, score, swept = look(logs)
    for _ in range(NOISE.max_steps):
        fresh = key not in curvatures
        if fresh:
            information = _information(chosen, swept, logs, start, index, workers)
            curvatures[key] = information + np.diag(weight)
        curvature = curvatures[key]
        step = np.clip(np.linalg.solve(curvature, score), -NOISE.max_log_step, NOISE.max_log_step)
        for _ in range(5):
            there = logs.copy()
            there[index] = np.maximum(logs[index] + step, floor[index])
            found, slope, passes = look(there)
            if found > value - 1e-9:
                break
            step = step / 3
        else:
            if fresh:
                break
            del curvatures[key]
            continue
        gain, way = found - value, there[index] - logs[index]
        curvatures[key] = _bfgs_update(curvature, way, score - slope)
        promised = 0.5 * float(score @ way)
        logs, value, score, swept = there, found, slope, passes
        if max(gain, promised) < tolerance:
            break
    return noise_of(logs, start)


def _bfgs_update(curvature: NDArray, way: NDArray, change: NDArray) -> NDArray:
    """The curvature (k, k) after a BFGS update: along the step `way` (k,), the score fell by `change` (k,)."""
    along, before = float(way @ change), curvature @ way
    if along <= 1e-3 * float(way @ before):
        return curvature
    return curvature + np.outer(change, change) / along - np.outer(before, before) / float(way @ before)


def _information(
    chosen: list[Part], here: list[Swept], logs: NDArray, start: Noise, index: NDArray, workers: Workers
) -> NDArray:
    """Information (k, k) of the scales `index` (k,) from all flights, by differences from the passes `here`."""

    def sweep(at: NDArray) -> list[Swept]:
        noise = noise_of(at, start)
        return [
            run_sweep(f, a, o, np.zeros((f.time.size, 6, 0)), np.zeros((f.time.size, 12, 0)), noise)
            for f, a, o in chosen
        ]

    moved = workers.map(sweep, logs + NOISE.log_step * np.eye(logs.size)[index])
    information = np.zeros((index.size, index.size))
    for part, base in enumerate(here):
        seen = base.variance > 0
        s, e = base.variance[seen], base.innovation[seen]
        ds = np.stack([(m[part].variance[seen] - s) / NOISE.log_step for m in moved]) / s
        de = np.stack([(m[part].innovation[seen] - e) / NOISE.log_step for m in moved]) / np.sqrt(s)
        information += 0.5 * ds @ ds.T + de @ de.T
    return information
