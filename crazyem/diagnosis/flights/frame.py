"""The tilt of the pose frame against the rotors, which is another angle in every recording.

Motion capture sees a body by its markers. When the markers are mounted again, the frame is another one. A tilt of half
a degree is a constant side force of 0.1 m/s^2. The part that all recordings share is a property of the drone
(`attitude_misalignment`). The difference between recordings belongs to each recording, like the clock of its rotors; it
is removed before the fit.

No thrust model is needed. Thrust points along body z. So the tilt is the lateral part of the specific force (from the
positions) that does not depend on the velocity, over the thrust.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.flights.flight import Flight, Frame
from crazyem.diagnosis.settings import LEVELLING, RECORDINGS
from crazyem.vehicle import GRAVITY


def in_mean_frame(flights: Sequence[Flight], kept_apart: Sequence[Flight]) -> tuple[list[Flight], list[Flight]]:
    """The flights with their pose frames turned to the mean frame of the fitted flights.

    The variance between recordings is estimated beside the error of each recording (DerSimonian and Laird 1986). If it
    is 0, or if attitudes come from a filter on board, nothing is done.
    """
    everyone = [*flights, *kept_apart]
    known = {i: tilt for i, f in enumerate(everyone) if (tilt := tilt_of(f)) is not None}
    fitted = sum(i < len(flights) for i in known)
    if not fitted or len(known) < 2:
        return list(flights), list(kept_apart)
    tilts, sds = (np.array([found[k] for found in known.values()]) for k in (0, 1))
    deviation = np.stack([_deviation(tilts[:, a], sds[:, a], fitted) for a in range(2)], 1)
    turned = list(everyone)
    for i, away, error in zip(known, deviation, sds, strict=True):
        if away.any():
            turned[i] = _turned_back(everyone[i], away, error)
    return turned[: len(flights)], turned[len(flights) :]


def tilt_of(flight: Flight) -> tuple[NDArray, NDArray] | None:
    """Roll and pitch (2,) rad of the pose frame in the body, and their standard deviations; None if not determined."""
    if flight.fused or not {"position", "attitude"} <= flight.signals:
        return None
    rows = [_across(flight, part) for part in _stretches(flight)]
    rows = [r for r in rows if r.size]
    if not rows:
        return None
    own = [np.floor(np.arange(len(r)) * LEVELLING.step / RECORDINGS.block).astype(int) for r in rows]
    first = np.cumsum([0, *(b[-1] + 1 for b in own[:-1])])
    block = np.concatenate([b + f for b, f in zip(own, first, strict=True)])
    if block.max() + 1 < LEVELLING.min_blocks:
        return None
    whole = np.concatenate(rows)
    lean, error = np.zeros(2), np.zeros(2)
    for axis in range(2):
        lean[axis], error[axis] = _constant(whole[:, [axis, 3]], whole[:, 4 + axis], block)
    return np.array([lean[1], -lean[0]]), error[::-1]


def _stretches(flight: Flight) -> list[NDArray]:
    """Rows with complete poses, in pieces without gaps."""
    seen = np.isfinite(flight.y[:, [0, 6]]).all(1)
    piece = np.cumsum(flight.gaps)
    parts = [np.flatnonzero(seen & (piece == p)) for p in np.unique(piece)]
    return [
        p for p in parts if p.size > 4 and flight.time[p[-1]] - flight.time[p[0]] > 2 * LEVELLING.width * LEVELLING.step
    ]


def _across(flight: Flight, part: NDArray) -> NDArray:
    """(k, 6): velocity [m/s], specific force along z, and along x and y [m/s^2], in the axes of the pose."""
    time = flight.time[part]
    grid = np.arange(time[0], time[-1], LEVELLING.step)
    place = np.stack([np.interp(grid, time, c) for c in flight.y[part, :3].T], 1)
    attitude = flight.y[part, 6:10].copy()
    attitude[1:] *= np.cumprod(np.where(np.sum(attitude[1:] * attitude[:-1], axis=1) < 0, -1.0, 1.0))[:, None]
    back = Rotation.from_quat(np.stack([np.interp(grid, time, c) for c in attitude.T], 1)).inv()
    velocity, acceleration = (
        savgol_filter(place, LEVELLING.width, 3, deriv=d, delta=LEVELLING.step, axis=0) for d in (1, 2)
    )
    force = back.apply(acceleration + np.array([0.0, 0.0, GRAVITY]))
    moved = back.apply(velocity)
    return np.column_stack([moved, force[:, 2], force[:, :2]])[LEVELLING.width // 2 : -(LEVELLING.width // 2)]


def _constant(explaining: NDArray, across: NDArray, block: NDArray) -> tuple[float, float]:
    """Coefficient of the last column of (k, 2) in the regression of (k,), and its standard deviation by blocks."""
    count = int(block.max()) + 1
    a, b = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(a, block, explaining[:, :, None] * explaining[:, None, :])
    np.add.at(b, block, explaining * across[:, None])
    inverse = np.linalg.pinv(a.sum(0), hermitian=True)  # singular for a drone that does not move
    theta = inverse @ b.sum(0)
    rest = b - a @ theta
    covariance = inverse @ (rest.T @ rest) @ inverse * count / (count - 2)
    return float(theta[1]), max(LEVELLING.min_angle_sd, float(np.sqrt(covariance[1, 1])))


def _deviation(tilt: NDArray, sd: NDArray, fitted: int) -> NDArray:
    """(n,) rad, deviation of each tilt from the mean of the first `fitted`, shrunk by its own error."""
    weight = sd**-2.0
    mean = float(weight @ tilt / weight.sum())
    spread, freedom = float(weight @ (tilt - mean) ** 2), tilt.size - 1
    if stats.chi2.sf(spread, freedom) > LEVELLING.equal_p:
        return np.zeros(tilt.size)
    between = max(0.0, (spread - freedom) / float(weight.sum() - (weight**2).sum() / weight.sum()))
    weight = 1.0 / (sd**2 + between)
    centre = float(weight[:fitted] @ tilt[:fitted] / weight[:fitted].sum())
    away: NDArray = between / (sd**2 + between) * (tilt - centre)
    return away


def _turned_back(flight: Flight, away: NDArray, error: NDArray) -> Flight:
    y, seen = flight.y.copy(), np.isfinite(flight.y[:, 6])
    by = Rotation.from_rotvec([-away[0], -away[1], 0.0])
    y[seen, 6:10] = (Rotation.from_quat(y[seen, 6:10]) * by).as_quat()
    frame = Frame(float(away[0]), float(away[1]), (float(error[0]), float(error[1])))
    return replace(flight, y=y, frame=frame)
