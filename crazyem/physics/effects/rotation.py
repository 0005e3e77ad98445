"""Rotations of many moments at once, for what sensors show: axes from angles, and the rotation between attitudes."""

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.rotations import quaternion_from_euler, rotation_matrix


def axes(roll: float, pitch: float, yaw: float) -> NDArray:
    """(3, 3): Rz(yaw) Ry(pitch) Rx(roll), rad; its columns are the turned axes."""
    return rotation_matrix(quaternion_from_euler(roll, pitch, yaw))


def rotation_between(one: NDArray, other: NDArray) -> NDArray:
    """log(one' other), the shorter way round: one exp(it) = other. (n, 3, 3) twice -> (n, 3) rad, in axes of `one`.

    `other` may also be a point on the chord between two rotations that are near each other.
    """
    a, b = (np.ascontiguousarray(np.asarray(m, float).transpose(2, 1, 0)) for m in (one, other))  # column, component, n

    def element(i: int, j: int) -> NDArray:
        return a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]

    twice = np.stack([element(2, 1) - element(1, 2), element(0, 2) - element(2, 0), element(1, 0) - element(0, 1)])
    trace = element(0, 0) + element(1, 1) + element(2, 2)
    sine = 0.5 * np.sqrt((twice**2).sum(0))
    angle = np.arctan2(sine, 0.5 * (trace - 1))
    small = sine < 1e-9
    vector = (twice * np.where(small, 0.5, angle / np.where(small, 2.0, 2 * sine))).T
    for row in np.flatnonzero(angle > 3.1):  # near half a turn the sine does not show the axis any more
        vector[row] = _near_half_turn(one[row].T @ other[row], twice[:, row], angle[row])
    return vector


def _near_half_turn(matrix: NDArray, twice_sine: NDArray, angle: float) -> NDArray:
    """The axis from the symmetric part, (1 - cos) a a' + cos; its sign from the sine. (3, 3), (3,), rad -> (3,) rad."""
    outer = (matrix + matrix.T) / 2 - np.cos(angle) * np.eye(3)
    axis = outer[np.argmax(np.diag(outer))]
    axis = axis / np.linalg.norm(axis)
    return angle * (-axis if axis @ twice_sine < 0 else axis)
