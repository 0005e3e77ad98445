"""The load on a string as a spherical pendulum with a moving pivot: its direction, carried along the pivot's path.

The load hangs at r_O + L n, |n| = 1. With a the acceleration of the pivot and d = -c (v + L dn/dt - air) that of its
drag,

    L d2n/dt2 = (1 - n n')(g - a + d) - L |dn/dt|^2 n.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled

GRAVITY = 9.81  # m/s^2
DAMPING = 0.1  # 1/s: drag of the load over its mass
FASTEST = 200.0  # 1/s: only absurd paths swing faster


@compiled
def _slope(state, pull, velocity, air, length, out):
    """d(state)/dt; pull is gravity less the pivot's acceleration [m/s^2], velocity that of the pivot now [m/s]."""
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
def _along(gap, broken, velocity, air, length, out):
    """The swing at every row of a path; at rest, hanging, at the first of each stretch."""
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
def _each(swing, acceleration, velocity, air, step, length, out):
    """One step of each of n pendulums of their own."""
    work = np.zeros((6, 6))
    for k in range(len(swing)):
        out[k] = swing[k]
        _swing(out[k], acceleration[k], velocity[k], air[k], step[k], length, work)


def swing_along(*, gap: NDArray, broken: NDArray, velocity: NDArray, air: NDArray, length: float) -> NDArray:
    """Swing of a load at every row of the pivot's path; a row knows only rows up to itself.

    Args:
        gap: (n,) s since the row before.
        broken: (n,) whether a stretch begins, where the load hangs at rest below the drone.
        velocity, air: (n, 3) m/s of the pivot and of the air, world. The pivot's velocity is a line between rows.
        length: m.

    Returns:
        (n, 6): direction from the pivot to the load (unit, world) and its derivative [1/s].
    """
    out = np.empty((len(gap), 6))
    _along(_plain(gap), np.ascontiguousarray(broken), _plain(velocity), _plain(air), float(length), out)
    return out


def swing_on(
    swing: NDArray, *, acceleration: NDArray, velocity: NDArray, air: NDArray, step: NDArray, length: float
) -> NDArray:
    """One step of n loads of n predictions.

    Args:
        swing: (n, 6) as `swing_along` returns it.
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
