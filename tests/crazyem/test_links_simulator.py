"""The link against the simulated firmware: real tables, real blocks, a verified write, a flight, a death."""

import struct
import time

import pytest

from crazyem.errors import LinkError
from crazyem.links.base import LinkLost, Packet
from crazyem.links.crazyflie import CrazyflieLink
from crazyem.signals.vocabulary import decoders, standard_variables


@pytest.fixture
def drone(simulator):
    return simulator("--seed", "1")


def take(link, seconds):
    items, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        if link.packets.empty():
            time.sleep(0.005)
        else:
            items.append(link.packets.get_nowait())
    return items


def test_standard_blocks_stream_at_100_hz(drone):
    with CrazyflieLink(drone.uri) as link:
        blocks = link.subscribe(standard_variables(link.log_variables), 100.0)
        packets = take(link, 1.0)
        statistics = link.statistics()
    assert len(blocks) == 3
    assert all(isinstance(p, Packet) for p in packets)
    assert statistics.lost == 0
    table = decoders(blocks)
    samples = [s for p in packets for s in table[p.block].decode(p)]
    assert {s.signal for s in samples} >= {
        "position",
        "velocity",
        "attitude",
        "body_rate",
        "specific_force",
        "motor_command",
        "voltage",
        "flying",
    }
    force = [s.value for s in samples if s.signal == "specific_force"]
    mean = [sum(v[i] for v in force) / len(force) for i in range(3)]
    assert mean == pytest.approx([0.0, 0.0, 9.81], abs=0.1)  # at rest on the ground


def test_parameters_read_and_write(drone):
    with CrazyflieLink(drone.uri) as link:
        assert link.parameters["ctrlLee.mass"] == "float"
        write = link.write_parameter("ctrlLee.mass", 0.0312)
        assert write.verified
        assert link.read_parameter("ctrlLee.mass") == struct.unpack("<f", struct.pack("<f", 0.0312))[0]


def test_a_second_client_can_take_off_after_the_first_has_commanded(drone):
    with CrazyflieLink(drone.uri) as first:
        first.send_hover(0.0, 0.0, 0.0, 0.0)
    with CrazyflieLink(drone.uri) as second:
        blocks = second.subscribe(["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"], 50.0)
        second.take_off(0.5, 1.0)
        packets = take(second, 2.0)
        second.land(0.0, 1.0)
        time.sleep(1.2)
    table = decoders(blocks)
    heights = [s.value[2] for p in packets for s in table[p.block].decode(p)]
    assert max(heights) > 0.2


@pytest.mark.parametrize("how", ["kill", "pause"])
def test_a_dead_simulator_is_reported_once(drone, how):
    with CrazyflieLink(drone.uri) as link:
        link.subscribe(standard_variables(link.log_variables), 100.0)
        getattr(drone, how)()
        items = take(link, 3.0)
        assert [type(i) for i in items if isinstance(i, LinkLost)] == [LinkLost]
        assert isinstance(items[-1], LinkLost)
        with pytest.raises(LinkError):
            link.read_parameter("ctrlLee.mass")
