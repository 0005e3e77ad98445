"""Bytes to and from an autopilot: UDP that waits for it, UDP that calls it, and serial ports. No thread of its own."""

import contextlib
import select
import socket
from typing import Any, Protocol

from crazyem.errors import LinkError
from crazyem.links.mavlink.address import Address

_SOCKET_BUFFER = 1 << 20  # bytes
_LARGEST_READ = 65536  # bytes taken at once

Peer = tuple[str, int] | None


class Transport(Protocol):
    """`receive` gives what has come within a time, and from whom; `send` never blocks for long and never raises."""

    where: str

    def receive(self, timeout: float) -> tuple[bytes, Peer]: ...  # raises LinkError if the wire is gone
    def send(self, data: bytes) -> bool: ...
    def answer(self, sender: Peer) -> None: ...
    def close(self) -> None: ...


class UdpTransport:
    """UDP. "in": bound, sends to whomever `answer` named. "out": sends to the address, hears nobody else."""

    def __init__(self, address: Address) -> None:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._peer: Any = None
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            self._socket.setsockopt(socket.SOL_SOCKET, option, _SOCKET_BUFFER)
        try:
            if address.kind == "udpin":
                self._socket.bind((address.host, address.port))
            else:
                self._socket.connect((address.host, address.port))
        except OSError as error:
            self._socket.close()
            what = "listen on" if address.kind == "udpin" else "send to"
            raise LinkError(f"cannot {what} UDP {address.host}:{address.port}: {error.strerror or error}.") from None
        self._connected = address.kind == "udpout"
        self._socket.setblocking(False)
        self.where = "{}:{}".format(*self._socket.getsockname()[:2])

    def receive(self, timeout: float) -> tuple[bytes, Peer]:
        try:
            if not select.select([self._socket], [], [], timeout)[0]:
                return b"", None
            data, sender = self._socket.recvfrom(_LARGEST_READ)
        except BlockingIOError:
            return b"", None
        except ValueError:
            raise LinkError("the UDP socket was closed.") from None
        except OSError:  # an ICMP error: nobody listens there yet
            return b"", None
        return data, (str(sender[0]), int(sender[1]))

    def send(self, data: bytes) -> bool:
        try:
            if self._connected:
                self._socket.send(data)
            elif self._peer is not None:
                self._socket.sendto(data, self._peer)
            else:
                return False
        except OSError:  # not reachable, or no room: as good as lost in the air
            return False
        return True

    def answer(self, sender: Peer) -> None:
        self._peer = sender

    def close(self) -> None:
        self._socket.close()


class SerialTransport:
    """A serial port, by pyserial."""

    def __init__(self, address: Address) -> None:
        import serial

        self.where = address.device
        try:
            self._port = serial.Serial(address.device, address.baud, timeout=0, write_timeout=0.5)
        except (serial.SerialException, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise LinkError(f"cannot open the serial port {address.device}: {reason}.") from None
        self._errors = (serial.SerialException, OSError, TypeError, ValueError)

    def receive(self, timeout: float) -> tuple[bytes, Peer]:
        try:
            if not select.select([self._port.fileno()], [], [], timeout)[0]:
                return b"", None
            data = bytes(self._port.read(_LARGEST_READ))
        except self._errors as error:
            raise LinkError(f"the serial port {self.where} is gone: {error}.") from None
        if not data:  # readable and empty: unplugged
            raise LinkError(f"the serial port {self.where} is gone.")
        return data, None

    def send(self, data: bytes) -> bool:
        try:
            return int(self._port.write(data)) == len(data)
        except self._errors:
            return False

    def answer(self, sender: Peer) -> None:
        """There is only one at the other end."""

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._port.close()


def open_transport(address: Address) -> Transport:
    """Raises LinkError if it cannot be opened."""
    return SerialTransport(address) if address.kind == "serial" else UdpTransport(address)
