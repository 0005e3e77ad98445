"""High-level commands whose arrival counts: sent until the drone says that it has them.

cflib sends a command to port 8 once and looks at no reply. The firmware answers each with its first byte, two more, and
an error (crtp_commander_high_level.c).
"""

import queue
import struct
import time
from typing import Any

HIGH_LEVEL_PORT = 8
LAND_COMMAND = 8  # land2: group, height [m], yaw [rad], whether the present yaw is kept, duration [s]


def land_command(height: float, duration: float) -> bytes:
    """Landing straight down to `height` [m, world] in `duration` [s], with the yaw it has."""
    return struct.pack("<BBff?f", LAND_COMMAND, 0, height, 0.0, True, duration)


def send_until_confirmed(crazyflie: Any, command: bytes, *, timeout: float, repeat_after: float) -> bool:
    """Whether the drone confirmed a command within `timeout` [s]; it is sent again every `repeat_after` [s].

    For commands that may be carried out twice. Not to be called from a cflib callback.
    """
    from cflib.crtp.crtpstack import CRTPPacket

    replies: queue.SimpleQueue[int] = queue.SimpleQueue()

    def take(packet: Any) -> None:
        data = bytes(packet.data)
        if (packet.port, packet.channel) == (HIGH_LEVEL_PORT, 0) and len(data) >= 4 and data[0] == command[0]:
            replies.put(data[3])

    crazyflie.packet_received.add_callback(take)
    try:
        deadline = time.monotonic() + timeout
        while (now := time.monotonic()) < deadline and crazyflie.link is not None:
            packet = CRTPPacket()
            packet.set_header(HIGH_LEVEL_PORT, 0)
            packet.data = command
            crazyflie.send_packet(packet)
            try:
                if replies.get(timeout=min(repeat_after, deadline - now)) == 0:
                    return True
            except queue.Empty:
                continue
        return False
    finally:
        crazyflie.packet_received.remove_callback(take)
