"""A piece of a recording: the samples between two times, as if nothing else had been recorded."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.recordings.finding import Finding
from crazyem.recordings.ordering import all_time
from crazyem.recordings.recording import Event, Recording

_WHOLE_FLIGHT_SECTION = "statistics"  # section of the metadata that counts packets of the whole flight


def cut(recording: Recording, start: float | None, end: float | None) -> Recording:
    """The samples from `start` to `end`, both included; the time axis stays as it is.

    Args:
        start, end: s on the time axis of the recording, as `info` and `doctor` show it; None: no limit.

    Raises: UsageError if the limits make no sense or nothing lies between them.
    """
    if start is None and end is None:
        return recording
    piece = _cut(recording, *_limits(start, end))
    if not len(piece):
        span = "".join(f"from {first:.3f} to {last:.3f} s" for first, last in all_time(recording)) or "empty"
        raise UsageError(f"{recording.path}: there are no samples {_between(start, end)}; the recording is {span}.")
    return piece


def cut_parts(parts: Iterator[Recording], start: float | None, end: float | None) -> Iterator[Recording]:
    """As `cut`, of a recording in parts; parts without samples between the limits are left out."""
    if start is None and end is None:
        yield from parts
        return
    limits, path, some = _limits(start, end), "", False
    for part in parts:
        piece, path = _cut(part, *limits), part.path
        if len(piece):
            some = True
            yield piece
    if not some and path:
        raise UsageError(f"{path}: there are no samples {_between(start, end)}.")


def _limits(start: float | None, end: float | None) -> tuple[float, float]:
    low, high = -math.inf if start is None else start, math.inf if end is None else end
    if not low < high:
        raise UsageError(f"--from {start:g} is not before --to {end:g}.")
    return low, high


def _between(start: float | None, end: float | None) -> str:
    first = "the start" if start is None else f"{start:g} s"
    return f"between {first} and {'the end' if end is None else f'{end:g} s'}"


def _cut(recording: Recording, low: float, high: float) -> Recording:
    kept = {
        name: np.flatnonzero((array.time >= low) & (array.time <= high)) for name, array in recording.signals.items()
    }
    signals = {name: array.rows(kept[name]) for name, array in recording.signals.items()}
    hosts = [array.host_time[np.isfinite(array.host_time)] for array in signals.values()]
    hosts = [h for h in hosts if h.size]
    span = (min(h.min() for h in hosts), max(h.max() for h in hosts)) if hosts else None
    sizes = {name: array.time.size for name, array in recording.signals.items()}
    return replace(
        recording,
        signals=signals,
        metadata={
            section: values for section, values in recording.metadata.items() if section != _WHOLE_FLIGHT_SECTION
        },
        findings=tuple(
            _finding(f, kept, sizes)
            for f in recording.findings
            if not f.intervals or any(a <= high and b >= low for a, b in f.intervals)
        ),
        events=tuple(e for e in recording.events if _within(e, low, high, span)),
    )


def _within(event: Event, low: float, high: float, span: tuple[float, float] | None) -> bool:
    """Whether an event belongs to the piece; log messages always do, because they describe the flight."""
    if event.data.get("clock") == "firmware":
        return low <= event.time <= high
    return event.kind == "log" or span is None or span[0] <= event.time <= span[1]


def _finding(finding: Finding, kept: Mapping[str, NDArray[np.int64]], sizes: Mapping[str, int]) -> Finding:
    """The finding with the rows of its repair renumbered; without the repair if the rows differ between signals."""
    fix = finding.fix
    if fix is None or not fix.signals:
        return finding
    first = fix.signals[0]
    if first not in kept or any(n not in kept or not np.array_equal(kept[n], kept[first]) for n in fix.signals):
        return replace(finding, fix=None)
    if fix.rows is None:
        return finding
    inside = (fix.rows >= 0) & (fix.rows < sizes[first])
    place = np.full(sizes[first], -1, np.int64)
    place[kept[first]] = np.arange(kept[first].size)
    rows = place[fix.rows[inside]]
    left = rows >= 0
    factor = fix.factor
    if fix.kind == "unwrap" and len(factor) == fix.rows.size:  # one factor per row
        factor = tuple(np.array(factor)[inside][left].tolist())
    return replace(finding, fix=replace(fix, rows=rows[left], factor=factor) if left.any() else None)
