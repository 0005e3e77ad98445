"""Every exchange a client can have, byte for byte: flying, watchdogs, arming, localisation, boot, any packet."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_client import Client, FakeFlight, client_fixture

from firmware_sim import wire
from firmware_sim.commander import setpoint as sp
from firmware_sim.errors import ScenarioError
from firmware_sim.firmware import Firmware

client = pytest.fixture(client_fixture)


def high_level(client, form, *values):
    return client.ask(8, 0, struct.pack(form, *values))


def test_high_level_flight_and_its_replies(client):
    assert high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 1.0) == [b"\x07\x00\x00\x00"]
    client.firmware.advance(1500)
    assert client.flight.setpoint[sp.Z] == pytest.approx(1.0)
    assert client.flight.setpoint[sp.MODE_YAW] == sp.ABSOLUTE
    assert client.ask(9, 0, b"\x0c") == [b"\x8c" + struct.pack("<H", 0x031E)]
    assert client.ask(9, 0, b"\x05") == [b"\x85\x01"]
    assert high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 1.0)[0][3] == 1  # flying already
    high_level(client, "<BBBBfffff", 12, 0, 1, 0, 1.0, 0.0, 0.0, 0.5, 1.0)
    client.firmware.advance(1100)
    assert client.flight.setpoint[[sp.X, sp.Z]] == pytest.approx([1.0, 1.0])
    assert client.flight.setpoint[sp.YAW] == pytest.approx(math.degrees(0.5))
    high_level(client, "<BBff?f", 8, 0, 0.0, 0.0, True, 1.0)
    client.firmware.advance(1100)
    np.testing.assert_array_equal(client.flight.setpoint, sp.null_setpoint())
    assert high_level(client, "<BB", 99, 3) == [b"\x63\x03\x00\x08"]  # ENOEXEC
    assert high_level(client, "<B", 7)[0][3] == 8  # too short
    assert high_level(client, "<BBff?f", 10, 0, 1.0, 0.0, True, 1.0)[0] == b"\x0a\x00\x00\x08"


def test_information_bits_of_a_flight_are_those_of_the_real_firmware(client):
    """Sequence recorded from the real firmware (August 2026, brushed): high-level take-off, stream, go-to, landing."""
    seen = [client.firmware.supervisor.info]

    def watch(milliseconds, packet=None):
        for _ in range(milliseconds // 20):
            if packet:
                client.ask(7, 0, packet)
            client.firmware.advance(20)
            info = int(client.firmware.log.table.by_name["supervisor.info"].value)
            if info != seen[-1]:
                seen.append(info)

    high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 2.5)
    watch(4000)
    watch(2000, b"\x07" + struct.pack("<ffff", 0.0, 0.0, 1.0, 0.0))
    client.ask(7, 1, b"\x00" + struct.pack("<I", 0))
    high_level(client, "<BBBBfffff", 12, 0, 0, 0, 0.0, 0.0, 1.0, 0.0, 2.0)
    watch(2500)
    high_level(client, "<BBff?f", 8, 0, 0.0, 0.0, True, 2.5)
    watch(3000)
    real = [0x20E, 0x10E, 0x11E, 0x31E, 0x21E, 0x11E, 0x31E, 0x11E, 0x21E]
    assert [info for info in seen if info != 0x10E] == [
        info for info in real if info != 0x10E
    ]  # flies within an update


def test_a_notice_in_flight_without_a_command_stops_the_motors(client):
    hover = b"\x0a" + struct.pack("<ffff", 0.0, 0.0, 0.0, 0.7)
    client.ask(7, 0, hover)
    client.firmware.advance(100)
    assert client.flight.setpoint[sp.MODE_Z] == sp.ABSOLUTE
    client.ask(7, 1, b"\x00" + struct.pack("<I", 0))
    client.firmware.advance(20)
    np.testing.assert_array_equal(client.flight.setpoint, sp.null_setpoint())


def test_group_masks(client):
    assert high_level(client, "<BBff?f", 7, 2, 1.0, 0.0, True, 1.0)[0][3] == 0
    client.firmware.advance(100)
    assert client.flight.setpoint[sp.MODE_Z] == 0  # not our group
    high_level(client, "<BB", 0, 2)
    high_level(client, "<BBff?f", 7, 2, 1.0, 0.0, True, 1.0)
    client.firmware.advance(100)
    assert client.flight.setpoint[sp.MODE_Z] == sp.ABSOLUTE


def test_uploaded_trajectory(client):
    piece = struct.pack("<33f", 0.0, 1.0, *[0.0] * 6, *[0.0] * 8, 1.0, *[0.0] * 15, 2.0)
    for start in range(0, len(piece), 24):
        client.ask(4, 2, struct.pack("<BI", 0, 264 + start) + piece[start : start + 24])
    assert high_level(client, "<BBBBIB", 6, 1, 1, 0, 264, 1)[0][3] == 0
    assert high_level(client, "<BBBBIB", 6, 10, 1, 0, 264, 1)[0][3] == 8
    assert high_level(client, "<BBBBBBf", 13, 0, 0, 0, 0, 3, 1.0)[0][3] == 8  # not defined
    high_level(client, "<BBff?f", 7, 0, 0.5, 0.0, True, 0.1)
    client.firmware.advance(200)
    assert high_level(client, "<BBBBBBf", 13, 0, 1, 0, 0, 1, 0.5)[0][3] == 0
    client.firmware.advance(1200)
    assert client.flight.setpoint[[sp.X, sp.Z]] == pytest.approx([2.0, 0.5])

    compressed = struct.pack("<4h", 0, 0, 500, 0) + struct.pack("<BHh", 0x01, 1000, 300) + bytes(3)
    client.ask(4, 2, struct.pack("<BI", 0, 1000) + compressed)
    high_level(client, "<BBBBIB", 6, 2, 1, 1, 1000, 1)
    assert high_level(client, "<BBBBBBf", 13, 0, 0, 0, 0, 2, 2.0)[0][3] == 8  # compressed ones do not stretch
    assert high_level(client, "<BBBBBBf", 13, 0, 0, 0, 0, 2, 1.0)[0][3] == 0
    client.firmware.advance(510)
    assert client.flight.setpoint[[sp.X, sp.Z]] == pytest.approx([0.15, 0.5], abs=0.003)


def test_brushless_arming_over_both_ports():
    client = Client("cf21bl")
    assert client.ask(9, 0, b"\x0c") == [b"\x8c" + struct.pack("<H", 0x0201)]
    assert high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 0.5)[0][3] == 16
    assert client.ask(9, 1, b"\x01\x01") == [b"\x81\x01\x01"]
    client.firmware.advance(80)
    assert client.flight.armed
    assert client.flight.motors_allowed
    assert client.ask(13, 0, b"\x01\x00") == [b"\x01\x01\x00"]
    client.firmware.advance(80)
    assert not client.flight.armed
    assert client.ask(9, 1, b"\x02") == [b"\x82\x01\x01"]
    assert client.ask(9, 1, b"\x03") == []
    client.firmware.advance(120)
    assert client.ask(9, 0, b"\x07") == [b"\x87\x01"]


def test_localisation_reaches_the_estimator(client):
    client.ask(6, 0, struct.pack("<fff", 1.0, 2.0, 3.0))
    client.ask(6, 1, b"\x08" + struct.pack("<7f", 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0))
    client.ask(6, 1, b"\x09" + struct.pack("<BhhhI", 0xE7, 1000, 0, -500, 3 << 30))
    client.ask(6, 2, struct.pack("<BhhhBhhh", 0x01, 9, 9, 9, 0xE7, 100, 200, 300))
    assert client.flight.fixes == [
        [1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], [1.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0], [0.1, 0.2, 0.3],
    ]  # fmt: skip


def test_boot_console_text_and_splitting():
    firmware = Firmware(FakeFlight(), platform="cf2", seed=0)
    assert not firmware.outbox
    firmware.receive(wire.Packet(15, 1, b"\0"))
    first, *rest = (wire.decode(datagram) for datagram, _ in firmware.outbox)
    assert first.port == wire.LINK  # replies come first
    assert all(p.port == wire.CONSOLE and len(p.data) <= 30 for p in rest)
    text = "".join(p.data.decode() for p in rest)
    assert "up and running" in text
    from firmware_sim.services.ports import text_chunks

    assert [chunk.decode() for chunk in text_chunks("ä" * 20)] == ["ä" * 15, "ä" * 5]


def test_scenario_parameters_are_boot_values():
    client = Client(parameters={"ctrlLee.mass": 0.05, "supervisor.prefltTimeout": 1000.0})
    lee = client.param_id("ctrlLee.mass")
    assert client.ask(2, 1, lee) == [lee + b"\0" + struct.pack("<f", 0.05)]
    assert client.ask(2, 3, b"\x08" + lee) == [b"\x08" + lee + b"\x00" + struct.pack("<f", 0.029)]
    with pytest.raises(ScenarioError, match=r"ctrlLee\.mas,"):
        Client(parameters={"ctrlLee.mas": 0.05})


def test_the_same_seed_is_the_same_flight():
    """Down to the bytes of every log packet; another seed gives another flight."""
    from firmware_sim.flight import Flight
    from firmware_sim.scenario import load_scenario

    def packets(seed):
        firmware = Firmware(Flight(load_scenario(None), seed), platform="cf2", seed=seed)
        firmware.advance(200)
        index = [item.name for item in firmware.log.table.items].index("stateEstimate.x")
        for data in (struct.pack("<BBBH", 6, 1, 7, index), b"\x03\x01\x01"):
            firmware.receive(wire.Packet(wire.LOG, 1, data))
        firmware.receive(wire.Packet(wire.SETPOINT_HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 0.5, 0.0, True, 1.0)))
        firmware.advance(2000)
        assert firmware.supervisor.flying
        return list(firmware.outbox)

    assert packets(3) == packets(3)
    assert packets(3) != packets(4)


@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_no_packet_breaks_the_firmware(port, channel, data):
    """Whatever arrives, it is answered with packets or ignored; and a request is answered at most once."""
    client = shared_client()
    client.firmware.receive(wire.Packet(port, channel, data))
    client.firmware.advance(3)
    replies = [p for p in client.outgoing() if p[:2] == (port, channel)]
    assert len(replies) <= 1 or port == wire.CONSOLE


_shared = []


def shared_client():
    if not _shared or _shared[0].firmware.supervisor.stopped:
        _shared[:] = [Client()]
    return _shared[0]
