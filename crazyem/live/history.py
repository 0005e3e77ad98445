"""What a session remembers for its summary and plot: the track, the estimates, the pushes and the phases."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crazyem.estimation.result import Estimate
from crazyem.signals.sample import Sample

NAMES = ("mass", "Ixx", "Iyy", "Izz", "motor_time_constant")
SETTLE = 4.0  # s after the first push before a tracking error counts as "after": the height loop takes 2 to 3 s


@dataclass(frozen=True)
class Push:
    """One parameter write: time on the drone's clock [s], what was written and whether its echo came back equal."""

    time: float
    parameter: str
    value: float
    verified: bool

    def to_json(self) -> dict[str, Any]:
        """The form of the summary."""
        return {"time": self.time, "parameter": self.parameter, "value": self.value, "verified": self.verified}


@dataclass
class History:
    """Grows while a session runs.

    Attributes:
        track: rows of time [s], position xyz [m].
        setpoints: rows of time [s], active setpoint xyz [m].
        estimates: every estimate, in order.
        pushes: every parameter write by the guard.
        marks: phase -> time on the drone's clock [s]: trajectory_start, trajectory_end, push_enabled.
        notices: sentences for the user.
    """

    track: list[tuple[float, ...]] = field(default_factory=list)
    setpoints: list[tuple[float, ...]] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)
    pushes: list[Push] = field(default_factory=list)
    marks: dict[str, float] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    losses: list[tuple[float, int]] = field(default_factory=list)

    def notice(self, sentence: str) -> None:
        """Keep a sentence once."""
        if sentence and sentence not in self.notices:
            self.notices.append(sentence)

    def take(self, sample: Sample) -> None:
        """Keep a sample if it is of the track."""
        if sample.signal == "setpoint_position":
            self.setpoints.append((sample.time, *sample.value))
        elif sample.signal == "position":
            self.track.append((sample.time, *sample.value))

    def track_array(self) -> np.ndarray:
        """Time, position and setpoint, shape (n, 7); the setpoint is interpolated onto the positions' times.

        The two travel in packets of different instants; NaN where no setpoint is known.
        """
        track = np.array(self.track, dtype=float).reshape(-1, 4)
        out = np.full((len(track), 7), np.nan)
        out[:, :4] = track
        wanted = np.array(self.setpoints, dtype=float).reshape(-1, 4)
        if len(wanted):
            for k in (1, 2, 3):
                out[:, 3 + k] = np.interp(track[:, 0], wanted[:, 0], wanted[:, k], left=np.nan)
        return out

    def _error(self) -> tuple[np.ndarray, np.ndarray]:
        """Time and position error (position - setpoint), shape (n,) and (n, 3), during the trajectory."""
        track = self.track_array()
        # Without marks (somebody else's flight) nobody knows when the setpoint was meant to be followed.
        start, end = self.marks.get("trajectory_start", math.inf), self.marks.get("trajectory_end", math.inf)
        keep = (track[:, 0] >= start) & (track[:, 0] <= end) & np.isfinite(track[:, 4:]).all(axis=1)
        return track[keep, 0], track[keep, 1:4] - track[keep, 4:7]

    def before_and_after(self) -> tuple[dict[str, float | None], dict[str, float | None]]:
        """Tracking rms [m] and mean height error [m], each before the first push and after it has settled."""
        t, error = self._error()
        verified = [p.time for p in self.pushes if p.verified]
        first = min(verified, default=math.inf)
        rms: dict[str, float | None] = {}
        height: dict[str, float | None] = {}
        for name, keep in (("before_push", t < first), ("after_push", t >= first + SETTLE)):
            e = error[keep]
            enough = len(e) >= 10
            rms[name] = float(np.sqrt((e**2).sum(axis=1).mean())) if enough else None
            height[name] = float(e[:, 2].mean()) if enough else None
        return rms, height
