"""Whether the state of the drone lets a write pass: the newest telemetry, supervisor, battery and attitude decide.

Everything else may be late: an estimate, a decision, a queue. So each single write passes here just before it is sent,
or it is not sent.
"""

import math
import time
from collections import deque
from collections.abc import Callable

from crazyem.live.policy import HealthLimits
from crazyem.live.telemetry import CRASHED, FLYING, LOCKED, TUMBLED, Telemetry
from crazyem.signals.sample import Sample

# s on the drone's clock: what was heard longer ago says nothing about where the drone is now
FRESH_TELEMETRY_SECONDS = 0.3
VOLTAGE_AVERAGE_SECONDS = 1.0  # s over which the voltage is averaged: a rotor that speeds up pulls it down for a moment
VOLTAGE_HYSTERESIS = 0.05  # V over the threshold before writes are allowed again
FAULT_STATES = {TUMBLED: "has tumbled", LOCKED: "is locked", CRASHED: "has crashed"}


class WriteGate:
    """Says why nothing may be pushed now, and of one write, just before it is sent, why it must not be.

    A push, its undoing and a revert belong into the air. Values are put back after a flight (`restore`) on the ground.

    Args:
        telemetry: written by the receiving thread.
        limits: see `HealthLimits`.
        rate: seconds of the drone's clock in one of the host's (a simulator may run fast).
        now: host time, s since the epoch, as in `Packet.host_time`.
    """

    def __init__(
        self,
        telemetry: Telemetry,
        limits: HealthLimits | None = None,
        *,
        rate: Callable[[], float] = lambda: 1.0,
        now: Callable[[], float] = time.time,
    ) -> None:
        self.telemetry, self.rate, self.now = telemetry, rate, now
        self.limits = limits or HealthLimits()
        self.motors_cut = False  # by this program: telemetry says so up to 0.3 s later
        self._voltages: deque[tuple[float, float]] = deque(maxlen=2000)
        self._tilt = math.nan
        self._low = False

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
        if self.motors_cut:
            return "the motors were cut"
        if not self.telemetry.airborne:
            return "the drone is not in the air"
        return "the drone is about to land" if self.telemetry.landing else ""

    def objection(self, purpose: str) -> str:
        """Why a write must not be sent now, one clause; "" if it may."""
        return self.stale() or self.misplaced(purpose)

    def take(self, sample: Sample) -> None:
        """One sample of the flight."""
        if sample.signal == "voltage":
            self._voltages.append((sample.time, sample.value[0]))
            while sample.time - self._voltages[0][0] > VOLTAGE_AVERAGE_SECONDS:
                self._voltages.popleft()
        elif sample.signal == "attitude":
            x, y = sample.value[0], sample.value[1]
            self._tilt = math.acos(min(max(1.0 - 2.0 * (x * x + y * y), -1.0), 1.0))

    @property
    def voltage(self) -> float:
        """V, mean of the last second; NaN before any."""
        kept = tuple(self._voltages)  # a copy: another thread adds to it
        return sum(v for _, v in kept) / len(kept) if kept else math.nan

    def health_objection(self, *, age: float) -> str:
        """Why the state of the drone forbids every push now, one clause; "" if nothing does.

        Args:
            age: s by which the newest estimate is behind the drone's clock.
        """
        return self._supervisor() or self._battery() or self._motion(age)

    def _supervisor(self) -> str:
        if not self.limits.supervisor:
            return ""
        if self.telemetry.info is None:
            return "the supervisor has said nothing yet"
        for bit, what in FAULT_STATES.items():
            if self.telemetry.has(bit):
                return f"the drone {what}"
        return "" if self.telemetry.has(FLYING) else "the supervisor does not say that the drone flies"

    def _battery(self) -> str:
        least = self.limits.battery
        if least <= 0.0:
            return ""
        volts = self.voltage
        if math.isnan(volts):
            return "the battery's voltage is not known"
        self._low = volts < (least + VOLTAGE_HYSTERESIS if self._low else least)
        return f"the battery is at {volts:.2f} V, below {least:g} V" if self._low else ""

    def _motion(self, age: float) -> str:
        if age > self.limits.stale:
            return f"the newest estimate is {age:.1f} s old"
        if self._tilt > self.limits.tilt:
            return f"the drone leans {math.degrees(self._tilt):.0f} degrees"
        return ""
