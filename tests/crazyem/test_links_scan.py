"""`crazyem links` on made-up machines: a folder with sysfs and udev rules in it, serial ports, UDP peers of our own."""

import json
import socket
import types

import pytest

from crazyem.cli import main
from crazyem.commands.links import drones, text
from crazyem.links.scan import PROBE_PACKET, UDEV_RULES, answering_ports, scan, udev_vendors, usb_devices

BITCRAZE = "# permissions\n" + "\n".join(UDEV_RULES) + "\n"


def plug(root, name, vendor, product, *, serial="", usable=True):
    """A USB device in a made-up sysfs; its node exists only if it is usable (whose rights it has is the system's)."""
    folder = root / "sys/bus/usb/devices" / name
    folder.mkdir(parents=True)
    number = len(list(folder.parent.iterdir()))
    content = {"idVendor": vendor, "idProduct": product, "busnum": 1, "devnum": number, "serial": serial}
    for key, value in content.items():
        (folder / key).write_text(f"{value}\n")
    if usable:
        node = root / f"dev/bus/usb/001/{number:03}"
        node.parent.mkdir(parents=True, exist_ok=True)
        node.touch()


def rules(root, content=BITCRAZE):
    folder = root / "etc/udev/rules.d"
    folder.mkdir(parents=True)
    (folder / "99-bitcraze.rules").write_text(content)


def look(root, **options):
    options = {"ports": [1], "search_air": list, "serial_ports": list} | options
    return {i.name: i for i in scan(root=root, **options)}


def test_an_empty_machine(tmp_path):
    found = look(tmp_path)
    assert list(found) == ["radio", "usb", "udp", "serial"]
    assert all(not i.found and i.missing for i in found.values())
    assert "no Crazyradio dongle is plugged in (nor is there a udev rule" in found["radio"].missing[0]
    assert "python -m firmware_sim" in found["udp"].missing[0]
    shown = text(list(found.values()))
    assert shown.endswith("No drone was found.")


def test_a_radio_that_hears_a_drone(tmp_path):
    rules(tmp_path)
    plug(tmp_path, "1-2", "1915", "7777", serial="E7E7E7")
    plug(tmp_path, "usb1", "1d6b", "0002")
    found = look(tmp_path, search_air=lambda: ["radio://0/80/2M"])
    assert [(f.uri, f.problem) for f in found["radio"].found] == [("radio://0", ""), ("radio://0/80/2M", "")]
    assert "E7E7E7" in found["radio"].found[0].what
    assert drones(list(found.values())) == ["radio://0/80/2M"]
    assert "Try: crazyem watch radio://0/80/2M" in text(list(found.values()))


def test_a_radio_without_rights_is_not_asked_and_the_rule_is_shown(tmp_path):
    plug(tmp_path, "1-2", "1915", "7777", usable=False)
    found = look(tmp_path, search_air=broken)
    assert "no udev rule" in found["radio"].found[0].problem
    shown = text(list(found.values()))
    assert "99-bitcraze.rules" in shown
    assert UDEV_RULES[0] in shown
    assert "udevadm" in shown
    assert "could not be searched" not in shown


def test_a_rule_that_is_there_but_not_in_force(tmp_path):
    rules(tmp_path)
    plug(tmp_path, "1-2", "0483", "5740", usable=False)
    found = look(tmp_path)
    assert "plug it in again" in found["usb"].found[0].problem
    assert found["usb"].missing == []
    assert drones(list(found.values())) == []


def test_a_drone_on_usb_and_devices_in_their_bootloaders(tmp_path):
    plug(tmp_path, "1-1", "0483", "5740", serial="33\x1b[2J00")
    plug(tmp_path, "1-2", "0483", "df11")
    plug(tmp_path, "1-3", "35f0", "bad2")
    found = look(tmp_path)
    assert [f.uri for f in found["usb"].found] == ["usb://0", ""]
    assert "DFU" in found["usb"].found[1].what
    assert "bootloader" in found["radio"].found[0].what
    assert "\x1b" not in found["usb"].found[0].what
    assert drones(list(found.values())) == ["usb://0"]


def broken():
    raise OSError("no backend available")


def test_nothing_answers_on_the_air_or_what_cannot_be_searched(tmp_path):
    plug(tmp_path, "1-2", "1915", "7777")
    assert "is one switched on" in look(tmp_path)["radio"].missing[0]
    assert look(tmp_path, air=False)["radio"].missing == []
    for name, options in (("radio", {"search_air": broken}), ("serial", {"serial_ports": broken})):
        assert "no backend available" in look(tmp_path, **options)[name].missing[0]


@pytest.mark.parametrize(
    ("content", "vendors"),
    [
        (BITCRAZE, {"1915", "0483"}),
        ("#" + UDEV_RULES[0], set()),
        ('ATTRS{idVendor}=="1915"\n', set()),
        ('ATTRS{idVendor} == "1915", TAG+="uaccess"\n', {"1915"}),
        ("\xff\x00", set()),
    ],
)
def test_which_rules_count(tmp_path, content, vendors):
    rules(tmp_path, content)
    assert udev_vendors(tmp_path) == vendors


def test_broken_sysfs(tmp_path):
    plug(tmp_path, "1-2", "1915", "7777")
    (tmp_path / "sys/bus/usb/devices/1-2/devnum").write_text("../../etc\n")
    (tmp_path / "sys/bus/usb/devices/1-9").mkdir()
    (device,) = usb_devices(tmp_path)
    assert not device.usable


def port(device, **options):
    return types.SimpleNamespace(**{"device": device, "vid": None, "pid": None, "description": "n/a"} | options)


def test_serial_ports(tmp_path):
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/ttyACM0").touch()
    ports = [port("/dev/ttyUSB1", description="FT232"), port("/dev/ttyACM0", vid=0x0483, pid=0x5740)]
    found = look(tmp_path, serial_ports=lambda: ports)["serial"].found
    assert [f.uri for f in found] == ["serial://ttyACM0", "serial://ttyUSB1"]
    assert found[0].what == "Crazyflie on USB"
    assert not found[0].problem
    assert "dialout" in found[1].problem


@pytest.fixture
def peers():
    sockets = []
    for _ in range(3):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind(("127.0.0.1", 0))
        sockets.append(sock)
    yield sockets
    for sock in sockets:
        sock.close()


def test_udp_ports_are_asked_together(fake_peer, peers):
    """One answers, one is silent, one is closed."""
    alive = int(fake_peer.uri.rpartition(":")[2])
    silent = peers[0].getsockname()[1]
    closed = peers[1].getsockname()[1]
    peers[1].close()
    fake_peer._answer = lambda request: [request]
    assert answering_ports("127.0.0.1", [closed, silent, alive], wait=2.0) == [alive]
    assert fake_peer.requests == [PROBE_PACKET]


def test_a_host_that_does_not_exist(tmp_path):
    assert "no.such.host.invalid" in look(tmp_path, host="no.such.host.invalid")["udp"].missing[0]


def test_the_command(capsys, fake_peer, tmp_path):
    number = fake_peer.uri.rpartition(":")[2]
    fake_peer._answer = lambda request: [request]
    out = tmp_path / "links.json"
    assert main(["links", "--ports", number, "--no-air", "--json", str(out)]) == 0
    assert f"udp://127.0.0.1:{number}" in capsys.readouterr().out
    data = json.loads(out.read_text())
    assert f"udp://127.0.0.1:{number}" in data["drones"]
    assert [i["name"] for i in data["interfaces"]] == ["radio", "usb", "udp", "serial"]
    assert main(["links", "--ports", number, "--no-air", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == data
