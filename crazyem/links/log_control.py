"""Creation, start and deletion of log blocks with a check of every reply: cflib ignores those for appended variables.

Most of our blocks have ten variables or more, which need two packets. If the second packet is lost, the block delivers
packets that are too short. If it is repeated, the block has its variables twice.
"""

import struct
from collections.abc import Sequence

from crazyem.errors import LinkError, UsageError
from crazyem.links.requests import RequestClient

_PORT, _CONTROL = 5, 1
_DELETE, _START, _CREATE, _APPEND, _START_MS = 2, 3, 6, 7, 8
ENOENT, _ENOEXEC, _EEXIST = 2, 8, 17
_REASONS = {
    ENOENT: "a variable does not exist",
    7: "too many bytes in it",
    _ENOEXEC: "the command is unknown",
    12: "no memory left for blocks or variables",
    _EEXIST: "it exists already",
}
_ITEMS_A_PACKET = 9  # of 3 bytes each, in 28 bytes
REPLY_WITHIN, REPEAT_AFTER = 0.5, 0.15  # s
INSTALL_ATTEMPTS = 5

Items = Sequence[tuple[int, int]]  # type byte, index in the table


class LogControl:
    """The log port's commands for one Crazyflie."""

    def __init__(self, requests: RequestClient, uri: str) -> None:
        self._requests, self._uri = requests, uri

    def install(self, identifier: int, items: Items) -> None:
        """Create the block with exactly these variables; replaces a block with the same number.

        Raises: LinkError: no answer, or refused.
        """
        for attempt in range(INSTALL_ATTEMPTS):
            if attempt:
                self._command(bytes((_DELETE, identifier)))
            packets = [items[i : i + _ITEMS_A_PACKET] for i in range(0, len(items), _ITEMS_A_PACKET)]
            for number, part in enumerate(packets):
                head = bytes((_APPEND if number else _CREATE, identifier))
                body = b"".join(struct.pack("<BH", kind, index) for kind, index in part)
                status = self._command(head + body, repeat=False)
                if status in (None, _EEXIST):  # the content of the block is unknown: delete it
                    break
                if status:
                    raise LinkError(f"The drone at {self._uri} refused log block {identifier}: {_reason(status)}.")
            else:
                return
        raise LinkError(f"The drone at {self._uri} did not confirm log block {identifier}.")

    def start(self, identifier: int, period_ms: int) -> bool:
        """Start the block; False if it does not exist.

        Periods that are not a multiple of 10 ms need a start command in milliseconds, which cflib does not use.

        Raises: UsageError: the firmware does not have this command. LinkError: no answer, or refused.
        """
        if period_ms % 10 == 0:
            status = self._command(bytes((_START, identifier, period_ms // 10)))
        else:
            status = self._command(struct.pack("<BBH", _START_MS, identifier, period_ms))
        if status is None:
            raise LinkError(f"The drone at {self._uri} did not confirm the start of log block {identifier}.")
        if status == _ENOEXEC and period_ms % 10:
            raise UsageError(
                f"The firmware at {self._uri} cannot log every {period_ms} ms, only every 10 ms or multiples of that."
            )
        if status not in (0, ENOENT):
            raise LinkError(f"The drone at {self._uri} did not start log block {identifier}: {_reason(status)}.")
        return status == 0

    def delete(self, identifier: int) -> bool:
        """Delete the block if it exists; returns whether the drone answered."""
        return self._command(bytes((_DELETE, identifier))) is not None

    def _command(self, data: bytes, *, repeat: bool = True) -> int | None:
        """Status of a command, None without an answer."""
        after = REPEAT_AFTER if repeat else None
        reply = self._requests.request(_PORT, _CONTROL, data, timeout=REPLY_WITHIN, repeat_after=after)
        return reply[2] if reply is not None and len(reply) > 2 else None


def _reason(status: int) -> str:
    return _REASONS.get(status, f"error {status}")
