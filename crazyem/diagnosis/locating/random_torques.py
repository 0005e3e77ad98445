"""Random torques with a structure: of a single rotor, or in one band of frequencies.

Noise of commands and air acts on all rotors alike, so torques about two axes are not correlated. A rotor that sticks,
slips or misfires correlates roll, pitch and yaw with the signs of its place. A vibration makes a hump in the spectrum
of the innovations of body rates. No effect of the catalogue explains either.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.locating.locate import AXES, Finding, axis_columns, units_of
from crazyem.diagnosis.settings import LOCATION, SPECTRUM
from crazyem.physics.motion import body_of
from crazyem.physics.rotors import wrench
from crazyem.vehicle import GRAVITY

AT_RANDOM = "at random"  # variable of such a finding; that of a finding by thrust is `rotor`
PAIRS = ((0, 1), (0, 2), (1, 2))  # pairs of axes


def standardised(model: Model, point: Point, turned: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """(n, 3) innovations of the body rates in standard deviations, and (n,) whether a row has all three.

    Args:
        turned: (3, 3) matrix that multiplies the innovations first; None: no matrix.
    """
    swept = model.sweep(point)
    innovation, variance = swept.innovation[:, 9:12], swept.variance[:, 9:12]
    seen: NDArray = np.all(variance > 0, axis=1)
    if turned is not None:
        innovation, variance = innovation @ turned.T, variance @ np.square(turned).T
    z = np.divide(innovation, np.sqrt(variance), where=seen[:, None], out=np.zeros((seen.size, 3)))
    return np.clip(z, -SPECTRUM.outlier, SPECTRUM.outlier), seen


def memoryless(data: Data, point: Point) -> Point:
    """The point without memory of disturbing torques, with refitted noise scales.

    A filter with such a memory predicts the torques, so they would not show in the innovations.
    """
    white = np.concatenate([point.noise.disturbance[:3], np.zeros(3)])
    return data.fit_noise(replace(point, noise=replace(point.noise, disturbance=white)))


def erratic_rotor(models: Sequence[Model], point: Point) -> Finding | None:
    """The rotor with a random thrust, from correlations between the innovations of two axes; None if there is none.

    Nothing is fitted, so fitted and held-out flights count alike. The test is strongest with `memoryless` torques. The
    innovations are turned into torques: with products of inertia, rates are correlated for all rotors.
    """
    inertia = body_of(point.vehicle, point.effects).inertia
    sums, count = [], 0
    for model in models:
        z, seen = standardised(model, point, inertia / np.max(inertia))
        sums.append(block_covariances(z, seen, model.flight.block, model.flight.blocks))
        count += int(seen.sum())
    scores = np.concatenate(sums)
    if count == 0 or len(scores) < 8:
        return None
    vehicle = point.vehicle
    torque = wrench(np.eye(4), arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)[:, 1:]
    best: tuple[float, int, float] = (0.0, 0, 0.0)
    for rotor in range(4):
        sign = np.array([np.sign(torque[rotor, i] * torque[rotor, j]) for i, j in PAIRS])
        turned = scores * sign
        tilt, yaw, all_three = (_t(s) for s in (turned[:, 0], turned[:, 1:].sum(1), turned.sum(1)))
        if min(tilt, yaw) > SPECTRUM.min_t and all_three > best[0]:
            best = (all_three, rotor, float(turned.sum() / (3 * count)))
    t, rotor, correlation = best
    chance = min(1.0, 4.0 * float(stats.t.sf(t, len(scores) - 1)))
    if chance > SPECTRUM.chance or correlation < SPECTRUM.min_correlation:
        return None
    noise = point.noise
    step = float(np.median(np.diff(models[0].flight.time)))
    level = np.hypot(noise.disturbance[3:5], noise.impulse[3:5] / np.sqrt(step)) * vehicle.inertia[:2]
    size = float(np.sqrt(correlation) * level.mean())
    time = models[0].flight.time
    return Finding("torque", "x", f"rotor {rotor + 1} at random", AT_RANDOM, (float(time[0]), float(time[-1])), size,
                   size / (2 * t), "N m", float(-np.log(max(chance, 1e-300))), chance)  # fmt: skip


def block_covariances(z: NDArray, seen: NDArray, block: NDArray, blocks: int) -> NDArray:
    """(blocks, 3) sums of products of (n, 3) innovations for each of `PAIRS`, about their means in each block.

    The mean is a steady torque (the trim of another day, wind), not a random one.
    """
    rows = np.where(seen[:, None], z, 0.0)
    count = np.maximum(np.bincount(block, seen, blocks), 1.0)
    mean = np.stack([np.bincount(block, rows[:, i], blocks) / count for i in range(3)], axis=1)
    away = np.where(seen[:, None], z - mean[block], 0.0)
    return np.stack([np.bincount(block, away[:, i] * away[:, j], blocks) for i, j in PAIRS], axis=1)


def _t(sums: NDArray) -> float:
    """Student's t of the mean over blocks."""
    spread = float(sums.std(ddof=1))
    return float(sums.mean() / spread * np.sqrt(sums.size)) if spread > 0 else 0.0


def spectrum(values: NDArray, period: float) -> tuple[NDArray, NDArray, int]:
    """Frequencies [Hz], mean power density [unit^2/Hz] of (n,) samples, and its number of pieces."""
    size = round(SPECTRUM.piece / period)
    window = np.hanning(size)
    begins = range(0, values.size - size + 1, max(1, size // 2))
    powers = [np.abs(np.fft.rfft((p - p.mean()) * window)) ** 2 for b in begins for p in (values[b : b + size],)]
    if not powers:
        return np.zeros(0), np.zeros(0), 0
    return np.fft.rfftfreq(size, period), 2 * period / float(np.sum(window**2)) * np.mean(powers, axis=0), len(powers)


def hump(frequency: NDArray, power: NDArray) -> tuple[int, float]:
    """Index of the largest power over that of the surroundings, and this ratio."""
    best, where = 0.0, 0
    inside = (frequency > SPECTRUM.min_frequency) & (frequency < SPECTRUM.max_frequency * 2 * frequency[-1])
    for k in np.flatnonzero(inside):
        away = np.abs(frequency - frequency[k])
        around = power[inside & (away > SPECTRUM.hump_width) & (away < SPECTRUM.surroundings)]
        if around.size >= 8 and power[k] > best * np.median(around):
            best, where = float(power[k] / np.median(around)), int(k)
    return where, best


def peaks(model: Model, point: Point) -> list[tuple[int, float, float, int]]:
    """Humps in the spectra of the innovations of body rates, of any cause: axis 0 to 2, frequency [Hz], power over that
    of the surroundings, number of pieces of the spectrum."""
    z, seen = standardised(model, point)
    if seen.sum() < 256:
        return []
    period = float(np.median(np.diff(model.flight.time)))
    grid = np.arange(model.flight.time[0], model.flight.time[-1], period)
    found = []
    for i in range(3):
        frequency, power, pieces = spectrum(np.interp(grid, model.flight.time[seen], z[seen, i]), period)
        if pieces >= SPECTRUM.min_pieces:
            k, ratio = hump(frequency, power)
            if ratio > SPECTRUM.min_hump:
                found.append((i, float(frequency[k]), ratio, pieces))
    return found


def humps(model: Model, point: Point) -> list[Finding]:
    """Findings of humps in the spectra of the innovations of body rates, with the amplitude of their torque."""
    flight = model.flight
    period = float(np.median(np.diff(flight.time)))
    grid = np.arange(flight.time[0], flight.time[-1], period)
    span = (float(flight.time[0]), float(flight.time[-1]))
    least = LOCATION.torque * point.vehicle.mass * GRAVITY * max(*point.vehicle.arm, 0.01)
    found = []
    for i, at, ratio, pieces in peaks(model, point):
        amplitude, sd = amplitude_of(model, point, i, at)
        if model.rows_path is None:  # the model left the range of numbers
            continue
        frequency, rate, _ = spectrum(np.interp(grid, flight.time, model.rows_path[:, 10 + i]), period)
        band = np.abs(frequency - at) <= SPECTRUM.hump_width
        swing = float(np.sqrt(2 * np.trapezoid((rate * (2 * np.pi * frequency) ** 2)[band], frequency[band])))
        torque = amplitude * float(units_of(point)[3 + i])
        if amplitude < SPECTRUM.min_hump_torque * swing or torque < least:
            continue
        nats = pieces / 2 * (ratio - 1 - np.log(ratio))  # pieces overlap by half
        where, chance = f"frequency {at:.1f} Hz", float(np.exp(-min(nats, 700.0)))
        found.append(Finding("torque", AXES[i], where, "frequency", span, torque, torque * sd / amplitude, "N m",
                             float(nats), chance))  # fmt: skip
    return found


def amplitude_of(model: Model, point: Point, axis: int, frequency: float) -> tuple[float, float]:
    """Amplitude of an angular acceleration [rad/s^2] at a frequency, and its standard deviation.

    It is the root mean square over blocks; the phase is free in each block.
    """
    angle = 2 * np.pi * frequency * model.flight.time
    columns = [axis_columns(model.flight, wave)[3 + axis] for wave in (np.cos(angle), np.sin(angle))]
    swept = model.sweep(point, columns)
    powers = []
    for b, a in zip(swept.score, swept.information, strict=True):
        if np.linalg.cond(a) < 1e3:
            inverse = np.linalg.inv(a)
            powers.append(float(np.sum((inverse @ b) ** 2) - np.trace(inverse)))
    if len(powers) < 2:
        return 0.0, 0.0
    mean, sd = float(np.mean(powers)), float(np.std(powers, ddof=1) / np.sqrt(len(powers)))
    amplitude = float(np.sqrt(max(mean, 0.0)))
    return amplitude, sd / (2 * amplitude) if amplitude > 0 else 0.0
