"""accelerometer_misalignment: the accelerometer against the specific force of the fitted model.

The filter does not use the accelerometer, whose low pass is part of no model. Only this regression shows its tilt: the
residual is regressed on the tilt, with a bias and a lag of the sensor as nuisances. Errors come from the scatter of
blocks.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import Gram, Solution
from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.settings import ACCELEROMETER
from crazyem.physics.effects.sensing import ACCELEROMETER_MISALIGNMENT

MISALIGNED = ACCELEROMETER_MISALIGNMENT.name
ANGLES = ("roll", "pitch", "yaw")


def tilt(data: Data, point: Point) -> Solution | None:
    """Angles (roll, pitch, yaw first in theta) of the accelerometer [rad]; None without one."""
    if "specific_force" not in data.signals:
        return None
    grams = [_of(model, point) for model in data.models]
    if any(g.score.shape[0] < 8 or not np.isfinite(g.information).all() for g in grams):
        return None
    gram = Gram.joined(grams)
    precision = np.array(
        [0.0] * 2 + [ACCELEROMETER.yaw_sd**-2] + [ACCELEROMETER.bias_sd**-2] * 3 + [ACCELEROMETER.lag_sd**-2]
    )
    solution = gram.solve(range(7), precision=precision, tested=range(2))
    more = np.diag([ACCELEROMETER.angle_sd**2] * 2 + [0.0] * 5)
    return replace(solution, covariance=solution.covariance + more)


def held_out_gain(data: Data, point: Point, angles: NDArray, *, yaw_sd: float) -> float:
    """Gain of the angles on other flights [nats], with bias and lag fitted there.

    The yaw is fitted there, too, about the value found and within `yaw_sd` [rad]: a hover does not determine it, and a
    quick flight does.
    """
    total, dispersion = 0.0, gram_dispersion(data, point)
    bare = [3, 4, 5, 6]
    known = {2: yaw_sd**-2, **dict.fromkeys((3, 4, 5), ACCELEROMETER.bias_sd**-2), 6: ACCELEROMETER.lag_sd**-2}
    for model in data.models:
        # the dispersion applies to the residuals, not to the priors
        b, a = (v / dispersion for v in _of(model, point).total(range(7)))
        shift = np.array([*angles])
        total += float(b[:3] @ shift - 0.5 * shift @ a[:3, :3] @ shift)
        total += _fitted(b - a[:, :3] @ shift, a, known) - _fitted(b, a, {i: known[i] for i in bare})
    return total


def _fitted(score: NDArray, information: NDArray, known: Mapping[int, float]) -> float:
    """Gain of the parameters `known` (index -> precision of the prior) [nats]; the others stay as they are."""
    at = list(known)
    inner = information[np.ix_(at, at)] + np.diag([known[i] for i in at])
    return 0.5 * float(score[at] @ np.linalg.solve(inner, score[at]))


def gram_dispersion(data: Data, point: Point) -> float:
    """Variance of the scores over that of white residuals; at least 1."""
    found = tilt(data, point)
    return max(1.0, found.dispersion) if found else 1.0


def _of(model: Model, point: Point) -> Gram:
    flight = model.flight
    acceleration, situation = model.accelerations(point)
    force = acceleration[:, :3]
    shown = np.full_like(flight.force, np.nan)  # mean over the step, as in the model
    shown[1:] = 0.5 * (flight.force[1:] + flight.force[:-1])
    residual = shown - force
    usable = np.all(np.isfinite(residual), axis=1) & ~flight.starts & (situation.step > 0)
    columns = np.zeros((7, flight.time.size, 3))
    measured = ACCELEROMETER_MISALIGNMENT.measured
    assert measured is not None
    there = replace(situation, specific_force=force)
    for i, angle in enumerate(ANGLES):
        values = {**dict.fromkeys(ANGLES, 0.0), angle: ACCELEROMETER.step}
        columns[i] = measured(there, **values).specific_force / ACCELEROMETER.step
    for i in range(3):
        columns[3 + i, :, i] = 1.0
    columns[6] = -np.gradient(force, flight.time, axis=0)
    blocks = flight.blocks
    score, information = np.zeros((blocks, 7)), np.zeros((blocks, 7, 7))
    rows = np.flatnonzero(usable)
    if rows.size < 50:
        return Gram(np.zeros((0, 7)), np.zeros((0, 7, 7)), np.zeros(0, int))
    centred = residual[rows] - np.median(residual[rows], axis=0)
    variance = np.square(1.4826 * np.median(np.abs(centred), axis=0)) + 1e-6
    kept = rows[np.all(np.abs(centred) < 6 * np.sqrt(variance), axis=1)]
    for b in range(blocks):
        mine = kept[flight.block[kept] == b]
        for c in range(3):
            d = columns[:, mine, c] / np.sqrt(variance[c])
            r = residual[mine, c] / np.sqrt(variance[c])
            score[b] += d @ r
            information[b] += d @ d.T
    return Gram(score, information, np.zeros(blocks, int))
