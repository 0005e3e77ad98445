"""Whether the drone is in a state in which its parameters may be changed: supervisor, battery, attitude, freshness."""

import math
from collections import deque

from crazyem.live.policy import HealthLimits
from crazyem.live.telemetry import CRASHED, FLYING, LOCKED, TUMBLED, Telemetry
from crazyem.signals.sample import Sample

VOLTAGE_AVERAGE_SECONDS = 1.0  # s over which the voltage is averaged: a rotor that speeds up pulls it down for a moment
VOLTAGE_HYSTERESIS = 0.05  # V over the threshold before writes are allowed again
FAULT_STATES = {TUMBLED: "has tumbled", LOCKED: "is locked", CRASHED: "has crashed"}


class Health:
    """Fed with samples, asked before a write.

    Args:
        limits: see `HealthLimits`.
        telemetry: holds what the supervisor says; written by the receiving thread.
    """

    def __init__(self, limits: HealthLimits, telemetry: Telemetry) -> None:
        self.limits = limits
        self.telemetry = telemetry
        self._voltages: deque[tuple[float, float]] = deque(maxlen=2000)
        self._tilt = math.nan
        self._low = False

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

    def objection(self, *, age: float) -> str:
        """Why nothing may be written now, empty if nothing speaks against it.

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
