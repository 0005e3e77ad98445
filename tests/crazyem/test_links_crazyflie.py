"""The link against a bare-socket Crazyflie that loses what it is told to lose: nothing may hang, nothing may lie."""

import struct
import threading
import time
from types import SimpleNamespace

import pytest
from relayed import connected, packets, wait_for

from crazyem.errors import LinkError, UsageError
from crazyem.links import open_link
from crazyem.links.base import LinkLost
from crazyem.links.connection import new_crazyflie
from crazyem.links.crazyflie import CrazyflieLink
from crazyem.links.requests import land_command, send_until_confirmed
from crazyem.signals.vocabulary import decoders, standard_variables

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
        fake_peer.lose = lambda request: False
        assert link.write_parameter("ctrlLee.mass", 0.035).verified


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
        ("mavlink:nonsense", "mavlink"),
    ],
)
def test_uris_that_name_no_link(uri, message):
    with pytest.raises(UsageError, match=message):
        open_link(uri)


# --- the simulated firmware: real tables, real blocks, a take-off ---


def test_standard_blocks_stream_at_100_hz(resting):
    with CrazyflieLink(resting.uri) as link:
        blocks = link.subscribe(standard_variables(link.log_variables), 100.0)
        came = packets(link, 300)
        statistics = link.statistics()
    assert len(blocks) == 3
    assert statistics.lost == 0
    table = decoders(blocks)
    samples = [s for p in came for s in table[p.block].decode(p)]
    assert {s.signal for s in samples} >= {
        "position", "velocity", "attitude", "body_rate", "specific_force", "motor_command", "voltage", "flying",
    }  # fmt: skip
    force = [s.value for s in samples if s.signal == "specific_force"]
    mean = [sum(v[i] for v in force) / len(force) for i in range(3)]
    assert mean == pytest.approx([0.0, 0.0, 9.81], abs=0.1)  # at rest on the ground


def test_a_second_client_can_take_off_after_the_first_has_commanded(resting):
    with CrazyflieLink(resting.uri) as first:
        first.send_position(0.0, 0.0, 0.0, 0.0)
    with CrazyflieLink(resting.uri) as second:
        blocks = second.subscribe(["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"], 50.0)
        second.take_off(0.5, 1.0)
        table = decoders(blocks)
        for packet in packets(second, 200):  # 4 s of the drone's clock
            if any(s.value[2] > 0.2 for s in table[packet.block].decode(packet)):
                return
    raise AssertionError("it did not take off")


# --- commands whose arrival counts: sent until they are confirmed, and given up in time ---


class Drone:
    """A Crazyflie that answers the n-th packet, and others' packets before it."""

    def __init__(self, *, answers, error=0, noise=()):
        self.link, self.sent, self.callbacks = object(), [], []
        self.packet_received = SimpleNamespace(
            add_callback=self.callbacks.append, remove_callback=self.callbacks.remove
        )
        self._answers, self._error, self._noise = answers, error, noise

    def send_packet(self, packet):
        self.sent.append((packet.port, packet.channel, bytes(packet.data)))
        for port, channel, data in self._noise:
            self._receive(port, channel, data)
        if len(self.sent) == self._answers:
            self._receive(8, 0, bytes([packet.data[0], 0, 0, self._error]))

    def _receive(self, port, channel, data):
        for callback in list(self.callbacks):
            callback(SimpleNamespace(port=port, channel=channel, data=bytearray(data)))


def test_the_command_is_the_firmwares():
    # uint8 command 8, uint8 group, float height, float yaw, bool use current yaw, float duration: packed, little endian
    assert land_command(0.25, 2.0) == b"\x08\x00" + struct.pack("<f", 0.25) + bytes(4) + b"\x01" + struct.pack(
        "<f", 2.0
    )


@pytest.mark.parametrize("lost", [0, 1, 5])
def test_it_is_sent_until_it_is_confirmed(lost):
    drone = Drone(answers=lost + 1)
    assert send_until_confirmed(drone, land_command(0.0, 2.0), timeout=60.0, repeat_after=0.001)
    assert drone.sent == [(8, 0, land_command(0.0, 2.0))] * (lost + 1)
    assert drone.callbacks == []


@pytest.mark.parametrize(
    "drone",
    [
        Drone(answers=0),
        Drone(answers=1, error=16),  # the supervisor refuses
        Drone(answers=0, noise=[(8, 0, b"\x07\x00\x00\x00"), (5, 0, b"\x08\x00\x00\x00"), (8, 0, b"\x08")]),
    ],
)
def test_silence_refusals_and_other_answers_are_no_confirmation(drone):
    assert not send_until_confirmed(drone, land_command(0.0, 2.0), timeout=0.05, repeat_after=0.01)
    assert drone.callbacks == []


def test_a_lost_link_ends_it_at_once():
    drone = Drone(answers=1)
    drone.link = None
    assert not send_until_confirmed(drone, land_command(0.0, 2.0), timeout=60.0, repeat_after=1.0)
    assert drone.sent == []
