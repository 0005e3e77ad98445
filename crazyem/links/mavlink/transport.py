"""URIs of MAVLink links, their transports (UDP that listens, UDP that connects, serial ports), and messages sent.

The messages are heartbeats, time, commands with acknowledgements, requests for streams. No threads.
"""

import contextlib
import queue
import re
import select
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

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


OUR_SYSTEM, OUR_COMPONENT = 255, 190  # usual numbers of a ground station
_COMMAND_ATTEMPTS, _COMMAND_TIMEOUT = 4, 0.3  # of a command, s each
ACCEPTED, IN_PROGRESS = 0, 5  # MAV_RESULT


class MessageSender:
    """Sends to one system; may be used from several threads.

    Attributes:
        target: system and component of the receiver; (0, 0), all systems, until it is known.
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.target = (0, 0)
        self._packer = mavlink.MAVLink(None, srcSystem=OUR_SYSTEM, srcComponent=OUR_COMPONENT)
        self._lock = threading.Lock()
        self._commanding = threading.Lock()
        self._acks: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()

    def send(self, message: Any) -> bool:
        """Send a message; returns whether the transport accepted it."""
        with self._lock:
            data = bytes(message.pack(self._packer))
            self._packer.seq = (self._packer.seq + 1) % 256
            return self.transport.send(data)

    def heartbeat(self) -> bool:
        """Send the heartbeat of a ground station."""
        return self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def ask_time(self) -> bool:
        """Request the time; the answer has our time in ts1 and the autopilot's in tc1, ns."""
        return self.send(mavlink.MAVLink_timesync_message(0, time.monotonic_ns()))

    def answer_time(self, theirs: int) -> bool:
        """Answer an autopilot's request for our time."""
        return self.send(mavlink.MAVLink_timesync_message(time.time_ns(), theirs))

    def ask_parameter(self, name: str) -> None:
        """Send PARAM_REQUEST_READ by name."""
        self.send(mavlink.MAVLink_param_request_read_message(*self.target, name.encode(), -1))

    def set_parameter(self, name: str, value: float, kind: int) -> None:
        """Send PARAM_SET with an encoded value."""
        self.send(mavlink.MAVLink_param_set_message(*self.target, name.encode(), value, kind))

    def acknowledged(self, fields: Mapping[str, Any]) -> None:
        """Take a received COMMAND_ACK."""
        self._acks.put((int(fields["command"]), int(fields["result"])))

    def command(self, number: int, *parameters: float) -> int | None:
        """Send COMMAND_LONG, repeatedly without an answer; returns its MAV_RESULT, None without an answer."""
        values = (*parameters, *(0.0,) * (7 - len(parameters)))
        with self._commanding:
            while not self._acks.empty():
                self._acks.get_nowait()
            for attempt in range(_COMMAND_ATTEMPTS):
                self.send(mavlink.MAVLink_command_long_message(*self.target, number, attempt, *values))
                until = time.monotonic() + _COMMAND_TIMEOUT
                while (left := until - time.monotonic()) > 0:
                    try:
                        command, result = self._acks.get(timeout=left)
                    except queue.Empty:
                        break
                    if command == number and result != IN_PROGRESS:
                        return result
        return None

    def set_interval(self, message: int, hertz: float) -> int | None:
        """Send MAV_CMD_SET_MESSAGE_INTERVAL; returns MAV_RESULT or None."""
        return self.command(511, float(message), 1e6 / hertz)

    def request_stream(self, group: int, hertz: float) -> None:
        """Send the older REQUEST_DATA_STREAM, which has no answer."""
        rate = max(1, min(65535, round(hertz)))
        self.send(mavlink.MAVLink_request_data_stream_message(*self.target, group, rate, 1))

    def request_message(self, message: int) -> None:
        """Send MAV_CMD_REQUEST_MESSAGE once, without waiting for the answer."""
        self.send(mavlink.MAVLink_command_long_message(*self.target, 512, 0, float(message), 0, 0, 0, 0, 0, 0))
