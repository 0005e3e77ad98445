"""The last gate before the link: every single parameter write of the guard passes here, or it is not sent.

Nothing but the newest telemetry counts here, because everything else may be late: an estimate, a decision, a queue.
"""

import math
import time
from collections.abc import Callable

from crazyem.live.telemetry import FLYING, Telemetry

# s on the drone's clock: what was heard longer ago says nothing about where the drone is now
FRESH_TELEMETRY_SECONDS = 0.3


class WriteGate:
    """Says of one write, just before it is sent, why it must not be.

    A push, its undoing and a revert belong into the air. Values are put back after a flight (`restore`) on the ground.

    Args:
        telemetry: written by the receiving thread.
        rate: seconds of the drone's clock in one of the host's (a simulator may run fast).
        now: host time, s since the epoch, as in `Packet.host_time`.
    """

    def __init__(
        self, telemetry: Telemetry, *, rate: Callable[[], float] = lambda: 1.0, now: Callable[[], float] = time.time
    ) -> None:
        self.telemetry, self.rate, self.now = telemetry, rate, now

    def stale(self) -> str:
        """Why telemetry says nothing about the present, one clause; "" while it is fresh."""
        if self.telemetry.heard == -math.inf:
            return "no telemetry comes"
        age = abs(self.now() - self.telemetry.heard) * self.rate()  # abs: somebody may set the host's clock
        return "" if age <= FRESH_TELEMETRY_SECONDS else f"the newest telemetry is {age:.1f} s old"

    def misplaced(self, purpose: str) -> str:
        """Why a write for this purpose (`Push.purpose`) does not belong where the drone is, one clause; else ""."""
        if purpose == "restore":
            return "the drone still flies" if self.telemetry.has(FLYING) else ""
        return "" if self.telemetry.airborne else "the drone is not in the air"

    def objection(self, purpose: str) -> str:
        """Why a write must not be sent now, one clause; "" if it may."""
        return self.stale() or self.misplaced(purpose)
