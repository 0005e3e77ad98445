"""Signals that the filter does not use, asked where it cannot tell two effects apart.

Inputs that act late and measurements that are late are one to the filter; an accelerometer is punctual, so its lag
behind the forces of the punctual model is the delay in the first case and nothing in the second. A rotor that is weak
and one whose sensor counts wrong are one to the filter; commands tell what speed the other rotors would have shown.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.naming.accelerometer import tilt
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording

TELLING = 3.0  # nats by which a witness tells two effects apart
PUNCTUAL, PUNCTUAL_SD = 1e-3, 1.5e-3  # s: lag of the accelerometer behind the forces of commands where nothing is late
# Where thrust never sets in at once, what the model lacks of slow forces passes for lag: with 0.3 s of thrust over its
# rate (standard deviations) by -18 to 28 ms in 17 simulated flights, most by 8 to 20, with 0.16 to 0.19 s by -3 to 8 in
# 9; with 0.05 s, as sudden take-offs have, by no more than above.
SUDDEN, SLOW = 0.06, 0.06  # s; s of lag for each second beyond it
TWINS_SD = 0.01  # relative: speeds of two healthy rotors at one command
LAG = 6  # which of the parameters of `accelerometer.tilt` is the lag [s]
SECOND = 100  # samples to a block
FEWEST = 8  # blocks


def late_measurements(data: Data, nominal: Point, delay: float) -> float | None:
    """Nats for late measurements and against late inputs, of `delay` [s]; None without an accelerometer.

    `nominal` has no delay. The flight that tells the lag best is heard, most often one where thrust sets in at once:
    errors have one sign (in 11 simulated flights with nothing hidden that tell it to 2 to 4 ms it was one sd too long
    on average, too short in none), so the mean of several would pass for better than it is. For measured rotor speeds
    nothing is said: their own lag is not known.
    """
    if data.flights[0].inputs.measured:
        return None
    told = [found for found in (_lag_of(one, nominal) for one in data.each()) if found is not None]
    if not told:
        return None
    lag, variance = min(told, key=lambda one: one[1])
    return ((lag - PUNCTUAL - delay) ** 2 - (lag - PUNCTUAL) ** 2) / (2.0 * variance)


def _lag_of(data: Data, nominal: Point) -> tuple[float, float] | None:
    """Lag [s] of the accelerometer behind the forces of one flight's commands, and its variance; None without one."""
    found = tilt(data, nominal)
    if found is None:
        return None
    flight = data.models[0].flight
    force = data.models[0].accelerations(nominal)[0][:, 2]
    inside = ~flight.starts & np.isfinite(force)
    rate = np.gradient(force, flight.time)[inside]
    slow = max(float(force[inside].std()) / max(float(rate.std()), 1e-9) - SUDDEN, 0.0)
    variance = float(found[0].covariance[LAG, LAG]) + PUNCTUAL_SD**2 + (SLOW * slow) ** 2
    return float(found[0].theta[LAG]), variance


def false_speed(recordings: Sequence[Recording], rotor: int, scale: float, lag: float) -> float | None:
    """Nats for a sensor of rotor 1 to 4 that shows speeds times `scale`, against a rotor that is weak at true speed.

    `lag` [s] of the rotors behind their commands. None where commands or speeds are not recorded.
    """
    blocks = [b for r in recordings for b in [_beyond(r, rotor - 1, lag)] if b is not None]
    if not blocks:
        return None
    beyond = np.concatenate(blocks)
    if beyond.size < FEWEST:
        return None
    mean, variance = float(beyond.mean()), float(beyond.var(ddof=1)) / beyond.size + TWINS_SD**2
    return (mean**2 - (mean - float(np.log(scale))) ** 2) / (2.0 * variance)


def _beyond(recording: Recording, rotor: int, lag: float) -> NDArray | None:
    """(b,) by blocks: logarithm of a rotor's speed over what the others show at its command."""
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
    told = command.astype(float).copy()
    for k in range(1, time.size):
        decay = np.exp(-max(time[k] - time[k - 1], 0.0) / max(lag, 1e-3))
        told[k] = command[k - 1] + (told[k - 1] - command[k - 1]) * decay
    seen = np.stack([np.interp(time, when, speed[:, i]) for i in range(4)], 1)
    flying &= np.all((told > 0.01) & (seen > 1.0), axis=1)
    if flying.sum() < FEWEST * SECOND:
        return None
    x, y = np.log(told[flying]), np.log(seen[flying])
    others = [i for i in range(4) if i != rotor]
    centre = float(x.mean())
    slope = np.polynomial.Polynomial.fit(x[:, others].ravel() - centre, y[:, others].ravel(), 2)
    away = y - slope(x - centre)
    difference = away[:, rotor] - away[:, others].mean(1)  # the battery's state is common to all
    count = difference.size // SECOND
    return difference[: count * SECOND].reshape(count, SECOND).mean(1)
