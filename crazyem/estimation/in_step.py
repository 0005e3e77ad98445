"""Commands that are sampled in step with the onboard estimate: by how much inertia may be off, counted as uncertainty.

A Crazyflie predicts its estimate every 10 ms and lets it stand still in between. What its controller answers to is
therefore up to 10 ms old, and a log of the same period finds it always equally old: the logged torque is off by

    J k_R d ( rate + k_v tilt + k_p velocity / g )

with the age d of the sample less the mean age (-5 to 5 ms, unknown, drifting over seconds) and gains of the controller
that the log does not tell. For the filter these are three torques of known shape and unknown size: nuisance parameters,
whose posterior is found together with that of theta by one scoring step. Logs of another period visit every age, and
the mean is right.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation import kernels
from crazyem.estimation.em import Information, WindowEM

PERIOD = 0.010  # s, PREDICT_RATE of the firmware's estimator_kalman.c
ALIKE = 0.02  # of a period, within which a log keeps its step with it for seconds
FEWEST = 20  # stamps that tell a period
AGE = 0.003  # s, standard deviation of an age that is even over a period
# Lee's gains of the firmware (controller_lee.c), over inertia and gravity: attitude 309 1/s^2, velocity 4 1/s, position
# 7 1/s^2. Those of the other controllers are of the same size.
SIZES = np.array([309.0, 309.0 * 4.0, 309.0 * 7.0 / 9.81]) * AGE  # of rate [1/s], tilt [1/s^2], velocity [1/(m s)]

MOST = 0.5  # of a logarithm (or a unit) that one step may correct: beyond, the model is not linear


def in_step(stamps: NDArray) -> bool:
    """Whether commands with these stamps (n,) [s] stay in step with the onboard estimate."""
    if len(stamps) < FEWEST:
        return False
    steps = float(np.median(np.diff(stamps))) / PERIOD
    return steps > 0.5 and abs(steps - round(steps)) < ALIKE


def corrected(em: WindowEM, first: int, last: int, information: Information) -> Information:
    """The same information with the unknown torques as nuisance parameters; the window must have been filtered.

    With score s and information A of theta (prior included), C between theta and the sizes of the torques, and B of
    these, the block of theta in the inverse of [[A, C], [C', B + 1]] replaces the inverse of A, and the step that the
    score of the sizes asks for is what theta is off by.
    """
    setup = em.setup
    cross, among, score = _nuisance(em, first, last)
    free = np.flatnonzero(setup.free)
    a = information.matrix[np.ix_(free, free)] + np.diag(setup.prior.precision[free])
    c = cross[free]
    joint = np.linalg.inv(np.block([[a, c], [c.T, among + np.eye(len(among))]]))
    n = len(free)
    added = np.zeros_like(information.covariance)
    added[np.ix_(free, free)] = joint[:n, :n] - np.linalg.inv(a)
    shift = np.zeros(len(setup.free))
    shift[free] = np.clip(joint[:n, n:] @ score, -MOST, MOST)
    return replace(information, covariance=information.covariance + added, shift=shift)


def _shapes(em: WindowEM, first: int, last: int) -> list[NDArray]:
    """Torques (last, 3) for one unit of rate, tilt and velocity, through the rotor lag."""
    tape, inertia, tau = em.tape, em.parameters.theta[1:4], max(float(em.parameters.theta[4]), 1e-3)
    x, y, z, w = tape.xf[first:last, 6:10].T
    up = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])  # the vertical, seen by the body
    v = tape.xf[first:last, 3:6].T
    side = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])  # body y, seen by the world
    ahead = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    zero = np.zeros_like(x)
    signals = np.stack(
        [
            tape.xf[first:last, 10:13].T,
            np.stack([-up[1], up[0], zero]),
            np.stack([np.sum(side * v, 0), -np.sum(ahead * v, 0), zero]),
        ]
    )
    steps = np.diff(tape.time[first:last], prepend=tape.time[first])
    keep = np.exp(-np.clip(steps, 0.0, 0.1) / tau)
    lagged = signals.copy()
    for k in range(1, last - first):
        lagged[:, :, k] = signals[:, :, k - 1] + (lagged[:, :, k - 1] - signals[:, :, k - 1]) * keep[k]
    out = []
    for shape in lagged:
        torque = np.zeros((last, 3))
        torque[first:] = (shape * inertia[:, None]).T
        out.append(torque)
    return out


def _nuisance(em: WindowEM, first: int, last: int) -> tuple[NDArray, NDArray, NDArray]:
    """Information between theta (9,) and the sizes (3,), among these, and their score: (9, 3), (3, 3), (3,).

    By the kernels' derivatives, a torque standing in for that by lag or by delay.
    """
    tape, unit, lag = em.tape, em.setup.unit[kernels.DELAY], max(float(em.parameters.theta[kernels.LAG]), 1e-9)
    torques = [size * torque for size, torque in zip(SIZES, _shapes(em, first, last), strict=True)]
    kept = tape.score[first:last].copy()
    names = ("thrust_tau", "torque_tau", "thrust_delay", "torque_delay")
    own = [getattr(tape, name) for name in names]
    none = np.zeros_like(own[0])
    of_lag, of_delay = (own[0], own[1]), (own[2] * (unit / lag), own[3] * (unit / lag))
    cross, among, score = np.zeros((kernels.PARAMETERS, 3)), np.zeros((3, 3)), np.zeros(3)

    def derivatives(other: tuple[NDArray, NDArray], torque: NDArray) -> NDArray:
        for name, value in zip(names, (*other, none, torque / unit), strict=True):
            setattr(tape, name, value)
        return em.sensitivities(first, last)

    try:
        for i, torque in enumerate(torques):
            matrix = derivatives(of_lag, torque)
            cross[:, i], among[i, i] = matrix[kernels.DELAY], matrix[kernels.DELAY, kernels.DELAY]
            score[i] = tape.score[first:last, kernels.DELAY].sum()
            cross[kernels.DELAY, i] = derivatives(of_delay, torque)[kernels.LAG, kernels.DELAY]
            for j in range(i):
                matrix = derivatives((none, torques[j] / lag), torque)
                among[i, j] = among[j, i] = matrix[kernels.LAG, kernels.DELAY]
    finally:
        for name, value in zip(names, own, strict=True):
            setattr(tape, name, value)
        tape.score[first:last] = kept
    return cross, among, score
