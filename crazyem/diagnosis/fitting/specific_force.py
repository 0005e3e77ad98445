"""The accelerometer as evidence, for flights without a measured position or velocity.

The filter does not use the accelerometer, because no model contains its low pass and vibration. With a measured
position or velocity nothing is lost. Without (a log of gyro, accelerometer and commands), only the specific force shows
thrust over mass, lag and sag. Then each row is compared with the model, with a constant bias by axis and with vibration
as white noise. Vibration is not really white; the scatter of the blocks allows for this.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import NOISE


def is_needed(flight: Flight) -> bool:
    """Whether only the accelerometer shows forces."""
    shown = np.isfinite(flight.y[:, 0:6]).any()
    return not shown and bool(np.isfinite(flight.force).all(axis=1).sum() > 100)


def vibration(flight: Flight, model: NDArray) -> NDArray:
    """(3,) standard deviation [m/s^2] of the vibration, from the difference to a model (n, 3)."""
    period = float(np.median(np.diff(flight.time)))
    width = max(3, round(NOISE.vibration_period / period))
    kernel = np.ones(width) / width
    rest = np.where(np.isfinite(flight.force), flight.force, model) - model
    found = np.array([1.4826 * np.median(np.abs(c - np.convolve(c, kernel, "same"))) for c in rest.T])
    return np.maximum(found, NOISE.min_vibration)


def evidence(
    flight: Flight, model: NDArray, acting: NDArray, noise: NDArray, bias: NDArray
) -> tuple[float, NDArray, NDArray]:
    """Log-likelihood, score (b, c) and information (b, c, c) of the specific force.

    Args:
        flight: with a force (n, 3).
        model: (n, 3) specific force over the steps that end at the rows [m/s^2].
        acting: (n, 3, c) its derivatives by the columns.
        noise: (3,) m/s^2, standard deviation of the vibration.
        bias: (3,) m/s^2 of the sensor.
    """
    measured = np.full_like(flight.force, np.nan)  # mean over the step, as the model has it
    measured[1:] = 0.5 * (flight.force[1:] + flight.force[:-1])
    standard = (measured - model - bias) / noise
    usable = np.isfinite(standard).all(axis=1) & ~flight.starts
    z = np.where(usable[:, None], np.clip(standard, -NOISE.max_force_residual, NOISE.max_force_residual), 0.0)
    loglik = -0.5 * float(np.sum(z**2)) - float(usable.sum() * np.log(2 * np.pi * noise**2).sum() / 2)
    count, columns = flight.blocks, acting.shape[2]
    score, information = np.zeros((count, columns)), np.zeros((count, columns, columns))
    if columns:
        inner = usable[:, None] & (np.abs(standard) < NOISE.max_force_residual)
        slopes = np.where(inner[:, :, None], acting / noise[:, None], 0.0)
        first = np.concatenate([[0], np.flatnonzero(np.diff(flight.block)) + 1, [flight.block.size]])
        for b in range(count):
            rows = slice(first[b], first[b + 1])
            d = slopes[rows].reshape(-1, columns)
            score[b] = d.T @ z[rows].reshape(-1)
            information[b] = d.T @ d
    return loglik, score, information
