"""`crazyem links`: interfaces of this computer to drones, drones that answer, and missing requirements."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from crazyem.commands.output import put
from crazyem.errors import UsageError
from crazyem.links.scan import UDP_PORTS, Interface, scan
from crazyem.live.summary import check_writable, write_json

_INTERFACE_TITLES = {
    "radio": "Radio (Crazyradio)",
    "usb": "USB cable",
    "udp": "UDP (simulated drones, WiFi)",
    "serial": "Serial ports",
}
_PREFERENCE = ("radio", "usb", "udp")  # interfaces whose devices are drones; the most likely to fly first


def run(arguments: argparse.Namespace) -> int:
    """Scan and print the result; returns 0 even if nothing was found.

    Raises: UsageError: an unusable port, or the JSON cannot be written.
    """
    ports = arguments.ports or UDP_PORTS
    if not all(0 < port < 65536 for port in ports):
        raise UsageError("a UDP port lies between 1 and 65535.")
    check_writable(arguments.json)
    interfaces = scan(host=arguments.host, ports=ports, air=not arguments.no_air)
    if arguments.json != "-":
        put(text(interfaces))
    if arguments.json:
        write_json(summary(interfaces), arguments.json)
    return 0


def drones(interfaces: Sequence[Interface]) -> list[str]:
    """URIs that can be flown or watched now, best first."""
    by_name = {i.name: i for i in interfaces}
    return [
        f.uri
        for name in _PREFERENCE
        for f in (by_name[name].found if name in by_name else ())
        if f.uri and not f.problem and (name != "radio" or f.uri.count("/") > 2)
    ]


def summary(interfaces: Sequence[Interface]) -> dict[str, Any]:
    """The result for programs."""
    return {"interfaces": [asdict(i) for i in interfaces], "drones": drones(interfaces)}


def text(interfaces: Sequence[Interface]) -> str:
    """The result for people."""
    lines = []
    for interface in interfaces:
        lines.append(_INTERFACE_TITLES.get(interface.name, interface.name))
        for f in interface.found:
            lines.append(f"  {'!' if f.problem else '+'} {f.uri or '(no address)':<28} {f.what}")
            if f.problem:
                lines.append(f"      cannot be used: {f.problem}")
        for sentence in interface.missing:
            first, *rest = sentence.splitlines()
            lines.append(f"  - {first}")
            lines += [f"      {line}" for line in rest]
        lines.append("")
    ready = drones(interfaces)
    lines.append(f"Try: crazyem watch {ready[0]}" if ready else "No drone was found.")
    return "\n".join(lines)
