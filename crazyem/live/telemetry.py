"""The newest state of the drone, for the sequence of a flight (the pipeline estimates, not this module)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from crazyem.estimation.contact import CONTACT_HEIGHT, ContactGate
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
