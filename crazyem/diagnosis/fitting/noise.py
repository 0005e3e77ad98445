"""Noise scales of a model: Fisher scoring on the innovations of the flight.

The score is exact (`noise_score.py`). The information is sum 1/2 (ds/s)^2 + de^2/s, with de, ds by differences
(Cavanaugh and Shumway 1996, for a Gaussian innovations form). It costs a pass of the filter for each scale, so it is
made once, and what steps tell of the curvature is added to it (BFGS; Nocedal and Wright, Numerical Optimization,
ch. 6).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.model import Noise, Swept, run_sweep, scored_sweep
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.workers import Workers

ROWS = 1500  # of each flight, in a few stretches, from which the scales are taken
STRETCH = 750  # rows each: short ones begin too often at what was measured, and velocities seem better than they are
FEW, SHORT = 900, 150  # the same for the way there
PRIOR_SD = 2.0  # of the logarithm of a scale about its typical value
MOST_STEPS = 40
STEP = 0.02  # in the logarithm, for differences
LARGEST = 1.5  # step of scoring in the logarithm
TYPICAL = Noise(np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]), np.array([1e-3, 1e-2, 3e-3, 1e-2]))
FLOOR = np.log(np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 1e-5, 1e-4, 1e-4, 1e-4, *[1e-4] * 3, *[1e-3] * 3]))
# rad: no attitude made from an acceleration is better; in quiet flights 4 to 5 mrad. Believed to 0.5 mrad, every tremor
# of the acceleration is a torque, and a steady one (a weak rotor) is lost among these.
LEANING_FLOOR = 3e-3
TYPICAL_DISTURBANCE = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])


def logs_of(noise: Noise) -> NDArray:
    """(16,) logarithms: impulses, measurements, disturbances (of 0: -inf)."""
    with np.errstate(divide="ignore"):
        return np.log(np.concatenate([noise.impulse, noise.measurement, noise.disturbance]))


def noise_of(logs: NDArray, memory: float | NDArray) -> Noise:
    """Inverse of `logs_of`."""
    scales = np.exp(logs)
    return Noise(scales[:6], scales[6:10], scales[10:], memory)


def sample_rows(flight: Flight, *, rows: int = ROWS, stretch: int = STRETCH) -> NDArray:
    """(n,) bool: stretches spread over the flight, that the noise is taken from."""
    n = flight.time.size
    if n <= rows:
        return np.ones(n, bool)
    keep = np.zeros(n, bool)
    for begin in np.linspace(0, n - stretch, rows // stretch).astype(int):
        keep[begin : begin + stretch] = True
    return keep


def first_guess() -> Noise:
    """Where scoring begins."""
    return Noise(np.array([0.3, 0.3, 0.5, 5.0, 5.0, 5.0]), np.array([3e-3, 3e-2, 1e-2, 3e-2]))


@dataclass
class Informed:
    """What is known of the curvature (k, k) by the noise scales, by flights and free scales."""

    known: dict[tuple[object, ...], NDArray] = field(default_factory=dict)

    def copy(self) -> "Informed":
        """One that learns by itself from here on."""
        return Informed(dict(self.known))


Part = tuple[Flight, NDArray, NDArray]  # a flight, its accelerations (n, 6) and offsets (n, 12)


def fit_noise(
    parts: list[Part],
    start: Noise,
    *,
    near: bool = False,
    tolerance: float = 0.2,
    workers: Workers | None = None,
    informed: Informed | None = None,
    rows: int = ROWS,
    held: tuple[int, ...] = (),
) -> Noise:
    """Noise scales of highest posterior density, the accelerations (n, 6) and offsets (n, 12) of each flight given.

    Scales of quantities that nothing measures stay. Disturbances are fitted where they start above 0, but for those
    `held`. Unless the start is near, most of the way is gone on few rows.
    """
    workers, informed = workers or Workers(1), informed or Informed()
    if not near and any(f.time.size > FEW for f, _, _ in parts):
        few = [(f.rows(k), a[k], o[k]) for f, a, o in parts for k in (sample_rows(f, rows=FEW, stretch=SHORT),)]
        start = _scored(few, start, 5 * tolerance, workers, Informed(), held)
    chosen = [(f.rows(keep), a[keep], o[keep]) for f, a, o in parts for keep in (sample_rows(f, rows=rows),)]
    return _scored(chosen, start, tolerance, workers, informed, held)


def _scored(
    chosen: list[Part], start: Noise, tolerance: float, workers: Workers, informed: Informed, held: tuple[int, ...]
) -> Noise:
    measured = np.zeros(4, bool)
    for flight, _, _ in chosen:
        measured |= np.array([np.isfinite(flight.y[:, c]).any() for c in (0, 3, 6, 10)])
    free = np.concatenate([np.ones(6, bool), measured, start.disturbance > 0])
    free[10 + np.array(held, int)] = False
    logs, memory, floor = logs_of(start), start.memory, FLOOR.copy()
    if any("attitude" not in f.signals and np.isfinite(f.y[:, 6]).any() for f, _, _ in chosen):
        floor[8] = np.log(LEANING_FLOOR)
    logs = np.maximum(logs, np.where(free, floor, -np.inf))
    typical = logs_of(Noise(TYPICAL.impulse, TYPICAL.measurement, TYPICAL_DISTURBANCE))
    index = np.flatnonzero(free)
    key = (*(f.time.size for f, _, _ in chosen), *index.tolist(), *np.atleast_1d(memory).tolist())

    def look(at: NDArray) -> tuple[float, NDArray, list[Swept]]:
        """Log posterior density, its score and the passes of the flights."""
        found = workers.map(lambda part: scored_sweep(*part, noise_of(at, memory)), chosen)
        away = (at - typical)[index]
        value = sum(swept.loglik for swept, _ in found) - 0.5 * float(away @ away) / PRIOR_SD**2
        slope = np.sum([score[index] for _, score in found], axis=0) - away / PRIOR_SD**2
        return value, slope, [swept for swept, _ in found]

    value, score, swept = look(logs)
    for _ in range(MOST_STEPS):
        fresh = key not in informed.known
        if fresh:
            information = _information(chosen, swept, logs, memory, index, workers)
            informed.known[key] = information + np.eye(index.size) / PRIOR_SD**2
        curvature = informed.known[key]
        step = np.clip(np.linalg.solve(curvature, score), -LARGEST, LARGEST)
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
            del informed.known[key]
            continue
        gain, way = found - value, there[index] - logs[index]
        informed.known[key] = _learnt(curvature, way, score - slope)
        promised = 0.5 * float(score @ way)
        logs, value, score, swept = there, found, slope, passes
        if max(gain, promised) < tolerance:
            break
    return noise_of(logs, memory)


def _learnt(curvature: NDArray, way: NDArray, change: NDArray) -> NDArray:
    """The curvature (k, k) with what a step tells of it: along `way` (k,) the score fell by `change` (k,)."""
    along, before = float(way @ change), curvature @ way
    if along <= 1e-3 * float(way @ before):
        return curvature
    return curvature + np.outer(change, change) / along - np.outer(before, before) / float(way @ before)


def _information(
    chosen: list[Part], here: list[Swept], logs: NDArray, memory: float | NDArray, index: NDArray, workers: Workers
) -> NDArray:
    """About the scales `index` (k,) of all flights together: (k, k), by differences from the passes `here`."""

    def sweep(at: NDArray) -> list[Swept]:
        noise = noise_of(at, memory)
        return [
            run_sweep(f, a, o, np.zeros((f.time.size, 6, 0)), np.zeros((f.time.size, 12, 0)), noise)
            for f, a, o in chosen
        ]

    moved = workers.map(sweep, logs + STEP * np.eye(logs.size)[index])
    information = np.zeros((index.size, index.size))
    for part, base in enumerate(here):
        seen = base.variance > 0
        s, e = base.variance[seen], base.innovation[seen]
        ds = np.stack([(m[part].variance[seen] - s) / STEP for m in moved]) / s
        de = np.stack([(m[part].innovation[seen] - e) / STEP for m in moved]) / np.sqrt(s)
        information += 0.5 * ds @ ds.T + de @ de.T
    return information
