"""Every exchange a client can have, byte for byte: link, tables, log, parameters, memories; the flight a fake."""

import struct

import numpy as np
import pytest
from service_client import client_fixture

client = pytest.fixture(client_fixture)


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
