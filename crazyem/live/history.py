"""Data that a session keeps for its summary and plot (track, estimates, pushes and phases), and its recording."""

import json
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from crazyem.control.trajectories import Reference
from crazyem.estimation.result import Estimate, Step
from crazyem.links.base import DescribingLink, Link, LinkStatistics, ParameterWrite
from crazyem.monitoring.fault import Fault
from crazyem.signals.sample import Block, Packet, Sample
from crazyem.vehicle import Vehicle

MOST_ESTIMATES = 6000  # most estimates: four minutes at 25 a second. The recording has all of them
TRACK_ROWS = 60_000  # most rows of a track: ten minutes at 100 Hz
SETTLE_SECONDS = 4.0  # s from the first push until a tracking error counts as "after": the height loop takes 2 to 3 s


@dataclass(frozen=True)
class Push:
    """One parameter write: time on the drone's clock [s], parameter, value, and whether the echo was equal.

    `purpose` is "push", or for old values "revert" in flight, "restore" after the flight, "undo" of an incomplete set.
    """

    time: float
    parameter: str
    value: float
    verified: bool
    purpose: str = "push"

    def to_json(self) -> dict[str, Any]:
        """The form of the summary, with the purpose unless it is "push"."""
        usual = {"time": self.time, "parameter": self.parameter, "value": self.value, "verified": self.verified}
        return usual if self.purpose == "push" else {**usual, "purpose": self.purpose}


class Track:
    """Rows of time [s] and xyz [m] with bounded memory: whenever full, every second row is dropped."""

    def __init__(self, rows: int = TRACK_ROWS) -> None:
        self._values, self._most = array("d"), 4 * rows
        self._every, self._seen = 1, 0

    def add(self, time: float, position: tuple[float, ...]) -> None:
        """Add a row, unless the present thinning drops it."""
        if self._seen % self._every == 0:
            self._values.extend((time, *position))
            if len(self._values) == self._most:
                self._values = array("d", np.array(self._values).reshape(-1, 4)[::2].ravel())
                self._every *= 2
        self._seen += 1

    def array(self) -> np.ndarray:
        """(n, 4) time [s], xyz [m]; a copy."""
        return np.array(self._values).reshape(-1, 4)


@dataclass
class History:
    """Data of a session; its memory is bounded except for pushes, at most two a second.

    Attributes:
        track: position in the world.
        setpoints: active setpoint in the world.
        estimates: in order; whenever there are more than `MOST_ESTIMATES`, every second of the older half is dropped.
        pushes: every parameter write by the guard.
        marks: phase -> time on the drone's clock [s]: trajectory_start, trajectory_end, push_enabled.
        notices: sentences for the user.
        steps: detected changes of mass; the cause of the newest may be undecided.
        faults: reports of the monitor. monitored: s of flight in which the monitor has tested.
        guard: mode, policy and decisions of the guard, empty without one (see `WriteSupervisor`).
    """

    track: Track = field(default_factory=Track)
    setpoints: Track = field(default_factory=Track)
    estimates: list[Estimate] = field(default_factory=list)
    pushes: list[Push] = field(default_factory=list)
    marks: dict[str, float] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    losses: list[tuple[float, int]] = field(default_factory=list)
    steps: tuple[Step, ...] = ()
    faults: tuple[Fault, ...] = ()
    monitored: float = 0.0
    guard: dict[str, Any] = field(default_factory=dict)

    def notice(self, sentence: str) -> None:
        """Keep a sentence once."""
        if sentence and sentence not in self.notices:
            self.notices.append(sentence)

    def take(self, sample: Sample) -> None:
        """Keep a sample if it is of the track."""
        if sample.signal == "setpoint_position":
            self.setpoints.add(sample.time, sample.value)
        elif sample.signal == "position":
            self.track.add(sample.time, sample.value)

    def keep(self, estimate: Estimate) -> None:
        """Add an estimate. Thinning makes a new list, so other threads can still read the old one."""
        self.estimates.append(estimate)
        if len(self.estimates) > MOST_ESTIMATES:
            half = MOST_ESTIMATES // 2
            self.estimates = self.estimates[:half:2] + self.estimates[half:]

    def track_array(self) -> np.ndarray:
        """Time, position and setpoint, shape (n, 7).

        The setpoint is interpolated to the times of the positions, which come in other packets; NaN if unknown.
        """
        track = self.track.array()
        out = np.full((len(track), 7), np.nan)
        out[:, :4] = track
        wanted = self.setpoints.array()
        if len(wanted):
            for k in (1, 2, 3):
                out[:, 3 + k] = np.interp(track[:, 0], wanted[:, 0], wanted[:, k], left=np.nan)
        return out

    def _error(self) -> tuple[np.ndarray, np.ndarray]:
        """Time and position error (position - setpoint), shape (n,) and (n, 3), during the trajectory."""
        track = self.track_array()
        # Without marks (the flight of another program) it is unknown when the drone should follow the setpoint.
        start, end = self.marks.get("trajectory_start", math.inf), self.marks.get("trajectory_end", math.inf)
        keep = (track[:, 0] >= start) & (track[:, 0] <= end) & np.isfinite(track[:, 4:]).all(axis=1)
        return track[keep, 0], track[keep, 1:4] - track[keep, 4:7]

    def before_and_after(self) -> tuple[dict[str, float | None], dict[str, float | None]]:
        """Tracking rms [m] and mean height error [m], each before the first push and after it has settled."""
        t, error = self._error()
        verified = [p.time for p in self.pushes if p.verified and p.purpose == "push"]
        first = min(verified, default=math.inf)
        rms: dict[str, float | None] = {}
        height: dict[str, float | None] = {}
        for name, keep in (("before_push", t < first), ("after_push", t >= first + SETTLE_SECONDS)):
            e = error[keep]
            enough = len(e) >= 10
            rms[name] = float(np.sqrt((e**2).sum(axis=1).mean())) if enough else None
            height[name] = float(e[:, 2].mean()) if enough else None
        return rms, height


class Recorder(Protocol):
    """Interface of a recording. It is called from several threads; every call returns at once."""

    path: str
    failure: str

    def blocks(self, blocks: Sequence[Block]) -> None: ...
    def packet(self, packet: Packet) -> None: ...
    def setpoint(self, time: float, reference: Reference) -> None: ...
    def parameter_write(self, write: ParameterWrite) -> None: ...
    def estimate(self, estimate: Estimate) -> None: ...
    def link(self, statistics: LinkStatistics, latency: float = math.nan) -> None: ...
    def residual(self, time: float, values: Sequence[float], sd: Sequence[float]) -> None: ...
    def metadata(self, section: str, entries: Mapping[str, str]) -> None: ...
    def event(self, text: str) -> None: ...
    def close(self) -> None: ...


@runtime_checkable
class FrameRecorder(Protocol):
    """A recorder that also takes a drone's raw messages."""

    def frame(self, host_time: float, data: bytes) -> None: ...


def open_recorder(
    path: str | None, *, configuration: Mapping[str, Any], vehicle: Vehicle, link: Link, append: bool = False
) -> Recorder | None:
    """A recorder for `path`, None without one.

    Args:
        configuration: of the run; values are stored as JSON.
        vehicle: its text is stored, so that a replay starts from the same constants.
        link: connected; its tables and the firmware's description of itself are stored.
        append: continue an existing recording as its next session (after a reconnect) instead of replacing it.

    Raises: UsageError: the file cannot be created. FileFormatError: it cannot be continued.
    """
    if path is None:
        return None
    from crazyem.recordings.mcap.writer import RecordingWriter

    return RecordingWriter(
        path,
        metadata={
            "configuration": {k: json.dumps(v) for k, v in configuration.items()},
            "vehicle": {"name": vehicle.name, "toml": vehicle.to_toml()},
            "drone": {
                "uri": link.uri,
                "log_variables": " ".join(sorted(link.log_variables)),
                "parameters": " ".join(sorted(link.parameters)),
            },
            **(link.about if isinstance(link, DescribingLink) else {}),
        },
        append=append,
    )
