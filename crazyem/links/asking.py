"""One request and its reply over an open cflib Crazyflie, within a time of ours."""

import queue
import threading
import time
from typing import Any

from crazyem.errors import UsageError
from crazyem.links.courier import Key, key_of


class Asker:
    """Asks one thing at a time; safe to use from any thread but cflib's own."""

    def __init__(self, crazyflie: Any) -> None:
        self._cf = crazyflie
        self._lock = threading.Lock()
        self._waiting: Key | None = None
        self._replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        crazyflie.packet_received.add_callback(self._on_packet)

    def close(self) -> None:
        """Stop listening."""
        self._cf.packet_received.remove_callback(self._on_packet)

    def ask(self, port: int, channel: int, data: bytes, *, timeout: float, repeat_after: float | None) -> bytes | None:
        """The data of the reply that begins as its request does (`courier.key_of`), None if none came in time.

        Args:
            timeout: s.
            repeat_after: s without a reply after which to ask again; None for what must not be done twice.
        """
        from cflib.crtp.crtpstack import CRTPPacket

        if self._cf.is_called_by_incoming_handler_thread():
            raise UsageError("The drone cannot be asked from inside a cflib callback.")
        with self._lock:
            while not self._replies.empty():
                self._replies.get_nowait()
            self._waiting = key_of(port, channel, data)
            deadline, send_at = time.monotonic() + timeout, 0.0
            try:
                while (now := time.monotonic()) < deadline:
                    if now >= send_at:
                        if self._cf.link is None:
                            return None
                        packet = CRTPPacket()
                        packet.set_header(port, channel)
                        packet.data = data
                        self._cf.send_packet(packet)
                        send_at = deadline if repeat_after is None else now + repeat_after
                    try:
                        return self._replies.get(timeout=max(0.0, min(deadline, send_at) - now))
                    except queue.Empty:
                        continue
            finally:
                self._waiting = None
        return None

    def _on_packet(self, packet: Any) -> None:
        waiting = self._waiting
        if waiting is not None and (packet.port, packet.channel) == waiting[:2]:
            data = bytes(packet.data)
            if key_of(packet.port, packet.channel, data) == waiting:
                self._replies.put(data)
