"""The newest state of the drone, for the sequence of a flight, and the last check before each write by this state.

Estimates, decisions and queues may be late. So every single write is checked immediately before it is sent:
telemetry, supervisor, battery and attitude of the drone must allow it.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from crazyem.estimation.contact import CONTACT_HEIGHT, ContactGate
from crazyem.live.policy import HealthLimits
from crazyem.signals.sample import Sample

# s; a drone that reaches the ground within this time at its present descent is landing. Covers the delays of telemetry
# and of writes.
LANDING_SECONDS = 0.3

# supervisor.info, firmware supervisor.c
CAN_ARM, ARMED, AUTO_ARM, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << i for i in range(8))


def tilt_of(attitude: Sequence[float]) -> float:
    """Angle [rad] between the z axes of body and world. attitude: quaternion x, y, z, w."""
    x, y = attitude[0], attitude[1]
    return math.acos(min(max(1.0 - 2.0 * (x * x + y * y), -1.0), 1.0))


@dataclass
class Telemetry:
    """Newest values of telemetry; only the receiving thread writes them, all threads may read them.

    Attributes:
        info: bits of supervisor.info, None before the first.
        heard: s since the epoch, host time of the arrival of the newest `info`; -inf before the first, and after the
            link is lost.
        position: m, world. yaw: rad. voltage: V. setpoint: m, world.
        climb: m/s, vertical velocity in the world; 0 if none is logged.
    """

    info: int | None = None
    heard: float = -math.inf
    position: tuple[float, float, float] | None = None
    yaw: float = 0.0
    climb: float = 0.0
    voltage: float = math.nan
    setpoint: tuple[float, float, float] | None = None
    _duty: float = math.inf  # of the fastest rotor, 0..1; inf if unknown
    _contact: ContactGate = field(default_factory=lambda: ContactGate(math.inf))

    def take(self, sample: Sample) -> None:
        """Store the value of a sample."""
        v = sample.value
        if sample.signal == "position":
            self.position = (v[0], v[1], v[2])
            self._look(v[2])
        elif sample.signal == "motor_command":
            self._duty = max(v)
            self._look(math.nan)
        elif sample.signal == "attitude":
            x, y, z, w = v
            self.yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        elif sample.signal == "velocity":
            self.climb = v[2] if math.isfinite(v[2]) else 0.0
        elif sample.signal == "voltage":
            self.voltage = v[0]
        elif sample.signal == "setpoint_position":
            self.setpoint = (v[0], v[1], v[2])

    def _look(self, height: float) -> None:
        flying = self.has(FLYING)
        if flying and self._duty <= 0.0:
            height = math.nan  # rotors that stop in a fall do not show that the drone rests at this height
        self._contact.update(height=height, thrust=self._duty, flying=flying)

    @property
    def airborne(self) -> bool:
        """Whether the drone is in the air: the firmware says that it flies, and the estimator's contact rule agrees.

        The firmware says so for 2 s after its motors stop. By the contact rule, the rotors turn and the drone is not at
        its last resting height.
        """
        return self.has(FLYING) and self._contact.airborne

    @property
    def landing(self) -> bool:
        """Whether the drone is down within `LANDING_SECONDS` at its present descent; False if the floor is unknown."""
        return self.height - self._contact.rest_height + min(self.climb, 0.0) * LANDING_SECONDS < CONTACT_HEIGHT

    def has(self, bit: int) -> bool:
        """Whether a bit of supervisor.info is set (False before the first)."""
        return bool((self.info or 0) & bit)

    @property
    def height(self) -> float:
        """m above the world's origin, NaN until known."""
        return self.position[2] if self.position else math.nan

    def grounded_reason(self) -> str:
        """Why this drone cannot fly, in words; empty if no reason is known."""
        if self.has(LOCKED):
            return "it is locked until it is restarted (an emergency stop or a setpoint timeout in flight)"
        if self.has(CRASHED):
            return "it has crashed and waits to be recovered"
        if self.has(TUMBLED):
            return "it lies tumbled"
        return ""


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
