"""URIs of MAVLink links: mavlink:udpin:HOST:PORT, mavlink:udpout:HOST:PORT, mavlink:DEVICE:BAUD; ?system=N chooses."""

import re
from dataclasses import dataclass

from crazyem.errors import UsageError

SCHEME = "mavlink:"
ADDRESS_EXAMPLES = "mavlink:udpin:0.0.0.0:14550, mavlink:udpout:192.168.0.7:14540 or mavlink:/dev/ttyACM0:57600"
_BAUD_RATES = range(300, 12_000_001)


@dataclass(frozen=True, slots=True)
class Address:
    """Where a drone is: kind is udpin, udpout or serial. `system` is the one to talk to, None: the first heard."""

    kind: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 57600
    system: int | None = None


def parse(uri: str) -> Address:
    """The address of a URI. Raises UsageError, naming the URI and what is wrong with it."""
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
