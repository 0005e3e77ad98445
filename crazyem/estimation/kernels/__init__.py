"""Compiled inner loops of the estimator: Kalman filter, smoother, statistics, sensitivities, noise information.

All matrices are 12 x 12 or smaller, so the code is explicit loops over contiguous rows. Every measured quantity is one
component of the error state (position, velocity, attitude error, body rate). So measurements enter one scalar at a
time, and no matrix is inverted. The smoother is the modified Bryson-Frazier recursion. It gives the same smoothed
moments as Rauch-Tung-Striebel (benchmarks/reference.py has the textbook form; the tests compare them). It also gives
the smoothed process noise, which the M-step needs, without inverting the prediction covariance.

The model is the rigid body: position p [m, world], velocity v [m/s, world], attitude q (x, y, z, w; body to world),
body rate w [rad/s, FLU]. Errors are 12-vectors (dp, dv, dtheta, dw) with q_true = q * exp(dtheta): the attitude error
is in the body frame. One step of length dt with mean thrust F and mean torque M over the step, and random impulses u of
specific force and angular acceleration (body frame), with h = lead dt:

    a  = R(q exp(h w)) (e3 F/m + u_v/dt) - g e3             v' = v + dt a
    al = I^-1 (M - w x I w) + u_w/dt                        w' = w + dt al
    p' = p + dt v + h dt a                                  q' = q exp(dt w + h dt al)

`lead` is a fraction of a step: the velocities that move position and attitude, and the attitude that turns the force,
are taken at this time after the start of the step. Real flights use 1/2, the midpoint rule, second order in dt. The
others are for data of simulators: 0 is explicit Euler (Zhao eq. 56), 1 is semi-implicit Euler. There the discrete
motion is exact, and no noise acts within a step. For the midpoint rule, the integral of a Brownian motion given both
its ends adds dt^3/12 times its intensity to the covariance of position and attitude.

With explicit Euler, dt times their derivatives are added to roll, pitch and yaw (Zhao eq. 47), as in such simulators.
The result differs from q exp(dt w) by terms in dt^2, which matter at low noise. Where pitch is within 3 degrees of a
right angle, these derivatives are unbounded, and q exp(dt w) is used.

Noise enters through force and torque only (Zhao eq. 55), so its covariance has rank 6, not 12; in units of
acceleration it does not depend on mass and inertia.

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
