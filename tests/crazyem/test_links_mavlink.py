"""The MAVLink link at a made-up autopilot of pymavlink's: PX4 and ArduPilot, faults of the wire, writes, outages."""

import contextlib
import os
import queue
import socket
import threading
import tty

import pytest
from autopilots import ARDUPILOT, PX4, FakeAutopilot
from fake_drone import until
from mavlink_pilot import free_port
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from relayed import wait_for

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import LinkLost
from crazyem.links.mavlink.frames import FrameParser, number_of
from crazyem.links.mavlink.link import MavlinkLink
from crazyem.signals.vocabulary import decoders


@pytest.fixture(autouse=True)
def no_long_listening(monkeypatch):
    """This autopilot answers at once."""
    monkeypatch.setattr("crazyem.links.mavlink.link._LISTEN_SECONDS", 0.15)


def unconnected(port, query=""):
    return contextlib.closing(MavlinkLink(f"mavlink:udpin:127.0.0.1:{port}{query}"))


@contextlib.contextmanager
def linked(kind=PX4, *, query="", **options):
    """A connected link and the autopilot at its other end."""
    port = free_port()
    with unconnected(port, query) as link, FakeAutopilot(port, kind, **options) as drone:
        link.connect(60.0)
        yield link, drone


@contextlib.contextmanager
def streaming(kind=PX4, **options):
    with linked(kind, **options) as (link, drone):
        stop = threading.Event()
        thread = threading.Thread(target=lambda: [drone.stream(0.05) for _ in iter(stop.is_set, True)])
        thread.start()
        try:
            blocks = link.start_streams(50.0)
        finally:
            stop.set()
            thread.join()
        arrived(link)
        yield link, drone, blocks


def drain(link):
    found = []
    with contextlib.suppress(queue.Empty):
        while True:
            found.append(link.packets.get(timeout=0.05))
    return found


def arrived(link):
    """What was sent before this call: the answer to a question comes after it."""
    link.read_parameter("MPC_THR_HOVER" if link.autopilot == PX4 else "MOT_THST_HOVER", timeout=60.0)
    return drain(link)


def samples(link, blocks, packets):
    by_block = decoders(blocks)
    return [s for p in packets for s in by_block[p.block].decode(p)]


def of(found, signal):
    return [s for s in found if s.signal == signal]


def test_a_px4_is_identified_and_its_streams_become_signals():
    with streaming() as (link, drone, blocks):
        assert (link.autopilot, link.simulated) == (PX4, False)
        assert drone.intervals[number_of("LOCAL_POSITION_NED")] == 20_000
        assert drone.intervals[number_of("BATTERY_STATUS")] == 100_000
        before = drone.ms
        drone.stream(0.2)
        found = samples(link, blocks, arrived(link))
        position = of(found, "position")
        assert [s.time for s in position] == [(before + 10 * k) / 1000 for k in range(1, 21)]
        assert position[0].value[1:] == pytest.approx((-0.2, 1.0))
        assert of(found, "attitude")[0].value == pytest.approx((0.01, -0.02, -0.03, 1.0))
        assert of(found, "motor_command")[0].value == pytest.approx((0.5, 0.53, 0.51, 0.52))
        assert of(found, "voltage")[0].value == pytest.approx((12.03,))
        assert link.cells == 3
        assert of(found, "flying")[0].value == (1.0,)
        assert link.statistics().lost == 0
        assert link.about["mavlink"]["autopilot"] == "12"


def test_an_ardupilot_without_intervals_is_asked_the_older_way():
    with streaming(ARDUPILOT, modern=False, old=True) as (link, drone, blocks):
        until(lambda: set(drone.groups) == {1, 2, 3, 6, 10, 11})
        assert drone.groups[6] == 50
        drone.stream(0.1)
        found = samples(link, blocks, arrived(link))
        assert of(found, "attitude")[0].value == pytest.approx((0.0047, -0.0102, -0.0149, 0.9998), abs=1e-3)
        assert of(found, "motor_command")[0].value == pytest.approx((0.5, 0.53, 0.51, 0.52), abs=1e-6)
        assert of(found, "specific_force")[0].value == pytest.approx((0.0980665, -0.196133, 9.80665))
        assert of(found, "voltage")[0].value == pytest.approx((12.03,))
        assert link.hover_parameter == "MOT_THST_HOVER"
        assert link.read_parameter("MOT_PWM_MIN") == 1100.0
        assert "MOT_HOVER_LEARN" in link.onboard_hover_estimator


def test_our_simulator_says_so_itself_and_an_address_does_not():
    port = free_port()
    with unconnected(port) as link, FakeAutopilot(port) as drone:
        drone.uid = b"crazyem firmware"
        link.connect(60.0)
        assert link.simulated
    with linked() as (link, _):
        assert not link.simulated


def test_losses_repetitions_and_damage_are_counted():
    with streaming() as (link, drone, _):
        before, account = link.statistics(), dict(link.account())
        counter = iter(range(10_000))

        def mangle(data):
            k = next(counter)
            if k % 10 == 3:
                return []
            if k % 10 == 5:
                return [data, data]
            if k % 10 == 7:
                return [data[:-3] + bytes([data[-3] ^ 0x55]) + data[-2:]]  # the last byte before the checksum
            return [data]

        drone.mangle = mangle
        drone.stream(0.4)  # 5 messages each 10 ms, and heartbeats
        drone.mangle = lambda data: [data]
        drone.stream(0.05)
        packets = arrived(link)
        after, told = link.statistics(), link.account()
        harmed = next(counter) // 10
        assert after.lost - before.lost == pytest.approx(2 * harmed, abs=3)  # lost, and damaged: both never came
        assert int(told["repeated"]) - int(account["repeated"]) == pytest.approx(harmed, abs=2)
        assert int(told["damaged"]) - int(account["damaged"]) == pytest.approx(harmed, abs=2)
        assert len({(p.block, p.firmware_time_ms) for p in packets if p.block < 7}) == len(
            [p for p in packets if p.block < 7]
        )


def test_other_systems_components_and_senders_do_not_mix_in():
    with streaming() as (link, drone, _):
        stranger = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        camera = mavlink.MAVLink(None, srcSystem=1, srcComponent=100)
        wrong = mavlink.MAVLink_local_position_ned_message(drone.ms + 5, 99, 99, 99, 0, 0, 0)
        for packer in (stranger, camera):
            drone.socket.send(bytes(wrong.pack(packer)))
        forged = bytes(wrong.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:  # another sender who claims to be the drone
            other.sendto(forged, drone.socket.getpeername())
        drone.stream(0.05)
        packets = arrived(link)
        assert packets
        assert all(99.0 not in p.values for p in packets)
        assert "7:1" in link.account()["other_systems"]


def test_a_system_can_be_chosen_and_a_missing_one_is_a_sentence():
    port = free_port()
    link = MavlinkLink(f"mavlink:udpin:127.0.0.1:{port}?system=9")
    with (
        FakeAutopilot(port, system=4),
        pytest.raises(LinkError, match=r"no heartbeat of system 9.*Systems 4 were heard"),
    ):
        link.connect(0.6)
    with linked(query="?system=4", system=4) as (link, _):
        assert link.about["mavlink"]["system"] == "4"


def test_nobody_and_noise_are_sentences():
    port = free_port()
    with unconnected(port) as link, pytest.raises(LinkError, match=r"no heartbeat"):
        link.connect(0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s, unconnected(port) as link:
        timer = threading.Timer(0.1, lambda: s.sendto(b"hello, world", ("127.0.0.1", port)))
        timer.start()
        with pytest.raises(LinkError, match=r"12 bytes came that are not MAVLink"):
            link.connect(0.4)
        timer.join()


def test_a_port_in_use_and_a_device_that_is_not_there_are_sentences():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="cannot listen"):
            MavlinkLink(f"mavlink:udpin:127.0.0.1:{s.getsockname()[1]}").connect(1.0)
    with pytest.raises(LinkError, match="cannot open the serial port"):
        MavlinkLink("mavlink:/dev/no-such-port:57600").connect(1.0)


def test_a_drone_without_position_is_a_sentence(monkeypatch):
    monkeypatch.setattr("crazyem.links.mavlink.link._LONGEST_LISTEN_SECONDS", 0.2)
    with linked() as (link, _), pytest.raises(LinkError, match=r"sends no LOCAL_POSITION_NED.*no attitude"):
        link.start_streams(100.0)


def test_nan_and_absurd_stamps_become_no_packets():
    with streaming() as (link, drone, _):
        nan = float("nan")
        drone.send(mavlink.MAVLink_local_position_ned_message(drone.ms, nan, 0, 0, 0, 0, 0))
        drone.send(mavlink.MAVLink_local_position_ned_message((1 << 32) - 1, 1, 1, 1, 0, 0, 0))
        drone.send(mavlink.MAVLink_attitude_quaternion_message(drone.ms, 9, 9, 9, 9, 0, 0, 0))
        until(lambda: int(link.account()["refused"]) >= 3)
        assert not [p for p in drain(link) if isinstance(p, LinkLost) or p.block in (0, 1)]


def test_frames_are_handed_on_as_they_came():
    with streaming() as (link, drone, _):
        kept = []
        link.on_frame = lambda host, data: kept.append(data)
        drone.beating = False
        arrived(link)
        kept.clear()
        sent = []
        drone.mangle = lambda data: sent.append(data) or [data]
        drone.stream(0.05)
        until(lambda: len(kept) >= len(sent))
        assert kept[: len(sent)] == sent
        assert len(FrameParser().feed(b"".join(kept))) == len(kept)


# --- parameters ---


def test_a_write_is_verified_by_its_echo():
    with linked() as (link, drone):
        write = link.write_parameter("MPC_THR_HOVER", 0.61)
        assert write.verified
        assert write.echoed == pytest.approx(0.61)
        assert drone.parameters["MPC_THR_HOVER"][0] == pytest.approx(0.61)
        assert link.write_parameter("PWM_MAIN_MIN1", 1100).verified
        assert link.read_parameter("PWM_MAIN_MIN1") == 1100.0


def test_a_lost_echo_is_asked_for_again_and_a_wrong_one_is_no_confirmation():
    with linked() as (link, drone):
        drone.drop_replies = 2
        assert link.write_parameter("MPC_THR_HOVER", 0.55, timeout=30.0).verified
        assert len(drone.writes) == 3
        drone.wrong_echo = True
        write = link.write_parameter("MPC_THR_HOVER", 0.6, timeout=2.0)
        assert not write.verified
        assert write.echoed == pytest.approx(0.606)
    with linked() as (link, drone):  # another: nothing of the first may come late
        drone.deaf = True
        write = link.write_parameter("MPC_THR_HOVER", 0.6, timeout=0.4)
        assert (write.verified, write.echoed) == (False, None)


def test_unknown_parameters_and_values_are_sentences():
    with linked() as (link, _):
        with pytest.raises(UsageError, match="no parameter"):
            link.write_parameter("NO_SUCH", 1.0, timeout=0.3)
        with pytest.raises(UsageError, match="no name of a MAVLink"):
            link.read_parameter("A_NAME_THAT_IS_TOO_LONG", timeout=0.3)
        with pytest.raises(UsageError, match="cannot hold"):
            link.write_parameter("PWM_MAIN_MIN1", 0.5)
        with pytest.raises(LinkError, match="did not answer"):
            link.read_parameter("NO_SUCH", timeout=0.3)


# --- outages ---


def test_silence_is_told_once_and_the_link_comes_back(monkeypatch):
    with streaming() as (link, drone, blocks):
        drone.mute = True
        monkeypatch.setattr("crazyem.links.mavlink.receiver.SILENT_AFTER", 0.3)
        assert "nothing has come" in wait_for(link, LinkLost).reason
        assert not drain(link)
        with pytest.raises(LinkError, match="was lost"):
            link.read_parameter("MPC_THR_HOVER")
        with pytest.raises(LinkError, match="did not come back"):
            link.reconnect(0.2)
        monkeypatch.setattr("crazyem.links.mavlink.receiver.SILENT_AFTER", 60.0)
        drone.mute = False
        drone.intervals.clear()
        outage = link.reconnect(60.0)
        assert "nothing has come" in outage.reason
        assert number_of("LOCAL_POSITION_NED") in drone.intervals  # asked for again
        drone.stream(0.05)
        assert of(samples(link, blocks, arrived(link)), "position")
        assert link.statistics().outages == 1


def test_a_restarted_drone_is_not_gone_on_with():
    with streaming() as (link, drone, _):
        drone.ms = 500
        drone.stream(0.1)
        lost = [p for p in drain(link) if isinstance(p, LinkLost)]
        assert len(lost) == 1
        assert "restarted" in lost[0].reason
        assert not link.can_reconnect
        with pytest.raises(LinkError, match="restarted"):
            link.reconnect(0.2)


def test_a_serial_port_that_is_pulled_out_is_a_lost_drone(monkeypatch):
    """A pseudo-terminal as the port; closing its other end is what unplugging looks like."""
    monkeypatch.setattr("crazyem.links.mavlink.link._LISTEN_SECONDS", 0.05)
    master, slave = os.openpty()
    tty.setraw(slave)
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    stop, ms = threading.Event(), 1000

    def talk():
        nonlocal ms
        while not stop.wait(0.005):
            ms += 10
            for message in (
                mavlink.MAVLink_heartbeat_message(2, PX4, 128, 0, 4, 3),
                mavlink.MAVLink_local_position_ned_message(ms, 1, 2, 3, 0, 0, 0),
                mavlink.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0),
                mavlink.MAVLink_servo_output_raw_message(1000 * ms, 0, *[1500] * 8),
                mavlink.MAVLink_command_ack_message(511, 3),
            ):
                with contextlib.suppress(BlockingIOError):
                    os.write(master, bytes(message.pack(packer)))
                packer.seq = (packer.seq + 1) % 256

    os.set_blocking(master, False)
    thread = threading.Thread(target=talk)
    thread.start()
    with contextlib.closing(MavlinkLink(f"mavlink:{os.ttyname(slave)}:57600")) as link:
        link.connect(60.0)
        link.start_streams(100.0)
        until(lambda: link.packets.qsize() > 5)
        stop.set()
        thread.join()
        os.close(slave)
        os.close(master)
        assert "is gone" in wait_for(link, LinkLost).reason
        with pytest.raises(LinkError, match="did not come back"):
            link.reconnect(0.2)


def test_it_cannot_be_flown_and_closes_twice():
    with linked() as (link, _):
        for command in (link.arm, link.take_off, link.land, link.stop, link.send_full_state):
            with pytest.raises(UsageError, match="not flown"):
                command()
        link.close()
        link.close()
        with pytest.raises(LinkError, match="not open"):
            link.read_parameter("X")
