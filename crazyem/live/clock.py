"""Firmware time on the host, and setpoints streamed at a constant rate of this time, in a separate thread.

The clock is a line through the arrival times of log packets, followed without jumps.
"""

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise

from crazyem.control.indi import IndiGains, place_ahead
from crazyem.control.trajectories import Reference, Trajectory
from crazyem.errors import LinkError
from crazyem.links.base import Link

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


# Each setpoint makes a step in the commanded torques. At the rate of the log (100 Hz), every step would be at the same
# time between two log samples, and the logged motor commands would have a constant error: 6 % of the yaw torque, which
# goes directly into Izz. With 7 ms, the steps cover all times between log samples within 70 ms.
SETPOINT_PERIOD = 0.007  # s of firmware time
LARGEST_LEAP = 0.5  # s, largest jump of the trajectory's time between two setpoints, after an outage
OUTAGE_NOTICE_SECONDS = 0.3  # s from the loss of a link until the session notices the loss
SHORTEST_PERIOD = 0.0005  # s of host time, shortest period: limits the rate for a fast simulator


class SetpointStream:
    """Sends `trajectory` from `start()` until `stop()`; after its duration, its end point.

    Args:
        on_setpoint: called with (firmware time [s], reference) after each setpoint (recording).
        indi: gains of INDI, which gets positions ahead of the reference; None: full-state setpoints.
        reconnecting: whether a lost link is being reconnected; setpoints that cannot be sent then are skipped.
    """

    def __init__(
        self,
        link: Link,
        trajectory: Trajectory,
        clock: FirmwareClock,
        *,
        on_setpoint: Callable[[float, Reference], None] | None = None,
        reconnecting: Callable[[], bool] | None = None,
        indi: IndiGains | None = None,
    ) -> None:
        self.link = link
        self.trajectory = trajectory
        self.clock = clock
        self.on_setpoint = on_setpoint
        self.indi = indi
        self.reconnecting = reconnecting or (lambda: False)
        self._reached = 0.0
        self._after_outage = False
        self.failure: Exception | None = None
        self.began = float("nan")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="crazyem-setpoints", daemon=True)

    def start(self) -> None:
        """Begin; time 0 of the trajectory is the stamp of the newest packet."""
        self.began = self.clock.newest
        self._thread.start()

    def stop(self) -> None:
        """Send no more setpoints; waits for the thread to end, at most 2 s."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=2.0)

    @property
    def elapsed(self) -> float:
        """s of firmware time since the start, by the newest packet.

        The predicted clock runs ahead while the simulator or this process does not run; a flight would end early.
        """
        return self.clock.newest - self.began

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stop.is_set():
                firmware = self.clock.now()
                r = self.trajectory.at(self._progress(firmware))
                if self._send(r) and self.on_setpoint is not None:
                    self.on_setpoint(firmware, r)
                period = max(SETPOINT_PERIOD / max(self.clock.rate, 1e-3), SHORTEST_PERIOD)
                due = max(due + period, time.monotonic() - 0.05)
                self._stop.wait(max(due - time.monotonic(), 0.0))
        except Exception as error:
            self.failure = error

    def _progress(self, firmware: float) -> float:
        """The trajectory's time [s]; after an outage it continues from its last value: a jump shakes the drone."""
        progress = firmware - self.began
        if self.reconnecting():
            self._after_outage = True
        elif self._after_outage and progress - self._reached > LARGEST_LEAP:
            self.began += progress - self._reached
            self._after_outage, progress = False, self._reached
        self._reached = progress
        return progress

    def _send(self, r: Reference) -> bool:
        """Send a setpoint; returns whether it was sent. Raises LinkError if it was not and no reconnection runs."""
        try:
            if self.indi is not None:
                self.link.send_position(*place_ahead(r, self.indi))
            else:
                self.link.send_full_state(r.position, r.velocity, r.acceleration, r.quaternion, (0.0, 0.0, r.yaw_rate))
        except LinkError as error:
            # The link reports its loss through the queue of packets: give the reader of the queue time to react.
            until = time.monotonic() + OUTAGE_NOTICE_SECONDS
            while not self.reconnecting():
                if time.monotonic() > until or self._stop.is_set():
                    raise error
                time.sleep(0.005)
            return False
        return True
