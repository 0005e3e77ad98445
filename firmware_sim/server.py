"""The UDP server: one client at a time, real time (or a multiple of it), and nothing but CRTP datagrams.

Replies are never dropped, because cflib asks only once. Log packets are dropped when the socket would block.
"""

import contextlib
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from firmware_sim import wire
from firmware_sim.errors import ServerError
from firmware_sim.firmware import Firmware
from firmware_sim.start import bind
from firmware_sim.wire import Air

if TYPE_CHECKING:
    from firmware_sim.flight import Flight

__all__ = ["Server", "TruthWriter", "bind"]

# Largest delay of the drone's time behind the host's that is caught up after a stall; a longer delay is skipped. Below
# the 500 ms after which the setpoint watchdog regards a client as dead.
_MAX_BEHIND_HOST, _MAX_BEHIND_FIRMWARE = 250.0, 300.0  # ms of host time, ms of firmware time
_CHUNK_MS = 20  # ms of firmware time between two looks at the socket
_TRUTH_PERIOD = 10  # ms between rows of the truth file

Address = tuple[str, int]


class TruthWriter:
    """Writes rows of the flight's truth (t, position, ...) as CSV, 100 rows a second of firmware time.

    pass_time: lets milliseconds pass. Without a file, time passes and nothing is written.
    """

    def __init__(self, file: TextIO | None, flight: "Flight", pass_time: Callable[[int], None]):
        self._file, self._flight, self._pass_time = file, flight, pass_time
        self._next_row = flight.tick + 1  # tick of the next row
        if file is not None:
            file.write(",".join(flight.truth_header) + "\n")

    def advance(self, milliseconds: int) -> None:
        """Let time pass and write the rows that become due."""
        if self._file is None:
            self._pass_time(milliseconds)
            return
        flight, end = self._flight, self._flight.tick + milliseconds
        while flight.tick < end:
            self._pass_time(min(end, self._next_row) - flight.tick)
            if flight.tick < self._next_row:
                continue
            self._next_row = flight.tick - flight.tick % _TRUTH_PERIOD + _TRUTH_PERIOD
            try:
                self._file.write(",".join(f"{value:.9g}" for value in flight.truth_row()) + "\n")
            except OSError as error:
                raise ServerError(f"cannot write the truth file: {error.strerror}") from None


class Server:
    """Runs a firmware behind a bound socket. speed: firmware seconds per second of host time."""

    def __init__(
        self,
        firmware: Firmware,
        sock: socket.socket,
        *,
        speed: float = 1.0,
        truth: TextIO | None = None,
        air: Air | None = None,
    ):
        self.firmware, self._sock, self._speed = firmware, sock, speed
        self._air = air or Air(0.0, 1.0, 0)
        self.client: Address | None = None
        self.dropped = 0  # log packets
        self._pending: deque[bytes] = deque()  # replies the socket had no room for
        self._truth = TruthWriter(truth, firmware.flight, firmware.advance)
        self.stopping = False
        self._zero, self._epoch = 0, 0.0

    def run(self) -> None:
        """Serve until a signal handler sets `stopping`."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._sock, selectors.EVENT_READ)
            self.begin()
            while not self.stopping:
                due = self.turn(self.firmware.next_event)
                if due <= 0.0:
                    continue
                selector.modify(self._sock, self.wanted)
                selector.select(max(due - time.monotonic(), 0.0))

    def begin(self) -> None:
        """Start the clock at the present tick."""
        self._zero, self._epoch = self.firmware.flight.tick, time.monotonic()  # this tick belongs to this time

    def turn(self, next_event: Callable[[], int]) -> float:
        """Advance the drone by the time that is due, at most a chunk; receive and send.

        Args:
            next_event: gives the tick [ms] of the next turn.

        Returns: host time (monotonic, s) of the next turn, 0 for a turn at once.
        """
        flight = self.firmware.flight
        most = min(_MAX_BEHIND_HOST * self._speed, _MAX_BEHIND_FIRMWARE) + _CHUNK_MS
        behind = int(self._zero + (time.monotonic() - self._epoch) * 1000.0 * self._speed) - flight.tick
        if behind > most:
            self.begin()
            behind = 0
        if behind > 0:
            self._truth.advance(min(behind, _CHUNK_MS))
        self._receive_all()
        self._transmit()
        if behind > _CHUNK_MS:
            return 0.0
        return self._epoch + (next_event() - self._zero) / (1000.0 * self._speed)

    @property
    def wanted(self) -> int:
        """Events of the socket to wait for (`selectors`)."""
        return selectors.EVENT_READ | (selectors.EVENT_WRITE if self._pending else 0)

    def _receive_all(self) -> None:
        """Handle the datagrams that have arrived, at most a burst at a time: the flight must go on."""
        for _ in range(256):
            try:
                datagram, sender = self._sock.recvfrom(2048)
            except BlockingIOError:
                return
            except OSError:  # an ICMP error of a client that has gone
                continue
            if datagram == wire.SCAN_PROBE:
                with contextlib.suppress(OSError):
                    self._sock.sendto(wire.SCAN_PROBE, sender)  # a scan must not steal the session
                continue
            packet = wire.decode(datagram)
            if packet is None or packet.is_null or datagram in wire.IGNORED:
                continue
            if sender != self.client:
                self._adopt(sender)
            self.firmware.receive(packet)
            self._transmit()

    def _adopt(self, sender: Address) -> None:
        """Make the sender the client: its first packet does so, because CRTP has no start or end of a session."""
        self.client = sender
        self.firmware.outbox.clear()  # log packets for the old client
        self._pending.clear()

    def _transmit(self) -> None:
        outbox = self.firmware.outbox
        if self.client is None:
            outbox.clear()
            return
        while self._pending and self._put(self._pending[0]):
            self._pending.popleft()
        while outbox:
            datagram, droppable = outbox.popleft()
            if droppable and self._air.loses():
                continue
            if self._pending or not self._put(datagram):
                if droppable:
                    self.dropped += 1
                else:
                    self._pending.append(datagram)

    def _put(self, datagram: bytes) -> bool:
        """Send one datagram; False when the socket has no room now."""
        assert self.client is not None
        try:
            self._sock.sendto(datagram, self.client)
        except BlockingIOError:
            return False
        except OSError:  # the client's host cannot be reached: the packet is lost
            return True
        return True
