"""Inputs of the rigid body: means of logged thrust and torque over the steps; test for impossible samples."""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.tape import Tape
from crazyem.physics.lag import CAUSAL, fit_predictor, hold_predictor, lagged_means

MAX_GAP = 0.1  # s; a step with a longer gap between inputs is not used
_RECENT = 8  # newest inputs that are compared one by one before the binary search
SETTLED_TIME_CONSTANTS = 5.0  # time constants after which the start value of a lag no longer matters

# Largest possible values (SI). A larger sample is an error of transmission and counts as missing.
LARGEST_VALUE = {
    "position": 1e4, "velocity": 1e2, "attitude": 2.0, "body_rate": 2e2,
    "motor_command": 1.5, "rotor_speed": 8e3, "wrench_command": 1e3,
    "specific_force": 1e3,
}  # fmt: skip


def is_plausible(signal: str, value: tuple[float, ...]) -> bool:
    """Whether all components are possible values: no NaN, not too large, a quaternion near unit length."""
    limit = LARGEST_VALUE[signal]
    for v in value:  # runs for every sample: plain floats are faster than numpy here
        if not -limit < v < limit:
            return False
    return signal != "attitude" or 0.5 < math.hypot(*value) < 2.0


class InputHistory:
    """Stamps and wrenches in order of arrival, and the state of the rotor lag at the newest node."""

    def __init__(self, mode: int, capacity: int = 4096) -> None:
        self.mode = mode  # LINEAR, HOLD or CAUSAL of crazyem.physics.lag
        self.times = np.zeros(capacity)
        self.wrenches = np.zeros((capacity, 4))
        self.size = 0
        self.lag = np.zeros(13)  # see lagged_means
        self._at = 0  # index of the last command at or before the time of the lag's state
        self.predictor = hold_predictor()
        self.gap_end = -np.inf  # s, end of the last long gap between inputs
        self.newest = -np.inf  # stamp of the newest input [s], -inf if none

    def append(self, time: float, wrench: NDArray, *, needed_from: float) -> bool:
        """Add an input; False if its stamp is not newer than the newest. Inputs before `needed_from` may be dropped."""
        if time <= self.newest:
            return False
        if self.size == 0:
            self.lag[:12] = np.tile(wrench, 3)
            self.lag[12] = time
            self.gap_end = time  # earlier commands are unknown, and they still act through the lag
        elif time - self.newest > MAX_GAP:
            self.gap_end = time
        if self.size == len(self.times):
            self._make_room(needed_from)
        self.times[self.size] = time
        self.wrenches[self.size] = wrench
        self.newest = time
        self.size += 1
        return True

    def _make_room(self, needed_from: float) -> None:
        drop = max(0, int(np.searchsorted(self.times[: self.size], min(needed_from, self.lag[12]), "right")) - 1)
        if drop > self.size // 4:
            keep = self.size - drop
            self.times[:keep] = self.times[drop : self.size].copy()
            self.wrenches[:keep] = self.wrenches[drop : self.size].copy()
            self.size = keep
            self._at = max(0, self._at - drop)
        else:
            self.times = np.concatenate([self.times, np.zeros_like(self.times)])
            self.wrenches = np.concatenate([self.wrenches, np.zeros_like(self.wrenches)])

    def at(self, time: float) -> int:
        """Index of the last input at or before `time` [s], 0 if all are later; fast for recent times."""
        for back in range(1, min(self.size, _RECENT) + 1):
            if self.times[self.size - back] <= time:
                return self.size - back
        return max(0, int(np.searchsorted(self.times[: self.size], time, "right")) - 1)

    def covers(self, begin: float, end: float) -> bool:
        """Whether no stretch of [begin, end] is more than MAX_GAP away from inputs on both sides."""
        if self.gap_end <= begin <= end <= self.newest and self.times[0] <= begin:
            return True  # the last gap ended before `begin`
        times = self.times[: self.size]
        first = int(np.searchsorted(times, begin, "right")) - 1
        last = int(np.searchsorted(times, end, "left"))
        if first < 0:
            return False
        inside = times[first : min(last + 1, self.size)]
        return bool(np.all(np.diff(inside) <= MAX_GAP) and end - inside[-1] <= MAX_GAP)

    def between(self, begin: float, end: float) -> tuple[NDArray, NDArray]:
        """Stamps (n,) and wrenches (n, 4) of the inputs in [begin, end]."""
        times = self.times[: self.size]
        first, last = int(np.searchsorted(times, begin)), int(np.searchsorted(times, end, "right"))
        return times[first:last], self.wrenches[first:last]

    def advance(self, tape: Tape, first: int, last: int, theta: NDArray) -> None:
        """Fill the means of rows first..last-1 for parameters theta (9,), starting from the newest node."""
        self._at = lagged_means(
            self.times, self.wrenches, self._at, self.size, self.predictor, tape.time, first, last, self.mode, theta[4],
            theta[5], self.lag, tape.mean, tape.mean_tau, tape.mean_delay,
        )  # fmt: skip
        tape.spread_inputs(first, last, theta[6:9])

    def skip_to(self, time: float, tau: float, delay: float) -> None:
        """Move the lag's state to a time without a node (on the ground)."""
        node, unused = np.array([time]), np.zeros((3, 1, 4))
        self._at = lagged_means(
            self.times, self.wrenches, self._at, self.size, self.predictor, node, 0, 1, self.mode, tau, delay,
            self.lag, *unused,
        )  # fmt: skip

    def refill(self, tape: Tape, first: int, last: int, theta: NDArray) -> None:
        """Recompute the means of rows first+1..last-1 for other parameters theta (9,)."""
        start = tape.time[first] - theta[5] - 2 * SETTLED_TIME_CONSTANTS * max(theta[4], 0.02)
        at = max(0, int(np.searchsorted(self.times[: self.size], start, "right")) - 1)
        if self.mode == CAUSAL:
            self.predictor = fit_predictor(self.between(tape.time[first], tape.time[last - 1])[1])
        self.lag[:12] = np.tile(self.wrenches[at], 3)
        self.lag[12] = self.times[at]
        self._at = at
        self.advance(tape, first, last, theta)
