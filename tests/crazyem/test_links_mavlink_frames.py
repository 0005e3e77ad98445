"""MAVLink frames by hand, by pymavlink, damaged in every way; stamps, sequence numbers, addresses, parameter floats."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from crazyem.errors import UsageError
from crazyem.links.mavlink import parameters
from crazyem.links.mavlink.frames import FrameParser, SequenceCounter, checksum, definitions, number_of
from crazyem.links.mavlink.receiver import DroneClock, RestartedError
from crazyem.links.mavlink.transport import Address, parse


def slow_checksum(data):
    """CRC-16/MCRF4XX, bit by bit, as its definition says."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    return crc


def frame(message, *, system=1, component=1, sequence=0, old=False, signed=False):
    packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    packer.seq = sequence
    if signed:
        packer.signing.secret_key = bytes(32)
        packer.signing.link_id = 3
        packer.signing.timestamp = 1000
        packer.signing.sign_outgoing = True
    return bytes(message.pack(packer, force_mavlink1=old))


def attitude(ms=1000, roll=0.5):
    return mavlink.MAVLink_attitude_message(ms, roll, 0.25, -0.125, 1.0, 2.0, 3.0)


@given(st.binary(max_size=300))
def test_checksum_is_the_one_of_its_definition(data):
    assert checksum(data) == slow_checksum(data)


def test_a_frame_by_hand_version_1_and_2():
    """LOCAL_POSITION_NED, id 32, checksum seed 185 (mavlink.io): every byte written out."""
    payload = struct.pack("<Iffffff", 123456, 1.0, -2.0, 3.5, 0.5, -0.25, 0.125)
    one = bytes([28, 7, 9, 1, 32]) + payload
    first = b"\xfe" + one + struct.pack("<H", slow_checksum(one + bytes([185])))
    two = bytes([28, 0, 0, 8, 9, 1, 32, 0, 0]) + payload
    second = b"\xfd" + two + struct.pack("<H", slow_checksum(two + bytes([185])))
    found = FrameParser().feed(first + second)
    assert [(f.system, f.component, f.sequence, f.name) for f in found] == [
        (9, 1, 7, "LOCAL_POSITION_NED"),
        (9, 1, 8, "LOCAL_POSITION_NED"),
    ]
    wanted = {"time_boot_ms": 123456, "x": 1.0, "y": -2.0, "z": 3.5, "vx": 0.5, "vy": -0.25, "vz": 0.125}
    assert [f.fields() for f in found] == [wanted, wanted]
    assert [f.raw for f in found] == [first, second]


def test_esc_status_by_hand():
    """Not in pymavlink 2.4.50: the seed follows from the names and types of the definition (serialisation guide)."""
    text = b"ESC_STATUS " + b"uint64_t time_usec "
    for kind, name in (("int32_t", "rpm"), ("float", "voltage"), ("float", "current")):
        text += f"{kind} {name} ".encode() + bytes([4])
    crc = slow_checksum(text + b"uint8_t index ")
    seed = (crc & 255) ^ (crc >> 8)
    body = bytes([57, 0, 0, 1, 1, 1]) + (291).to_bytes(3, "little")
    body += struct.pack("<Q4i4f4fB", 5_000_000, 9000, -9100, 9200, 9300, *range(8), 0)
    (found,) = FrameParser().feed(b"\xfd" + body + struct.pack("<H", slow_checksum(body + bytes([seed]))))
    assert found.fields()["rpm"] == (9000, -9100, 9200, 9300)


@given(data=st.data())
def test_every_message_as_pymavlink_decodes_it(data):
    number = data.draw(st.sampled_from(sorted(mavlink.mavlink_map)))
    known = mavlink.mavlink_map[number]
    payload = data.draw(st.binary(min_size=known.unpacker.size, max_size=known.unpacker.size))
    cut = payload.rstrip(b"\0") or b"\0"
    body = bytes([len(cut), 0, 0, 5, 1, 1]) + number.to_bytes(3, "little") + cut
    raw = b"\xfd" + body + struct.pack("<H", slow_checksum(body + bytes([known.crc_extra])))
    (found,) = FrameParser().feed(raw)
    other = known.unpacker.unpack(payload)
    mine = [v for value in found.fields().values() for v in (value if isinstance(value, tuple) else (value,))]
    assert repr(mine) == repr(list(other))
    assert list(found.fields()) == known.ordered_fieldnames


def test_signed_frames_are_read():
    raw = frame(attitude(), signed=True)
    assert raw[2] == 1
    (found,) = FrameParser().feed(raw)
    assert found.raw == raw
    assert found.fields()["roll"] == 0.5


@given(
    messages=st.lists(st.integers(0, 255), min_size=1, max_size=8),
    noise=st.lists(st.binary(max_size=40).filter(lambda b: not set(b) & {0xFD, 0xFE}), min_size=8, max_size=8),
    cuts=st.lists(st.integers(0, 600), max_size=6),
    old=st.booleans(),
)
def test_frames_are_found_between_noise_however_they_are_cut(messages, noise, cuts, old):
    frames = [frame(attitude(ms), sequence=ms, old=old) for ms in messages]
    stream = b"".join(n + f for n, f in zip(noise, frames, strict=False))
    parser, found = FrameParser(), []
    at = 0
    for cut in sorted(cuts):
        found += parser.feed(stream[at:cut])
        at = max(at, cut)
    found += parser.feed(stream[at:])
    assert [f.raw for f in found] == frames
    assert parser.skipped == len(stream) - sum(map(len, frames))


@given(chunks=st.lists(st.binary(max_size=400), max_size=12))
def test_any_bytes_are_survived_in_bounded_memory(chunks):
    parser = FrameParser()
    for chunk in chunks:
        parser.feed(b"\xfd" + chunk)
        assert len(parser._buffer) <= 4096
    for _ in range(3):  # whatever waits for its end is given up for what follows
        found = parser.feed(b"\0" * 300 + frame(attitude()))
    assert found
    assert found[-1].raw == frame(attitude())


@given(place=st.integers(0, 50), flip=st.integers(1, 255))
def test_one_wrong_byte_is_one_frame_lost_and_never_a_wrong_value(place, flip):
    good = [frame(attitude(k), sequence=k) for k in range(4)]
    wrong = bytearray(good[1])
    wrong[place % len(wrong)] ^= flip
    parser = FrameParser()
    found = parser.feed(good[0] + bytes(wrong) + good[2] + good[3] + bytes(300))
    raw = [f.raw for f in found]
    assert raw[:1] == good[:1]
    assert raw[-2:] == good[2:]
    assert all(f.raw in good for f in found if f.name == "ATTITUDE" and f.raw != bytes(wrong))


def test_unknown_messages_are_counted_and_stepped_over():
    unknown = b"\xfd" + bytes([3, 0, 0, 1, 1, 1]) + (9_999_999).to_bytes(3, "little") + b"abc" + b"\0\0"
    parser = FrameParser()
    found = parser.feed(frame(attitude()) + unknown + frame(attitude()))
    assert (len(found), parser.unknown, parser.skipped) == (2, 1, 0)


# --- stamps ---


def test_stamps_of_all_kinds_land_on_one_clock():
    clock = DroneClock()
    assert clock.place({}, 0.0) is None  # nothing to go by yet
    assert clock.place({"time_boot_ms": 5000}, 0.0) == 5000
    assert clock.place({"time_usec": 5_000_999}, 0.0) == 5000  # cut, as PX4 cuts time_boot_ms
    assert clock.place({"voltage_battery": 1}, 0.0) == 5000  # no stamp: the newest
    assert clock.place({"time_usec": 1_700_000_000_000_000}, 0.0) == 5000  # since 1970
    assert clock.place({"time_usec": 1_700_000_000_020_000}, 0.1) == 5020
    assert clock.place({"time_usec": 5_030_000, "servo1_raw": 0}, 0.1) == 5030
    assert clock.place({"time_usec": 0}, 0.1) == 5030 == clock.newest_ms


def test_stamps_wrap_after_49_days_and_servo_stamps_after_71_minutes():
    clock = DroneClock()
    near = (1 << 32) - 10
    assert clock.place({"time_boot_ms": near}, 0.0) == near
    assert clock.place({"time_boot_ms": 5}, 0.1) == (1 << 32) + 5
    servo = ((1 << 32) + 7) * 1000 % (1 << 32)
    assert clock.place({"time_usec": servo, "servo1_raw": 0}, 0.1) == (1 << 32) + 7


def test_absurd_stamps_are_refused_and_a_restart_is_told():
    clock = DroneClock()
    clock.place({"time_boot_ms": 60_000}, 0.0)
    assert clock.place({"time_boot_ms": 900_000_000}, 0.1) is None
    assert clock.place({"time_boot_ms": 60_010}, 0.1) == 60_010
    assert clock.place({"time_boot_ms": 59_500}, 0.1) == 59_500  # late, within reason
    assert clock.refused == 1
    for k in range(18):
        assert clock.place({"time_boot_ms": 1000 + 10 * k}, 0.2) is None
    with pytest.raises(RestartedError):
        [clock.place({"time_boot_ms": 1180 + 10 * k}, 0.2) for k in range(2)]


# --- sequence numbers ---


def test_sequence_numbers_lost_late_repeated():
    count = SequenceCounter()
    for number in (254, 255, 0, 3, 2, 4):  # 1 and 2 are missing, 2 comes late
        assert count.take(number, bytes([number]))
    assert not count.take(4, bytes([4]))
    assert (count.received, count.lost, count.late, count.repeated) == (6, 1, 1, 1)


@given(kept=st.lists(st.booleans(), min_size=2, max_size=400))
def test_losses_are_counted_exactly_while_fewer_than_128_follow_each_other(kept):
    kept = [True, *kept, True]
    count = SequenceCounter()
    run = longest = 0
    for k, keep in enumerate(kept):
        run = 0 if keep else run + 1
        longest = max(longest, run)
        if keep:
            count.take(k % 256, k.to_bytes(4, "big"))
    if longest < 127:
        assert count.lost == kept.count(False)
        assert count.late == 0


def test_a_repetition_that_comes_too_late_to_be_recognised_cancels_no_loss():
    count = SequenceCounter()
    for number in range(200):
        if number != 150:
            count.take(number, bytes([number]))
    assert count.lost == 1
    assert count.take(110, bytes([110]))
    assert count.lost == 1
    assert count.take(150, bytes([150]))  # the lost one, at last
    assert (count.lost, count.late) == (0, 2)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 120)), min_size=2, max_size=300))
def test_repetitions_cancel_no_loss(course):
    """Each frame is lost or comes, and comes again some frames later."""
    arrivals, lost, run = [], 0, 0
    for k, (keep, later) in enumerate([(True, 0), *course, (True, 0)]):
        run = 0 if keep else run + 1
        lost += not keep
        if run > 100:
            return
        if keep:
            arrivals += [(k, 0, k), (k + later, 1, k)]
    count = SequenceCounter()
    for _, _, k in sorted(arrivals):
        count.take(k % 256, k.to_bytes(4, "big"))
    assert count.lost == lost


# --- addresses ---


@pytest.mark.parametrize(
    ("uri", "address"),
    [
        ("mavlink:udpin:127.0.0.1:14550", Address("udpin", host="127.0.0.1", port=14550)),
        ("mavlink:udpout:drone.local:14540", Address("udpout", host="drone.local", port=14540)),
        ("mavlink:udpin:[::1]:14550", Address("udpin", host="::1", port=14550)),
        ("mavlink:/dev/ttyACM0:57600", Address("serial", device="/dev/ttyACM0", baud=57600)),
        ("mavlink:/dev/ttyUSB1:921600?system=7", Address("serial", device="/dev/ttyUSB1", baud=921600, system=7)),
        ("mavlink:/dev/ttyACM0", Address("serial", device="/dev/ttyACM0", baud=57600)),
        ("mavlink:COM3:115200", Address("serial", device="COM3", baud=115200)),
    ],
)
def test_addresses(uri, address):
    assert parse(uri) == address


@pytest.mark.parametrize(
    "uri",
    [
        *("mavlink:", "mavlink:udpin", "mavlink:udpin:127.0.0.1", "mavlink:udpin:127.0.0.1:70000", "mavlink:tcp:a:1"),
        *("mavlink:udpout:a:0", "mavlink:udpin::14550", "mavlink:/dev/ttyACM0:fast", "mavlink:/dev/ttyACM0:1"),
        *("mavlink:udpin:a:1?system=0", "mavlink:udpin:a:1?system=256", "mavlink:udpin:a:1?x=1", "mavlink:tty:1"),
        *("udp://a:1", "mavlink:udpin:a\n:1", "mavlink:udpin:a:\u0661", "mavlink:" + "x" * 600),
    ],
)
def test_wrong_addresses_are_a_sentence(uri):
    with pytest.raises(UsageError, match=r"\.$"):
        parse(uri)


# --- parameters as floats ---


def test_integers_travel_as_bits_with_px4_and_as_values_with_ardupilot():
    bits = struct.unpack("<f", struct.pack("<i", 1000))[0]
    assert parameters.encode(1000, 6, bitwise=True) == bits != 1000.0
    assert parameters.encode(1000, 6, bitwise=False) == 1000.0
    assert parameters.decode(bits, 6, bitwise=True) == 1000.0
    assert parameters.decode(-3.0, 6, bitwise=False) == -3.0
    assert parameters.encode(0.1, 9, bitwise=True) == struct.unpack("<f", struct.pack("<f", 0.1))[0]
    assert math.isnan(parameters.decode(1.0, 10, bitwise=True))  # a double does not fit


@pytest.mark.parametrize(("value", "kind"), [(300, 1), (-1, 5), (0.5, 6), (1e60, 9), (math.nan, 6), (1, 99)])
def test_values_that_do_not_fit_are_a_sentence(value, kind):
    with pytest.raises(UsageError):
        parameters.encode(value, kind, bitwise=True)


def test_names_and_numbers():
    assert number_of("ACTUATOR_OUTPUT_STATUS") == 375
    assert definitions()[32].seed == 185
    with pytest.raises(KeyError):
        number_of("NO_SUCH_MESSAGE")
