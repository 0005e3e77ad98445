"""URIs of MAVLink links and their transports: UDP that listens, UDP that connects, serial ports. No threads."""

import contextlib
import re
import select
import socket
from dataclasses import dataclass
from typing import Any, Protocol

from crazyem.errors import LinkError, UsageError

SCHEME = "mavlink:"
ADDRESS_EXAMPLES = "mavlink:udpin:0.0.0.0:14550, mavlink:udpout:192.168.0.7:14540 or mavlink:/dev/ttyACM0:57600"
_BAUD_RATES = range(300, 12_000_001)


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a drone: kind is udpin, udpout or serial; `system` is its number, None: the first one received."""

    kind: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 57600
    system: int | None = None


def parse(uri: str) -> Address:
    """The address in a URI. Raises UsageError, which names the URI and its error."""
    if not uri.startswith(SCHEME) or not uri.isprintable() or len(uri) > 500:
        raise UsageError(f'"{uri[:100]!s}" is no MAVLink URI; it should look like {ADDRESS_EXAMPLES}.')
    place, _, query = uri[len(SCHEME) :].partition("?")
    system = _system(uri, query)
    kind, separator, rest = place.partition(":")
    if kind in ("udpin", "udpout") and separator:
        host, _, port = rest.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        least = 0 if kind == "udpin" else 1  # 0: any free port, for tests
        if not host or not _digits(port) or not least <= int(port) <= 65535:
            raise UsageError(f'"{uri}" needs a host and a port, such as mavlink:{kind}:127.0.0.1:14550.')
        return Address(kind, host=host, port=int(port), system=system)
    if place.startswith("/") or re.match(r"COM\d+(:|$)", place):
        device, separator, baud = place.rpartition(":")
        if not separator:
            device, baud = place, "57600"
        if not device or not _digits(baud) or int(baud) not in _BAUD_RATES:
            raise UsageError(f'"{uri}" needs a device and a baud rate, such as mavlink:/dev/ttyACM0:57600.')
        return Address("serial", device=device, baud=int(baud), system=system)
    raise UsageError(f'"{uri}" is no MAVLink URI; it should look like {ADDRESS_EXAMPLES}.')


def _system(uri: str, query: str) -> int | None:
    if not query:
        return None
    name, _, value = query.partition("=")
    if name != "system" or not _digits(value) or not 1 <= int(value) <= 255:
        raise UsageError(f'"{uri}": after the ? only system=N can stand, N from 1 to 255.')
    return int(value)


def _digits(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 8


_SOCKET_BUFFER = 1 << 20  # bytes
_LARGEST_READ = 65536  # bytes of one read

Peer = tuple[str, int] | None


class Transport(Protocol):
    """Interface of a transport: `receive` gives bytes and their sender; `send` blocks only briefly and never raises."""

    where: str

    def receive(self, timeout: float) -> tuple[bytes, Peer]: ...  # raises LinkError if the wire is gone
    def send(self, data: bytes) -> bool: ...
    def answer(self, sender: Peer) -> None: ...
    def close(self) -> None: ...


class UdpTransport:
    """UDP. "in": bound, sends to the peer set by `answer`. "out": sends to the address, receives only from it."""

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
        except OSError:  # an ICMP error: no program listens there yet
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
        except OSError:  # not reachable, or no buffer: like a packet lost in the air
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
        """Does nothing: a serial port has only one peer."""

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._port.close()


def open_transport(address: Address) -> Transport:
    """Open the transport of an address. Raises LinkError if this fails."""
    return SerialTransport(address) if address.kind == "serial" else UdpTransport(address)
