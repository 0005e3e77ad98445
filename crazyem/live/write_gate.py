"""The last check before each write: telemetry, supervisor, battery and attitude of the drone must allow it.

Estimates, decisions and queues may be late. So every single write is checked immediately before it is sent.
"""

import math
import time
from collections import deque
from collections.abc import Callable

from crazyem.live.policy import HealthLimits
from crazyem.live.telemetry import (
    CRASHED,
    FLYING,
    LOCKED,
    TUMBLED,
    Telemetry,
    tilt_of,
)
from crazyem.signals.sample import Sample

# s on the drone's clock; older telemetry does not show the present state
FRESH_TELEMETRY_SECONDS = 0.3
VOLTAGE_AVERAGE_SECONDS = 1.0  # s, averaging time of the voltage: an accelerating rotor lowers it for a moment
VOLTAGE_HYSTERESIS = 0.05  # V above the threshold at which writes are allowed again
FAULT_STATES = {TUMBLED: "has tumbled", LOCKED: "is locked", CRASHED: "has crashed"}


class WriteGate:
    """Gives the reason why nothing may be pushed now, or why a single write must not be sent.

    A push, its undo and a revert are allowed in the air only; a `restore` after a flight is allowed on the ground only.

    Args:
        telemetry: written by the receiving thread.
        limits: see `HealthLimits`.
        rate: seconds of the drone's clock per second of the host's (a simulator may run fast).
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
        self.motors_cut = False  # by this program; telemetry shows it up to 0.3 s later
        self._voltages: deque[tuple[float, float]] = deque(maxlen=2000)
        self._tilt = math.nan
        self._low = False

    def stale(self) -> str:
        """Why telemetry is not fresh, one clause; "" if it is."""
        if self.telemetry.heard == -math.inf:
            return "no telemetry comes"
        age = abs(self.now() - self.telemetry.heard) * self.rate()  # abs: the host's clock may be set
        return "" if age <= FRESH_TELEMETRY_SECONDS else f"the newest telemetry is {age:.1f} s old"

    def misplaced(self, purpose: str) -> str:
        """Why the place of the drone forbids a write for this purpose (`Push.purpose`), one clause; or ""."""
        if purpose == "restore":
            return "the drone still flies" if self.telemetry.has(FLYING) else ""
        if self.motors_cut:
            return "the motors were cut"
        if not self.telemetry.airborne:
            return "the drone is not in the air"
        return "the drone is about to land" if self.telemetry.landing else ""

    def objection(self, purpose: str) -> str:
        """Why a write must not be sent now, one clause; "" if it is allowed."""
        return self.stale() or self.misplaced(purpose)

    def take(self, sample: Sample) -> None:
        """One sample of the flight."""
        if sample.signal == "voltage":
            self._voltages.append((sample.time, sample.value[0]))
            while sample.time - self._voltages[0][0] > VOLTAGE_AVERAGE_SECONDS:
                self._voltages.popleft()
        elif sample.signal == "attitude":
            self._tilt = tilt_of(sample.value)

    @property
    def voltage(self) -> float:
        """V, mean of the last second; NaN before the first."""
        kept = tuple(self._voltages)  # a copy: another thread adds to it
        return sum(v for _, v in kept) / len(kept) if kept else math.nan

    def health_objection(self, *, age: float) -> str:
        """Why the state of the drone forbids all pushes now, one clause; "" if it allows them.

        Args:
            age: s, age of the newest estimate on the drone's clock.
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
