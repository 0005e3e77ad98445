"""Requests to a Crazyflie: repeated until a reply arrives; each reply is delivered once.

cflib sends a request once and waits for ever, and UDP does not repeat it. Repetition alone is not enough, because cflib
acts on some answers at any time: the link's name and the protocol version restart the whole connection, which resets
the log. So answers that are no longer expected, also duplicates by the link, are dropped here.

The same holds for high-level commands: cflib sends a command to port 8 once and ignores the reply. The firmware answers
each with its first byte, two more, and an error (crtp_commander_high_level.c).
"""

import contextlib
import functools
import queue
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from crazyem.errors import UsageError

_FIRST_TIMEOUT = 0.15  # s until the first repetition, if the round trip is unknown
_SHORTEST_TIMEOUT, _LONGEST_TIMEOUT = 0.03, 0.5  # s
_TIMEOUT_DEVIATIONS = 4.0  # a timeout is the mean round trip plus so many deviations
_TIMEOUT_GROWTH = 1.7  # factor on the timeout for each repetition

_ITEM_V1, _ITEM, _INFO = 0, 2, 3
_LOG_RESET = 5
_TOCS = ((5, 0), (2, 0))

Key = tuple[int, int, bytes]
Reply = TypeVar("Reply")


def replies(
    ask: Callable[[], object], arrived: "queue.SimpleQueue[Reply]", *, timeout: float, repeat_after: float | None
) -> Iterator[Reply]:
    """Yield each reply that arrives within `timeout` [s]; replies from before the first request are dropped.

    Args:
        ask: sends the request; returns False if this is impossible, which ends the waiting.
        arrived: replies, from any thread.
        repeat_after: s after which the request is repeated; None if it must not be repeated.
    """
    while not arrived.empty():
        arrived.get_nowait()
    deadline, again = time.monotonic() + timeout, 0.0
    while (now := time.monotonic()) < deadline:
        if now >= again:
            if ask() is False:
                return
            again = deadline if repeat_after is None else now + repeat_after
        try:
            reply = arrived.get(timeout=max(0.001, min(deadline, again) - now))
        except queue.Empty:
            continue
        yield reply


def send(crazyflie: Any, port: int, channel: int, data: bytes) -> bool:
    """Send a packet through a cflib Crazyflie; False if its link is gone."""
    from cflib.crtp.crtpstack import CRTPPacket

    if crazyflie.link is None:
        return False
    packet = CRTPPacket()
    packet.set_header(port, channel)
    packet.data = data
    crazyflie.send_packet(packet)
    return True


def types_of(table: Any) -> dict[str, str]:
    """Name -> C type of everything in a table of contents of cflib."""
    return {f"{group}.{name}": item.ctype for group, items in table.toc.items() for name, item in items.items()}


def key_of(port: int, channel: int, data: bytes) -> Key | None:
    """Key common to a request and its reply: port, channel and first bytes; None if it is not a request."""
    lengths = {(15, 1): 0, (13, 1): 1, (4, 1): 5, (2, 1): 2, (2, 3): 3}
    length = lengths.get((port, channel))
    if (port, channel) in _TOCS:
        length = {_ITEM_V1: 2, _ITEM: 3}.get(data[0] if data else -1, 1)
    elif (port, channel) == (4, 0):
        length = 2 if data[:1] == b"\x02" else 1
    elif (port, channel) == (5, 1):
        length = 1 if data[:1] == bytes((_LOG_RESET,)) else 2
    return None if length is None else (port, channel, bytes(data[:length]))


def _acts_unrequested(key: Key) -> bool:
    """Whether cflib acts on such an answer even without a request."""
    port, channel, head = key
    return (port, channel) in ((15, 1), (13, 1), (4, 0), *_TOCS) or (port, channel, head) == (5, 1, b"\x05")


class RetryTransport:
    """A wrapper of a cflib driver that tracks requests; everything else goes to the driver.

    Attributes:
        tables: port (5 log, 2 parameters) -> the reply that describes its table: count and checksum.
    """

    def __init__(self, driver: Any) -> None:
        self._driver = driver
        self._lock = threading.Lock()
        self._latest: tuple[Key, Any] | None = None  # the newest request
        self._awaited: Key | None = None  # the newest request whose answer must be delivered only once
        self._sent_at = 0.0
        self._repeated = 0
        self._round_trip = 0.0
        self._deviation = 0.0
        self.tables: dict[int, bytes] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def send_packet(self, packet: Any) -> Any:
        """Pass a packet to the driver; a request is stored as the newest."""
        key = key_of(packet.port, packet.channel, bytes(packet.data))
        if key is not None:
            with self._lock:
                again = self._latest is not None and self._latest[1] is packet
                self._repeated = self._repeated + 1 if again else 0
                self._latest, self._sent_at = (key, packet), time.monotonic()
                if _acts_unrequested(key):
                    self._awaited = key
        return self._driver.send_packet(packet)

    def receive_packet(self, wait: float = 0) -> Any:
        """The next packet, None if there is none in time or it is an unexpected answer."""
        packet = self._driver.receive_packet(wait)
        if packet is None or not self._passes(packet):
            return None
        return packet

    def _passes(self, packet: Any) -> bool:
        data = bytes(packet.data)
        key = key_of(packet.port, packet.channel, data)
        if key is None:
            return True
        with self._lock:
            if _acts_unrequested(key):
                if key != self._awaited:
                    return False
                self._awaited = None
                if key[:2] in _TOCS and data[:1] == bytes((_INFO,)):
                    self.tables[packet.port] = data
            if self._latest is not None and key == self._latest[0] and not self._repeated:
                self._measure(time.monotonic() - self._sent_at)
        return True

    def _measure(self, round_trip: float) -> None:
        """Update the smoothed round trip and its deviation, as in TCP (RFC 6298)."""
        if self._round_trip == 0.0:
            self._round_trip, self._deviation = round_trip, round_trip / 2
        else:
            self._deviation += 0.25 * (abs(round_trip - self._round_trip) - self._deviation)
            self._round_trip += 0.125 * (round_trip - self._round_trip)

    def due_retry(self) -> Any:
        """The newest request if it is due for repetition (through the same Crazyflie object), else None."""
        with self._lock:
            if self._latest is None:
                return None
            timeout = _FIRST_TIMEOUT
            if self._round_trip > 0.0:
                timeout = max(_SHORTEST_TIMEOUT, self._round_trip + _TIMEOUT_DEVIATIONS * self._deviation)
            timeout = min(_LONGEST_TIMEOUT, timeout * _TIMEOUT_GROWTH**self._repeated)
            return self._latest[1] if time.monotonic() - self._sent_at > timeout else None


class RequestClient:
    """Client for one request at a time; may be used from any thread except cflib's own."""

    def __init__(self, crazyflie: Any) -> None:
        self._cf = crazyflie
        self._lock = threading.Lock()
        self._waiting: Key | None = None
        self._replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        crazyflie.packet_received.add_callback(self._on_packet)

    def close(self) -> None:
        """Stop listening."""
        with contextlib.suppress(ValueError):
            self._cf.packet_received.remove_callback(self._on_packet)

    def request(
        self, port: int, channel: int, data: bytes, *, timeout: float, repeat_after: float | None
    ) -> bytes | None:
        """The data of the reply with the same key as the request (`key_of`), None if none came in time.

        Args:
            timeout: s.
            repeat_after: s without a reply after which the request is repeated; None if it must not be repeated.
        """
        if self._cf.is_called_by_incoming_handler_thread():
            raise UsageError("The drone cannot be asked from inside a cflib callback.")
        key = key_of(port, channel, data)
        assert key is not None
        return next(self.replies(key, data, timeout=timeout, repeat_after=repeat_after), None)

    def replies(self, key: Key, data: bytes, *, timeout: float, repeat_after: float | None) -> Iterator[bytes]:
        """Send a request to the port and channel of its key; yield the data of each reply with this key, in time."""
        port, channel, _ = key
        with self._lock:
            self._waiting = key
            try:
                ask = functools.partial(send, self._cf, port, channel, data)
                yield from replies(ask, self._replies, timeout=timeout, repeat_after=repeat_after)
            finally:
                self._waiting = None

    def _on_packet(self, packet: Any) -> None:
        """Take a packet in cflib's thread; must not raise, or this thread ends."""
        waiting = self._waiting
        if waiting is not None and (packet.port, packet.channel) == waiting[:2]:
            data = bytes(packet.data)
            if data.startswith(waiting[2]):
                self._replies.put(data)


HIGH_LEVEL_PORT = 8
LAND_COMMAND = 8  # land2: group, height [m], yaw [rad], whether the present yaw is kept, duration [s]


def land_command(height: float, duration: float) -> bytes:
    """Command to land straight down to `height` [m, world] in `duration` [s], with the present yaw."""
    return struct.pack("<BBff?f", LAND_COMMAND, 0, height, 0.0, True, duration)


def send_until_confirmed(crazyflie: Any, command: bytes, *, timeout: float, repeat_after: float) -> bool:
    """Send a command every `repeat_after` [s] until the drone confirms it; False if not within `timeout` [s].

    For commands that may be carried out twice. Must not be called from a cflib callback.
    """
    errors: queue.SimpleQueue[int] = queue.SimpleQueue()

    def take(packet: Any) -> None:
        data = bytes(packet.data)
        if (packet.port, packet.channel) == (HIGH_LEVEL_PORT, 0) and len(data) >= 4 and data[0] == command[0]:
            errors.put(data[3])

    crazyflie.packet_received.add_callback(take)
    try:
        ask = functools.partial(send, crazyflie, HIGH_LEVEL_PORT, 0, command)
        return 0 in replies(ask, errors, timeout=timeout, repeat_after=repeat_after)
    finally:
        crazyflie.packet_received.remove_callback(take)


_PORT, _READ_CHANNEL, _WRITE_CHANNEL = 2, 1, 2
