"""The interface between a session and its recording, and functions to open and close an MCAP recording."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from crazyem.control.trajectories import Reference
from crazyem.estimation.result import Estimate
from crazyem.links.base import DescribingLink, Link, LinkStatistics, ParameterWrite
from crazyem.signals.sample import Block, Packet
from crazyem.vehicle import Vehicle


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
