"""Fixtures of the crazyem tests: the simulator as its own process, and a bare-socket Crazyflie that loses replies."""

import contextlib
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = REPOSITORY.parent / "shared"


@pytest.fixture(scope="session")
def shared_recordings() -> Path:
    """The folder of recordings beside the repository; the test is skipped where it does not exist."""
    folder = SHARED / "recordings"
    if not folder.is_dir():
        pytest.skip("needs the recordings in ../shared")
    return folder


class Simulator:
    """`python -m firmware_sim` as a child process; `uri` is where it listens."""

    def __init__(self, *arguments: str, timeout: float = 240.0) -> None:  # a fresh clone compiles first
        command = [sys.executable, "-m", "firmware_sim", "--port", "0", *arguments]
        self.process = subprocess.Popen(
            command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert self.process.stdout is not None
        self.output: list[str] = []
        deadline = time.monotonic() + timeout
        self.uri = ""
        while not self.uri and time.monotonic() < deadline and self.process.poll() is None:
            if not select.select([self.process.stdout], [], [], 0.2)[0]:
                continue
            line = self.process.stdout.readline()
            self.output.append(line)
            found = re.search(r"udp://[\d.]+:\d+", line)
            if found:
                self.uri = found.group(0)
        if not self.uri:
            self.stop()
            raise RuntimeError("the simulator did not come up: " + "".join(self.output))
        # keep its pipe empty, or it would block on a full one
        self._drain = threading.Thread(target=self._read, daemon=True)
        self._drain.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with contextlib.suppress(ValueError):
            self.output.extend(self.process.stdout)

    def pause(self) -> None:
        """Freeze it: the peer falls silent without closing its socket."""
        os.kill(self.process.pid, signal.SIGSTOP)

    def resume(self) -> None:
        os.kill(self.process.pid, signal.SIGCONT)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(5)

    def stop(self) -> None:
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self.resume()
            self.process.terminate()
            try:
                self.process.wait(5)
            except subprocess.TimeoutExpired:
                self.kill()
        if self.process.stdout is not None:
            self._drain.join(1) if hasattr(self, "_drain") else None
            self.process.stdout.close()


@pytest.fixture
def simulator() -> Iterator[Callable[..., Simulator]]:
    """A factory: `simulator("--seed", "1")` starts one more simulator, all are stopped after the test."""
    running: list[Simulator] = []

    def start(*arguments: str) -> Simulator:
        running.append(Simulator(*arguments))
        return running[-1]

    yield start
    for one in running:
        one.stop()


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


@pytest.fixture
def fake_peer() -> Iterator[FakePeer]:
    peer = FakePeer()
    yield peer
    peer.close()
