"""The autopilot's clock from the stamps of its messages: milliseconds since boot, unwrapped and checked.

Messages have stamps in ms since boot (32 bits), us since boot (64 or 32 bits), us since 1970, or none. Sources:
mavlink.io/en/messages/common.html. PX4 truncates microseconds to time_boot_ms, so microseconds are truncated here, too.
"""

import math
from collections.abc import Mapping
from typing import Any

EPOCH_US = 10**15  # us; a larger time_usec is since 1970
_BEHIND_MS = 2000.0  # ms; stamps further behind the newest one are refused
_AHEAD_MS = 2000.0  # ms; largest lead of a stamp, in addition to the next factor times the host's elapsed time
_FASTEST_CLOCK_RATIO = 100.0
_RESTART_REFUSALS = 20  # refused stamps in a row that mean a restart
_WRAP32 = 1 << 32


class RestartedError(Exception):
    """The autopilot's clock has restarted."""


class DroneClock:
    """Places messages on the drone's clock.

    Attributes:
        newest_ms: newest accepted stamp; NaN before the first.
        refused: number of refused stamps.
    """

    def __init__(self) -> None:
        self.newest_ms = math.nan
        self.refused = 0
        self._newest_host = math.nan
        self._utc_ms: int | None = None  # 1970 on the drone's clock
        self._refused_in_row = 0

    def place(self, fields: Mapping[str, Any], host: float) -> int | None:
        """Stamp [ms] of a message that arrived at `host` [s, any steady clock]; None: refused, or not known yet.

        A message without its own stamp gets the newest stamp of the others: it is at least as new.

        Raises: RestartedError after `_RESTART_REFUSALS` refused stamps in a row.
        """
        stamp = self._stamp_of(fields)
        if stamp is None:
            return None if math.isnan(self.newest_ms) else int(self.newest_ms)
        if not math.isnan(self.newest_ms):
            allowed = _AHEAD_MS + _FASTEST_CLOCK_RATIO * 1000.0 * max(host - self._newest_host, 0.0)
            if not -_BEHIND_MS <= stamp - self.newest_ms <= allowed:
                self.refused += 1
                self._refused_in_row += 1
                if self._refused_in_row >= _RESTART_REFUSALS:
                    raise RestartedError
                return None
        self._refused_in_row = 0
        if not stamp <= self.newest_ms:
            self.newest_ms, self._newest_host = float(stamp), host
        return stamp

    def _stamp_of(self, fields: Mapping[str, Any]) -> int | None:
        if "time_boot_ms" in fields:
            return self._unwrapped(int(fields["time_boot_ms"]), _WRAP32)
        if "time_usec" not in fields or fields["time_usec"] <= 0:
            return None
        stamp = int(fields["time_usec"])
        if stamp > EPOCH_US:
            if math.isnan(self.newest_ms):
                return None
            if self._utc_ms is None:
                self._utc_ms = stamp // 1000 - int(self.newest_ms)
            return stamp // 1000 - self._utc_ms
        if "servo1_raw" not in fields:
            return stamp // 1000
        if math.isnan(self.newest_ms):
            return None
        return self._unwrapped(stamp, _WRAP32, per_ms=1000)  # 32 bits of microseconds wrap after 71 minutes

    def _unwrapped(self, stamp: int, modulus: int, per_ms: int = 1) -> int:
        if math.isnan(self.newest_ms):
            return stamp // per_ms
        newest = int(self.newest_ms) * per_ms
        half = modulus // 2
        return (newest + (stamp - newest + half) % modulus - half) // per_ms
