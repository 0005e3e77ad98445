"""Torque errors of commands that are sampled with the same period as the onboard estimate.

A Crazyflie predicts its state estimate every 10 ms and holds it in between. So the state that its controller uses is up
to 10 ms old. In a log of the same period, the age of the state is the same at every sample. Then the logged torque is
wrong by

    J k_R d ( rate + k_v tilt + k_p velocity / g )

with d the age at the sample less the mean age (-5 to 5 ms, unknown, drifting over seconds), and controller gains that
the log does not contain. For the filter these are torques of known shape and unknown size: nuisances, estimated
together with theta by one scoring step. In logs of another period all ages occur, and the mean is right.

In five simulated quiet flights logged every 10 ms, a third to a half of the error does not have these shapes and adds
up like the rest. So the correction counts as one more standard deviation.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.estimation.em import Information, WindowEM

PERIOD = 0.010  # s, PREDICT_RATE of the firmware's estimator_kalman.c
ALIKE = 0.02  # share of a period; with a smaller difference the age of the samples is constant over seconds
FEWEST = 20  # stamps needed to find a period
AGE = 0.003  # s, standard deviation of an age that is uniform over a period
# Gains of the firmware's Lee controller (controller_lee.c), over inertia and gravity: attitude 309 1/s^2, velocity
# 4 1/s, position 7 1/s^2. Gains of other controllers are of the same size, within OTHERS.
SIZES = np.array([309.0, 309.0 * 4.0, 309.0 * 7.0 / 9.81]) * AGE  # of rate [1/s], tilt [1/s^2], velocity [1/(m s)]
OTHERS = 0.5  # standard deviation of a gain, relative to Lee's
SHAPES = 2 * len(SIZES)  # about x and y, with common sizes, and about z
# Precision of the prior of the sizes. The three sizes about x and y have one common age, so they are correlated. The
# three about z depend on more than the age of the yaw, so they are independent.
PRECISION = np.linalg.inv(
    np.block([[1.0 + OTHERS**2 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), (1.0 + OTHERS**2) * np.eye(3)]])
)
NODES = 8.0  # s between nodes of a size; the size is linear in time between nodes
MOST = 0.5  # largest correction of a logarithm (or in a unit); beyond, the model is not linear


def in_step(stamps: NDArray, period: float) -> bool:
    """Whether the period of stamps (n,) [s] is a multiple of `period` [s] of an onboard estimate (0: unknown)."""
    if len(stamps) < FEWEST or not period > 0.0:
        return False
    steps = float(np.median(np.diff(stamps))) / period
    return steps > 0.5 and abs(steps - round(steps)) < ALIKE


def corrected(em: WindowEM, first: int, last: int, information: Information) -> Information:
    """The information with `shift` and `open_sd` because of such torques; the window must have been filtered.

    A is the information of theta (prior included), C the one between theta and the sizes of the torques, B that of the
    sizes (prior included). The scoring step uses the inverse of [[A, C], [C', B]] and the score of the sizes.
    """
    setup, time = em.setup, em.tape.time[first:last]
    at = np.linspace(time[0], time[-1], max(2, 1 + round((time[-1] - time[0]) / NODES)))
    cross, among, score = em.torque_sensitivities(first, last, _shapes(em, first, last, at))
    free = np.flatnonzero(setup.free)
    n = len(free)
    a = information.matrix[np.ix_(free, free)] + np.diag(setup.prior.precision[free])
    among += np.kron(np.eye(len(at)), PRECISION)
    joint = np.linalg.inv(np.block([[a, cross[free]], [cross[free].T, among]]))
    step = np.clip(joint[:n, n:] @ score, -MOST, MOST)
    shift, open_sd = np.zeros(len(setup.free)), np.zeros(len(setup.free))
    shift[free] = step
    open_sd[free] = np.sqrt(np.maximum(np.diag(joint[:n, :n] - np.linalg.inv(a)), 0.0) + step**2)
    return replace(information, shift=shift, open_sd=open_sd)


def _shapes(em: WindowEM, first: int, last: int, at: NDArray) -> NDArray:
    """Torques (last, 3, K) after the rotor lag, for sizes of one standard deviation.

    There are torques from rate, tilt and velocity, about x and y and about z, each with a size at every time in `at`.
    """
    tape, inertia, tau = em.tape, em.parameters.theta[1:4], max(float(em.parameters.theta[4]), 1e-3)
    time = tape.time[first:last]
    turned, speed = tape.xf[first:last, 6:10], tape.xf[first:last, 3:6]
    x, y, z, w = turned.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    ahead = np.cos(yaw) * speed[:, 0] + np.sin(yaw) * speed[:, 1]
    left = np.cos(yaw) * speed[:, 1] - np.sin(yaw) * speed[:, 0]
    kinds = np.zeros((last - first, 3, SHAPES))
    turns = (tape.xf[first:last, 10:13], _turn(roll, pitch, roll), _turn(-left, ahead, roll))
    for i, turn in enumerate(turns):
        kinds[:, :2, i] = turn[:, :2] * SIZES[i]
        kinds[:, 2, len(SIZES) + i] = turn[:, 2] * SIZES[i]
    kinds *= inertia[:, None]
    # the lag: a first-order low pass with a constant step; gaps are rare
    keep = math.exp(-float(np.median(np.diff(time))) / tau)
    lagged = lfilter([1.0 - keep], [1.0, -keep], kinds, axis=0, zi=keep * kinds[:1])[0]
    hats = np.stack([np.interp(time, at, row) for row in np.eye(len(at))], 1)
    out = np.zeros((last, 3, SHAPES * len(at)))
    out[first:] = (hats[:, None, :, None] * lagged[:, :, None, :]).reshape(last - first, 3, -1)
    return out


def _turn(roll_change: NDArray, pitch_change: NDArray, roll: NDArray) -> NDArray:
    """Rotation in the body frame (n, 3) by small changes of roll and pitch (n,) [rad] at constant yaw."""
    return np.stack([roll_change, np.cos(roll) * pitch_change, -np.sin(roll) * pitch_change], 1)
