"""The clocks of a telemetry log on one axis: the autopilot's time since boot, or arrival where nothing has that."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.autopilots.tlog_frames import MESSAGES, Frames, Frameset, columns_of
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.topics import seconds

_EPOCH = 10**15  # us; a `time_usec` beyond is since 1970, below since boot


class Clocks:
    """The clocks of a log on one axis: time since boot of the autopilot, or the host's if no message has that.

    A message without a time of its own is placed by its arrival, less the median of what others took to arrive.
    """

    def __init__(self, found: Frameset, system: int) -> None:
        self._offset: dict[int, float] = {}  # component -> host time minus its time since boot, s
        self._utc: dict[int, float] = {}  # component -> host time minus its own UTC, s
        counts: Counter[int] = Counter()
        boots: dict[int, list[NDArray[np.float64]]] = {}
        epochs: dict[int, list[NDArray[np.float64]]] = {}
        for (sender, component, identifier), frames in found.frames.items():
            if sender != system:
                continue
            counts[component] += len(frames.stamps) * (1000 if identifier == 0 else 1)
            boot, utc = _own_time(MESSAGES[identifier], frames)
            host = seconds(np.array(frames.stamps, np.int64))
            if boot is not None:
                boots.setdefault(component, []).append(host - boot)
            if utc is not None:
                epochs.setdefault(component, []).append(host - utc)
        self._offset = {c: float(np.median(np.concatenate(v))) for c, v in boots.items()}
        self._utc = {c: float(np.median(np.concatenate(v))) for c, v in epochs.items()}
        self.component = max(counts, key=lambda c: (c in self._offset, counts[c], -c))
        first = min(f.stamps[0] for f in found.frames.values())
        self.boot = self._offset.get(self.component)  # host time at which the axis is 0, None: no such axis
        self.origin = 0.0 if self.boot is not None else float(first // 1_000_000)

    def place(self, component: int, frames: Frames, message: object) -> tuple[NDArray[np.float64], str]:
        """Times of frames on the axis [s], and the clock they are of."""
        host = np.array(frames.stamps, np.int64)
        boot, utc = _own_time(message, frames)
        if self.boot is None:
            return self.arrival(host), "host"
        if boot is not None:
            if component == self.component:
                return boot, "autopilot"
            return boot + (self._offset[component] - self.boot), f"component {component}"
        if utc is not None:
            return utc + (self._utc[component] - self.boot), f"UTC of component {component}"
        return self.arrival(host), "host"

    def arrival(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Times on the axis [s] of what arrived at these times [us]."""
        if self.boot is None:
            return seconds(stamps - int(self.origin) * 1_000_000)
        return seconds(stamps) - self.boot

    def findings(self) -> list[Finding]:
        if self.boot is None:
            text = "No message has the autopilot's own time; all times are those of arrival at the ground station."
            return [note("mapping", text, Grade.DEGRADES)]
        text = (
            'Messages without a time of their own (clock "host") are placed by their arrival less the median delay '
            'of the others; among signals of clock "host" times are exact, against others they are not.'
        )
        return [note("mapping", text, boot_s=self.boot)]


def _own_time(message: object, frames: Frames) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Times that messages carry: since boot [s], and since 1970 [s]; at most one of them."""
    names = message.fieldnames  # type: ignore[attr-defined]
    if "time_boot_ms" in names:
        return seconds(columns_of(message, frames.payloads)["time_boot_ms"], 1e3), None
    if "time_usec" not in names:
        return None, None
    raw = columns_of(message, frames.payloads)["time_usec"]
    stamps = np.asarray(raw).astype(np.int64)
    if raw.dtype.itemsize == 4:  # wraps after 71 minutes
        steps = (np.diff(stamps) + (1 << 31)) % (1 << 32) - (1 << 31)
        stamps = stamps[:1].repeat(stamps.size) + np.concatenate([[0], np.cumsum(steps)])
    if (stamps <= 0).any():
        return None, None
    if (stamps > _EPOCH).all():
        return None, seconds(stamps)
    return (seconds(stamps), None) if (stamps < _EPOCH).all() else (None, None)
