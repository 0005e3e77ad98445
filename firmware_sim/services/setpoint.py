"""Ports 3 and 7: low-level setpoints, and the notice that a stream of them has ended. No replies."""

import struct

import numpy as np

from firmware_sim.commander.decode import RpytDecoder, decode_generic
from firmware_sim.commander.setpoint import CRTP, Arbiter

SETPOINT, META = 0, 1
NOTIFY_STOP = 0


class SetpointService:
    """Decodes setpoints and hands them to the arbiter, unless the supervisor does not allow flight."""

    def __init__(self, arbiter: Arbiter, rpyt: RpytDecoder):
        self._arbiter, self._rpyt = arbiter, rpyt

    def handle_rpyt(self, channel: int, data: bytes, tick: int, *, allowed: bool) -> list[tuple[int, bytes]]:
        """A packet on port 3: roll, pitch, yaw rate, thrust."""
        if channel == 0 and len(data) >= 14 and allowed:
            roll, pitch, yaw_rate, thrust = struct.unpack_from("<fffH", data)
            setpoint = self._rpyt.decode(roll, pitch, yaw_rate, thrust, disabled=self._arbiter.disabled)
            self._offer(setpoint, tick)
        return []

    def handle_generic(self, channel: int, data: bytes, tick: int, *, allowed: bool) -> list[tuple[int, bytes]]:
        """A packet on port 7: a typed setpoint (channel 0) or a meta command (channel 1)."""
        if channel == META:
            if data[:1] == bytes((NOTIFY_STOP,)):
                self._arbiter.relax()
        elif channel == SETPOINT and data and allowed:
            setpoint = decode_generic(data[0], data[1:])
            if setpoint is not None:
                self._offer(setpoint, tick)
        return []

    def _offer(self, setpoint: np.ndarray, tick: int) -> None:
        """The firmware would fly into NaN; a simulator ignores what is not a number."""
        if np.isfinite(setpoint).all():
            self._arbiter.offer(setpoint, CRTP, tick)
