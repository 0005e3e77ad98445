"""A drone that is pushed about with a load on a rod below it: both as points in space, tied by a Lagrange multiplier.

Shares no line with the catalogue's pendulum, which knows a direction and its derivative only.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
G = 9.81


@dataclass(frozen=True)
class Hanging:
    """What came of it, at n moments.

    Attributes:
        time: (n,) s.
        position, velocity: (n, 3) of the drone, world.
        swing: (n, 6) direction from the drone to the load and its derivative.
    """

    time: Array
    position: Array
    velocity: Array
    swing: Array


def hang(
    push: Callable[[float], Array], time: Array, *, drone: float, load: float, length: float, start: Array
) -> Hanging:
    """push: (3,) N, world, on the drone, without weight; start: (6,) swing at the first moment, the drone at rest."""

    def slope(t: float, state: Array) -> Array:
        p, v, q, u = state.reshape(4, 3)
        apart, moving = q - p, u - v
        drone_free = push(t) / drone - [0, 0, G]
        load_free = -0.1 * u - [0, 0, G]
        # along the rod: apart . (a_load - a_drone) = -|moving|^2
        pull = (apart @ (load_free - drone_free) + moving @ moving) / (apart @ apart * (1 / load + 1 / drone))
        return np.concatenate([v, drone_free + pull * apart / drone, u, load_free - pull * apart / load])

    n, turning = start[:3], start[3:]
    begin = np.concatenate([[0, 0, 2], np.zeros(3), [0, 0, 2] + length * n, length * turning])
    y = solve_ivp(slope, (time[0], time[-1]), begin, t_eval=time, rtol=1e-10, atol=1e-12).y.T
    swing = np.concatenate([y[:, 6:9] - y[:, :3], y[:, 9:] - y[:, 3:6]], axis=1) / length
    return Hanging(time, y[:, :3], y[:, 3:6], swing)


def tilted(angle: float) -> Array:
    """(6,) a load at rest, `angle` rad from below towards x."""
    return np.array([np.sin(angle), 0, -np.cos(angle), 0, 0, 0])
