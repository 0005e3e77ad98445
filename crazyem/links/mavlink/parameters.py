"""The parameter protocol: reads and writes one value at a time, and repeats requests without an answer.

Values are sent as floats: PX4 sends the bits of an integer in a float, ArduPilot converts its value to a float.
Source: mavlink.io/en/services/parameter.html.
"""

import queue
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import ParameterWrite
from crazyem.links.requests import replies

RESEND_AFTER = 0.3  # s
# MAV_PARAM_TYPE -> name, struct format
PARAMETER_TYPES = {1: ("uint8_t", "B"), 2: ("int8_t", "b"), 3: ("uint16_t", "H"), 4: ("int16_t", "h"),
                   5: ("uint32_t", "I"), 6: ("int32_t", "i"), 9: ("float", "f")}  # fmt: skip
_REAL32 = 9


def decode(value: float, kind: int, *, bitwise: bool) -> float:
    """The value in a PARAM_VALUE; NaN for a type that does not fit into a float."""
    if kind not in PARAMETER_TYPES:
        return float("nan")
    if kind == _REAL32 or not bitwise:
        return value
    form = PARAMETER_TYPES[kind][1]
    return float(struct.unpack_from("<" + form, struct.pack("<f", value))[0])


def encode(value: float, kind: int, *, bitwise: bool) -> float:
    """The float for a value in a PARAM_SET. Raises UsageError if the type cannot hold the value."""
    name, form = PARAMETER_TYPES.get(kind, ("unknown", ""))
    try:
        if kind == _REAL32:
            return float(struct.unpack("<f", struct.pack("<f", value))[0])
        if not form or value != int(value):
            raise ValueError
        packed = struct.pack("<" + form, int(value))
    except (ValueError, OverflowError, struct.error):
        raise UsageError(f"a parameter of type {name} cannot hold {value:g}.") from None
    return float(struct.unpack("<f", packed.ljust(4, b"\0"))[0]) if bitwise else float(value)


class ParameterClient:
    """Client for parameters: `read` and `write` send requests; the receiving thread passes answers to `on_value`.

    Args:
        uri: for messages.
        ask_read: sends PARAM_REQUEST_READ of a name. ask_write: sends PARAM_SET of a name, float and type.
        bitwise: whether integers are sent as bits (PX4).
    """

    def __init__(
        self,
        uri: str,
        *,
        ask_read: Callable[[str], None],
        ask_write: Callable[[str, float, int], None],
        bitwise: Callable[[], bool],
    ) -> None:
        self._uri, self._ask_read, self._ask_write, self._bitwise = uri, ask_read, ask_write, bitwise
        self._known: dict[str, tuple[float, int]] = {}
        self._replies: queue.SimpleQueue[tuple[float, int]] = queue.SimpleQueue()
        self._waiting = ""
        self._lock = threading.Lock()

    @property
    def known(self) -> Mapping[str, float]:
        """All values received so far."""
        return {name: decode(v, kind, bitwise=self._bitwise()) for name, (v, kind) in dict(self._known).items()}

    def types(self) -> Mapping[str, str]:
        """C type of every parameter received so far."""
        return {
            name: PARAMETER_TYPES[kind][0] for name, (_, kind) in dict(self._known).items() if kind in PARAMETER_TYPES
        }

    def on_value(self, fields: Mapping[str, Any]) -> None:
        """Take a received PARAM_VALUE."""
        name = bytes(fields["param_id"]).split(b"\0")[0].decode("ascii", "replace")
        value, kind = float(fields["param_value"]), int(fields["param_type"])
        if len(self._known) < 5000 or name in self._known:
            self._known[name] = (value, kind)
        if name and name == self._waiting:
            self._replies.put((value, kind))

    def read(self, name: str, timeout: float) -> float:
        """The present value in the drone. Raises LinkError: no answer (some autopilots ignore unknown names)."""
        with self._lock:
            for value, kind in self._replies_to(name, lambda: self._ask_read(name), timeout):
                return decode(value, kind, bitwise=self._bitwise())
        raise LinkError(f"The drone at {self._uri} did not answer a read of {name} within {timeout:g} s.")

    def write(self, name: str, value: float, timeout: float) -> ParameterWrite:
        """Write and wait for the echo: `verified` only if the drone sends back exactly the written bits.

        Raises: UsageError: unknown parameter, or its type cannot hold the value.
        """
        if name not in self._known:
            try:
                self.read(name, timeout)
            except LinkError:
                raise UsageError(f'the drone has no parameter "{name}", or does not answer for it.') from None
        kind = self._known[name][1]
        bitwise = self._bitwise()
        wire = encode(value, kind, bitwise=bitwise)
        echoed: float | None = None
        with self._lock:
            for echo, echo_kind in self._replies_to(name, lambda: self._ask_write(name, wire, kind), timeout):
                echoed = decode(echo, echo_kind, bitwise=bitwise)
                # An echo with another value belongs to an earlier write: keep waiting for ours.
                if echo_kind == kind and struct.pack("<f", echo) == struct.pack("<f", wire):
                    return ParameterWrite(name, value, echoed, True, time.time())
        return ParameterWrite(name, value, echoed, False, time.time())

    def _replies_to(self, name: str, request: Callable[[], object], timeout: float) -> Iterator[tuple[float, int]]:
        """Repeat the request until the deadline, and yield each answer for the name."""
        if not name or len(name) > 16 or not name.isascii():
            raise UsageError(f'"{name[:40]}" is no name of a MAVLink parameter.')
        self._waiting = name
        try:
            yield from replies(request, self._replies, timeout=timeout, repeat_after=RESEND_AFTER)
        finally:
            self._waiting = ""
