"""Reading and writing parameters over a cflib Crazyflie, verified and with our own time limits.

cflib's own writer waits for ever for a lost echo and blocks all later writes. This module does not use it: packets are
sent by a `RequestClient`, which repeats them without an answer (a write is idempotent) and matches them to their echo.
So a lost echo costs only one unverified write.
"""

import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import ParameterWrite
from crazyem.links.requests import _PORT, _READ_CHANNEL, _WRITE_CHANNEL, RequestClient, types_of

_RESEND_AFTER = 0.3  # s


class ParameterClient:
    """Verified parameter access for one connected cflib Crazyflie object."""

    def __init__(self, crazyflie: Any, uri: str) -> None:
        self._cf, self._uri = crazyflie, uri
        self._requests = RequestClient(crazyflie)

    def close(self) -> None:
        """Stop listening."""
        self._requests.close()

    def types(self) -> Mapping[str, str]:
        """All parameters: name -> C type."""
        return types_of(self._cf.param.toc)

    def read(self, name: str, timeout: float) -> float:
        """The present value in the firmware. Raises UsageError (unknown name) or LinkError (no answer in time)."""
        element = self._element(name)
        for reply in self._replies_to(_READ_CHANNEL, struct.pack("<H", element.ident), timeout):
            value = _decode(element.pytype, reply[3:])
            if reply[2] == 0 and value is not None:
                return value
            raise LinkError(f"The drone refused to read the parameter {name} (error {reply[2]}).")
        raise LinkError(f"The drone at {self._uri} did not answer a read of {name} within {timeout:g} s.")

    def write(self, name: str, value: float, timeout: float) -> ParameterWrite:
        """Write a value and wait for its echo; without an echo the result is not verified.

        Raises: UsageError: an unknown or read-only parameter, or a value that its type cannot hold.
        """
        element = self._element(name)
        if element.access == element.RO_ACCESS:
            raise UsageError(f"The parameter {name} is read-only.")
        payload = struct.pack("<H", element.ident) + _encode(name, element, value)
        echoed: float | None = None
        for reply in self._replies_to(_WRITE_CHANNEL, payload, timeout):
            echoed = _decode(element.pytype, reply[2:])
            # An echo with another value belongs to an earlier write: keep waiting for ours.
            if reply == payload:
                group = self._cf.param.values.get(element.group)
                if group is not None and echoed is not None:
                    group[element.name] = str(echoed)  # cflib's own table of values (for its get_value)
                return ParameterWrite(name, value, echoed, True, time.time())
        return ParameterWrite(name, value, echoed, False, time.time())

    def _replies_to(self, channel: int, payload: bytes, timeout: float) -> Iterator[bytes]:
        """Repeat the request until `timeout`, and yield each reply on the channel with the same identifier."""
        if self._cf.is_called_by_incoming_handler_thread():
            raise UsageError("Parameters cannot be accessed from inside a cflib callback.")
        key = (_PORT, channel, payload[:2])
        for reply in self._requests.replies(key, payload, timeout=timeout, repeat_after=_RESEND_AFTER):
            if len(reply) > 2:
                yield reply

    def _element(self, name: str) -> Any:
        element = self._cf.param.toc.get_element_by_complete_name(name) if name.count(".") == 1 else None
        if element is None:
            raise UsageError(f'The drone has no parameter "{name}".')
        return element


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
