"""Firmware time as the host can know it: a line through the arrival times of log packets, followed without jumps."""

import statistics
import threading
import time
from collections import deque
from itertools import pairwise

SEGMENT = 0.5  # s of host time; the rate is the median slope of the newest SEGMENTS of these
SEGMENTS = 8
OFFSET_SPAN = 0.5  # s over which the promptest packet is looked for
SLEW = 0.2  # largest relative departure from the measured rate while catching up
LARGEST_CATCH_UP = 3.0  # s of firmware time beyond which catching up is given up


class FirmwareClock:
    """Predicts the drone's clock from packet stamps, so that setpoints keep its time, not the host's.

    A simulator may run faster or slower than real time and any drone's crystal drifts, so the rate is measured: the
    slope over the last seconds of packets. The offset is that of the promptest recent packet, because delays only add.
    A simulator, or this process, that was denied the processor for a while leaves the prediction wrong by that while;
    the error is made good by running a little slow or fast, because a setpoint that freezes or jumps shakes the drone.
    """

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float]] = deque()  # host s (monotonic), firmware s
        self._posts: deque[tuple[float, float]] = deque(maxlen=SEGMENTS + 1)
        self._lock = threading.Lock()
        self._rate = 1.0
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
                return  # four blocks of a 100 Hz log would otherwise weigh a burst as heavily as time
            self._pairs.append((host, firmware_time))
            while self._pairs[-1][0] - self._pairs[0][0] > OFFSET_SPAN:
                self._pairs.popleft()
            self._measure_rate(host, firmware_time)
            self._stale = True  # the line is drawn when it is asked for: packets are many, and watching asks for none

    def _draw_line(self) -> None:
        """Through the promptest packet of the last while, with the measured rate."""
        newest = self._pairs[-1][0]
        self._line = (newest, max(f - self._rate * (h - newest) for h, f in self._pairs))
        self._stale = False

    def _measure_rate(self, host: float, firmware_time: float) -> None:
        """Median slope of half seconds, which one stall cannot bend; the overall slope while there are too few."""
        posts = self._posts
        if not posts or host - posts[-1][0] >= SEGMENT:
            posts.append((host, firmware_time))
            slopes = [(f2 - f1) / (h2 - h1) for (h1, f1), (h2, f2) in pairwise(posts)]
            if len(slopes) >= 3:
                self._rate = max(statistics.median(slopes), 1e-3)
        if len(posts) < 4 and host - posts[0][0] > 0.05 and firmware_time > posts[0][1]:
            self._rate = (firmware_time - posts[0][1]) / (host - posts[0][0])

    @property
    def rate(self) -> float:
        """Firmware seconds per host second."""
        return self._rate

    def now(self, host: float | None = None) -> float:
        """Firmware time [s] now; never runs backwards."""
        host = time.monotonic() if host is None else host
        with self._lock:
            if self._stale:
                self._draw_line()
            # No packet, no progress: do not extrapolate for ever when the drone falls silent.
            ahead = min(host - self._line[0], 1.0)
            value = self._line[1] + self._rate * ahead
            if self._shown is not None:
                before, shown = self._shown
                elapsed = max(host - before, 0.0)
                if abs(value - shown - self._rate * elapsed) < LARGEST_CATCH_UP and host - self._line[0] <= 1.0:
                    slowest, fastest = ((1.0 + s) * self._rate * elapsed for s in (-SLEW, SLEW))
                    value = shown + min(max(value - shown, slowest), fastest)
                value = max(value, shown)
            self._shown = (max(host, self._shown[0]) if self._shown else host, value)
            return value
