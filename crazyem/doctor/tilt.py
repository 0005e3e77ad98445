"""Check: a tilted pose frame, by comparison of its vertical with gravity from the accelerometer.

In a frame with a small tilt t (rotation vector), the residual R f - dv/dt - g e3 is g (t x e3) + R b. The first part is
constant in the world frame. The second part (bias b or mounting of the accelerometer) turns with the body. Only a
change of heading separates the two.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.doctor.kinematics import (
    GRAVITY,
    UP,
    Grid,
    Track,
    Window,
    delay,
    difference,
    grid_of,
    measurements,
    origin_of,
    poses,
    rate_of_attitude,
    track,
    width_for,
)
from crazyem.doctor.regression import FEWEST_BLOCKS, SLOPE_CONFIDENCE, blocks, jackknife_error
from crazyem.physics.rotations import rotate
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording, SignalArray

REPORTED_TILT = math.radians(0.5)  # smallest reported tilt
DEGRADING_TILT = math.radians(1.5)  # tilt that degrades results
REPORTED_SENSOR_ANGLE = math.radians(2.0)  # smallest reported mounting error or bias of the accelerometer, as an angle
# least eigenvalue of the normalised normal matrix that separates tilt and bias: half the variance of the heading, rad^2
SMALLEST_EIGENVALUE = 2e-3
LARGEST_HALF_WIDTH = math.radians(0.5)  # largest 95 % half-width with which tilt and bias are reported separately


def check(recording: Recording) -> list[Finding]:
    """Findings about every attitude that can be compared with an accelerometer."""
    force = next(iter(measurements(recording, "specific_force").items()), None)
    if force is None:
        return []
    looks = [_look(recording, *pose, *force) for pose in poses(recording).items()]
    return [finding for finding in looks if finding is not None]


def _look(recording: Recording, pose: str, turning: SignalArray, name: str, array: SignalArray) -> Finding | None:
    # the velocity of the pose's origin, else the first velocity
    velocities = sorted(measurements(recording, "velocity").items(), key=lambda v: origin_of(v[0]) != origin_of(pose))
    moving = [velocity for _, velocity in velocities[:1]]
    grid = grid_of(array, turning, *moving)
    attitude = track(turning, grid)
    world = _residual(recording, attitude, array, moving, grid, max(0.5, width_for(array, turning)))
    rows = np.flatnonzero(world.valid & attitude.valid)[::5]
    if rows.size < 100:
        return None
    e, q = world.value[rows], attitude.value[rows]
    norm = float(np.median(np.linalg.norm(e + GRAVITY * UP, axis=1)))
    if not 0.7 * GRAVITY < norm < 1.3 * GRAVITY:
        return None  # not a specific force in m/s^2: another check says so
    block = blocks(grid.time[rows])
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return None
    design = _design(q, both=True)
    both, spread = _jackknife(design, e, block)
    # tilt and bias are separate only if the heading changes enough
    flat = design.reshape(-1, design.shape[2])
    flat = flat / np.linalg.norm(flat, axis=0)
    if float(np.linalg.eigvalsh(flat.T @ flat)[0]) <= SMALLEST_EIGENVALUE:
        spread = np.full_like(spread, np.inf)
    return _judge(pose, name, both, spread, _jackknife(_design(q, both=False), e, block), count)


def _residual(
    recording: Recording, attitude: Track, array: SignalArray, moving: list[SignalArray], grid: Grid, width: float
) -> Track:
    """R f - dv/dt - g e3 on the grid, smoothed; without a velocity R f - g e3."""
    window = Window(width)
    force = track(array, grid, shift=_lag(recording, attitude, array, grid))
    felt = window.mean(Track(rotate(attitude.value, force.value), attitude.valid & force.valid))
    value, valid = felt.value, felt.valid
    for velocity in moving:
        acceleration = window.mean(difference(track(velocity, grid)))
        value, valid = value - acceleration.value, valid & acceleration.valid
    return Track(value - GRAVITY * UP, valid)


def _lag(recording: Recording, attitude: Track, array: SignalArray, grid: Grid) -> float:
    """Delay of the accelerometer [s]: that of the gyro of the same stream, against the attitude; 0 if unknown."""
    for gyro in measurements(recording, "body_rate").values():
        if gyro.stream == array.stream and gyro.time.size == array.time.size:
            window = Window(0.24)
            late = delay(window.mean(rate_of_attitude(attitude)), window.mean(track(gyro, grid)))
            return 0.0 if late is None or late.at_edge or late.explained < 0.3 else late.value
    return 0.0


def _design(q: Array, *, both: bool) -> Array:
    """(n, 3, k): columns for tilt x, y (world), and bias x, y, z (body); without `both` only the tilt and bias z."""
    n = len(q)
    a = np.zeros((n, 3, 5 if both else 3))
    a[:, 0, 1], a[:, 1, 0] = GRAVITY, -GRAVITY
    for k, axis in enumerate((0, 1, 2) if both else (2,)):
        a[:, :, 2 + k] = rotate(q, np.tile(np.eye(3)[axis], (n, 1)))
    return a


def _jackknife(a: Array, e: Array, block: NDArray[np.int64]) -> tuple[Array, Array]:
    """Least squares of a x = e over rows, and standard errors by leaving out blocks."""
    parts = [(a[block == b], e[block == b]) for b in range(int(block.max()) + 1)]
    normal = np.array([np.einsum("nij,nik->jk", rows, rows) for rows, _ in parts])
    right = np.array([np.einsum("nij,ni->j", rows, rest) for rows, rest in parts])
    matrix, vector = normal.sum(axis=0), right.sum(axis=0)
    ridge = 1e-9 * np.eye(len(matrix)) * np.trace(matrix)
    left = np.array([np.linalg.solve(matrix - n + ridge, vector - r) for n, r in zip(normal, right)])
    return np.linalg.solve(matrix + ridge, vector), jackknife_error(left)


def _judge(pose: str, force: str, both: Array, spread: Array, alone: tuple[Array, Array], count: int) -> Finding | None:
    usual, sure = (float(stats.t.ppf(level, count - 1)) for level in (0.975, SLOPE_CONFIDENCE))
    tilt, error = float(np.hypot(*both[:2])), float(np.hypot(*spread[:2]))
    mount, mount_error = float(np.hypot(*both[2:4])) / GRAVITY, float(np.hypot(*spread[2:4])) / GRAVITY
    evidence = {
        "tilt_deg": math.degrees(tilt),
        "tilt_low_deg": math.degrees(max(tilt - usual * error, 0.0)),
        "tilt_high_deg": math.degrees(tilt + usual * error),
        "tilt_x_deg": math.degrees(both[0]),
        "tilt_y_deg": math.degrees(both[1]),
        "body_x_m_s2": float(both[2]),
        "body_y_m_s2": float(both[3]),
        "body_deg": math.degrees(mount),
    }
    said = f"{evidence['tilt_deg']:.2f} deg ({evidence['tilt_low_deg']:.2f} to {evidence['tilt_high_deg']:.2f})"
    if usual * max(error, mount_error) <= LARGEST_HALF_WIDTH:
        if tilt >= REPORTED_TILT and tilt > sure * error:
            grade = Grade.DEGRADES if tilt >= DEGRADING_TILT else Grade.HARMLESS
            text = f"The frame of {pose} is tilted by {said} against gravity as felt by {force}."
            advice = "Level the frame: turn positions, velocities and attitudes by the opposite rotation."
            return Finding("tilt", grade, text, pose, (), evidence, advice)
        if mount >= REPORTED_SENSOR_ANGLE and mount > sure * mount_error:
            text = (
                f"{force} and {pose} differ by {math.degrees(mount):.1f} deg in the body frame: the accelerometer has "
                f"a bias ({both[2]:.2f}, {both[3]:.2f} m/s^2 along x, y), or the pose's body frame is not the IMU's."
            )
            return Finding("tilt", Grade.HARMLESS, text, force, (), evidence, "Estimate the offset along.")
        return None
    level, level_error = alone
    total, total_error = float(np.hypot(*level[:2])), float(np.hypot(*level_error[:2]))
    if total < 2.0 * REPORTED_TILT or total <= sure * total_error:
        return None
    numbers = {"together_deg": math.degrees(total), "together_error_deg": math.degrees(total_error)}
    text = (
        f"The vertical of {pose} and gravity as felt by {force} differ by {math.degrees(total):.2f} deg: a tilted "
        "frame, or a bias of the accelerometer; the heading changed too little to tell these apart."
    )
    grade = Grade.DEGRADES if total >= 2.0 * DEGRADING_TILT else Grade.HARMLESS
    advice = "Record a flight that turns once about the vertical."
    return Finding("tilt", grade, text, pose, (), numbers, advice)
