"""CRTP packets on the wire, `[header][0..30 data bytes]` in a UDP datagram; and a model of their losses.

header = port << 4 | 0b11 << 2 | channel. Source: crazyflie-firmware docs/functional-areas/crtp, cflib crtpstack.py.
"""

import random
from typing import NamedTuple

MAX_DATA = 30  # bytes after the header

# Ports.
CONSOLE, PARAM, SETPOINT, MEMORY, LOG, LOCALISATION, SETPOINT_GENERIC, SETPOINT_HIGH_LEVEL = 0, 2, 3, 4, 5, 6, 7, 8
SUPERVISOR, PLATFORM, LINK = 9, 13, 15

PROTOCOL_VERSION = 12

# errno values of newlib, as the firmware sends them.
ENOENT, EIO, E2BIG, ENOEXEC, ENOMEM, EACCES, EBUSY, EEXIST, EINVAL = 2, 5, 7, 8, 12, 13, 16, 17, 22

SCAN_PROBE = b"\xff"
IGNORED = (b"\xf3", b"\xf4")  # start and end packets of older forks of cflib; they have no effect


class Packet(NamedTuple):
    """One CRTP packet: port 0..15, channel 0..3, at most 30 data bytes."""

    port: int
    channel: int
    data: bytes

    @property
    def is_null(self) -> bool:
        """True for link-layer null packets (port 15, channel 3): empty, and their sender does not become client."""
        return self.port == LINK and self.channel == 3


def encode(port: int, channel: int, data: bytes) -> bytes:
    """The datagram of a packet. Raises ValueError on a port, channel or length that CRTP cannot carry."""
    if not 0 <= port <= 15 or not 0 <= channel <= 3:
        raise ValueError(f"CRTP has no port {port} channel {channel}")
    if len(data) > MAX_DATA:
        raise ValueError(f"a CRTP packet carries at most {MAX_DATA} bytes, not {len(data)}")
    return bytes((port << 4 | 0x0C | channel,)) + data


def decode(datagram: bytes) -> Packet | None:
    """The packet in a datagram, or None when it is not CRTP (empty, or too long). The two link bits are ignored."""
    if not 1 <= len(datagram) <= MAX_DATA + 1:
        return None
    header = datagram[0]
    return Packet(header >> 4, header & 0x03, datagram[1:])


class Air:
    """Decides for each log packet whether it is lost (Gilbert's model: a bad state loses all, a good state none).

    Args:
        loss: share of packets lost in the long run, 0 <= loss < 1.
        burst: mean number of packets lost in a row, at least 1; 1 with a small loss is close to independent losses.
        seed: of the chain: the same seed loses the same packets of a sequence.

    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39 (1960).
    """

    def __init__(self, loss: float, burst: float, seed: int) -> None:
        # Leaving the bad state has probability 1/burst; entering it is set by the share of time spent there.
        self._leave = 1.0 / burst
        self._enter = min(1.0, self._leave * loss / (1.0 - loss))
        if self._enter == 1.0:  # the bursts are too short for this loss: leave the bad state more slowly
            self._leave = (1.0 - loss) / loss
        self._random = random.Random(seed)
        self._bad = False
        self._perfect = loss == 0.0

    def loses(self) -> bool:
        """True if the next packet is lost."""
        if self._perfect:
            return False
        self._bad = self._random.random() >= self._leave if self._bad else self._random.random() < self._enter
        return self._bad
