"""A signal that sticks: the same values again and again, more often than this signal repeats itself.

Logs come in steps, so a signal at rest repeats itself now and then, and a slow one often. A run of repetitions is
improbable by the share p of repetitions so far: a run of n has the probability p^n.
"""

import math

from crazyem.monitoring.threshold import HOUR

MEMORY = 2000  # samples over which the share of repetitions is taken
REPEATED_BEFORE, SEEN_BEFORE = 5.0, 20.0  # repetitions and samples that the share begins with
LONGEST_GAP = 0.5  # s without a sample after which a run begins anew


class RunTest:
    """Of one signal.

    Args:
        false_alarms_per_hour: of this test.
    """

    def __init__(self, false_alarms_per_hour: float) -> None:
        self._per_second = false_alarms_per_hour / HOUR
        self._repeated, self._seen = REPEATED_BEFORE, SEEN_BEFORE
        self._value: tuple[float, ...] = ()
        self._time = self.since = -math.inf
        self._run = 0
        self.alarmed = False

    def add(self, time: float, value: tuple[float, ...]) -> bool:
        """One sample at `time` [s]; True when a run has just become too long for chance."""
        step = time - self._time
        same = value == self._value and 0.0 < step < LONGEST_GAP
        if not same:
            share = max(1.0 - 1.0 / MEMORY, 0.0) if self._seen > MEMORY else 1.0
            self._seen = share * self._seen + 1.0 + (0 if self.alarmed else self._run)
            self._repeated = share * self._repeated + (0 if self.alarmed else self._run)
            self._run, self.since, self.alarmed = 0, time, False
        else:
            self._run += 1
        self._value, self._time = value, time
        if not same or self.alarmed:
            return False
        log_probability = self._run * math.log(self._repeated / self._seen)
        self.alarmed = log_probability < math.log(self._per_second * step)
        return self.alarmed
