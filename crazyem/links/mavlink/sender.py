"""Messages to an autopilot: heartbeats, time, commands with acknowledgements, requests for streams."""

import queue
import threading
import time
from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from crazyem.links.mavlink.transport import Transport

OUR_SYSTEM, OUR_COMPONENT = 255, 190  # usual numbers of a ground station
_COMMAND_ATTEMPTS, _COMMAND_TIMEOUT = 4, 0.3  # of a command, s each
ACCEPTED, IN_PROGRESS = 0, 5  # MAV_RESULT


class MessageSender:
    """Sends to one system; may be used from several threads.

    Attributes:
        target: system and component of the receiver; (0, 0), all systems, until it is known.
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.target = (0, 0)
        self._packer = mavlink.MAVLink(None, srcSystem=OUR_SYSTEM, srcComponent=OUR_COMPONENT)
        self._lock = threading.Lock()
        self._commanding = threading.Lock()
        self._acks: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()

    def send(self, message: Any) -> bool:
        """Send a message; returns whether the transport accepted it."""
        with self._lock:
            data = bytes(message.pack(self._packer))
            self._packer.seq = (self._packer.seq + 1) % 256
            return self.transport.send(data)

    def heartbeat(self) -> bool:
        """Send the heartbeat of a ground station."""
        return self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def ask_time(self) -> bool:
        """Request the time; the answer has our time in ts1 and the autopilot's in tc1, ns."""
        return self.send(mavlink.MAVLink_timesync_message(0, time.monotonic_ns()))

    def answer_time(self, theirs: int) -> bool:
        """Answer an autopilot's request for our time."""
        return self.send(mavlink.MAVLink_timesync_message(time.time_ns(), theirs))

    def ask_parameter(self, name: str) -> None:
        """Send PARAM_REQUEST_READ by name."""
        self.send(mavlink.MAVLink_param_request_read_message(*self.target, name.encode(), -1))

    def set_parameter(self, name: str, value: float, kind: int) -> None:
        """Send PARAM_SET with an encoded value."""
        self.send(mavlink.MAVLink_param_set_message(*self.target, name.encode(), value, kind))

    def acknowledged(self, fields: Mapping[str, Any]) -> None:
        """Take a received COMMAND_ACK."""
        self._acks.put((int(fields["command"]), int(fields["result"])))

    def command(self, number: int, *parameters: float) -> int | None:
        """Send COMMAND_LONG, repeatedly without an answer; returns its MAV_RESULT, None without an answer."""
        values = (*parameters, *(0.0,) * (7 - len(parameters)))
        with self._commanding:
            while not self._acks.empty():
                self._acks.get_nowait()
            for attempt in range(_COMMAND_ATTEMPTS):
                self.send(mavlink.MAVLink_command_long_message(*self.target, number, attempt, *values))
                until = time.monotonic() + _COMMAND_TIMEOUT
                while (left := until - time.monotonic()) > 0:
                    try:
                        command, result = self._acks.get(timeout=left)
                    except queue.Empty:
                        break
                    if command == number and result != IN_PROGRESS:
                        return result
        return None

    def set_interval(self, message: int, hertz: float) -> int | None:
        """Send MAV_CMD_SET_MESSAGE_INTERVAL; returns MAV_RESULT or None."""
        return self.command(511, float(message), 1e6 / hertz)

    def request_stream(self, group: int, hertz: float) -> None:
        """Send the older REQUEST_DATA_STREAM, which has no answer."""
        rate = max(1, min(65535, round(hertz)))
        self.send(mavlink.MAVLink_request_data_stream_message(*self.target, group, rate, 1))

    def request_message(self, message: int) -> None:
        """Send MAV_CMD_REQUEST_MESSAGE once, without waiting for the answer."""
        self.send(mavlink.MAVLink_command_long_message(*self.target, 512, 0, float(message), 0, 0, 0, 0, 0, 0))
