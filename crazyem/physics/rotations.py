"""Quaternions (x, y, z, w; body to world) and rotation vectors, in plain numpy.

>>> import numpy as np
>>> q = quaternion_from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))
>>> np.round(rotation_matrix(q) @ np.array([1.0, 0.0, 0.0]), 12)
array([0., 1., 0.])
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def skew(a: ArrayLike) -> NDArray:
    """Matrix of the cross product, skew(a) @ b = a x b. a: (3,) -> (3, 3)."""
    x, y, z = np.asarray(a, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def quaternion_product(p: ArrayLike, q: ArrayLike) -> NDArray:
    """Hamilton product p * q, scalar last. p, q: (..., 4) -> (..., 4)."""
    px, py, pz, pw = np.moveaxis(np.asarray(p, float), -1, 0)
    qx, qy, qz, qw = np.moveaxis(np.asarray(q, float), -1, 0)
    return np.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: ArrayLike) -> NDArray:
    """Inverse of a unit quaternion. q: (..., 4) -> (..., 4)."""
    return np.asarray(q, float) * np.array([-1.0, -1.0, -1.0, 1.0])


def quaternion_from_rotation_vector(phi: ArrayLike) -> NDArray:
    """Exponential map. phi: (..., 3) rad -> (..., 4)."""
    phi = np.asarray(phi, float)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    half_sinc = 0.5 * np.sinc(angle / (2 * np.pi))  # sin(angle / 2) / angle
    return np.concatenate([half_sinc * phi, np.cos(angle / 2)], axis=-1)


def rotation_vector_from_quaternion(q: ArrayLike) -> NDArray:
    """Logarithmic map, with an angle up to pi. q: (..., 4) -> (..., 3) rad."""
    q = np.asarray(q, float)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)


def rotate(q: NDArray, vector: NDArray, *, inverse: bool = False) -> NDArray:
    """R v, body to world, or R^T v with `inverse`. q: (n, 4) unit quaternions, vector: (n, 3) -> (n, 3)."""
    axis = -q[:, :3] if inverse else q[:, :3]
    cross = 2.0 * np.cross(axis, vector)
    return vector + q[:, 3:] * cross + np.cross(axis, cross)


def rotation_matrix(q: ArrayLike) -> NDArray:
    """Body to world. q: (..., 4) -> (..., 3, 3)."""
    q = np.asarray(q, float)
    x, y, z, w = np.moveaxis(q, -1, 0)
    matrix = np.empty((*q.shape[:-1], 3, 3))
    matrix[..., 0, 0], matrix[..., 1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    matrix[..., 2, 2] = 1 - 2 * (x * x + y * y)
    for i, j, even, odd in ((0, 1, x * y, z * w), (2, 0, x * z, y * w), (1, 2, y * z, x * w)):
        matrix[..., i, j], matrix[..., j, i] = 2 * (even - odd), 2 * (even + odd)
    return matrix


def quaternion_from_euler(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> NDArray:
    """R = Rz(yaw) Ry(pitch) Rx(roll), right-handed, rad. (...,) each -> (..., 4)."""
    cr, sr = np.cos(np.asarray(roll) / 2), np.sin(np.asarray(roll) / 2)
    cp, sp = np.cos(np.asarray(pitch) / 2), np.sin(np.asarray(pitch) / 2)
    cy, sy = np.cos(np.asarray(yaw) / 2), np.sin(np.asarray(yaw) / 2)
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def euler_from_quaternion(q: ArrayLike) -> NDArray:
    """Roll, pitch, yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll), (..., 3), of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(q), -1, 0)
    return np.stack(
        [
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        ],
        axis=-1,
    )


def axes(roll: float, pitch: float, yaw: float) -> NDArray:
    """(3, 3): Rz(yaw) Ry(pitch) Rx(roll), rad; its columns are the turned axes."""
    return rotation_matrix(quaternion_from_euler(roll, pitch, yaw))


def rotation_between(one: NDArray, other: NDArray) -> NDArray:
    """Rotation vector phi with one exp(phi) = other, |phi| up to pi. (n, 3, 3) twice -> (n, 3) rad, in axes of `one`.

    `other` may also be a linear interpolation between two rotations that are near each other.
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
    for row in np.flatnonzero(angle > 3.1):  # near half a turn the sine is too small to give the axis
        vector[row] = _near_half_turn(one[row].T @ other[row], twice[:, row], angle[row])
    return vector


def _near_half_turn(matrix: NDArray, twice_sine: NDArray, angle: float) -> NDArray:
    """Rotation vector with the axis a from the symmetric part (1 - cos) a a' + cos I, its sign from the sine."""
    outer = (matrix + matrix.T) / 2 - np.cos(angle) * np.eye(3)
    axis = outer[np.argmax(np.diag(outer))]
    axis = axis / np.linalg.norm(axis)
    return angle * (-axis if axis @ twice_sine < 0 else axis)
