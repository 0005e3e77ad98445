"""A pass of the filter over a flight, and noise scales of a model by Fisher scoring on the innovations.

The score is exact (`noise_score.py`). The information is sum 1/2 (ds/s)^2 + de^2/s, with de, ds by differences
(Cavanaugh and Shumway 1996, for a Gaussian innovations form). It costs a pass of the filter for each scale. So it is
computed once, and each step updates it (BFGS; Nocedal and Wright, Numerical Optimization, ch. 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.kernel import layout, sweep
from crazyem.diagnosis.fitting.noise_score import noise_score
from crazyem.diagnosis.flights.flight import COLUMNS, Flight
from crazyem.diagnosis.settings import NOISE
from crazyem.diagnosis.workers import Workers

WIDE = np.repeat(np.square(NOISE.start_sd), 3)  # variances at a start of unmeasured states


@dataclass(frozen=True)
class Noise:
    """Noise of process and measurement.

    Attributes:
        impulse: (6,) intensities of specific force [m/s^2 sqrt(s)] and angular acceleration [rad/s^2 sqrt(s)], body.
        measurement: (4,) standard deviations of position [m], velocity [m/s], attitude [rad], body rate [rad/s].
        disturbance: (6,) standard deviations of disturbances with memory [m/s^2, rad/s^2], body; 0: none.
        memory: s, their correlation time; or (6,).
        coloured: (4,) as `measurement`, of the errors that have a memory; 0: none.
        recall: (4,) s, correlation times of these.
        thrust_only: whether onboard estimates know thrust and attitude alone, and no other force (`transition.py`).
    """

    impulse: NDArray
    measurement: NDArray
    disturbance: NDArray = field(default_factory=lambda: np.zeros(6))
    memory: float | NDArray = 1.0
    coloured: NDArray = field(default_factory=lambda: np.zeros(4))
    recall: NDArray = field(default_factory=lambda: np.ones(4))
    thrust_only: bool = True

    @property
    def remembered(self) -> tuple[NDArray, NDArray]:
        """(18,) variances and (18,) correlation times [s] of disturbances (6) and errors (12) with memory."""
        memory = np.broadcast_to(np.asarray(self.memory, float), (6,))
        errors = np.repeat(np.square(self.coloured), 3), np.repeat(self.recall, 3)
        return np.concatenate([np.square(self.disturbance), errors[0]]), np.concatenate([memory, errors[1]])


@dataclass(frozen=True)
class Swept:
    """Results of one pass over a flight.

    Attributes:
        loglik: log-likelihood of the whole flight [nats].
        rows: (n,) log-likelihood by row.
        predicted, filtered: (n, 19) states.
        innovation, variance: (n, 12), sequential scalars; variance 0 where nothing was measured.
        score: (b, c) by block; information: (b, c, c) by block. Empty without columns.
    """

    loglik: float
    rows: NDArray
    predicted: NDArray
    filtered: NDArray
    innovation: NDArray
    variance: NDArray
    score: NDArray
    information: NDArray


def run_sweep(
    flight: Flight, acceleration: NDArray, offset: NDArray, acting: NDArray, showing: NDArray, noise: Noise
) -> Swept:
    """A pass of the kernel; the log-likelihood is -inf if a variance is negative or NaN.

    Noise scales of very different size make the covariance indefinite by rounding; their likelihood would be too large.
    """
    return _run(flight, acceleration, offset, acting, showing, noise, _kept(0, 12))[0]


def scored_sweep(flight: Flight, acceleration: NDArray, offset: NDArray, noise: Noise) -> tuple[Swept, NDArray]:
    """A pass without columns, and the derivatives of its log-likelihood by the logarithms of the noise (24,): impulses,
    measurements, disturbances, coloured errors, their correlation times."""
    n, (spread, memory) = flight.time.size, noise.remembered
    nothing = np.zeros((n, 6, 0)), np.zeros((n, 12, 0))
    kept = _kept(n, 12 + layout(spread)[0].size)
    swept, states = _run(flight, acceleration, offset, *nothing, noise, kept)
    measured = np.isfinite(np.delete(flight.y, 9, axis=1))
    by_variance = np.zeros(54)
    noise_score(
        flight.time, flight.starts, measured, _thrust_only(flight, noise), spread, memory, states,
        swept.innovation, swept.variance, *kept, by_variance,
    )  # fmt: skip
    by_scale = np.concatenate(
        [by_variance[:6], _threes(by_variance[6:18]), by_variance[18:24], _threes(by_variance[24:36])]
    )
    scales = np.concatenate([noise.impulse, noise.measurement, noise.disturbance, noise.coloured])
    return swept, np.append(2.0 * by_scale * np.square(scales), _threes(by_variance[42:]))


def _thrust_only(flight: Flight, noise: Noise) -> int:
    return int(flight.fused and noise.thrust_only)


def _threes(values: NDArray) -> NDArray:
    """(4,) sums over the axes of (12,)."""
    total: NDArray = values.reshape(4, 3).sum(1)
    return total


def _kept(n: int, size: int) -> tuple[NDArray, NDArray, NDArray]:
    """Arrays that the kernel fills for the score of the noise: gains, steps, covariances of states with memory."""
    return np.zeros((n, 12, size)), np.zeros((n, size + 6, size)), np.zeros((n, size - 12, size))


def _run(
    flight: Flight, acceleration: NDArray, offset: NDArray, acting: NDArray, showing: NDArray, noise: Noise,
    kept: tuple[NDArray, NDArray, NDArray],
) -> tuple[Swept, NDArray]:  # fmt: skip
    """The pass and its states (n, 31)."""
    n, m = flight.time.size, acting.shape[2] + showing.shape[2]
    predicted, filtered = np.zeros((n, 31)), np.zeros((n, 31))
    innovation, variance, rows = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros(n)
    blocks = flight.blocks if m else 1
    score, information = np.zeros((blocks, m)), np.zeros((blocks, m, m))
    loglik = sweep(
        flight.time, flight.starts, flight.y, np.ascontiguousarray(acceleration[:, :3]),
        np.ascontiguousarray(acceleration[:, 3:]), offset, acting, showing, np.square(noise.impulse),
        np.repeat(np.square(noise.measurement), 3), *noise.remembered, WIDE,
        flight.block if m else np.zeros(n, np.int64), _thrust_only(flight, noise), predicted, filtered,
        innovation, variance, rows, score, information, *kept,
    )  # fmt: skip
    if not np.all(variance >= 0.0):
        loglik = -np.inf
    upper = np.triu(information)
    information = upper + np.transpose(np.triu(information, 1), (0, 2, 1))
    before, after = (np.ascontiguousarray(v[:, :19]) for v in (predicted, filtered))
    return Swept(loglik, rows, before, after, innovation, variance, score, information), filtered


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
