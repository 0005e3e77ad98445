"""The window that every contender of the speed comparison gets: samples, inputs, prior, parameters; plain arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Window:
    """One window of a flight, with all inputs of an extended Kalman smoother.

    Attributes:
        time: (n,) s.
        y: (n, 13) measurements: position [m], velocity [m/s] world; quaternion x y z w; body rate [rad/s] FLU.
        thrust: (n,) mean thrust over the step that ends at each sample [N]. torque: (n, 3) the same [N m], FLU.
        prior: (13,) state before the first measurement. prior_cov: (12, 12) of its error (attitude in the body frame).
        mass: kg. inertia: (3, 3) kg m^2.
        q: (6,) variances per second of specific and angular impulses, body frame. r: (12,) measurement variances.
    """

    time: NDArray
    y: NDArray
    thrust: NDArray
    torque: NDArray
    prior: NDArray
    prior_cov: NDArray
    mass: float
    inertia: NDArray
    q: NDArray
    r: NDArray


def euler_from_quaternion(q: NDArray) -> NDArray:
    """Roll, pitch, yaw [rad] (rotations about z, then y, then x) of quaternions (..., 4) x y z w."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ],
        -1,
    )


def euler_rates(euler: NDArray) -> NDArray:
    """Matrices (n, 3, 3) from body rates to the derivatives of roll, pitch, yaw (n, 3)."""
    (roll, pitch, _), n = euler.T, len(euler)
    out = np.zeros((n, 3, 3))
    out[:, 0, 0] = 1.0
    out[:, 0, 1], out[:, 0, 2] = np.sin(roll) * np.tan(pitch), np.cos(roll) * np.tan(pitch)
    out[:, 1, 1], out[:, 1, 2] = np.cos(roll), -np.sin(roll)
    out[:, 2, 1], out[:, 2, 2] = np.sin(roll) / np.cos(pitch), np.cos(roll) / np.cos(pitch)
    return out


def rotation(euler: NDArray) -> NDArray:
    """Rotation matrices (n, 3, 3), body to world, of roll, pitch, yaw (n, 3)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(euler.T), np.cos(euler.T)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def euler_measurements(window: Window) -> NDArray:
    """Measurements (n, 12) with roll, pitch, yaw [rad] in place of the quaternion, for peers without manifolds."""
    return np.concatenate([window.y[:, :6], euler_from_quaternion(window.y[:, 6:10]), window.y[:, 10:13]], axis=1)


def euler_prior(window: Window) -> tuple[NDArray, NDArray]:
    """Prior mean (12,) and covariance (12, 12) with roll, pitch, yaw in place of the attitude error."""
    euler = euler_from_quaternion(window.prior[6:10])
    turn = np.eye(12)
    turn[6:9, 6:9] = euler_rates(euler[None])[0]
    mean = np.concatenate([window.prior[:6], euler, window.prior[10:13]])
    return mean, turn @ window.prior_cov @ turn.T
