"""The simulated drones of a study, one after the other in one process, which loads its compiled code only once.

Firmware and UDP server are those of `python -m firmware_sim`. Only the speed differs: in real time until log packets
flow; then the drone's time waits while the host has not read them or a setpoint is due. So a flight on a busy machine
is as good as on an idle one, and as fast as the machine allows.
"""

import multiprocessing
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

UNREAD = 60  # ms of log that the host may have unread
UNCONTROLLED = 20  # ms without a setpoint while they are streamed; they are 7 ms apart
PATIENCE = 0.5  # s of host time for which the drone waits for the host; the link gives up after 2 s
SETPOINTS = 7  # CRTP port; channel 0 carries setpoints, channel 1 ends them


@dataclass(frozen=True)
class Drone:
    """The drone to simulate. scenario: TOML file; seed: of every noise; speed: firmware seconds per second."""

    scenario: Path
    seed: int
    speed: float


def _serve(pipe: Connection, seen: Any) -> None:
    """Process body: receives a Drone and sends its port; the next message ends the drone; None ends the process."""
    from firmware_sim.firmware import Firmware
    from firmware_sim.flight import Flight
    from firmware_sim.scenario import load_scenario
    from firmware_sim.server import Server, bind
    from firmware_sim.wire import Air

    class UpdateThrottle(Server):
        """A server that waits for its host; `seen`: ms stamp of the newest log packet that the host has read."""

        owed: int | None = None  # tick of the newest setpoint, None while none are streamed

        def _advance(self, milliseconds: int) -> None:
            tick = self.firmware.flight.tick
            room = milliseconds
            if seen.value >= 0:
                self._speed = self.pace
                room = min(room, int(seen.value) + UNREAD - tick)
            if self.owed is not None:
                room = min(room, self.owed + UNCONTROLLED - tick)
            if room <= 0 and time.monotonic() < self.patience:
                time.sleep(0.001)
                return
            self.patience = time.monotonic() + PATIENCE
            super()._advance(room if room > 0 else milliseconds)  # waited long enough: packets were lost, so go on

        patience = float("inf")
        pace = 1.0

        def heard(self, receive: Callable[[Any], None]) -> Callable[[Any], None]:
            """The firmware's `receive`, which also notes the time of setpoints."""

            def listen(packet: Any) -> None:
                if packet.port == SETPOINTS:
                    self.owed = self.firmware.flight.tick if packet.channel == 0 else None
                receive(packet)

            return listen

    while isinstance(drone := pipe.recv(), Drone):
        try:
            scenario = load_scenario(drone.scenario)
            flight = Flight(scenario, drone.seed)
            firmware = Firmware(flight, platform=scenario.platform, seed=drone.seed, parameters=scenario.parameters)
            firmware.advance(1)
            with bind("127.0.0.1", 0) as sock:
                air = Air(scenario.link.loss, scenario.link.burst, drone.seed)
                seen.value = -1
                server = UpdateThrottle(firmware, sock, speed=1.0, air=air)
                server.pace = drone.speed
                firmware.receive = server.heard(firmware.receive)  # type: ignore[method-assign]

                def watch(server: UpdateThrottle = server) -> None:
                    pipe.recv()
                    server.stopping = True

                watcher = threading.Thread(target=watch, daemon=True)
                watcher.start()
                pipe.send(sock.getsockname()[1])
                server.run()
                watcher.join()
                pipe.send(server.dropped)
        except Exception as error:  # sent to the caller, who decides
            pipe.send(str(error) or repr(error))


class Hangar:
    """Starts drones in a process of its own; `with hangar.drone(...) as uri`."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self.seen = context.Value("q", -1, lock=False)  # ms; written by the host, see `UpdateThrottle`
        self._process = context.Process(target=_serve, args=(other, self.seen), daemon=True)
        self._process.start()
        other.close()

    def start(self, drone: Drone) -> str:
        """URI of the drone. Raises RuntimeError with the simulator's sentence."""
        self._pipe.send(drone)
        port = self._answer()
        if isinstance(port, str):
            raise RuntimeError(port)
        return f"udp://127.0.0.1:{port}"

    def stop(self) -> None:
        """End the present drone."""
        self._pipe.send("stop")
        self._answer()

    def _answer(self) -> int | str:
        if not self._pipe.poll(900.0):  # on a busy machine the first drone compiles for minutes
            raise RuntimeError("the simulator does not answer")
        answer: int | str = self._pipe.recv()
        return answer

    def close(self) -> None:
        if self._process.is_alive():
            self._pipe.send(None)
            self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.terminate()

    def __enter__(self) -> "Hangar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
