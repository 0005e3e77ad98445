"""Asking until a reply comes: over any link a request or its reply may be lost."""

import queue
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

Reply = TypeVar("Reply")


def replies(
    ask: Callable[[], object], arrived: "queue.SimpleQueue[Reply]", *, timeout: float, repeat_after: float | None
) -> Iterator[Reply]:
    """Each reply that arrives within `timeout` [s]; what arrived before the first question is thrown away.

    Args:
        ask: send the request; False where nobody can be asked any more, which ends the waiting.
        arrived: replies, from whichever thread.
        repeat_after: s after which to ask again; None for what must not be done twice.
    """
    while not arrived.empty():
        arrived.get_nowait()
    deadline, again = time.monotonic() + timeout, 0.0
    while (now := time.monotonic()) < deadline:
        if now >= again:
            if ask() is False:
                return
            again = deadline if repeat_after is None else now + repeat_after
        try:
            reply = arrived.get(timeout=max(0.001, min(deadline, again) - now))
        except queue.Empty:
            continue
        yield reply


def send(crazyflie: Any, port: int, channel: int, data: bytes) -> bool:
    """Send a packet through a cflib Crazyflie; False if its link is gone."""
    from cflib.crtp.crtpstack import CRTPPacket

    if crazyflie.link is None:
        return False
    packet = CRTPPacket()
    packet.set_header(port, channel)
    packet.data = data
    crazyflie.send_packet(packet)
    return True
