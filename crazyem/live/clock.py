"""Firmware time as the host can know it: a line through the arrival times of log packets."""

import threading
import time
from collections import deque


class FirmwareClock:
    """Predicts the drone's clock from packet stamps, so that setpoints keep its time, not the host's.

    A simulator may run faster or slower than real time and any drone's crystal drifts, so the rate is measured: the
    slope over the last seconds of packets. The offset is that of the promptest packets, because delays only add.
    """

    def __init__(self, *, span: float = 3.0) -> None:
        self.span = span
        self._pairs: deque[tuple[float, float]] = deque()  # host s (monotonic), firmware s
        self._lock = threading.Lock()
        self._rate = 1.0
        self._line = (0.0, 0.0)
        self._last = float("-inf")
        self.newest = float("nan")

    def observe(self, firmware_time: float, host: float | None = None) -> None:
        """A packet stamped `firmware_time` [s] arrived now (or at `host`, s on the monotonic clock)."""
        host = time.monotonic() if host is None else host
        with self._lock:
            if not firmware_time <= self.newest:  # also the first, while newest is NaN
                self.newest = firmware_time
            if self._pairs and host - self._pairs[-1][0] < 0.002:
                return  # four blocks of a 100 Hz log would otherwise weigh a burst as heavily as time
            self._pairs.append((host, firmware_time))
            while self._pairs[-1][0] - self._pairs[0][0] > self.span:
                self._pairs.popleft()
            first, last = self._pairs[0], self._pairs[-1]
            if last[0] - first[0] > 0.1:
                n = len(self._pairs)
                mh = sum(h - first[0] for h, _ in self._pairs) / n
                mf = sum(f - first[1] for _, f in self._pairs) / n
                num = sum((h - first[0] - mh) * (f - first[1] - mf) for h, f in self._pairs)
                den = sum((h - first[0] - mh) ** 2 for h, _ in self._pairs)
                if den > 0 and num > 0:
                    self._rate = num / den
            offset = max(f - self._rate * (h - last[0]) for h, f in self._pairs)
            self._line = (last[0], offset)

    @property
    def rate(self) -> float:
        """Firmware seconds per host second."""
        return self._rate

    def now(self, host: float | None = None) -> float:
        """Firmware time [s] now; never runs backwards."""
        host = time.monotonic() if host is None else host
        with self._lock:
            # No packet, no progress: do not extrapolate for ever when the drone falls silent.
            ahead = min(host - self._line[0], 1.0)
            value = self._line[1] + self._rate * ahead
            self._last = max(self._last, value)
            return self._last
