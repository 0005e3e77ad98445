"""A simulated drone on a real socket, in a thread of this process, whose time can wait for the host."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight as SimulatedFlight
from firmware_sim.scenario import load_scenario
from firmware_sim.server import Server, bind

# A gate for writes without a guard: every write passes (see crazyem.live.telemetry).
OPEN_GATE: Any = SimpleNamespace(stale=lambda: "", misplaced=lambda purpose: "")


class Pace:
    """Makes the drone's time wait for an estimator that is late on a slow machine, because this is no drawn fault."""

    def __init__(self, speed: float) -> None:
        self.speed = speed  # firmware seconds per second
        self.late: Callable[[], bool] | None = None  # whether the drone has to wait

    def wait(self) -> None:
        """Wait while the estimator is late, at most 0.2 s: less than the delay that the simulator catches up."""
        until = time.monotonic() + 0.2
        while (late := self.late) is not None and late() and time.monotonic() < until:
            time.sleep(0.003)


@contextlib.contextmanager
def in_a_thread(server: Any) -> Iterator[None]:
    """Run a relay or a simulated drone in another thread."""
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.stopping = True
        thread.join(5.0)


@contextlib.contextmanager
def simulator(scenario: Path, *, seed: int, truth: Path, pace: Pace) -> Iterator[tuple[str, int]]:
    """A simulated drone and its address; its true motion goes to the file `truth`."""
    facts = load_scenario(scenario)
    firmware = Firmware(
        SimulatedFlight(facts, seed), platform=facts.platform, seed=seed, parameters=dict(facts.parameters)
    )
    with contextlib.ExitStack() as stack:
        sock = stack.enter_context(contextlib.closing(bind("127.0.0.1", 0)))
        file = stack.enter_context(truth.open("w", encoding="utf-8"))
        firmware.advance(1)
        advance = firmware.advance

        def throttle(milliseconds: int) -> None:
            pace.wait()
            advance(milliseconds)

        firmware.advance = throttle  # type: ignore[method-assign]
        stack.enter_context(in_a_thread(Server(firmware, sock, speed=pace.speed, truth=file)))
        yield sock.getsockname()
