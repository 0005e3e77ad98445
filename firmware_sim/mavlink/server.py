"""The MAVLink front end: its wires (UDP or a pseudo-terminal), the loop in real time, and the start of a run."""

import argparse
import contextlib
import os
import select
import socket
import time
import tty
from collections.abc import Sequence
from typing import Protocol, TextIO

from firmware_sim.errors import FirmwareSimError, ServerError
from firmware_sim.firmware import boot
from firmware_sim.mavlink.autopilot import Autopilot
from firmware_sim.server import TruthWriter
from firmware_sim.start import open_truth, stop_on_signals

_MAX_BEHIND, _CHUNK = 250.0, 20  # ms of host time to catch up; ms of drone time between two looks at the wire
_BURST, _ERRORS = 64, 16  # datagrams handled at a time; errors of a client that is not there


class Wire(Protocol):
    """Bytes both ways, never blocking."""

    where: str  # address as a client writes it

    def fileno(self) -> int: ...
    def receive(self) -> bytes: ...
    def send(self, data: bytes) -> bool: ...
    def close(self) -> None: ...


class Udp:
    """udpout:HOST:PORT calls a ground station, as autopilots do; udpin:HOST:PORT waits for one."""

    def __init__(self, kind: str, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peer: tuple[str, int] | None = (host, port) if kind == "udpout" else None
        self._fixed = kind == "udpout"
        try:
            self._socket.bind((host, port) if kind == "udpin" else ("", 0))
        except (OSError, OverflowError) as error:
            self._socket.close()
            reason = getattr(error, "strerror", None) or str(error)
            raise ServerError(f"cannot use UDP {host}:{port}: {reason}") from None
        self._socket.setblocking(False)
        own = "{}:{}".format(*self._socket.getsockname())
        self.where = f"mavlink:udpin:{host}:{port}" if self._fixed else f"mavlink:udpout:{own}"

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> bytes:
        for _ in range(_ERRORS):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                return b""
            except OSError:  # an ICMP error of a client that is not there
                continue
            if not self._fixed:
                self._peer = sender
            if data:
                return data
        return b""

    def send(self, data: bytes) -> bool:
        if self._peer is None:
            return True  # there is no client yet
        try:
            self._socket.sendto(data, self._peer)
        except BlockingIOError:
            return False
        except OSError:
            return True  # the packet is lost
        return True

    def close(self) -> None:
        self._socket.close()


class Pty:
    """A serial port: the other end of a pseudo-terminal."""

    def __init__(self) -> None:
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise ServerError(f"there is no pseudo-terminal to be had: {error.strerror}") from None
        tty.setraw(self._slave)  # kept open, so that the port outlives its clients
        os.set_blocking(self._master, False)
        self.where = f"mavlink:{os.ttyname(self._slave)}:57600"

    def fileno(self) -> int:
        return self._master

    def receive(self) -> bytes:
        try:
            return os.read(self._master, 65536)
        except (BlockingIOError, OSError):
            return b""

    def send(self, data: bytes) -> bool:
        """Send a whole frame or nothing, as far as the system allows; False: nobody reads."""
        try:
            return os.write(self._master, data) == len(data)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def close(self) -> None:
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)


def wire_of(text: str) -> Wire:
    """From "udpout:HOST:PORT", "udpin:HOST:PORT" or "serial". Raises FirmwareSimError in one sentence."""
    if text == "serial":
        return Pty()
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind not in ("udpin", "udpout") or not host or not port.isdecimal() or not int(port) <= 65535:
        raise FirmwareSimError(f"--mavlink must be udpout:HOST:PORT, udpin:HOST:PORT or serial, not '{text}'")
    return Udp(kind, host, int(port))


class MavlinkServer:
    """Runs an autopilot on several wires: all get the same, all may command. speed: its seconds per host second."""

    def __init__(
        self, autopilot: Autopilot, wires: Sequence[Wire], *, speed: float = 1.0, truth: TextIO | None = None
    ) -> None:
        self.autopilot, self._wires, self._speed = autopilot, wires, speed
        self._truth = TruthWriter(truth, autopilot.firmware.flight, autopilot.advance)
        self.dropped = 0
        self.stopping = False

    def run(self) -> None:
        """Serve until a signal handler sets `stopping`."""
        flight = self.autopilot.firmware.flight
        zero, epoch = flight.tick, time.monotonic()
        while not self.stopping:
            behind = int(zero + (time.monotonic() - epoch) * 1000.0 * self._speed) - flight.tick
            if behind > _MAX_BEHIND * self._speed + _CHUNK:
                zero, epoch, behind = flight.tick, time.monotonic(), 0
            if behind > 0:
                self._truth.advance(min(behind, _CHUNK))
            self._listen()
            self._talk()
            if behind > _CHUNK:
                continue
            due = epoch + (self.autopilot.next_event() - zero) / (1000.0 * self._speed)
            select.select(self._wires, [], [], max(due - time.monotonic(), 0.0))

    def _listen(self) -> None:
        for number, wire in enumerate(self._wires):
            for _ in range(_BURST):  # a limit, so that the flight goes on
                if not (data := wire.receive()):
                    break
                self.autopilot.receive(data, channel=number)

    def _talk(self) -> None:
        """Send waiting frames; a wire without room loses the frame, like a radio."""
        while self.autopilot.outbox:
            frame = self.autopilot.outbox.popleft()
            self.dropped += sum(not wire.send(frame) for wire in self._wires)


def run(arguments: argparse.Namespace) -> None:
    """Serve until SIGINT or SIGTERM. Raises FirmwareSimError in one sentence."""
    if arguments.swarm is not None:
        raise FirmwareSimError("--mavlink is for one drone: leave out --swarm")
    with contextlib.ExitStack() as stack:
        wires = [stack.enter_context(contextlib.closing(wire_of(text))) for text in arguments.mavlink]
        from firmware_sim.plant import layout
        from firmware_sim.scenario import load_scenario  # here: compiled code takes a while to load

        scenario = load_scenario(arguments.scenario)
        truth = open_truth(arguments.truth, stack)
        firmware = boot(scenario, arguments.seed)
        autopilot = Autopilot(firmware, thrust=4.0 * float(scenario.board()[layout.B_THRUST_MAX]))
        server = MavlinkServer(autopilot, wires, speed=arguments.speed, truth=truth)
        stop_on_signals(server)
        where = " ".join(wire.where for wire in wires)
        print(f"firmware_sim: {where} platform {scenario.platform} seed {arguments.seed}", flush=True)
        server.run()
