"""A manoeuvre as a sum of a few harmonics on each axis with a smooth window: it starts and ends in hover.

Each of x, y, z and yaw is q(t) = w(t) sum_k (c_k cos 2 pi f_k t + s_k sin 2 pi f_k t), with the window w of
`trajectories.window`: position, velocity, acceleration and jerk are zero at both ends.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.control.trajectories import Reference, Trajectory, Vector, reference_about, step_polynomials

AXES = ("x", "y", "z", "yaw")


@dataclass(frozen=True)
class Axis:
    """One axis: frequency (k,) Hz; cosine, sine (k,) m, or rad for yaw."""

    frequency: tuple[float, ...] = ()
    cosine: tuple[float, ...] = ()
    sine: tuple[float, ...] = ()


@dataclass(frozen=True)
class Harmonics:
    """A manoeuvre about the hover point.

    Attributes:
        duration: s.
        ramp: s to reach full amplitude, and to return to rest.
        axes: x, y, z, yaw.
    """

    duration: float
    ramp: float
    axes: tuple[Axis, Axis, Axis, Axis]

    def derivatives(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement and its first three derivatives at `time` (n,) s: (4 orders, n, 4 axes), m and rad, SI.

        Times outside [0, duration] give the state at the ends, which is at rest.
        """
        t = np.clip(np.asarray(time, float), 0.0, self.duration)
        weight = self._window(t)
        out = np.zeros((4, t.size, 4))
        for i, axis in enumerate(self.axes):
            if not axis.frequency:
                continue
            rate = 2.0 * math.pi * np.array(axis.frequency)
            c, s = np.cos(np.outer(t, rate)), np.sin(np.outer(t, rate))
            a, b = np.array(axis.cosine), np.array(axis.sine)
            # d/dt (a cos + b sin) = rate (b cos - a sin)
            q = np.empty((4, t.size))
            for order in range(4):
                q[order] = c @ a + s @ b
                a, b = rate * b, -rate * a
            for order in range(4):  # product rule
                out[order, :, i] = sum(math.comb(order, k) * weight[order - k] * q[k] for k in range(order + 1))
        return out

    def _window(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """(4, n): weight and its first three derivatives (as `trajectories.smooth_step`)."""
        ramp = min(self.ramp, self.duration / 2)
        rising = t <= self.duration / 2
        x = np.minimum(np.where(rising, t, self.duration - t) / ramp, 1.0)
        w = np.array(step_polynomials(x))
        sign = np.where(rising, 1.0, np.array([1.0, -1.0, 1.0, -1.0])[:, None])
        slopes: NDArray[np.float64] = w * np.array([1.0, 1.0 / ramp, ramp**-2.0, ramp**-3.0])[:, None] * sign
        return slopes

    def scaled(self, share: float) -> "Harmonics":
        """All amplitudes times `share`."""
        axes = tuple(
            replace(a, cosine=tuple(share * c for c in a.cosine), sine=tuple(share * s for s in a.sine))
            for a in self.axes
        )
        return replace(self, axes=(axes[0], axes[1], axes[2], axes[3]))

    def trajectory(self, position: Vector, yaw: float, name: str = "plan") -> Trajectory:
        """The manoeuvre about `position` [m, world]; its x axis points along the heading `yaw` [rad]."""
        c, s = math.cos(yaw), math.sin(yaw)

        def at(t: float) -> Reference:
            rows = self.derivatives(np.array([t]))[:, 0]
            return reference_about(position, yaw, (self._turned(row, c, s) for row in rows))

        return Trajectory(name, self.duration, at)

    @staticmethod
    def _turned(row: NDArray[np.float64], c: float, s: float) -> tuple[float, float, float, float]:
        x, y, z, yaw = row.tolist()
        return c * x - s * y, s * x + c * y, z, yaw
