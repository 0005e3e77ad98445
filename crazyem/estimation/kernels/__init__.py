"""Compiled inner loops of the estimator: Kalman filter, smoother, statistics, sensitivities, noise information.

All matrices are 12 x 12 or smaller, so everything is explicit loops over contiguous rows. Every measured
quantity is one component of the error state (position, velocity, attitude error, body rate), so measurements
enter one scalar at a time and no matrix is ever inverted. The smoother is the modified Bryson-Frazier
recursion: it gives the smoothed moments of Rauch-Tung-Striebel (benchmarks/reference.py is that, in textbook form; the
tests compare them), and yields the smoothed process noise, all that the M-step needs, without inverting the
prediction covariance.

State arrays hold 13 numbers: position (3) m world, velocity (3) m/s world, quaternion x y z w (4) body to
world, body rate (3) rad/s FLU. Noise intensities `q` (6,) are in units of acceleration: variance per second of
specific-impulse x y z [(m/s)^2/s] and angular-velocity impulse x y z [(rad/s)^2/s], body frame. `r` (12,) are
measurement variances."""

from crazyem.estimation.kernels.filter import forward
from crazyem.estimation.kernels.layout import (
    AXIS,
    AXIS_SIZE,
    BRIDGE,
    COUNT,
    DELAY,
    IMPULSE,
    IMPULSE_SEEN,
    LAG,
    MASS,
    MEASURED,
    OFFSET,
    PARAMETERS,
    RESIDUAL,
    RESIDUAL_SEEN,
    SIZE,
)
from crazyem.estimation.kernels.noise import noise_information
from crazyem.estimation.kernels.sensitivity import sensitivities, torque_sensitivities
from crazyem.estimation.kernels.smoother import backward, total

__all__ = [
    "AXIS",
    "AXIS_SIZE",
    "BRIDGE",
    "COUNT",
    "DELAY",
    "IMPULSE",
    "IMPULSE_SEEN",
    "LAG",
    "MASS",
    "MEASURED",
    "OFFSET",
    "PARAMETERS",
    "RESIDUAL",
    "RESIDUAL_SEEN",
    "SIZE",
    "backward",
    "forward",
    "noise_information",
    "sensitivities",
    "torque_sensitivities",
    "total",
]
