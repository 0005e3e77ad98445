"""Starts and stops the simulated firmware in its own process; the process returns only its address."""

import atexit
import contextlib
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from crazyem.errors import CrazyemError, FileFormatError

READY_LINE = re.compile(r"(udp://\S+)")
START_TIMEOUT = 180.0  # s; the first start on a machine compiles the plant's kernels


class Simulator:
    """`python -m firmware_sim` on a free port of this host, during a `with` block.

    Args:
        scenario: file with the true values, read only by the simulator; None for its defaults.
        seed: of all its noise.
        speed: firmware seconds per second.
        command: another command to start (tests).

    Raises:
        FileFormatError: the simulator refused its scenario (with its own sentence).
        CrazyemError: the simulator did not start.
    """

    def __init__(
        self,
        *,
        scenario: str | Path | None = None,
        seed: int = 0,
        speed: float = 1.0,
        command: Sequence[str] | None = None,
        timeout: float = START_TIMEOUT,
    ) -> None:
        self.uri = ""
        self.timeout = timeout
        self._scenario = scenario
        self._command = list(command) if command else [sys.executable, "-m", "firmware_sim"]
        self._command += ["--port", "0", "--seed", str(seed), "--speed", f"{speed:g}"]
        if scenario is not None:
            self._command += ["--scenario", str(scenario)]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Simulator":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def launch(self) -> None:
        """Start the process without waiting, so that several simulators can compile at the same time."""
        # In its own session: Ctrl-C in the terminal must land the drone, not end its firmware.
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        atexit.register(self.stop)

    def start(self) -> str:
        """Launch the process if needed, wait until it answers, and return its URI."""
        if self._process is None:
            self.launch()
        process = self._process
        assert process is not None
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        errors: list[str] = []

        def read_out() -> None:
            for line in process.stdout or ():
                lines.put(line)
            lines.put(None)

        def read_errors() -> None:
            errors.extend(line.strip() for line in process.stderr or () if line.strip())

        threads = [threading.Thread(target=f, daemon=True) for f in (read_out, read_errors)]
        for thread in threads:
            thread.start()
        while True:
            try:
                line = lines.get(timeout=self.timeout)
            except queue.Empty:
                self.stop()
                raise CrazyemError(f"the simulator did not get ready within {self.timeout:g} s.") from None
            if line is None:
                code = process.wait()
                threads[1].join(timeout=1.0)
                self.stop()
                reason = errors[-1].removeprefix("firmware_sim: ") if errors else f"exit code {code}"
                if self._scenario is not None and Path(str(self._scenario)).name in reason:
                    raise FileFormatError(reason)
                raise CrazyemError(f"the simulator did not start: {reason}")
            found = READY_LINE.search(line)
            if found:
                self.uri = found.group(1)
                return self.uri

    def stop(self) -> None:
        """End the process; safe to call twice."""
        atexit.unregister(self.stop)
        process, self._process = self._process, None
        if process is None:
            return
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for stream in filter(None, (process.stdout, process.stderr)):
            with contextlib.suppress(OSError, ValueError):
                stream.close()
