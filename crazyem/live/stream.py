"""Streams setpoints at a constant rate of the firmware's clock, in a separate thread."""

import threading
import time
from collections.abc import Callable

from crazyem.control.indi import IndiGains, place_ahead
from crazyem.control.trajectories import Reference, Trajectory
from crazyem.errors import LinkError
from crazyem.links.base import Link
from crazyem.live.clock import FirmwareClock

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
