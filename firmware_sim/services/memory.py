"""Port 4, the memories: the trajectory memory of the high-level commander, and the memory tester.

No 1-wire and no EEPROM memory: cflib would read their headers before it goes on connecting.
"""

import struct

from firmware_sim.tables import Slot
from firmware_sim.wire import EIO

INFO, READ, WRITE = 0, 1, 2
TRAJECTORY, TESTER = 0x12, 0x15
TRAJECTORY_SIZE = 4096
TESTER_SIZE = 0x1000
MAX_READ, MAX_WRITE = 24, 24


class MemoryService:
    """Two memories: id 0 holds trajectories (shared with the commander), id 1 the tester, whose byte n is n mod 256."""

    def __init__(self, trajectory: bytearray, tester_errors: Slot):
        self._trajectory = trajectory
        self._errors = tester_errors
        self._kinds = (TRAJECTORY, TESTER)

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the memory port."""
        if channel == INFO:
            return [(INFO, reply) for reply in self._info(data)]
        if channel not in {READ, WRITE} or len(data) < 5:
            return []
        number, address = struct.unpack_from("<BI", data)
        if channel == READ:
            if len(data) < 6:
                return []
            content = self._read(number, address, data[5])
        else:
            content = self._write(number, address, data[5:])
        status = b"\0" + content if content is not None else bytes((EIO,))
        return [(channel, data[:5] + status)]

    def _info(self, data: bytes) -> list[bytes]:
        if data[:1] == b"\x01":
            return [bytes((1, len(self._kinds)))]
        if data[:1] == b"\x02" and len(data) >= 2:
            number = data[1]
            if number >= len(self._kinds):
                return [bytes((2, number))]
            size = (len(self._trajectory), TESTER_SIZE)[number]
            return [struct.pack("<BBBI", 2, number, self._kinds[number], size) + bytes(8)]  # no serial number
        return []

    def _read(self, number: int, address: int, length: int) -> bytes | None:
        if length > MAX_READ:
            return None
        if number == 0 and address + length <= len(self._trajectory):
            return bytes(self._trajectory[address : address + length])
        if number == 1 and address + length <= TESTER_SIZE:
            return bytes((address + n) & 0xFF for n in range(length))
        return None

    def _write(self, number: int, address: int, content: bytes) -> bytes | None:
        if number == 0 and address + len(content) <= len(self._trajectory):
            self._trajectory[address : address + len(content)] = content
            return b""
        if number == 1 and address + len(content) <= TESTER_SIZE:
            wrong = sum(byte != (address + n) & 0xFF for n, byte in enumerate(content))
            self._errors[0][self._errors[1]] += wrong
            return b""
        return None
