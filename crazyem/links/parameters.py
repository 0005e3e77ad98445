"""Reading and writing parameters over a cflib Crazyflie, verified and with our own time limits.

cflib's own writer waits for an echo for ever and takes every later write down with it when one is lost. The packets
here travel beside it: sent through `Crazyflie.send_packet`, sent again while unanswered (a write is idempotent), and
matched to their echo by a port callback. A lost echo so costs one unverified write, never the parameter path.
"""

import queue
import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import ParameterWrite

_READ_CHANNEL = 1
_WRITE_CHANNEL = 2
_RESEND_AFTER = 0.3  # s


class ParameterClient:
    """Verified parameter access for one connected cflib Crazyflie object.

    Attributes:
        fault: why the last access went unanswered, one sentence; "" while parameters work.
    """

    def __init__(self, crazyflie: Any, uri: str) -> None:
        self.fault = ""
        self._cf = crazyflie
        self._uri = uri
        self._lock = threading.Lock()
        self._waiting: tuple[int, bytes] | None = None
        self._replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        from cflib.crtp.crtpstack import CRTPPort

        self._port = CRTPPort.PARAM
        crazyflie.add_port_callback(self._port, self._on_packet)

    def close(self) -> None:
        """Stop listening."""
        self._cf.remove_port_callback(self._port, self._on_packet)

    def types(self) -> Mapping[str, str]:
        """All parameters: name -> C type."""
        table = self._cf.param.toc.toc
        return {f"{group}.{name}": item.ctype for group, items in table.items() for name, item in items.items()}

    def read(self, name: str, timeout: float) -> float:
        """The value the firmware holds now. Raises UsageError (unknown name) or LinkError (no answer in time)."""
        element = self._element(name)
        identifier = struct.pack("<H", element.ident)
        with self._lock:
            deadline = time.monotonic() + timeout
            for reply in self._replies_until(_READ_CHANNEL, identifier, identifier, deadline):
                value = _decode(element.pytype, reply[3:])
                if reply[2] == 0 and value is not None:
                    self.fault = ""
                    return value
                raise LinkError(f"The drone refused to read the parameter {name} (error {reply[2]}).")
        self.fault = f"The drone at {self._uri} did not answer a read of {name} within {timeout:g} s."
        raise LinkError(self.fault)

    def write(self, name: str, value: float, timeout: float) -> ParameterWrite:
        """Write a value and wait for its echo; never raises for a silent drone, the result says what happened.

        Raises: UsageError for an unknown or read-only parameter, or a value its type cannot hold.
        """
        element = self._element(name)
        if element.access == element.RO_ACCESS:
            raise UsageError(f"The parameter {name} is read-only.")
        identifier = struct.pack("<H", element.ident)
        payload = identifier + _encode(name, element, value)
        echoed: float | None = None
        with self._lock:
            deadline = time.monotonic() + timeout
            for reply in self._replies_until(_WRITE_CHANNEL, identifier, payload, deadline):
                echoed = _decode(element.pytype, reply[2:])
                # An echo with another value belongs to an earlier write: keep waiting for ours.
                if reply == payload:
                    self.fault = ""
                    self._remember(element, echoed)
                    return ParameterWrite(name, value, echoed, True, time.time())
        self.fault = (
            f"The drone at {self._uri} did not confirm {name} = {value:g} within {timeout:g} s."
            if echoed is None
            else f"The drone at {self._uri} answered {name} = {value:g} with {echoed:g}."
        )
        return ParameterWrite(name, value, echoed, False, time.time())

    def _replies_until(self, channel: int, identifier: bytes, payload: bytes, deadline: float) -> Any:
        """Send until the deadline, yielding each reply on the channel that carries the identifier."""
        from cflib.crtp.crtpstack import CRTPPacket

        if self._cf.is_called_by_incoming_handler_thread():
            raise UsageError("Parameters cannot be accessed from inside a cflib callback.")
        while not self._replies.empty():  # leftovers of an exchange that was given up
            self._replies.get_nowait()
        self._waiting = (channel, identifier)
        try:
            resend_at = 0.0
            while (now := time.monotonic()) < deadline and self._cf.link is not None:
                if now >= resend_at:
                    packet = CRTPPacket()
                    packet.set_header(self._port, channel)
                    packet.data = payload
                    self._cf.send_packet(packet)
                    resend_at = now + _RESEND_AFTER
                try:
                    yield self._replies.get(timeout=max(0.0, min(deadline, resend_at) - now))
                except queue.Empty:
                    continue
        finally:
            self._waiting = None

    def _on_packet(self, packet: Any) -> None:
        """In cflib's thread: must not raise, or cflib's own parameter thread dies."""
        waiting = self._waiting
        if waiting is not None and packet.channel == waiting[0]:
            data = bytes(packet.data)
            if data[:2] == waiting[1] and len(data) > 2:
                self._replies.put(data)

    def _element(self, name: str) -> Any:
        element = self._cf.param.toc.get_element_by_complete_name(name) if name.count(".") == 1 else None
        if element is None:
            raise UsageError(f'The drone has no parameter "{name}".')
        return element

    def _remember(self, element: Any, value: float | None) -> None:
        """Keep cflib's own table of values (what get_value returns) in step with what we wrote."""
        group = self._cf.param.values.get(element.group)
        if group is not None and value is not None:
            group[element.name] = str(value)


def _encode(name: str, element: Any, value: float) -> bytes:
    try:
        number: Any = float(value)
        if element.pytype[-1] not in "fde":
            if not number.is_integer():
                raise UsageError(f"The parameter {name} is of type {element.ctype}: {value:g} is not a whole number.")
            number = int(value)
        return struct.pack(element.pytype, number)
    except (struct.error, OverflowError):
        raise UsageError(f"The parameter {name} is of type {element.ctype}, which cannot hold {value:g}.") from None


def _decode(pytype: str, data: bytes) -> float | None:
    return struct.unpack(pytype, data)[0] if struct.calcsize(pytype) == len(data) else None
