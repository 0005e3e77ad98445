"""Commands whose arrival counts: sent until they are confirmed, and given up in time."""

import struct
from types import SimpleNamespace

import pytest

from crazyem.links.requests import land_command, send_until_confirmed


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
