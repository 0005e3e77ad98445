"""The thrust of the rotors as a function of time: commands through the lag, in closed form between their stamps.

For open-loop prediction. In contrast to `physics.motion.rotor_thrust`, inputs are known up to another stamp for every
start, and the last known input is held. No predictor of inputs is fitted.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.physics.effects.effect import Effects
from crazyem.physics.motion import RotorInput, settled
from crazyem.vehicle import Vehicle


@compiled
def _carry(time, thrust, lag, linear, state, integral):
    """Lagged thrust (m, 4) at the stamps and its integral since the first stamp, where the thrust is settled."""
    state[0] = thrust[0]
    for k in range(len(time) - 1):
        h = time[k + 1] - time[k]
        decay = np.exp(-h / lag) if lag > 0.0 else 0.0
        for c in range(4):
            u0 = thrust[k, c]
            u1 = thrust[k + 1, c] if linear else u0
            fall = (u1 - u0) / h * lag
            end = u1 - fall + (state[k, c] - u0 + fall) * decay
            area = 0.5 * h * (u0 + u1)
            integral[k + 1, c] = integral[k, c] + area - (lag * (end - state[k, c]) if lag > 0.0 else 0.0)
            state[k + 1, c] = end if lag > 0.0 else thrust[k + 1, c]


class ThrustCourse:
    """Thrust of each rotor after the lag, at any time.

    Args:
        inputs: commands or measured speeds of the rotors.
        vehicle, effects: lag, and the effects on commands, measured speeds, lag and delay.

    Attributes:
        lag, delay: s, with effects.
    """

    def __init__(self, inputs: RotorInput, *, vehicle: Vehicle, effects: Effects) -> None:
        self.thrust, self.lag, self.delay = settled(inputs, vehicle=vehicle, effects=effects)
        self.time = inputs.time
        self.linear = inputs.measured or (self.lag > 0 and inputs.aged)  # as in physics.motion.rotor_thrust
        self._state, self._integral = np.zeros_like(self.thrust), np.zeros_like(self.thrust)
        _carry(self.time, self.thrust, float(self.lag), self.linear, self._state, self._integral)

    def newest(self, time: NDArray) -> NDArray:
        """(n,) index of the newest stamp at or before each time (n,) s; -1 before the first."""
        return np.searchsorted(self.time, time + 1e-9, "right") - 1

    def over(
        self, begin: NDArray, end: NDArray, *, last: NDArray, late: NDArray | float = 0.0
    ) -> tuple[NDArray, NDArray]:
        """Mean thrust over intervals, and its mean derivative there.

        Args:
            begin, end: (n,) s, end after begin.
            last: (n,) index of the last known stamp; its command is held from there on.
            late: (n,) s, added to the delay.

        Returns: (n, 4) N and (n, 4) N/s.
        """
        first, area_first = self._at(begin - self.delay - late, last)
        second, area_second = self._at(end - self.delay - late, last)
        span = (end - begin)[:, None]
        return (area_second - area_first) / span, (second - first) / span

    def _at(self, time: NDArray, last: NDArray) -> tuple[NDArray, NDArray]:
        """Lagged thrust (n, 4) N and its integral since the first stamp (n, 4) N s."""
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, np.maximum(last, 0))
        after = np.minimum(k + 1, len(self.time) - 1)
        h = (time - self.time[k])[:, None]
        u = self.thrust[k]
        slope = np.zeros_like(u)
        if self.linear:
            gap = (self.time[after] - self.time[k])[:, None]
            known = ((k < last) & (after > k))[:, None] & (h > 0)  # also held before the first stamp
            slope = np.where(known, (self.thrust[after] - u) / np.where(gap > 0, gap, 1.0), 0.0)
        area = u * h + 0.5 * slope * h * h
        if self.lag <= 0.0:
            return u + slope * h, self._integral[k] + area
        start, fall = self._state[k], slope * self.lag
        decay = np.exp(-np.maximum(h, 0.0) / self.lag)
        end = u + slope * h - fall + (start - u + fall) * decay
        return end, self._integral[k] + area - self.lag * (end - start)
