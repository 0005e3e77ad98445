"""Noise scales of a model: the maximum of their posterior density, by the exact score (`noise_score.py`)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from crazyem.diagnosis.fitting.sweeps import Noise, scored_sweep
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


def noise_of(logs: NDArray, memory: float | NDArray) -> Noise:
    """Inverse of `logs_of`."""
    scales = np.exp(logs)
    return Noise(scales[:6], scales[6:10], scales[10:16], memory, scales[16:20], scales[20:])


def coloured(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """The noise with as much coloured as white error, for quantities that are sampled fast enough to show it.

    If both position and velocity are measured, neither gets a coloured error. They come from one filter, whose errors
    in the two are correlated with each other and with the motion; independent errors would look like a wrong scale of
    the velocity.
    """
    periods = np.array([_period(flights, c) for c in FIRST])
    lasting = periods < NOISE.white_period * RECALL
    lasting[:2] &= not np.isfinite(periods[:2]).all()
    return replace(noise, coloured=np.where(lasting, noise.measurement, 0.0), recall=RECALL.copy())


def without_negligible(noise: Noise, flights: Sequence[Flight]) -> Noise:
    """The noise without coloured errors that are negligible at all frequencies: each costs time in every pass."""
    periods = np.array([_period(flights, c) for c in FIRST])
    density = noise.coloured * np.sqrt(1.0 + 2.0 * noise.recall / periods)
    return replace(noise, coloured=np.where(density < NOISE.min_coloured * noise.measurement, 0.0, noise.coloured))


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
    """Start values of the fit."""
    return Noise(np.array([0.3, 0.3, 0.5, 5.0, 5.0, 5.0]), np.array([3e-3, 3e-2, 1e-2, 3e-2]))


Part = tuple[Flight, NDArray, NDArray]  # a flight, its accelerations (n, 6) and offsets (n, 12)


def fit_noise(parts: list[Part], start: Noise, *, workers: Workers | None = None) -> Noise:
    """Noise scales of highest posterior density, for given accelerations (n, 6) and offsets (n, 12) of each flight.

    By L-BFGS-B with the exact score, within `NOISE.max_deviation` of typical scales. Scales of quantities that are not
    measured stay. Disturbances are fitted where they start above 0. Long flights count by stretches (`sample_rows`).
    """
    workers = workers or Workers(1)
    chosen = [(f.rows(keep), a[keep], o[keep]) for f, a, o in parts for keep in (sample_rows(f),)]
    measured = np.zeros(4, bool)
    for flight, _, _ in chosen:
        measured |= np.array([np.isfinite(flight.y[:, c]).any() for c in FIRST])
    lasting = measured & (start.coloured > 0)
    index = np.flatnonzero([*np.ones(6, bool), *measured, *(start.disturbance > 0), *lasting, *lasting])
    logs, memory, floor = logs_of(start), start.memory, logs_of(SMALLEST)
    if any("attitude" not in f.signals and np.isfinite(f.y[:, 6]).any() for f, _, _ in chosen):
        floor[8] = np.log(NOISE.min_attitude)
    typical, weight = logs_of(TYPICAL)[index], LOG_SD[index] ** -2.0

    def noise_at(free: NDArray) -> Noise:
        there = logs.copy()
        there[index] = free
        return noise_of(there, memory)

    def cost(free: NDArray) -> tuple[float, NDArray]:
        """Minus log posterior density, and its gradient."""
        noise, away = noise_at(free), free - typical
        found = workers.map(lambda part: scored_sweep(*part, noise), chosen)
        value = sum(swept.loglik for swept, _ in found) - 0.5 * float(weight @ np.square(away))
        slope = np.sum([score[index] for _, score in found], axis=0) - weight * away
        if not np.isfinite(value) or not np.isfinite(slope).all():  # rounding made a variance negative
            return NOISE.impossible, np.zeros(index.size)
        return -value, -slope

    begin = np.maximum(logs[index], floor[index])
    options = {"ftol": NOISE.tolerance / max(1.0, abs(cost(begin)[0])), "maxiter": NOISE.max_steps}
    bounds = list(zip(floor[index], typical + NOISE.max_deviation * LOG_SD[index], strict=True))
    return noise_at(minimize(cost, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x)
