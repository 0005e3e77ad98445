"""Port 13, the platform: versions (channel 1) and the deprecated arming and recovery commands (channel 0)."""

import struct

from firmware_sim.commander.supervisor import Supervisor
from firmware_sim.wire import PROTOCOL_VERSION

COMMAND, VERSION = 0, 1
FIRMWARE_VERSION = "2026.08-crazyem-sim"
DEVICE = {"cf2": "Crazyflie 2.1", "cf21bl": "Crazyflie 2.1 Brushless"}


class PlatformService:
    """Answers version requests, and forwards arming and recovery to the supervisor."""

    def __init__(self, platform: str, supervisor: Supervisor):
        self._device = DEVICE.get(platform, "Crazyflie")
        self._supervisor = supervisor

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the platform port."""
        if not data:
            return []
        if channel == VERSION:
            return self._version(data[0])
        if channel == COMMAND and data[0] == 0x01 and len(data) >= 2:
            done = self._supervisor.request_arming(bool(data[1]))
            return [(COMMAND, bytes((0x01, done, self._supervisor.armed)))]
        if channel == COMMAND and data[0] == 0x02:
            done = self._supervisor.request_recovery()
            return [(COMMAND, bytes((0x02, done, not self._supervisor.crashed)))]
        return []

    def _version(self, command: int) -> list[tuple[int, bytes]]:
        if command == 0:
            return [(VERSION, struct.pack("<Bi", 0, PROTOCOL_VERSION))]
        if command == 1:
            return [(VERSION, b"\x01" + FIRMWARE_VERSION.encode() + b"\0")]
        if command == 2:
            return [(VERSION, b"\x02" + self._device.encode() + b"\0")]
        return []
