"""Every exchange a client can have, byte for byte: the firmware in the same process, the flight a fake."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_sim import tables, wire
from firmware_sim.commander import setpoint as sp
from firmware_sim.errors import ScenarioError
from firmware_sim.firmware import Firmware

LOG = [
    *(f"stateEstimate.{n}" for n in ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")),
    *(f"{group}.{axis}" for group in ("gyro", "acc") for axis in "xyz"),
    *(f"motor.m{n}" for n in range(1, 5)),
    "pm.vbat",
    "pm.state",
    *(f"filler{n}.value" for n in range(140)),
]
PARAM = {"ctrlLee.mass": 0.029, "ctrlMel.mass": 0.03, "stabilizer.controller": 5.0, "powerDist.idleThrust": 7000.0}


class FakeFlight:
    """The estimate is where the setpoint is, once the motors may turn."""

    def __init__(self):
        self.tick = 0
        self.log, self.param = tables.slots(dict.fromkeys(LOG, 0.0)), tables.slots(PARAM)
        self.param_defaults = dict(PARAM)
        self.setpoint = sp.null_setpoint()
        self.motors_allowed = self.armed = False
        self.written, self.fixes = [], []
        self.set("acc.z", 1.0)
        self.set("pm.vbat", 4.1)

    def set(self, name, value):
        array, index = self.log[name]
        array[index] = value

    def parameter_written(self, name):
        self.written.append(name)
        array, index = self.param["stabilizer.controller"]
        if name == "stabilizer.controller" and array[index] == 0:
            array[index] = 5.0

    def external_position(self, position):
        self.fixes.append(np.round(position, 6).tolist())

    def external_pose(self, position, quaternion):
        self.fixes.append(np.round(np.concatenate([position, quaternion]), 2).tolist())

    def step(self):
        self.tick += 1
        flying = self.motors_allowed and self.setpoint[sp.MODE_Z] != 0
        self.set("motor.m1", 30000.0 if flying else 0.0)
        if flying:
            self.set("stateEstimate.z", self.setpoint[sp.Z])


class Client:
    """Talks to a firmware without sockets."""

    def __init__(self, platform="cf2", **kwargs):
        self.flight = FakeFlight()
        self.firmware = Firmware(self.flight, platform=platform, seed=1, **kwargs)
        self.firmware.advance(201)
        self.ask(wire.LINK, 0, b"")
        self.outgoing()

    def outgoing(self):
        packets = [wire.decode(datagram) for datagram, _ in self.firmware.outbox]
        self.firmware.outbox.clear()
        return packets

    def ask(self, port, channel, data):
        """The data of every reply on the same port and channel."""
        self.firmware.receive(wire.Packet(port, channel, bytes(data)))
        return [bytes(p.data) for p in self.outgoing() if p[:2] == (port, channel)]

    def log_id(self, name):
        return [item.name for item in self.firmware.log.table.items].index(name)

    def param_id(self, name):
        return struct.pack("<H", [item.name for item in self.firmware.param.table.items].index(name))

    def create(self, number, names, kind=7, command=6):
        body = b"".join(struct.pack("<BH", kind, self.log_id(name)) for name in names)
        return self.ask(5, 1, bytes((command, number)) + body)[0]


@pytest.fixture
def client():
    return Client()


def test_link_and_platform(client):
    assert client.ask(15, 0, b"\x00pings123") == [b"\x00pings123"]
    assert client.ask(15, 1, b"\x00") == [b"Bitcraze Crazyflie" + bytes(12)]
    assert client.ask(15, 2, b"\x00") == []
    assert client.ask(13, 1, b"\x00") == [b"\x00\x0c\x00\x00\x00"]
    assert client.ask(13, 1, b"\x01")[0][1:].endswith(b"\0")
    assert client.ask(13, 1, b"\x02") == [b"\x02Crazyflie 2.1\0"]
    assert client.ask(13, 0, b"\x01\x01") == [b"\x01\x01\x01"]


def test_table_of_contents(client):
    (info,) = client.ask(5, 0, b"\x03")
    command, count, crc, blocks, operations = struct.unpack("<BHIBB", info)
    assert (command, blocks, operations) == (3, 16, 128)
    (param_info,) = client.ask(2, 0, b"\x03")
    assert len(param_info) == 7
    assert struct.unpack_from("<I", param_info, 3)[0] != crc
    names = set()
    for n in range(count):
        (item,) = client.ask(5, 0, struct.pack("<BH", 2, n))
        assert item[:3] == struct.pack("<BH", 2, n)
        group, name, rest = item[4:].split(b"\0")
        assert rest == b""  # the final NUL
        names.add(f"{group.decode()}.{name.decode()}")
    assert {"pm.vbat", "supervisor.info", "sys.canfly", "motor.m1"} <= names
    assert client.ask(5, 0, struct.pack("<BH", 2, count)) == [b"\x02"]
    assert client.ask(2, 0, b"\x02\xff\xff") == [b"\x02"]


def test_log_block_errors(client):
    assert client.ask(5, 1, b"\x05") == [b"\x05\x00\x00"]
    assert client.create(1, ["pm.vbat"]) == b"\x06\x01\x00"
    assert client.create(1, ["pm.vbat"]) == b"\x06\x01\x11"  # EEXIST
    assert client.create(2, ["gyro.x"] * 6 + ["acc.x"]) == b"\x06\x02\x07"  # E2BIG, 28 bytes
    assert client.ask(5, 1, b"\x06\x03\x07\xf0\xf0") == [b"\x06\x03\x02"]  # ENOENT
    assert client.ask(5, 1, b"\x00\x04\x07\x00") == [b"\x00\x04\x08"]  # V1 create: ENOEXEC
    for command in (3, 4, 2, 7):
        assert client.ask(5, 1, bytes((command, 99, 1))) == [bytes((command, 99, 2))]
    assert client.ask(5, 1, b"\x02\x01") == [b"\x02\x01\x00"]
    assert client.ask(5, 1, b"\x03\x01\x01") == [b"\x03\x01\x02"]


def test_log_limits(client):
    for number in range(16):
        assert client.create(number, ["pm.state"] * 8, kind=1)[2] == 0
    assert client.create(17, ["pm.state"]) == b"\x06\x11\x0c"  # ENOMEM: 16 blocks
    assert client.create(0, ["pm.state"], kind=1, command=7) == b"\x07\x00\x0c"  # ENOMEM: 128 variables
    client.ask(5, 1, b"\x05")
    assert client.create(17, ["pm.state"]) == b"\x06\x11\x00"


def test_a_dangling_type_byte_is_ignored_and_the_high_nibble_too(client):
    body = b"".join(struct.pack("<BH", 0x74, client.log_id("pm.vbat")) for _ in range(9))
    assert client.ask(5, 1, b"\x06\x05" + body + b"\x74") == [b"\x06\x05\x00"]
    assert client.create(5, ["pm.state"], kind=0x11, command=7) == b"\x07\x05\x00"
    assert client.ask(5, 1, b"\x03\x05\x00") == [b"\x03\x05\x00"]  # one shot
    client.firmware.advance(50)
    (packet,) = client.outgoing()
    assert packet[:2] == (5, 2)
    assert packet.data[4:] == b"\x04" * 9 + b"\x00"  # 4.1 V as int8


@pytest.mark.parametrize("start", [b"\x03\x00\x02", b"\x08\x00\x14\x00"])
def test_log_data_mean_period_is_exact_and_stamps_are_24_bit(client, start):
    client.create(0, ["pm.vbat", "stateEstimate.z"])
    client.firmware.flight.tick = 0xFFFF00
    began = client.flight.tick
    assert client.ask(5, 1, start)[0][2] == 0
    client.firmware.advance(20 * 500 + 10 + 16)
    packets = [p.data for p in client.outgoing() if p[:2] == (5, 2)]
    assert len(packets) in {500, 501}
    packets = packets[:500]
    stamps = np.array([int.from_bytes(data[1:4], "little") for data in packets])
    elapsed = (stamps - began) % 2**24
    lateness = elapsed - 20 * np.arange(1, 501)
    assert 0 <= lateness.min() < 10  # the phase
    lateness -= lateness.min()
    assert 0 < lateness.max() <= 16
    assert (lateness > 0).mean() < 0.1
    assert packets[0][4:] == struct.pack("<ff", 4.1, 0.0)
    client.ask(5, 1, b"\x04\x00")
    client.firmware.advance(100)
    assert client.outgoing() == []


def test_blocks_have_their_own_phase(client):
    for number in range(2):
        client.create(number, ["pm.vbat"])
        client.ask(5, 1, bytes((3, number, 1)))
    client.firmware.advance(200)
    stamps = {0: [], 1: []}
    for packet in client.outgoing():
        if packet[:2] == (5, 2):
            stamps[packet.data[0]].append(int.from_bytes(packet.data[1:4], "little"))
    assert np.median(np.array(stamps[0]) % 10) != np.median(np.array(stamps[1]) % 10)


def test_parameters_read_write_and_echo(client):
    mass = client.param_id("ctrlLee.mass")
    assert client.ask(2, 1, mass) == [mass + b"\0" + struct.pack("<f", 0.029)]
    write = mass + struct.pack("<f", 0.034)
    assert client.ask(2, 2, write) == [write]
    assert client.ask(2, 1, mass) == [mass + b"\0" + struct.pack("<f", 0.034)]
    assert client.flight.written == ["ctrlLee.mass"]
    assert client.ask(2, 1, b"\xff\xff") == [b"\xff\xff\x02"]
    assert client.ask(2, 2, b"\xff\xff\x01") == [b"\xff\xff\x02"]
    assert client.ask(2, 2, client.param_id("deck.bcFlow") + b"\x01") == []  # read-only: silence
    short = client.param_id("powerDist.idleThrust") + b"\x05"
    assert client.ask(2, 2, short) == [short]
    controller = client.param_id("stabilizer.controller")
    assert client.ask(2, 2, controller + b"\x00") == [controller + b"\x00"]
    assert client.ask(2, 1, controller) == [controller + b"\x00\x05"]  # only a re-read shows what runs


def test_misc_channel(client):
    mass, lee = client.param_id("ctrlMel.mass"), client.param_id("ctrlLee.mass")
    default, new = struct.pack("<f", 0.03), struct.pack("<f", 0.04)
    assert client.ask(2, 3, b"\x07" + mass) == [b"\x07" + mass + b"\x00\x01"]
    assert client.ask(2, 3, b"\x07" + lee) == [b"\x07" + lee + b"\x02"]
    assert client.ask(2, 3, b"\x02" + mass) == [b"\x02" + mass + b"\x01"]
    assert client.ask(2, 3, b"\x04" + mass) == [b"\x04" + mass + b"\x00" + default]
    client.ask(2, 2, mass + new)
    assert client.ask(2, 3, b"\x03" + mass) == [b"\x03" + mass + b"\x00"]
    assert client.ask(2, 3, b"\x04" + mass) == [b"\x04" + mass + b"\x01" + default + new]
    assert client.ask(2, 3, b"\x05" + mass) == [b"\x05" + mass + b"\x00"]
    assert client.ask(2, 3, b"\x04" + mass) == [b"\x04" + mass + b"\x00" + default]
    assert client.ask(2, 3, b"\x06" + mass) == [b"\x06" + mass + default]
    assert client.ask(2, 3, b"\x08" + lee) == [b"\x08" + lee + b"\x00" + struct.pack("<f", 0.029)]
    assert client.ask(2, 3, b"\x08\xff\xff") == [b"\x08\xff\xff\x02"]
    assert client.ask(2, 3, b"\x03" + lee) == [b"\x03" + lee + b"\x02"]
    by_name = b"\x00ctrlLee\0mass\0"
    assert client.ask(2, 3, by_name + b"\x06" + new) == [by_name + b"\x00"]
    assert client.ask(2, 1, lee) == [lee + b"\0" + new]
    assert client.ask(2, 3, by_name + b"\x08\x01") == [by_name + b"\x16"]  # EINVAL: wrong type
    assert client.ask(2, 3, b"\x00no\0such\0\x06" + new) == [b"\x00no\0such\0\x02"]
    assert client.ask(2, 3, b"\x00deck\0bcFlow\0\x08\x01") == [b"\x00deck\0bcFlow\0\x0d"]


def test_memories(client):
    assert client.ask(4, 0, b"\x01") == [b"\x01\x02"]
    assert client.ask(4, 0, b"\x02\x00") == [struct.pack("<BBBI", 2, 0, 0x12, 4096) + bytes(8)]
    assert client.ask(4, 0, b"\x02\x01")[0][2] == 0x15
    assert client.ask(4, 0, b"\x02\x07") == [b"\x02\x07"]
    head = struct.pack("<BI", 0, 4090)
    assert client.ask(4, 2, head + b"abcdef") == [head + b"\x00"]
    assert client.ask(4, 2, head + b"abcdefg") == [head + b"\x05"]  # EIO
    assert client.ask(4, 1, head + b"\x06") == [head + b"\x00abcdef"]
    assert client.ask(4, 1, head + b"\x07") == [head + b"\x05"]
    tester = struct.pack("<BI", 1, 254)
    assert client.ask(4, 1, tester + b"\x04") == [tester + b"\x00\xfe\xff\x00\x01"]
    client.ask(4, 2, tester + b"\xfe\xff\x05")
    assert client.firmware.log.table.by_name["memTst.errCntW"].value == 1.0


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


def test_a_closing_link_locks_the_high_level_out_until_a_notice(client):
    client.ask(3, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))
    assert high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 0.5)[0][3] == 0  # the reply says nothing
    client.firmware.advance(600)
    assert client.flight.setpoint[sp.MODE_Z] == 0
    client.ask(7, 1, b"\x00" + struct.pack("<I", 0))
    high_level(client, "<BB", 3, 0)
    high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 0.5)
    client.firmware.advance(600)
    assert client.flight.setpoint[sp.Z] == pytest.approx(1.0)
    client.ask(3, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))  # the same packet in flight cuts the motors
    client.firmware.advance(60)
    assert client.flight.setpoint[sp.MODE_Z] == 0


def test_a_stream_that_dries_up_levels_out_and_locks(client):
    hover = b"\x0a" + struct.pack("<ffff", 0.2, 0.0, 0.0, 0.7)
    for _ in range(10):
        client.ask(7, 0, hover)
        client.firmware.advance(50)
    assert client.flight.setpoint[[sp.VX, sp.Z]] == pytest.approx([0.2, 0.7])
    client.firmware.advance(600)
    assert client.flight.setpoint[sp.MODE_X] == sp.DISABLE
    assert client.flight.setpoint[sp.Z] == pytest.approx(0.7)
    client.firmware.advance(1600)
    assert not client.flight.motors_allowed
    assert client.ask(9, 0, b"\x07") == [b"\x87\x01"]
    assert high_level(client, "<BBff?f", 7, 0, 1.0, 0.0, True, 0.5)[0][3] == 16  # EBUSY
    assert client.ask(9, 1, b"\x01\x01") == [b"\x81\x00\x00"]


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
        [1.0, 2.0, 3.0],
        [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0],
        [1.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0],
        [0.1, 0.2, 0.3],
    ]


def test_boot_console_text_and_splitting():
    firmware = Firmware(FakeFlight(), platform="cf2", seed=0)
    assert not firmware.outbox
    firmware.receive(wire.Packet(15, 1, b"\0"))
    first, *rest = (wire.decode(datagram) for datagram, _ in firmware.outbox)
    assert first.port == wire.LINK  # replies come first
    assert all(p.port == wire.CONSOLE and len(p.data) <= 30 for p in rest)
    text = "".join(p.data.decode() for p in rest)
    assert "up and running" in text
    from firmware_sim.services.console import split

    assert [chunk.decode() for chunk in split("ä" * 20)] == ["ä" * 15, "ä" * 5]


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


@settings(max_examples=300, deadline=None)
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
