"""Names for kinds of CRTP packets, so that a fault can be aimed at one of them; and the error of the relay."""

from collections.abc import Iterable

from firmware_sim import wire
from firmware_sim.errors import FirmwareSimError


class RelayError(FirmwareSimError):
    """A schedule, an option or an address that cannot be used."""


# (port, channel) -> name; the part before the dot alone means every channel of the port.
KIND_NAMES: dict[tuple[int, int], str] = {
    (wire.CONSOLE, 0): "console",
    (wire.PARAM, 0): "param.toc",
    (wire.PARAM, 1): "param.read",
    (wire.PARAM, 2): "param.write",
    (wire.PARAM, 3): "param.misc",
    (wire.SETPOINT, 0): "setpoint.rpyt",
    (wire.MEMORY, 0): "memory.info",
    (wire.MEMORY, 1): "memory.read",
    (wire.MEMORY, 2): "memory.write",
    (wire.LOG, 0): "log.toc",
    (wire.LOG, 1): "log.control",
    (wire.LOG, 2): "log.data",
    (wire.LOCALISATION, 0): "localisation.position",
    (wire.LOCALISATION, 1): "localisation.generic",
    (wire.SETPOINT_GENERIC, 0): "setpoint.generic",
    (wire.SETPOINT_GENERIC, 1): "setpoint.meta",
    (wire.SETPOINT_HIGH_LEVEL, 0): "highlevel",
    (wire.SUPERVISOR, 0): "supervisor.info",
    (wire.SUPERVISOR, 1): "supervisor.command",
    (wire.PLATFORM, 0): "platform.command",
    (wire.PLATFORM, 1): "platform.version",
    (wire.LINK, 0): "link.echo",
    (wire.LINK, 1): "link.source",
    (wire.LINK, 3): "link.null",
}
OTHER = "other"
_GROUPS = {name.partition(".")[0] for name in KIND_NAMES.values()}


def kind_of(datagram: bytes) -> str:
    """Name of a datagram's kind: "log.data"; "port9.2" where the pair has no name, "other" if it is no CRTP packet."""
    if datagram == wire.SCAN_PROBE:
        return "link.null"
    packet = wire.decode(datagram)
    if packet is None:
        return OTHER
    return KIND_NAMES.get((packet.port, packet.channel), f"port{packet.port}.{packet.channel}")


def check_kinds(names: Iterable[str]) -> frozenset[str]:
    """The names as a set; a name is a kind, or the part before its dot for all of a port.

    Raises: RelayError naming the unknown kind.
    """
    known = set(KIND_NAMES.values()) | _GROUPS | {OTHER}
    wanted = frozenset(names)
    for name in sorted(wanted - known):
        port, _, channel = name.removeprefix("port").partition(".")
        numeric = name.startswith("port") and port.isdigit() and int(port) < 16
        if not numeric or (channel and channel not in "0123"):
            raise RelayError(f'there is no kind of packet "{name}"; known are {", ".join(sorted(known))} and portN.C')
    return wanted


def matches(kind: str, wanted: frozenset[str]) -> bool:
    """Whether a packet of this kind is wanted; an empty set wants all."""
    return not wanted or kind in wanted or kind.partition(".")[0] in wanted
