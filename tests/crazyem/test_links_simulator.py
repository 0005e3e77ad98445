"""The link against the simulated firmware: real tables, real blocks, a take-off."""

import pytest
from received import packets

from crazyem.links.crazyflie import CrazyflieLink
from crazyem.signals.vocabulary import decoders, standard_variables


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
        first.send_hover(0.0, 0.0, 0.0, 0.0)
    with CrazyflieLink(resting.uri) as second:
        blocks = second.subscribe(["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"], 50.0)
        second.take_off(0.5, 1.0)
        table = decoders(blocks)
        for packet in packets(second, 200):  # 4 s of the drone's clock
            if any(s.value[2] > 0.2 for s in table[packet.block].decode(packet)):
                return
    raise AssertionError("it did not take off")
