"""Test for a stuck signal: more equal values in a row than usual for this signal, while its pair says that it moves.

Logged values are discrete, so a signal at rest repeats a value now and then, and a slow signal often does. Repetitions
come in runs, because a drone rests for a while: a Markov chain of first order. Let p be the share of samples that begin
a run, and q the share of repetitions that continue. Then a run of n has the probability p q^(n - 1). p and q are known
only from earlier runs, so the test uses the expectation over their beta distributions.
"""

import math

from crazyem.monitoring.threshold import HOUR

MEMORY = 2000  # samples in the running share
REPEATED_BEFORE, SEEN_BEFORE = 5.0, 20.0  # prior of a share: repetitions and samples
LONGEST_GAP = 0.5  # s; a longer time between samples ends a run


class _Share:
    """Share of positive trials over about the last `MEMORY` trials."""

    def __init__(self) -> None:
        self._happened, self._could = REPEATED_BEFORE, SEEN_BEFORE

    def add(self, happened: int, could: int) -> None:
        kept = 1.0 - 1.0 / MEMORY if self._could > MEMORY else 1.0
        self._happened, self._could = kept * self._happened + happened, kept * self._could + could

    def log_probability(self, times: int) -> float:
        """Log probability of so many positive trials in a row: log E[q^n] of a beta distribution."""
        a, whole = self._happened, self._could
        return math.lgamma(a + times) - math.lgamma(a) - math.lgamma(whole + times) + math.lgamma(whole)


class RunTest:
    """Test for a stuck signal, for one signal.

    Args:
        false_alarms_per_hour: of this test.
    """

    def __init__(self, false_alarms_per_hour: float) -> None:
        self._per_second = false_alarms_per_hour / HOUR
        self._begun, self._continued = _Share(), _Share()
        self._value: tuple[float, ...] = ()
        self._time = self.since = -math.inf
        self._run = 0
        self.alarmed = False

    def add(self, time: float, value: tuple[float, ...]) -> bool:
        """Add one sample at `time` [s]; True when a run has just become too long for chance."""
        step = time - self._time
        same = value == self._value and 0.0 < step < LONGEST_GAP
        if not same:
            # a run that ended was a rest of the drone, with or without an alarm
            self._begun.add(int(self._run > 0), 1)
            self._continued.add(max(self._run - 1, 0), self._run)
            self._run, self.since, self.alarmed = 0, time, False
        else:
            self._run += 1
        self._value, self._time = value, time
        if not same or self.alarmed:
            return False
        log_probability = self._begun.log_probability(1) + self._continued.log_probability(self._run - 1)
        self.alarmed = log_probability < math.log(self._per_second * step)
        return self.alarmed


class Pair:
    """A signal and its derivative: whether one has changed by the other since its newest run of equal values began.

    A quiet drone repeats values of a log in millimetres for seconds, and so does its velocity. A position is stuck only
    where the velocity says that the drone has moved, and a velocity where the position has not followed it.

    Args:
        scale: change of the signal for an integral of 1 of the derivative; 0.5 for a quaternion and a body rate, whose
            changes are compared by their length.
    """

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._resolution = 0.0  # of the signal: its smallest change so far
        self._value: tuple[float, ...] = ()
        self._path: tuple[float, ...] = ()  # integral of the derivative
        self._time = -math.inf  # of the newest derivative
        self._path_before: tuple[float, ...] = ()  # when the run of the signal began
        self._before: tuple[tuple[float, ...], float] = ((), -math.inf)  # when the run of the derivative began

    def add_value(self, value: tuple[float, ...], *, begun: bool) -> bool:
        """Add a sample of the signal; `begun`: with a new run. Whether the derivative, if there is one, says that the
        signal has moved."""
        changes = [abs(a - b) for a, b in zip(value, self._value) if a != b]
        if changes:
            self._resolution = min(self._resolution or math.inf, *changes)
        self._value = value
        if begun:
            self._path_before = self._path or (0.0,) * len(value)
        if not self._path:
            return True
        return self._larger(tuple(self._scale * (a - b) for a, b in zip(self._path, self._path_before)))

    def add_rate(self, time: float, rate: tuple[float, ...], *, begun: bool) -> bool:
        """Add a sample of the derivative at `time` [s]. Whether the signal, if there is one, has not changed by it."""
        step = time - self._time
        step = step if 0.0 < step < LONGEST_GAP else 0.0
        path = self._path or (0.0,) * len(rate)
        self._path, self._time = tuple(p + step * r for p, r in zip(path, rate)), time
        if begun:
            self._before = (self._value, time)
        if not self._value:
            return True
        value, since = self._before
        change = tuple(a - b for a, b in zip(self._value, value))
        expected = tuple(self._scale * (time - since) * r for r in rate) if since > -math.inf else ()
        if len(change) != len(expected):
            return self._larger((math.hypot(*change) - math.hypot(*expected),))
        return self._larger(tuple(a - b for a, b in zip(change, expected)))

    def _larger(self, change: tuple[float, ...]) -> bool:
        """Whether a change is larger than two roundings."""
        return max(map(abs, change), default=0.0) > 2.0 * self._resolution
