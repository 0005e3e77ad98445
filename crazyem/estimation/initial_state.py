"""Initial state of a stretch of flight without a measured attitude, smoothed from all later samples.

At a break the attitude is uncertain by a third of a radian. The filter linearises around the first guess and the first
noisy samples. At such angles the vertical share of the thrust is cos, not 1, so the mass comes out too large by the
variance of the angle (0.35 standard deviations in 96 windows of 4 s, little process noise). So the first state is
smoothed from all later samples, and the filter starts there. Its start covariance is that of a small share of the same
data: small, so that the data hardly count twice, and large enough for a linear model to hold."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from crazyem.compiled import compiled
from crazyem.estimation.em import WindowEM
from crazyem.estimation.kernels.algebra import apply_transposed
from crazyem.estimation.tape import BREAK, START_VARIANCE
from crazyem.physics.rotations import quaternion_from_rotation_vector, quaternion_product

SMOOTHING_ITERATIONS = 4  # at most
START_INFORMATION_SHARE = 0.03  # share of the window's information on its first state that the start gets
SETTLED_ANGLE = 1e-3  # rad; with a smaller change of the initial attitude the iteration ends


@compiled
def smoothed_error(first, last, time, kind, lead, gain, s, e, blocks, pf, covariance):
    """Smoothed error (12,) of the filtered state at `first`, by all samples up to last - 1 or to the next break.

    `covariance` (12, 12) receives the smoothed covariance (modified Bryson and Frazier, as in `kernels.backward`).
    """
    lam = np.zeros((12, 1))
    back = np.zeros((12, 1))
    big = np.zeros((12, 12))
    half = np.empty((12, 12))
    turned = np.empty((12, 12))
    column = np.empty(12)
    for k in range(last - 1, first, -1):
        if kind[k] == 1:
            lam[:] = 0.0
            big[:] = 0.0
            continue
        for i in range(11, -1, -1):
            if s[k, i] == 0.0:
                continue
            pull = e[k, i] / s[k, i]
            both = 1.0 / s[k, i]
            for j in range(12):
                pull += gain[k, i, j] * lam[j, 0]
                column[j] = 0.0
                for m in range(12):
                    column[j] += big[j, m] * gain[k, i, m]
                both += gain[k, i, j] * column[j]
            lam[i, 0] -= pull
            for j in range(12):
                big[i, j] -= column[j]
                big[j, i] -= column[j]
            big[i, i] += both
        dt = time[k] - time[k - 1]
        apply_transposed(blocks[k], dt, lead * dt, lam, back)
        lam[:] = back
        apply_transposed(blocks[k], dt, lead * dt, big, half)
        turned[:] = half.T
        apply_transposed(blocks[k], dt, lead * dt, turned, big)
    error = np.zeros(12)
    for i in range(12):
        for j in range(12):
            error[i] -= pf[first, i, j] * lam[j, 0]
    covariance[:] = pf[first] - pf[first] @ big @ pf[first]
    return error


def starts_without_attitude(em: WindowEM, first: int) -> bool:
    """Whether row `first` is a break without a measured attitude."""
    return bool(em.tape.kind[first] == BREAK and np.isnan(em.tape.y[first, 6]))


def find(em: WindowEM, first: int, last: int) -> None:
    """Set the state at row `first` to its smoothed value, with a small share of the information; filters the window."""
    t = em.tape
    vague = np.diag(1.0 / START_VARIANCE)
    covariance = np.empty((12, 12))
    for _ in range(SMOOTHING_ITERATIONS):
        em.forward(first, last, restart=True)
        error = smoothed_error(
            first, last, t.time, t.kind, em.setup.lead, t.gain, t.s, t.e, t.blocks, t.pf, covariance
        )  # fmt: skip
        before = np.linalg.inv(t.pp[first])
        start = _turned(t.xf[first], error)
        moved = np.linalg.norm(start[6:10] - t.xp[first, 6:10])
        seen = np.linalg.inv(covariance) - before  # information of the data on the start
        t.xp[first] = start
        t.pp[first] = np.linalg.inv(vague + START_INFORMATION_SHARE * 0.5 * (seen + seen.T))
        if moved < SETTLED_ANGLE:
            break


def _turned(state: np.ndarray, error: np.ndarray) -> np.ndarray:
    out = state.copy()
    out[:6] += error[:6]
    out[6:10] = quaternion_product(state[6:10], quaternion_from_rotation_vector(error[6:9]))
    out[10:13] += error[9:12]
    return out


@contextmanager
def known_initial_state(em: WindowEM, first: int, last: int) -> Iterator[Callable[[], None]]:
    """Within the context, a window that begins without an attitude starts at its smoothed initial state.

    Yields a function that smooths the initial state again, with better parameters.
    """
    if not starts_without_attitude(em, first):
        yield lambda: None
        return
    em.tape.kind[first] = 0  # the filter now takes the prior on the tape
    try:
        find(em, first, last)
        yield lambda: find(em, first, last)
    finally:
        em.tape.kind[first] = BREAK
