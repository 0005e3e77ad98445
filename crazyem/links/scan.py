"""Search for radios, drones on USB, serial ports and UDP, and for problems with them.

The module reads sysfs and udev's rules on Linux, and tests UDP ports with cflib's own probe. It searches for drones by
radio only if there is a usable radio.
"""

import contextlib
import glob
import os
import re
import select
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROBE_PACKET = b"\xff"
UDP_PORTS = tuple(range(19850, 19860))  # cflib's ports for simulated drones
UDP_WAIT = 0.2  # s for all ports together
_LARGEST_RULE = 1 << 20  # bytes that are read of a file with udev rules

# (vendor, product) -> kind, and description with advice
USB_DEVICES: dict[tuple[str, str], tuple[str, str]] = {
    ("1915", "7777"): ("radio", "Crazyradio"),
    ("1915", "0101"): ("bootloader", "Crazyradio in its bootloader (unplug it, or flash its firmware)"),
    ("35f0", "bad2"): ("bootloader", "Crazyradio 2.0 in its bootloader (unplug it, or flash its firmware)"),
    ("0483", "5740"): ("usb", "Crazyflie on USB"),
    ("0483", "df11"): ("bootloader", "Crazyflie in DFU mode (restart it to use it)"),
}
UDEV_RULES_FILE = "/etc/udev/rules.d/99-bitcraze.rules"
UDEV_RULES = tuple(
    f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}", MODE="0664", GROUP="plugdev"'
    for vendor, product in (("1915", "7777"), ("0483", "5740"))
)
_RULE_FOLDERS = ("etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d")


@dataclass(frozen=True)
class Found:
    """A device or drone that was found.

    Attributes:
        uri: its address, "" if it has none.
        what: description.
        problem: why it cannot be used, "" if it can.
    """

    uri: str
    what: str
    problem: str = ""


@dataclass
class Interface:
    """One kind of connection: what was found, and what is missing (one sentence each, with a remedy)."""

    name: str
    found: list[Found] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def scan(
    *,
    host: str = "127.0.0.1",
    ports: Sequence[int] = UDP_PORTS,
    root: Path = Path("/"),
    air: bool = True,
    search_air: Callable[[], list[str]] | None = None,
    serial_ports: Callable[[], Sequence[Any]] | None = None,
) -> list[Interface]:
    """Radio, USB, UDP and serial, in this order.

    Args:
        host, ports: to search for simulated drones.
        root: of the file system with devices and rules (for tests).
        air: whether to search by radio if there is a usable one; takes some seconds.
        search_air, serial_ports: functions for this (default: cflib, pyserial).
    """
    devices = usb_devices(root)
    rules = udev_vendors(root)
    return [
        _radio(devices, rules, search_air or _search_air if air else None),
        _by_cable("usb", "Crazyflie", devices, rules, "no Crazyflie is plugged in"),
        _udp(host, ports),
        _serial(serial_ports or _comports, root),
    ]


# --- USB ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Device:
    """A known USB device: kind, name, serial number, and whether this user may use it."""

    kind: str
    name: str
    serial: str
    vendor: str
    usable: bool


def usb_devices(root: Path = Path("/")) -> list[Device]:
    """Radios, drones and bootloaders on USB, from sysfs; empty without sysfs."""
    devices = []
    for folder in sorted(glob.glob(str(root / "sys/bus/usb/devices/*"))):
        path = Path(folder)
        vendor, product = _word(path / "idVendor"), _word(path / "idProduct")
        known = USB_DEVICES.get((vendor, product))
        if known is None:
            continue
        bus, number = _word(path / "busnum"), _word(path / "devnum")
        usable = False
        if bus.isdigit() and number.isdigit():
            usable = os.access(root / f"dev/bus/usb/{int(bus):03}/{int(number):03}", os.R_OK | os.W_OK)
        devices.append(Device(*known, _word(path / "serial"), vendor, usable))
    return devices


def _word(path: Path) -> str:
    """Text of a small sysfs file without control characters, at most 64 characters; "" if it cannot be read."""
    try:
        with path.open("rb") as file:
            text = file.read(128).decode("ascii", "replace").strip()
    except OSError:
        return ""
    return "".join(c for c in text if c.isprintable())[:64]


def udev_vendors(root: Path = Path("/")) -> set[str]:
    """USB vendors for which a udev rule gives rights to users."""
    vendors: set[str] = set()
    for folder in _RULE_FOLDERS:
        for name in sorted(glob.glob(str(root / folder / "*.rules"))):
            with contextlib.suppress(OSError), open(name, "rb") as file:
                for line in file.read(_LARGEST_RULE).decode("utf-8", "replace").splitlines():
                    found = re.search(r'idVendor\}\s*==\s*"([0-9a-fA-F]{4})"', line)
                    if found and not line.lstrip().startswith("#") and re.search(r"MODE|GROUP|uaccess", line):
                        vendors.add(found.group(1).lower())
    return vendors


def _no_rights(device: Device, rules: set[str]) -> str:
    if device.vendor not in rules:
        return f"no udev rule gives you the right to use it (see below for {UDEV_RULES_FILE})"
    return "you have no right to use it: plug it in again, and be in the group that its udev rule names"


def _rule_advice(rules: set[str]) -> list[str]:
    lines = [rule for rule in UDEV_RULES if not any(vendor in rule for vendor in rules)]
    if not lines:
        return []
    return [
        f"udev rules: write into {UDEV_RULES_FILE}\n" + "\n".join(lines) + "\n"
        "then: sudo udevadm control --reload-rules && sudo udevadm trigger, and plug the device in again"
    ]


def _by_cable(name: str, loader: str, devices: list[Device], rules: set[str], absent: str) -> Interface:
    """Plugged-in devices of one kind, numbered as in their addresses, and what is missing.

    Args:
        name: of the interface and kind of its devices. loader: word in the names of their bootloaders.
        absent: sentence if there is none.
    """
    interface = Interface(name)
    plugged = [d for d in devices if d.kind == name]
    for number, device in enumerate(plugged):
        what = device.name + (f", serial {device.serial}" if device.serial else "")
        interface.found.append(Found(f"{name}://{number}", what, "" if device.usable else _no_rights(device, rules)))
    loaders = [d for d in devices if d.kind == "bootloader" and loader in d.name]
    interface.found += [Found("", device.name, "in its bootloader") for device in loaders]
    if not interface.found:
        interface.missing.append(absent)
    if any(not d.usable for d in plugged):
        interface.missing += _rule_advice(rules)
    return interface


def _radio(devices: list[Device], rules: set[str], search: Callable[[], list[str]] | None) -> Interface:
    rule = "" if "1915" in rules else f" (nor is there a udev rule for one; it would go into {UDEV_RULES_FILE})"
    interface = _by_cable("radio", "radio", devices, rules, f"no Crazyradio dongle is plugged in{rule}")
    radios = [f for f in interface.found if f.uri]
    if radios and not any(f.problem for f in radios) and search is not None:
        try:
            uris = search()
        except Exception as error:  # cflib and libusb may raise any error
            interface.missing.append(f"the air could not be searched: {error or type(error).__name__}")
        else:
            interface.found += [Found(uri, "a drone on the air") for uri in uris]
            if not uris:
                interface.missing.append("no drone answers on its default address: is one switched on?")
    return interface


def _search_air() -> list[str]:
    """URIs of drones at their default address on all channels and rates, by the first radio (cflib, some seconds)."""
    import io

    from crazyem.links.connection import quiet_cflib

    quiet_cflib()
    from cflib.crtp.radiodriver import RadioDriver

    with contextlib.redirect_stdout(io.StringIO()) as said:  # cflib prints its errors
        found = RadioDriver().scan_interface(None)
    if not found and said.getvalue().strip():
        raise OSError(said.getvalue().strip().splitlines()[-1])
    return [str(uri) for uri, _ in found]


# --- UDP and serial -------------------------------------------------------------------------------------------------


def answering_ports(host: str, ports: Sequence[int], wait: float = UDP_WAIT) -> list[int]:
    """Ports of a host that answer cflib's probe, tested at the same time; this does not disturb a running session.

    Raises: OSError: the host is unknown.
    """
    address = socket.gethostbyname(host)
    asked: dict[socket.socket, int] = {}
    answered: list[int] = []
    try:
        for port in ports:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setblocking(False)
            asked[sock] = port
            with contextlib.suppress(OSError):
                sock.connect((address, port))
                sock.send(PROBE_PACKET)
        waiting, deadline = set(asked), time.monotonic() + wait
        while waiting and (left := deadline - time.monotonic()) > 0:
            for sock in select.select(list(waiting), [], [], left)[0]:
                waiting.discard(sock)
                with contextlib.suppress(OSError):  # refused: no program listens there
                    sock.recv(64)
                    answered.append(asked[sock])
    finally:
        for sock in asked:
            sock.close()
    return sorted(answered)


def _udp(host: str, ports: Sequence[int]) -> Interface:
    interface = Interface("udp")
    try:
        answered = answering_ports(host, ports)
    except OSError as error:
        interface.missing.append(f"the host {host} cannot be asked: {error.strerror or error}")
        return interface
    interface.found = [Found(f"udp://{host}:{port}", "a drone, or a simulated one") for port in answered]
    if not answered:
        span = f"port {ports[0]}" if len(ports) == 1 else f"ports {min(ports)} to {max(ports)}"
        interface.missing.append(
            f"nothing answers on {span} of {host}; `python -m firmware_sim` starts a simulated drone"
        )
    return interface


def _comports() -> Sequence[Any]:
    from serial.tools import list_ports

    return list(list_ports.comports())


def _serial(list_ports: Callable[[], Sequence[Any]], root: Path) -> Interface:
    interface = Interface("serial")
    try:
        ports = sorted(list_ports(), key=lambda p: str(p.device))
    except Exception as error:  # pyserial may raise any error of the platform
        interface.missing.append(f"serial ports could not be listed: {error}")
        return interface
    for port in ports:
        known = USB_DEVICES.get((f"{port.vid or 0:04x}", f"{port.pid or 0:04x}"))
        described = port.description if port.description not in (None, "n/a") else ""
        what = known[1] if known else described or "serial port"
        device = root / str(port.device).lstrip("/")
        problem = ""
        if not os.access(device, os.R_OK | os.W_OK):
            problem = "you have no right to use it: be in its group (dialout, on most systems), then log in again"
        interface.found.append(Found(f"serial://{os.path.basename(port.device)}", what, problem))
    if not ports:
        interface.missing.append("no serial port is there")
    return interface
