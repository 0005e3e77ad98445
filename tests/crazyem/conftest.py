"""Fixtures of the crazyem tests: the simulator as its own process, and a bare-socket Crazyflie that loses replies."""

import contextlib
import fcntl
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_peer import FakePeer

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = REPOSITORY.parent / "shared"


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[[str, Callable[[], str]], str]:
    """`made_once(name, make)`: a text that takes long to make, made by the first of all processes that asks for it."""
    own = tmp_path_factory.getbasetemp()
    folder = own if worker_id == "master" else own.parent

    def text(name: str, make: Callable[[], str]) -> str:
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
            path = folder / name
            if not path.exists():
                path.write_text(make(), encoding="utf-8")
            return path.read_text(encoding="utf-8")

    return text


@pytest.fixture(scope="session")
def shared_recordings() -> Path:
    """The folder of recordings beside the repository; the test is skipped where it does not exist."""
    folder = SHARED / "recordings"
    if not folder.is_dir():
        pytest.skip("needs the recordings in ../shared")
    return folder


class Simulator:
    """`python -m firmware_sim` as a child process; `uri` is where it listens."""

    def __init__(self, *arguments: str, timeout: float = 1800.0) -> None:  # s, for one that hangs
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
        self.process.wait(60)

    def stop(self) -> None:
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self.resume()
            self.process.terminate()
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                self.kill()
        if self.process.stdout is not None:
            self._drain.join(1) if hasattr(self, "_drain") else None
            self.process.stdout.close()


@pytest.fixture(scope="module")
def resting() -> Iterator[Simulator]:
    """One simulator for all tests of a file, each of which leaves it as it was: on the floor, with nobody connected."""
    drone = Simulator("--seed", "1")
    yield drone
    drone.stop()


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


@pytest.fixture
def fake_peer() -> Iterator[FakePeer]:
    peer = FakePeer()
    yield peer
    peer.close()
