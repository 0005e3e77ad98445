"""A load on a string as a spherical pendulum with a moving pivot: its swing along the path of the pivot.

The load is at r_O + L n, |n| = 1. With a the acceleration of the pivot and d = -c (v + L dn/dt - air) the acceleration
of the load by its drag,

    L d2n/dt2 = (1 - n n')(g - a + d) - L |dn/dt|^2 n.

In strongly excited flights a driven pendulum is chaotic: small differences of start or path grow large in some seconds.
So the swing is the state of a separate extended Kalman filter (`watched_along`), which measures the pull of the load.
The swing of a step uses the pull in earlier steps only, so it is a prediction.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled

GRAVITY = 9.81  # m/s^2
DAMPING = 0.1  # 1/s, drag coefficient of the load over its mass
FASTEST = 200.0  # 1/s, largest rate of the swing; only impossible paths give more
# m/sqrt(s), process noise of the swing: the velocity of a filtered path changes by an error of 1 cm/s in 10 ms.
WANDERING = 1e-3
HANGING = 0.1  # rad, standard deviation of the angle at the start of a stretch, and of its rate over sqrt(g/L)


@compiled
def _slope(state, pull, velocity, air, length, out):
    """Write d(state)/dt to out; pull: gravity less the pivot's acceleration [m/s^2], velocity: of the pivot [m/s]."""
    along = 0.0
    speed = 0.0
    for i in range(3):
        out[3 + i] = pull[i] - DAMPING * (velocity[i] + length * state[3 + i] - air[i])
        along += state[i] * out[3 + i]
        speed += state[3 + i] * state[3 + i]
    for i in range(3):
        out[i] = state[3 + i]
        out[3 + i] = (out[3 + i] - along * state[i]) / length - speed * state[i]


@compiled
def _straighten(state):
    """Remove integration errors: unit length of the direction, derivative normal to it and up to `FASTEST`."""
    size = np.sqrt(state[0] * state[0] + state[1] * state[1] + state[2] * state[2])
    along = 0.0
    for i in range(3):
        state[i] /= size
        along += state[i] * state[3 + i]
    speed = 0.0
    for i in range(3):
        state[3 + i] -= along * state[i]
        speed += state[3 + i] * state[3 + i]
    if speed > FASTEST * FASTEST:
        for i in range(3):
            state[3 + i] *= FASTEST / np.sqrt(speed)


@compiled
def _swing(state, acceleration, velocity, air, step, length, work):
    """Carry state (6,) over one step with constant acceleration of the pivot, in place. work: (6, 6)."""
    pull = work[5, :3]
    now = work[5, 3:]
    for i in range(3):
        pull[i] = -acceleration[i]
    pull[2] -= GRAVITY
    strength = np.sqrt(pull[0] * pull[0] + pull[1] * pull[1] + pull[2] * pull[2])
    turning = np.sqrt(state[3] * state[3] + state[4] * state[4] + state[5] * state[5])
    parts = int(min(100.0, 1.0 + step * 5.0 * max(np.sqrt(strength / length), turning)))
    h = step / parts
    for part in range(parts):
        for stage in range(4):
            reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            for i in range(3):
                now[i] = velocity[i] + acceleration[i] * (part * h + reach)
            for i in range(6):
                work[4, i] = state[i] + (reach * work[stage - 1, i] if stage > 0 else 0.0)
            _slope(work[4], pull, now, air, length, work[stage])
        for i in range(6):
            state[i] += h / 6.0 * (work[0, i] + 2.0 * work[1, i] + 2.0 * work[2, i] + work[3, i])
        _straighten(state)


@compiled
def _along(gap, broken, velocity, air, length, out):
    """Swing at every row of a path; at the first row of a stretch the load hangs at rest."""
    work = np.zeros((6, 6))
    state = np.zeros(6)
    acceleration = np.zeros(3)
    for k in range(len(gap)):
        if broken[k]:
            state[:] = 0.0
            state[2] = -1.0
        else:
            for i in range(3):
                acceleration[i] = (velocity[k, i] - velocity[k - 1, i]) / gap[k]
            _swing(state, acceleration, velocity[k - 1], air[k], gap[k], length, work)
        out[k] = state


@compiled
def _slopes(state, pull, velocity, air, length, out):
    """Derivative (6, 6) of d(state)/dt by the state; arguments as in `_slope`."""
    along = speed = 0.0
    for i in range(3):
        along += state[i] * (pull[i] - DAMPING * (velocity[i] + length * state[3 + i] - air[i]))
        speed += state[3 + i] * state[3 + i]
    for i in range(3):
        for j in range(3):
            same = 1.0 if i == j else 0.0
            across = same - state[i] * state[j]
            drawn_j = pull[j] - DAMPING * (velocity[j] + length * state[3 + j] - air[j])
            out[i, j] = 0.0
            out[i, 3 + j] = same
            out[3 + i, j] = -(along * same + state[i] * drawn_j) / length - speed * same
            out[3 + i, 3 + j] = -DAMPING * across - 2.0 * state[i] * state[3 + j]


@compiled
def _both_sides(a, cov, half):
    """cov = a cov a' for (6, 6), in place; half: (6, 6) scratch. cov is symmetric."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += a[i, k] * cov[k, j]
            half[i, j] = total
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += half[i, k] * a[j, k]
            cov[i, j] = total
            cov[j, i] = total


@compiled
def _spread(cov, slopes, gap, after, length, phi, half):
    """Carry the covariance (6, 6) over a step, in place; slopes at its begin, swing `after` the step.

    phi, half: (6, 6) scratch. The upper half of the slopes is (0, 1), so only the lower half is multiplied out.
    """
    square = 0.5 * gap * gap
    for i in range(3):
        for j in range(6):
            twice = 0.0
            for m in range(6):
                twice += slopes[3 + i, m] * slopes[m, j]
            phi[i, j] = gap * slopes[i, j] + square * slopes[3 + i, j]
            phi[3 + i, j] = gap * slopes[3 + i, j] + square * twice
        phi[i, i] += 1.0
        phi[3 + i, 3 + i] += 1.0
    _both_sides(phi, cov, half)
    for i in range(3):
        cov[i, i] += gap * (WANDERING / length) ** 2
    phi[:] = 0.0
    for i in range(3):
        for j in range(3):
            phi[i, j] = phi[3 + i, 3 + j] = (1.0 if i == j else 0.0) - after[i] * after[j]
    _both_sides(phi, cov, half)  # no variance along the string: its length is constant


@compiled
def _corrected(state, cov, velocity, air, length, share, rotation, free, shown, noise, gap, scratch):
    """Kalman update of the swing and its covariance by the measured pull of a step, in place.

    The pull is share (n.(d - f) + L |dn/dt|^2) n, body axes. scratch: (6, 6).
    """
    drag, row, change, shows = scratch[0, :3], scratch[1], scratch[2], scratch[3]
    change[:] = 0.0
    taut = 0.0
    for i in range(3):
        force = 0.0
        for j in range(3):
            force += rotation[i, j] * free[j]
        drag[i] = -DAMPING * (velocity[i] + length * state[3 + i] - air[i]) - force
        taut += state[i] * drag[i] + length * state[3 + i] * state[3 + i]
    for axis in range(3):
        if not np.isfinite(shown[axis]):
            continue
        along = 0.0
        for i in range(3):
            along += rotation[i, axis] * state[i]
        missed = shown[axis] - free[axis] - share * taut * along
        spread = noise[axis] * noise[axis] / gap
        for i in range(3):
            shows[i] = share * (taut * rotation[i, axis] + along * drag[i])
            shows[3 + i] = share * along * 2.0 * length * state[3 + i]
        for i in range(6):
            row[i] = 0.0
            missed -= shows[i] * change[i]
            for j in range(6):
                row[i] += cov[i, j] * shows[j]
            spread += shows[i] * row[i]
        if not spread > 0.0:  # no variance
            continue
        for i in range(6):
            change[i] += row[i] / spread * missed
            for j in range(6):
                cov[i, j] -= row[i] * row[j] / spread
    for i in range(6):
        state[i] += change[i]
        for j in range(i):
            cov[i, j] = cov[j, i] = 0.5 * (cov[i, j] + cov[j, i])
    _straighten(state)


@compiled
def _watched(gap, broken, velocity, air, length, share, rotation, free, shown, noise, out):
    """As `_along`, with corrections by the measured pull; see `watched_along`."""
    work = np.zeros((6, 6))
    state, before = np.zeros(6), np.zeros(6)
    acceleration, pull = np.zeros(3), np.zeros(3)
    cov, slopes, phi = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    swinging = np.sqrt(GRAVITY / length)
    for k in range(len(gap)):
        if broken[k]:
            state[:] = 0.0
            state[2] = -1.0
            cov[:] = 0.0
            for i in range(2):
                cov[i, i] = HANGING**2
                cov[3 + i, 3 + i] = (HANGING * swinging) ** 2
            out[k] = state
            continue
        for i in range(3):
            acceleration[i] = (velocity[k, i] - velocity[k - 1, i]) / gap[k]
            pull[i] = -acceleration[i]
        pull[2] -= GRAVITY
        before[:] = state
        _swing(state, acceleration, velocity[k - 1], air[k], gap[k], length, work)
        out[k] = state  # before the update: the pull of this step is known only after it
        _slopes(before, pull, velocity[k - 1], air[k], length, slopes)
        _spread(cov, slopes, gap[k], state, length, phi, work)
        _corrected(state, cov, velocity[k], air[k], length, share, rotation[k], free[k], shown[k], noise, gap[k], work)


@compiled
def _each(swing, acceleration, velocity, air, step, length, out):
    """One step of each of n independent pendulums."""
    work = np.zeros((6, 6))
    for k in range(len(swing)):
        out[k] = swing[k]
        _swing(out[k], acceleration[k], velocity[k], air[k], step[k], length, work)


def swing_along(*, gap: NDArray, broken: NDArray, velocity: NDArray, air: NDArray, length: float) -> NDArray:
    """Swing of a load at every row of the pivot's path; a row depends only on rows up to itself.

    Args:
        gap: (n,) s since the row before.
        broken: (n,) bool, whether a stretch begins, where the load hangs at rest below the drone.
        velocity, air: (n, 3) m/s of the pivot and of the air, world. The pivot's velocity is linear between rows.
        length: m.

    Returns:
        (n, 6): direction from the pivot to the load (unit, world) and its derivative [1/s].
    """
    out = np.empty((len(gap), 6))
    _along(_plain(gap), np.ascontiguousarray(broken), _plain(velocity), _plain(air), float(length), out)
    return out


def watched_along(
    *, gap: NDArray, broken: NDArray, velocity: NDArray, air: NDArray, length: float, share: float,
    rotation: NDArray, free: NDArray, shown: NDArray, noise: NDArray,
) -> NDArray:  # fmt: skip
    """As `swing_along`, corrected row by row by the measured pull of the load in earlier rows.

    Args:
        gap, broken, velocity, air, length: as in `swing_along`.
        share: mass of the load over that of drone and load.
        rotation: (n, 3, 3) body to world.
        free: (n, 3) m/s^2, body: specific force over the steps, without the load.
        shown: (n, 3) m/s^2, body: measured specific force; NaN where unknown.
        noise: (3,) m/s^2 sqrt(s): intensity of the random part of the measured force.
    """
    out = np.empty((len(gap), 6))
    _watched(
        _plain(gap), np.ascontiguousarray(broken), _plain(velocity), _plain(air), float(length), float(share),
        _plain(rotation), _plain(free), _plain(shown), _plain(noise), out,
    )  # fmt: skip
    return out


def swing_on(
    swing: NDArray, *, acceleration: NDArray, velocity: NDArray, air: NDArray, step: NDArray, length: float
) -> NDArray:
    """Swing (n, 6) after one step of n loads in n predictions.

    Args:
        swing: (n, 6) before the step, as `swing_along` returns it.
        acceleration: (n, 3) m/s^2 of the pivot, world, gravity included; constant over the step.
        velocity: (n, 3) m/s of the pivot at the begin of the step, world. air: (n, 3) m/s.
        step: (n,) s.
        length: m.
    """
    out = np.empty((len(swing), 6))
    _each(_plain(swing), _plain(acceleration), _plain(velocity), _plain(air), _plain(step), float(length), out)
    return out


def _plain(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, dtype=np.float64)
