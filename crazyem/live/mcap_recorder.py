"""Opens the session's recorder: our MCAP format, with the run's configuration and vehicle file in it."""

import json
from collections.abc import Mapping
from typing import Any

from crazyem.links.base import DescribingLink, Link, LinkStatistics
from crazyem.live.history import History
from crazyem.live.recorder import Recorder
from crazyem.vehicle import Vehicle


def open_recorder(
    path: str | None, *, configuration: Mapping[str, Any], vehicle: Vehicle, link: Link, append: bool = False
) -> Recorder | None:
    """A recorder for `path`, None without one.

    Args:
        configuration: of the run; values are stored as JSON.
        vehicle: its file's text is stored, so that a replay starts from the same constants.
        link: connected; its tables and what the firmware says of itself are stored, as far as it knows them.
        append: continue an existing recording as its next session (after a reconnect) instead of replacing it.

    Raises:
        UsageError: the file cannot be created. FileFormatError: it cannot be continued.
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


def close_recorder(recorder: Recorder, statistics: LinkStatistics, history: History) -> None:
    """Finish the recording, with the account of lost packets in it; say so if it is not whole."""
    counts = {n: getattr(statistics, n) for n in ("received", "lost", "late", "duplicates")}
    recorder.metadata("statistics", {k: str(v) for k, v in counts.items()})
    recorder.close()
    history.notice(recorder.failure)
