"""Port 4, the memories; and the stored values of persistent parameters, which survive a reboot (the drone's EEPROM).

There are two memories: trajectories of the high-level commander, and the memory tester. 1-wire and EEPROM memories are
left out, because cflib reads their headers while connecting. Stored values are in the simulator's memory, or in a JSON
file {"group.name": value} that the next simulator reads.
"""

import json
import math
import struct
from pathlib import Path

from firmware_sim.errors import ServerError
from firmware_sim.tables import Slot
from firmware_sim.wire import EIO

INFO, READ, WRITE = 0, 1, 2
TRAJECTORY, TESTER = 0x12, 0x15
TRAJECTORY_SIZE = 4096
TESTER_SIZE = 0x1000
MAX_READ = 24


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


class Storage:
    """Stored parameters, name -> value in the firmware's unit; written to `path` at every change if there is one.

    Raises ServerError if the file cannot be read or written, or has another content.
    """

    def __init__(self, path: Path | None = None):
        self._path = path
        self.values: dict[str, float] = self._read(path) if path is not None and path.exists() else {}
        if path is not None:
            self._write()  # a missing folder is reported now, not in flight

    @staticmethod
    def _read(path: Path) -> dict[str, float]:
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ServerError(f"cannot read the stored parameters in {path}: {error}") from None
        numbers = isinstance(content, dict) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in content.values()
        )
        if not numbers:
            raise ServerError(f"{path} holds no stored parameters: expected a JSON object of names and numbers")
        return {name: float(value) for name, value in content.items()}

    def _write(self) -> None:
        if self._path is None:
            return
        try:
            self._path.write_text(json.dumps(self.values, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise ServerError(f"cannot write the stored parameters to {self._path}: {error.strerror}") from None

    def store(self, name: str, value: float) -> None:
        """Keep a value for the next boot."""
        self.values[name] = value
        self._write()

    def remove(self, name: str) -> None:
        """Forget a stored value."""
        self.values.pop(name, None)
        self._write()

    def clear(self) -> None:
        """Remove all stored values."""
        self.values.clear()
        self._write()
