"""A pass of the filter over a flight: its noise, its results, and the score of the noise."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.kernel import layout, sweep
from crazyem.diagnosis.fitting.noise_score import noise_score
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE

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
