"""Firmware time on the host: a line through the arrival times of log packets, followed without jumps."""

import statistics
import threading
import time
from collections import deque
from itertools import pairwise

SEGMENT = 0.5  # s of host time, length of a segment
SEGMENTS = 8  # number of newest segments; the rate is the median of their slopes
OFFSET_SPAN = 0.5  # s of packets; the one with the least delay gives the offset
SLEW = 0.2  # largest relative deviation from the measured rate during a correction
LARGEST_CATCH_UP = 3.0  # s of firmware time; a larger error is corrected by a jump


class FirmwareClock:
    """Predicts the drone's clock from packet stamps, so that setpoints follow the drone's time, not the host's.

    The rate is measured over the last seconds of packets: a simulator may run faster or slower than real time, and
    crystals drift. The offset is that of the recent packet with the least delay, because delays are never negative. If
    the simulator or this process does not run for a while, the prediction is wrong by this time. The clock then runs a
    little slow or fast until the error is gone, because a setpoint that stops or jumps shakes the drone.
    """

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float]] = deque()  # host s (monotonic), firmware s
        self._posts: deque[tuple[float, float]] = deque(maxlen=SEGMENTS + 1)
        self._lock = threading.Lock()
        self.rate = 1.0  # firmware seconds per host second
        self._line = (0.0, 0.0)
        self._stale = False
        self._shown: tuple[float, float] | None = None  # host s, firmware s of the last answer
        self.newest = float("nan")

    def observe(self, firmware_time: float, host: float | None = None) -> None:
        """A packet stamped `firmware_time` [s] arrived now (or at `host`, s on the monotonic clock)."""
        host = time.monotonic() if host is None else host
        with self._lock:
            if not firmware_time <= self.newest:  # also the first, while newest is NaN
                self.newest = firmware_time
            if self._pairs and host - self._pairs[-1][0] < 0.002:
                return  # one packet of a burst is enough
            self._pairs.append((host, firmware_time))
            while self._pairs[-1][0] - self._pairs[0][0] > OFFSET_SPAN:
                self._pairs.popleft()
            self._measure_rate(host, firmware_time)
            self._stale = True  # the line is computed on demand only: packets are frequent

    def _measure_rate(self, host: float, firmware_time: float) -> None:
        """Median slope of the segments, robust against one stall; the overall slope while there are too few."""
        posts = self._posts
        if not posts or host - posts[-1][0] >= SEGMENT:
            posts.append((host, firmware_time))
            slopes = [(f2 - f1) / (h2 - h1) for (h1, f1), (h2, f2) in pairwise(posts)]
            if len(slopes) >= 3:
                self.rate = max(statistics.median(slopes), 1e-3)
        if len(posts) < 4 and host - posts[0][0] > 0.05 and firmware_time > posts[0][1]:
            self.rate = (firmware_time - posts[0][1]) / (host - posts[0][0])

    def now(self, host: float | None = None) -> float:
        """Firmware time [s] now; never runs backwards."""
        host = time.monotonic() if host is None else host
        with self._lock:
            if self._stale:  # the line through the recent packet with the least delay, with the measured rate
                newest = self._pairs[-1][0]
                self._line = (newest, max(f - self.rate * (h - newest) for h, f in self._pairs))
                self._stale = False
            # Extrapolate for at most 1 s without a packet.
            ahead = min(host - self._line[0], 1.0)
            value = self._line[1] + self.rate * ahead
            if self._shown is not None:
                before, shown = self._shown
                elapsed = max(host - before, 0.0)
                if abs(value - shown - self.rate * elapsed) < LARGEST_CATCH_UP and host - self._line[0] <= 1.0:
                    slowest, fastest = ((1.0 + s) * self.rate * elapsed for s in (-SLEW, SLEW))
                    value = shown + min(max(value - shown, slowest), fastest)
                value = max(value, shown)
            self._shown = (max(host, self._shown[0]) if self._shown else host, value)
            return value
