"""Between cflib and its driver: asks again for what was not answered, and lets every answer through once.

cflib asks once and waits for ever, and over UDP nobody below it asks again. Asking again is not enough: two of its
answers act whenever they come (the link's name and the protocol version begin the whole connection anew, and with it
reset the log), so an answer that nobody waits for any more, as a link that repeats packets brings too, stops here.
"""

import threading
import time
from typing import Any

_FIRST_PATIENCE = 0.15  # s until the first repetition, while nothing is known about the round trip
_LEAST_PATIENCE, _MOST_PATIENCE = 0.03, 0.5  # s
_ROUND_TRIPS = 4.0  # patience, in smoothed round trips
_BACKOFF = 1.7  # each repetition waits that much longer

_ITEM_V1, _ITEM, _INFO = 0, 2, 3
_LOG_RESET = 5
_TOCS = ((5, 0), (2, 0))

Key = tuple[int, int, bytes]


def key_of(port: int, channel: int, data: bytes) -> Key | None:
    """What a request and its reply have in common: port, channel and first bytes; None if it is not a request."""
    lengths = {(15, 1): 0, (13, 1): 1, (4, 1): 5, (2, 1): 2, (2, 3): 3}
    length = lengths.get((port, channel))
    if (port, channel) in _TOCS:
        length = {_ITEM_V1: 2, _ITEM: 3}.get(data[0] if data else -1, 1)
    elif (port, channel) == (4, 0):
        length = 2 if data[:1] == b"\x02" else 1
    elif (port, channel) == (5, 1):
        length = 1 if data[:1] == bytes((_LOG_RESET,)) else 2
    return None if length is None else (port, channel, bytes(data[:length]))


def _acts_whenever(key: Key) -> bool:
    """Whether cflib acts on such an answer even if it comes unasked."""
    port, channel, head = key
    return (port, channel) in ((15, 1), (13, 1), (4, 0), *_TOCS) or (port, channel, head) == (5, 1, b"\x05")


class Courier:
    """A cflib driver that keeps account of requests; everything else is the driver's own.

    Attributes:
        tables: port (5 log, 2 parameters) -> the reply that described its table: count and checksum.
    """

    def __init__(self, driver: Any) -> None:
        self._driver = driver
        self._lock = threading.Lock()
        self._latest: tuple[Key, Any] | None = None  # the newest request
        self._awaited: Key | None = None  # the newest request whose answer must come once only
        self._sent_at = 0.0
        self._repeated = 0
        self._round_trip = 0.0
        self._deviation = 0.0
        self.tables: dict[int, bytes] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def send_packet(self, packet: Any) -> Any:
        """Hand a packet to the driver; a request is remembered as the newest."""
        key = key_of(packet.port, packet.channel, bytes(packet.data))
        if key is not None:
            with self._lock:
                again = self._latest is not None and self._latest[1] is packet
                self._repeated = self._repeated + 1 if again else 0
                self._latest, self._sent_at = (key, packet), time.monotonic()
                if _acts_whenever(key):
                    self._awaited = key
        return self._driver.send_packet(packet)

    def receive_packet(self, wait: float = 0) -> Any:
        """The next packet, None if there is none in time or it is an answer that nobody waits for."""
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
            if _acts_whenever(key):
                if key != self._awaited:
                    return False
                self._awaited = None
                if key[:2] in _TOCS and data[:1] == bytes((_INFO,)):
                    self.tables[packet.port] = data
            if self._latest is not None and key == self._latest[0] and not self._repeated:
                self._measure(time.monotonic() - self._sent_at)
        return True

    def _measure(self, round_trip: float) -> None:
        """Smoothed round trip and its deviation, as TCP keeps them (RFC 6298)."""
        if self._round_trip == 0.0:
            self._round_trip, self._deviation = round_trip, round_trip / 2
        else:
            self._deviation += 0.25 * (abs(round_trip - self._round_trip) - self._deviation)
            self._round_trip += 0.125 * (round_trip - self._round_trip)

    def overdue(self) -> Any:
        """The newest request if it is time to send it again (through the same Crazyflie object), else None."""
        with self._lock:
            if self._latest is None:
                return None
            patience = _FIRST_PATIENCE
            if self._round_trip > 0.0:
                patience = max(_LEAST_PATIENCE, self._round_trip + _ROUND_TRIPS * self._deviation)
            patience = min(_MOST_PATIENCE, patience * _BACKOFF**self._repeated)
            return self._latest[1] if time.monotonic() - self._sent_at > patience else None
