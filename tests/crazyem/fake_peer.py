"""A bare-socket Crazyflie that loses replies when told to: the least one that cflib connects to."""

import socket
import struct
import threading
import time
from collections.abc import Callable


class FakePeer:
    """The least Crazyflie that cflib connects to, in one thread; `lose(request)` decides which requests go unanswered.

    Log values are the packet's number in every variable; parameters are float32 at 1.0 (`fake.byte` is a uint8).
    """

    LOG = (("stateEstimateZ", "x", 5), ("stateEstimateZ", "y", 5), ("stateEstimateZ", "z", 5), ("pm", "vbat", 7))
    PARAMETERS = (("ctrlLee", "mass", 0x06), ("fake", "byte", 0x08), ("fake", "fixed", 0x46))

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self.socket.getsockname()[1]}"
        self.lose: Callable[[bytes], bool] = lambda request: False
        self.skip: Callable[[int], bool] = lambda number: False  # log packets that never leave
        self.silent = False
        self.values = [struct.pack("<f", 1.0), b"\x01", struct.pack("<f", 1.0)]
        self.requests: list[bytes] = []
        self.first_stamp = 0
        self._blocks: dict[int, list[int]] = {}
        self._periods: dict[int, tuple[int, float, int]] = {}
        self._client: tuple[str, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def number(self) -> int:
        """Of the packet that is sent next, of the only block that runs."""
        ((_, _, number),) = self._periods.values()
        return number

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2)
        self.socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.socket.settimeout(0.002 if self._periods else 0.05)
            try:
                request, self._client = self.socket.recvfrom(64)
            except TimeoutError:
                request = b""
            except OSError:
                return
            if request and not self.silent:
                self.requests.append(request)
                for reply in [] if self.lose(request) else self._answer(bytes(request)):
                    self.socket.sendto(reply, self._client)
            now = time.monotonic()
            for block, (period, due, number) in list(self._periods.items()):
                if now >= due and self._client and not self.silent:
                    stamp = (self.first_stamp + number * period) % (1 << 24)
                    self._periods[block] = (period, due + period / 1000.0, number + 1)
                    if not self.skip(number):
                        self.socket.sendto(self._log_packet(block, stamp, number), self._client)

    def _log_packet(self, block: int, stamp: int, number: int) -> bytes:
        kinds = {5: "<h", 7: "<f"}
        body = b"".join(struct.pack(kinds[self.LOG[i][2]], number) for i in self._blocks[block])
        return bytes([0x5E, block]) + struct.pack("<I", stamp)[:3] + body

    def _answer(self, request: bytes) -> list[bytes]:
        head, data = request[0] | 0x0C, request[1:]
        port, channel = head >> 4, head & 3
        if port == 15:
            return [bytes([head]) + b"Bitcraze Crazyflie".ljust(30, b"\0")] if channel == 1 else [request]
        if port == 13 and data[:1] == b"\0":
            return [bytes([head, 0, 12, 0, 0, 0])]
        if port == 4 and data[:1] == b"\x01":
            return [bytes([head, 1, 0])]
        if port in (2, 5) and channel == 0:
            return [bytes([head]) + self._table(data, self.LOG if port == 5 else self.PARAMETERS, port)]
        if port == 5 and channel == 1:
            return [bytes([head]) + self._log_command(data)]
        if port == 2 and channel in (1, 2):
            index = struct.unpack("<H", data[:2])[0]
            if channel == 1:
                return [bytes([head]) + data[:2] + b"\0" + self.values[index]]
            self.values[index] = data[2:]
            return [bytes([head]) + data]
        return []

    @staticmethod
    def _table(data: bytes, table: tuple[tuple[str, str, int], ...], port: int) -> bytes:
        if data[0] == 3:
            return b"\x03" + struct.pack("<HI", len(table), 0x1000 + port) + (b"\x10\x80" if port == 5 else b"")
        group, name, kind = table[struct.unpack("<H", data[1:3])[0]]
        return data[:3] + bytes([kind]) + f"{group}\0{name}\0".encode()

    def _log_command(self, data: bytes) -> bytes:
        command, block = data[0], data[1] if len(data) > 1 else 0
        if command in (6, 7):
            items = [struct.unpack("<H", data[i + 1 : i + 3])[0] for i in range(2, len(data) - 2, 3)]
            if command == 6 and block in self._blocks:
                return bytes([command, block, 17])
            self._blocks.setdefault(block, []).extend(items)
        elif command == 3:
            self._periods[block] = (data[2] * 10, time.monotonic(), 0)
        elif command in (2, 4):
            self._periods.pop(block, None)
            if command == 2:
                self._blocks.pop(block, None)
        elif command == 5:
            self._periods.clear()
            self._blocks.clear()
        return bytes([command, block, 0])
