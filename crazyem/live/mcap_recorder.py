"""The session's recorder: our MCAP format (crazyem.recordings.writer)."""

from collections.abc import Mapping
from typing import Any

from crazyem.links.base import Link
from crazyem.live.recorder import Recorder
from crazyem.vehicle import Vehicle


def open_recorder(
    path: str | None, *, configuration: Mapping[str, Any], vehicle: Vehicle, link: Link
) -> Recorder | None:
    """A recorder for `path`, None without one."""
    if path is None:
        return None
    raise NotImplementedError
