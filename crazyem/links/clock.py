"""Firmware stamps and host clock: unwrapping of 24 bits, counting of lost packets, relation of the two clocks."""

import math
import statistics
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

STAMP_MODULUS = 1 << 24  # ms; the firmware sends the low 24 bits of its millisecond counter: wraps at 16777.216 s
_HALF_MODULUS = STAMP_MODULUS // 2
_STALL_SECONDS = 0.4  # s of host time, least additional delay of all packets after the firmware's clock stopped
_KEPT_SECONDS = 600  # most bins (seconds of firmware time) that are kept
_STALL_BINS = 5  # bins (seconds of firmware time) in which all packets must have this additional delay


class StampUnwrapper:
    """Continuous firmware time from 24-bit stamps, in any order of arrival.

    All blocks of a drone share one clock and so one unwrapper. A stamp is placed within half a wrap (8388 s) of the
    newest stamp, so only gaps or delays of more than two hours cause an error.
    """

    def __init__(self) -> None:
        self._newest: int | None = None

    def unwrap(self, stamp: int) -> int:
        """Unwrapped time [ms] of a stamp [ms]; the first stamp is returned unchanged."""
        time = self.peek(stamp)
        self._newest = time if self._newest is None else max(self._newest, time)
        return time

    def peek(self, stamp: int) -> int:
        """As `unwrap`, but without storing the stamp."""
        if self._newest is None:
            return int(stamp)
        return self._newest + (int(stamp) - self._newest + _HALF_MODULUS) % STAMP_MODULUS - _HALF_MODULUS


class LossCounter:
    """Counts one block's packets by their stamps alone: the protocol has no sequence numbers.

    The firmware's timer keeps an exact mean period, but single packets are stamped late by up to a few periods. So the
    number of periods minus the number of packets, both since the first packet, is the number of lost packets, plus the
    lateness of the newest packet, minus the lateness of the first, in periods. The minimum over the last few packets
    removes the second term; the least value so far is the third.

    A packet with a repeated stamp is a duplicate made by the link and is not counted otherwise. There is one exception:
    after a delay the firmware samples an overdue packet at once, and two packets have the same millisecond (1 in 500 of
    the real firmware's, each after a gap of two periods). So a repeated stamp counts as a packet if one is overdue,
    that is, after a gap longer than a period. A duplicate just after a loss looks the same and hides the loss.
    """

    _SETTLING = 10  # packets; longer than a burst of late ones
    _MEMORY = 1000  # newest stamps in which duplicates are recognised
    _ON_TIME = 0.75  # periods between two packets, from which no packet is overdue any more

    def __init__(self, period_ms: int) -> None:
        self.period_ms = int(period_ms)
        self.received = 0
        self.late = 0
        self.duplicates = 0
        self._stamps: deque[int] = deque(maxlen=self._MEMORY)
        self._overdue = math.inf  # packets that may still come with the newest stamp; unlimited before the first
        self._first = 0
        self._newest = 0
        self._missing: deque[float] = deque(maxlen=self._SETTLING)
        self._least = 0.0

    def count(self, firmware_time_ms: int, *, late: bool = False) -> bool:
        """Count a packet with the stamp `firmware_time_ms` (unwrapped); False: a duplicate.

        `late`: whether it arrived with a delay.
        """
        if self.received == 0:
            self._first = self._newest = firmware_time_ms
        elif self._is_duplicate(firmware_time_ms):
            self.duplicates += 1
            return False
        self._stamps.append(firmware_time_ms)
        if late or firmware_time_ms < self._newest:
            self.late += 1
        self._newest = max(self._newest, firmware_time_ms)
        missing = (self._newest - self._first) / self.period_ms - self.received
        self.received += 1
        self._missing.append(missing)
        self._least = min(self._least, missing)
        return True

    def _is_duplicate(self, stamp: int) -> bool:
        gap = (stamp - self._newest) / self.period_ms
        if gap > 0.0:
            waiting = self._overdue if gap < self._ON_TIME else 0.0
            self._overdue = max(waiting + gap - 1.0, 0.0)
            return False
        seen = stamp in self._stamps
        if seen and (gap < 0.0 or self._overdue < self._ON_TIME):
            return True
        self._overdue = max(self._overdue - 1.0, 0.0)  # an overdue packet: late or overtaken
        return False

    @property
    def lost(self) -> int:
        """Number of missing packets between the first and the newest, without the newest few."""
        return round(min(self._missing) - self._least) if self._missing else 0


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Host time [s since the epoch] = offset + rate * firmware time [s], for packets with the least delay.

    Attributes:
        offset: s.
        rate: host seconds per firmware second (1 for a real drone, 1/speed for an accelerated simulator).
        delay: median delay of the packets over the least-delayed ones, s.
        packets: number of packets behind the fit.
    """

    offset: float
    rate: float
    delay: float
    packets: int

    def to_host(self, firmware_time_ms: float) -> float:
        """Host time [s] at which a stamp [ms] would arrive with the least delay."""
        return self.offset + self.rate * firmware_time_ms / 1000.0


class ClockRelation:
    """Fits the host clock against the firmware clock through the least-delayed packet of every second.

    Queues and schedulers can only delay a packet, so the lower edge of (host - firmware) is the clock relation, and the
    rest is delay. The memory is bounded: one candidate per second, for the newest ten minutes.
    """

    def __init__(self) -> None:
        self._origin: tuple[float, float] | None = None
        self._bins: dict[int, tuple[float, float]] = {}  # second of firmware time -> (firmware, host) from the origin
        self._newest = (0.0, 0.0)
        self._packets = 0

    def add(self, firmware_time_ms: int, host_time: float) -> None:
        """Add a packet: unwrapped stamp [ms] and arrival [s since the epoch]."""
        firmware = firmware_time_ms / 1000.0
        if self._origin is None:
            self._origin = (firmware, host_time)
        x, y = firmware - self._origin[0], host_time - self._origin[1]
        self._packets += 1
        if x > self._newest[0]:
            self._newest = (x, y)
        rate = self._newest[1] / self._newest[0] if self._newest[0] > 1.0 else 1.0
        key = math.floor(x)
        best = self._bins.get(key)
        if best is None or y - rate * x < best[1] - rate * best[0]:
            self._bins[key] = (x, y)
            while len(self._bins) > _KEPT_SECONDS:
                self._bins.pop(next(iter(self._bins)))

    def _forget_before_stall(self) -> None:
        """Drop packets from before a stop of the firmware's clock (a simulator without the processor).

        A stop is a step of `_STALL_SECONDS` or more in the delay of all packets for at least `_STALL_BINS` seconds.
        """
        points = list(self._bins.values())
        if len(points) < 2 * _STALL_BINS:
            return
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(points) if b[0] > a[0]]
        rate = statistics.median(slopes) if slopes else 1.0
        level = [y - rate * x for x, y in points]
        lowest = math.inf  # of the later bins
        for i in range(len(points) - 2, -1, -1):
            lowest = min(lowest, level[i + 1])
            if len(points) - 1 - i >= _STALL_BINS and lowest - level[i] > _STALL_SECONDS:
                for key in list(self._bins)[: i + 1]:
                    del self._bins[key]
                return

    def fit(self) -> ClockFit | None:
        """The present relation, None before the first packet. The rate is 1 with less than three seconds of data."""
        if self._origin is None:
            return None
        self._forget_before_stall()
        points = list(self._bins.values())
        n = len(points)
        mean_x = sum(p[0] for p in points) / n
        mean_y = sum(p[1] for p in points) / n
        spread = sum((p[0] - mean_x) ** 2 for p in points)
        rate = 1.0
        if n >= 3 and spread > 0.0:
            rate = sum((p[0] - mean_x) * (p[1] - mean_y) for p in points) / spread
        residuals = sorted(p[1] - mean_y - rate * (p[0] - mean_x) for p in points)
        offset = self._origin[1] + mean_y + residuals[0] - rate * (mean_x + self._origin[0])
        return ClockFit(offset, rate, residuals[n // 2] - residuals[0], self._packets)
