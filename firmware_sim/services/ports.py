"""Ports of a few messages: console (0), supervisor (9), platform (13) and link (15)."""

import struct

from firmware_sim.commander.supervisor import Supervisor
from firmware_sim.wire import MAX_DATA, PROTOCOL_VERSION


def text_chunks(text: str) -> list[bytes]:
    """The text as packet payloads, in order; each decodes as UTF-8 on its own."""
    chunks: list[bytes] = []
    current = b""
    for character in text:
        encoded = character.encode()
        if len(current) + len(encoded) > MAX_DATA:
            chunks.append(current)
            current = b""
        current += encoded
    return [*chunks, current] if current else chunks


# Port 15, the link: echo (pings), source (how cflib recognises a Crazyflie) and sink.
ECHO, SOURCE = 0, 1
# cflib compares the first 18 bytes; anything else makes it fall back to a protocol without version.
IDENTITY = b"Bitcraze Crazyflie".ljust(30, b"\0")


def link(channel: int, data: bytes) -> list[tuple[int, bytes]]:
    """Replies (channel, data) to a packet on the link port."""
    if channel == ECHO:
        return [(ECHO, data)]
    if channel == SOURCE:
        return [(SOURCE, IDENTITY)]
    return []


# Port 13, the platform: versions (channel 1) and the deprecated arming and recovery commands (channel 0).
COMMAND, VERSION = 0, 1
FIRMWARE_VERSION = "2026.08-crazyem-sim"
DEVICE = {"cf2": "Crazyflie 2.1", "cf21bl": "Crazyflie 2.1 Brushless"}


class PlatformService:
    """Answers version requests, and forwards arming and recovery to the supervisor."""

    def __init__(self, platform: str, supervisor: Supervisor):
        self._device = DEVICE.get(platform, "Crazyflie")
        self._supervisor = supervisor

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the platform port."""
        if not data:
            return []
        if channel == VERSION:
            return self._version(data[0])
        if channel == COMMAND and data[0] == 0x01 and len(data) >= 2:
            done = self._supervisor.request_arming(bool(data[1]))
            return [(COMMAND, bytes((0x01, done, self._supervisor.armed)))]
        if channel == COMMAND and data[0] == 0x02:
            done = self._supervisor.request_recovery()
            return [(COMMAND, bytes((0x02, done, not self._supervisor.crashed)))]
        return []

    def _version(self, command: int) -> list[tuple[int, bytes]]:
        if command == 0:
            return [(VERSION, struct.pack("<Bi", 0, PROTOCOL_VERSION))]
        if command == 1:
            return [(VERSION, b"\x01" + FIRMWARE_VERSION.encode() + b"\0")]
        if command == 2:
            return [(VERSION, b"\x02" + self._device.encode() + b"\0")]
        return []


# Port 9, the supervisor: information bits (channel 0), arming, recovery and emergency stop (channel 1).
INFO, ORDER = 0, 1
REPLY = 0x80
BITFIELD = 0x0C
ARM, RECOVER, EMERGENCY_STOP, EMERGENCY_STOP_WATCHDOG = 1, 2, 3, 4
_NUMBER_OF_BITS = 11  # commands 1..11 ask for bit 0..10


def supervise(supervisor: Supervisor, channel: int, data: bytes) -> list[tuple[int, bytes]]:
    """Replies (channel, data) to a packet on the supervisor port."""
    if not data:
        return []
    command = data[0]
    if channel == INFO:
        if command == BITFIELD:
            return [(INFO, bytes((REPLY | BITFIELD,)) + supervisor.info.to_bytes(2, "little"))]
        if 1 <= command <= _NUMBER_OF_BITS:
            return [(INFO, bytes((REPLY | command, supervisor.info >> (command - 1) & 1)))]
    elif channel == ORDER:
        if command == ARM and len(data) >= 2:
            done = supervisor.request_arming(bool(data[1]))
            return [(ORDER, bytes((REPLY | ARM, done, supervisor.armed)))]
        if command == RECOVER:
            done = supervisor.request_recovery()
            return [(ORDER, bytes((REPLY | RECOVER, done, not supervisor.crashed)))]
        if command == EMERGENCY_STOP:
            supervisor.emergency_stop()
        elif command == EMERGENCY_STOP_WATCHDOG:
            supervisor.emergency_stop_watchdog()
    return []
