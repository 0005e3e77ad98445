"""The link against a bare-socket Crazyflie that loses what it is told to lose: nothing may hang, nothing may lie."""

import struct
import threading
import time

import pytest
from received import packets, wait_for
from relayed import connected

from crazyem.errors import LinkError, UsageError
from crazyem.links import open_link
from crazyem.links.base import LinkLost
from crazyem.links.connection import new_crazyflie
from crazyem.links.crazyflie import CrazyflieLink

NAMES = ("stateEstimateZ.x", "stateEstimateZ.y", "stateEstimateZ.z", "pm.vbat")


def test_tables_and_log_data(fake_peer):
    with connected(fake_peer.uri) as link:
        assert dict(link.log_variables) == dict(zip(NAMES, ["int16_t"] * 3 + ["float"], strict=True))
        assert link.parameters["ctrlLee.mass"] == "float"
        (block,) = link.subscribe(NAMES, 100.0)
        came = packets(link, 20)
    assert [v.name for v in block.variables] == list(NAMES)
    assert [p.values for p in came] == [(n,) * 4 for n in range(20)]
    assert [p.firmware_time_ms for p in came] == [10 * n for n in range(20)]


def test_write_is_verified_by_its_echo(fake_peer):
    with connected(fake_peer.uri) as link:
        write = link.write_parameter("ctrlLee.mass", 0.034)
        assert write.verified
        assert write.echoed == struct.unpack("<f", struct.pack("<f", 0.034))[0]
        assert link.read_parameter("ctrlLee.mass") == write.echoed
        assert link.write_parameter("fake.byte", 200).verified


def test_one_lost_echo_is_healed_by_sending_again(fake_peer):
    lost = []
    fake_peer.lose = lambda request: request[0] & 0xF3 == 0x22 and not lost and (lost.append(request) or True)
    with connected(fake_peer.uri) as link:
        assert link.write_parameter("ctrlLee.mass", 0.03, timeout=30.0).verified
        assert lost


def test_lost_echoes_leave_the_write_unverified_and_the_link_usable(fake_peer):
    with connected(fake_peer.uri) as link:
        fake_peer.lose = lambda request: request[0] & 0xF3 == 0x22
        write = link.write_parameter("ctrlLee.mass", 0.034, timeout=0.4)
        assert not write.verified
        assert write.echoed is None
        assert "did not confirm ctrlLee.mass" in link.parameter_fault
        fake_peer.lose = lambda request: False
        assert link.write_parameter("ctrlLee.mass", 0.035).verified
        assert link.parameter_fault == ""


def test_an_echo_with_another_value_is_not_a_confirmation(fake_peer):
    with connected(fake_peer.uri) as link:
        answer = fake_peer._answer
        fake_peer._answer = lambda r: [r[:3] + struct.pack("<f", 9.0)] if r[0] & 0xF3 == 0x22 else answer(r)
        write = link.write_parameter("ctrlLee.mass", 0.034, timeout=2.0)
        assert not write.verified
        assert write.echoed == 9.0


def test_unanswered_read_is_an_error(fake_peer):
    with connected(fake_peer.uri) as link:
        fake_peer.lose = lambda request: request[0] & 0xF3 == 0x21
        with pytest.raises(LinkError, match=r"did not answer a read of ctrlLee\.mass"):
            link.read_parameter("ctrlLee.mass", timeout=0.3)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fake.nothing", 1.0, "no parameter"), ("nonsense", 1.0, "no parameter"), ("fake.fixed", 1.0, "read-only"),
        ("fake.byte", 256.0, "cannot hold"), ("fake.byte", 0.5, "whole number"), ("ctrlLee.mass", 1e300, "cannot hold"),
    ],
)  # fmt: skip
def test_writes_that_cannot_be_made(fake_peer, name, value, message):
    with connected(fake_peer.uri) as link, pytest.raises(UsageError, match=message):
        link.write_parameter(name, value)


# header and first data byte of a request, and what the message calls it
LOSSES = [
    (b"\xfd\x00", "Nothing answers"),
    (b"\xdd\x00", "its protocol version"),
    (b"\x5d\x05", "the log reset"),
    (b"\x5c\x02\x02", "the table of log variables"),
    (b"\x4c\x01", "the list of memories"),
    (b"\x2c\x02\x01", "the table of parameters"),
    (b"\x2d\x01", "a parameter's value"),
]


@pytest.mark.parametrize(("prefix", "message"), LOSSES)
def test_a_reply_lost_while_connecting_is_an_error_not_a_hang(fake_peer, monkeypatch, prefix, message):
    # Long enough that a busy host's pause is not taken for the drone's silence.
    monkeypatch.setattr("crazyem.links.connection.SILENCE_LIMIT", 0.8)
    fake_peer.lose = lambda request: bytes([request[0] | 0x0C]) + request[1 : len(prefix)] == prefix
    link = CrazyflieLink(fake_peer.uri)
    with pytest.raises(LinkError, match=message) as caught:
        link.connect(60.0)
    assert fake_peer.uri in str(caught.value)
    fake_peer.lose = lambda request: False
    link.connect(60.0)  # the same object can try again
    link.close()


def test_nothing_listens(fake_peer):
    fake_peer.close()
    with pytest.raises(LinkError, match="Nothing answers at udp"):
        CrazyflieLink(fake_peer.uri).connect(5.0)


@pytest.mark.parametrize("how", ["silent", "gone"])
def test_a_lost_drone_is_reported_once(fake_peer, monkeypatch, how):
    with connected(fake_peer.uri) as link:
        link.subscribe(NAMES, 100.0)
        if how == "silent":
            fake_peer.silent = True
        else:
            fake_peer.close()
        monkeypatch.setattr("crazyem.links.crazyflie.SILENT_AFTER", 0.5)
        wait_for(link, LinkLost)
        assert link.packets.empty()
        with pytest.raises(LinkError):
            link.send_position(0.0, 0.0, 1.0, 0.0)
        with pytest.raises(LinkError):
            link.write_parameter("ctrlLee.mass", 0.03)
        with pytest.raises(LinkError):
            link.read_parameter("ctrlLee.mass")


def test_closing_hands_back_only_if_it_commanded(fake_peer):
    with connected(fake_peer.uri) as link:
        link.send_position(0.0, 0.0, 1.0, 0.0)

    def last_two():
        return [bytes([r[0] | 0x0C]) + r[1:2] for r in list(fake_peer.requests) if r[0] >> 4 != 15][-2:]

    deadline = time.monotonic() + 60.0
    while last_two() != [b"\x3c\x00", b"\x7d\x00"]:  # zero setpoint, then "notify stop": the next take-off works
        assert time.monotonic() < deadline, last_two()
        time.sleep(0.005)
    fake_peer.requests.clear()
    with connected(fake_peer.uri):
        pass
    assert not [r for r in fake_peer.requests if r[0] >> 4 in (3, 7)]  # an observer sends no setpoint


def test_a_sender_that_meets_the_end_of_the_link_does_not_wait_for_the_ping_thread():
    """The ping thread of cflib waits for the send lock; a sender that finds the link dead holds it."""
    crazyflie = new_crazyflie("udp://127.0.0.1:1")
    crazyflie.connected.call("")  # starts the ping thread
    try:
        with crazyflie._send_lock:
            time.sleep(0.3)  # longer than between two pings: the thread waits for the lock now
            ender = threading.Thread(target=crazyflie.disconnected.call, args=("",), daemon=True)
            ender.start()
            ender.join(60)
            assert not ender.is_alive()
        thread = crazyflie.link_statistics.latency._ping_thread_instance
        thread.join(60)
        assert not thread.is_alive()
    finally:
        crazyflie.link_statistics.latency._stop_event.set()


def test_setpoint_outside_the_wire_format(fake_peer):
    with connected(fake_peer.uri) as link, pytest.raises(UsageError, match="does not fit the wire"):
        link.send_full_state((40.0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0, 1), (0, 0, 0))


def test_riding_on_an_open_crazyflie(fake_peer):
    from cflib.crazyflie import Crazyflie
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

    with connected(fake_peer.uri):  # initialises cflib's drivers
        pass
    with SyncCrazyflie(fake_peer.uri, cf=Crazyflie(rw_cache=None)) as sync:
        sync.wait_for_params()
        link = CrazyflieLink.from_crazyflie(sync.cf)
        link.subscribe(NAMES, 100.0)
        packets(link, 5)
        assert link.write_parameter("ctrlLee.mass", 0.031).verified
        assert float(sync.cf.param.get_value("ctrlLee.mass")) == pytest.approx(0.031, rel=1e-6)
        link.close()
        assert sync.cf.is_connected()
        assert sync.cf.log.log_blocks == []
    with pytest.raises(UsageError, match="not connected"):
        CrazyflieLink.from_crazyflie(sync.cf)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("nonsense", "not a link URI"),
        ("ftp://x", "no link for ftp"),
        ("udp://127.0.0.1", "needs a host and a port"),
        ("udp://127.0.0.1:99999", "needs a host and a port"),
    ],
)
def test_uris_that_name_no_link(uri, message):
    with pytest.raises(UsageError, match=message):
        open_link(uri)
