"""The newest state of the drone, for sequencing a flight (never for estimating: that is the pipeline's)."""

import math
from dataclasses import dataclass

from crazyem.signals.sample import Sample

# supervisor.info, firmware supervisor.c
CAN_ARM, ARMED, AUTO_ARM, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << i for i in range(8))


@dataclass
class Telemetry:
    """Written by the receiving thread only, read by anyone.

    Attributes:
        info: bits of supervisor.info, None until seen.
        position: m, world. yaw: rad. voltage: V. setpoint: m, world.
    """

    info: int | None = None
    position: tuple[float, float, float] | None = None
    yaw: float = 0.0
    voltage: float = math.nan
    setpoint: tuple[float, float, float] | None = None

    def take(self, sample: Sample) -> None:
        """Keep what this sample says."""
        v = sample.value
        if sample.signal == "position":
            self.position = (v[0], v[1], v[2])
        elif sample.signal == "attitude":
            x, y, z, w = v
            self.yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        elif sample.signal == "voltage":
            self.voltage = v[0]
        elif sample.signal == "setpoint_position":
            self.setpoint = (v[0], v[1], v[2])

    def has(self, bit: int) -> bool:
        """Whether a bit of supervisor.info is set (False until it was seen)."""
        return bool((self.info or 0) & bit)

    @property
    def height(self) -> float:
        """m above the world's origin, NaN until known."""
        return self.position[2] if self.position else math.nan

    def grounded_reason(self) -> str:
        """Why this drone cannot fly, in words; empty if nothing speaks against it."""
        if self.has(LOCKED):
            return "it is locked until it is restarted (an emergency stop or a setpoint timeout in flight)"
        if self.has(CRASHED):
            return "it has crashed and waits to be recovered"
        if self.has(TUMBLED):
            return "it lies tumbled"
        return ""
