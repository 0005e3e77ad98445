"""Tests by signals that the filter does not use, for effects that the filter cannot tell apart.

Late inputs and late measurements are the same to the filter. The accelerometer has no delay but its own low pass. So
its lag behind the forces of a model without delay contains the delay of late inputs, but not that of late measurements.
A weak rotor and a wrong rotor sensor are the same to the filter, too. Commands separate them: they give the speed that
the other rotors show at the same command.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.flights.alignment import band_passed, delay_of, delays_within, products, standard_error
from crazyem.diagnosis.settings import CLOCKS, RECORDINGS
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording


def late_measurements(data: Data, nominal: Point, delay: float) -> float | None:
    """Nats for late measurements against late inputs, with this `delay` [s]; None without an accelerometer.

    `nominal` has no delay. None also with measured rotor speeds, because their own lag is not known.
    """
    if data.flights[0].inputs.measured:
        return None
    lags = [found for found in (_lag_of(model, nominal) for model in data.models) if found is not None]
    if not lags:
        return None
    weight = sum(variance**-1 for _, variance in lags)
    lag, variance = (
        sum(lag / variance for lag, variance in lags) / weight,
        1.0 / weight + CLOCKS.accelerometer_lag_sd**2,
    )
    return ((lag - CLOCKS.accelerometer_lag - delay) ** 2 - (lag - CLOCKS.accelerometer_lag) ** 2) / (2.0 * variance)


def _lag_of(model: Model, point: Point) -> tuple[float, float] | None:
    """Lag [s] of the accelerometer behind the thrust of one flight's commands, and its variance; None without one."""
    flight = model.flight
    thrust = model.accelerations(point)[0][:, 2]
    known, shown = np.isfinite(thrust) & ~flight.starts, np.isfinite(flight.force[:, 2])
    grid = np.arange(flight.time[0], flight.time[-1], CLOCKS.grid)
    margin = round((CLOCKS.max_sensor_delay + CLOCKS.filter_half) / CLOCKS.grid)
    if min(known.sum(), shown.sum()) < 2 or grid.size < 2 * margin + CLOCKS.min_blocks * RECORDINGS.block / CLOCKS.grid:
        return None
    middle = flight.time - 0.5 * np.diff(flight.time, prepend=flight.time[0])  # thrust is the mean of the step before
    cause = band_passed(np.interp(grid, middle[known], thrust[known])[:, None])
    wanted = band_passed(np.interp(grid, flight.time[shown], flight.force[shown, 2])[:, None])
    index = np.arange(margin, grid.size - margin)
    block = ((grid[index] - grid[margin]) / RECORDINGS.block).astype(int)
    delays = delays_within(CLOCKS.max_sensor_delay)
    sums = np.stack([products(index, block, wanted, cause, [], d) for d in delays], 2)
    total = sums.sum(1)
    lag, variance = delay_of(delays, total)[0], standard_error(delays, sums, total) ** 2
    return (lag, variance) if np.isfinite([lag, variance]).all() and variance > 0.0 else None


def false_speed(recordings: Sequence[Recording], rotor: int, scale: float, lag: float) -> float | None:
    """Nats for a sensor of rotor 1 to 4 that shows `scale` times the speed, against a weak rotor with a right sensor.

    `lag` [s] of the rotors behind their commands. None where commands or speeds are not recorded.
    """
    blocks = [b for r in recordings for b in [_beyond(r, rotor - 1, lag)] if b is not None]
    if not blocks:
        return None
    beyond = np.concatenate(blocks)
    if beyond.size < CLOCKS.min_speed_blocks:
        return None
    mean, variance = float(beyond.mean()), float(beyond.var(ddof=1)) / beyond.size + CLOCKS.twin_speed_sd**2
    return (mean**2 - (mean - float(np.log(scale))) ** 2) / (2.0 * variance)


def _beyond(recording: Recording, rotor: int, lag: float) -> NDArray | None:
    """(b,) by blocks: logarithm of a rotor's speed over the speed of the others at its command."""
    air = airtime(recording)
    if any(n not in recording.signals for n in ("motor_command", "rotor_speed")):
        return None
    time, command = ordered(recording.signals["motor_command"])
    when, speed = ordered(recording.signals["rotor_speed"])
    flying = np.zeros(time.size, bool)
    for begin, end in air.flown:
        flying |= (time > begin + 0.5) & (time < end - 0.5)
    if time.size < 2 or when.size < 2:
        return None
    expected = command.astype(float).copy()
    for k in range(1, time.size):
        decay = np.exp(-max(time[k] - time[k - 1], 0.0) / max(lag, 1e-3))
        expected[k] = command[k - 1] + (expected[k - 1] - command[k - 1]) * decay
    seen = np.stack([np.interp(time, when, speed[:, i]) for i in range(4)], 1)
    flying &= np.all((expected > 0.01) & (seen > 1.0), axis=1)
    if flying.sum() < CLOCKS.min_speed_blocks * CLOCKS.samples_of_block:
        return None
    x, y = np.log(expected[flying]), np.log(seen[flying])
    others = [i for i in range(4) if i != rotor]
    centre = float(x.mean())
    slope = np.polynomial.Polynomial.fit(x[:, others].ravel() - centre, y[:, others].ravel(), 2)
    away = y - slope(x - centre)
    difference = away[:, rotor] - away[:, others].mean(1)  # cancels the battery's state, which all rotors share
    count = difference.size // CLOCKS.samples_of_block
    return difference[: count * CLOCKS.samples_of_block].reshape(count, CLOCKS.samples_of_block).mean(1)
