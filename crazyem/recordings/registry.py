"""The reader for each file, chosen by the first bytes of the file, never by its name alone.

A reader for a new format needs a file with `recognises` and `read`, and a line in `READERS`.
"""

import importlib
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, KnownFileError, UsageError
from crazyem.recordings.contents import ReadOptions, head_of
from crazyem.recordings.finding import Finding
from crazyem.recordings.ordering import all_time
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.stamps import screened, screened_parts


@dataclass(frozen=True, slots=True)
class Reader:
    """A file format.

    Its module has `recognises(head: bytes) -> bool`, given the (decompressed) first bytes of a file, and
    `read(path: Path, options: ReadOptions) -> Recording`, which raises FileFormatError. A reader of folders has
    `recognises_folder(path: Path) -> bool` instead of `recognises`, or both. The module is imported on first use.
    """

    name: str
    module: str

    def has(self, function: str) -> bool:
        return hasattr(self._module(), function)

    def recognises(self, source: bytes | Path) -> bool:
        """Whether the reader reads a file with these first bytes, or this folder."""
        function = "recognises_folder" if isinstance(source, Path) else "recognises"
        return self.has(function) and bool(getattr(self._module(), function)(source))

    def read(self, path: Path, options: ReadOptions) -> Recording:
        return cut(screened(self._module().read(path, options)), options.start, options.end)

    def read_parts(self, path: Path, options: ReadOptions, seconds: float) -> Iterator[Recording]:
        """As `read`, in parts; only for a reader whose module has `read_parts`."""
        parts = screened_parts(self._module().read_parts(path, options, seconds=seconds))
        return cut_parts(parts, options.start, options.end)

    def _module(self) -> ModuleType:
        return importlib.import_module(self.module)


# Most specific first.
READERS: tuple[Reader, ...] = (
    Reader("MCAP", "crazyem.recordings.mcap.file"),
    Reader("rosbag2", "crazyem.recordings.ros.rosbag2_file"),
    Reader("uSD card log", "crazyem.recordings.usd.file"),
    Reader("ULog", "crazyem.recordings.autopilots.ulog_file"),
    Reader("exported CSV", "crazyem.recordings.csv.exported"),
    Reader("cfclient CSV", "crazyem.recordings.csv.cfclient"),
    Reader("CSV", "crazyem.recordings.csv.file"),
    Reader("MAVLink tlog", "crazyem.recordings.autopilots.tlog_file"),
)


# First bytes of known formats without a reader, and the message to the user.
_REFUSALS: tuple[tuple[bytes, str], ...] = (
    (
        b"version https://git-lfs.github.com/spec/",
        "is a Git LFS pointer, not the file itself: run `git lfs pull` in its repository.",
    ),
    (
        b"\xa3\x95\x80\x80",
        "is an ArduPilot DataFlash log (.BIN), which is not read here. Read the tlog of the same flight, or convert a "
        "message to CSV with pymavlink (mavlogdump.py --format csv --types ATT FILE.BIN > att.csv) and say what its "
        "columns are with --map.",
    ),
)


def open_recording(path: str | Path, options: ReadOptions | None = None) -> Recording:
    """Read a flight from a file of any known format.

    Raises: UsageError if there is no such file, FileFormatError if the file is not a recording.
    """
    path = Path(path)
    return reader_of(path).read(path, options or ReadOptions())


def reader_of(path: Path) -> Reader:
    """The reader for a file or folder. Raises as `open_recording`."""
    known = ", ".join(reader.name for reader in READERS)
    try:
        folder = path.is_dir()
        if not folder and not path.exists():
            raise UsageError(f"{path}: no such file.")
        head = b"" if folder else head_of(path)
        reader = next((reader for reader in READERS if reader.recognises(path if folder else head)), None)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if reader is not None:
        return reader
    if folder:
        raise UsageError(f"{path} is a directory, not a recording.")
    refusal = next((why for start, why in _REFUSALS if head.startswith(start)), None)
    if refusal is not None:
        raise KnownFileError(f"{path} {refusal}")
    what = "is empty" if not head else f"is not a recording in a format known here ({known})"
    raise FileFormatError(f"{path} {what}.")


PART_SECONDS = 60.0  # s of flight in a part
_MEMORY_SHARE = 0.25  # share of the free memory; a larger file is read in parts
_GZIP_RATIO = 8.0  # size of an unpacked gzip file over its packed size, about


def can_be_parted(path: Path) -> bool:
    """True if the reader of this file can read it in parts. Raises as `open_recording`."""
    return reader_of(path).has("read_parts")


def to_be_parted(path: str | Path, *, asked: bool, jobs: int) -> bool:
    """Whether to read a file in parts: if the user asks or the file is large, and its reader can do so."""
    path = Path(path)
    return (asked or is_large(path, jobs=jobs)) and can_be_parted(path)


def is_large(path: Path, *, jobs: int = 1) -> bool:
    """True if reading the file whole, `jobs` such files at a time, may need more than a quarter of the free memory."""
    if not path.is_file():
        return False
    size = path.stat().st_size * (_GZIP_RATIO if path.suffix == ".gz" else 1.0)
    return size * jobs > _MEMORY_SHARE * free_memory()


def free_memory() -> float:
    """Free memory now [bytes]."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return float(line.split()[1]) * 1024.0
    except (OSError, ValueError):
        pass
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")) / 2.0
    except (OSError, ValueError, AttributeError):
        return 4e9


def open_parts(
    path: str | Path, options: ReadOptions | None = None, *, seconds: float = PART_SECONDS
) -> Iterator[Recording]:
    """Consecutive parts of `seconds` each of a recording; the length of a part bounds the memory.

    Raises: as `open_recording`; UsageError if the format cannot be read in parts.
    """
    path = Path(path)
    reader = reader_of(path)
    if not reader.has("read_parts"):
        raise UsageError(f"{path}: a {reader.name} cannot be read in parts, only whole.")
    yield from reader.read_parts(path, options or ReadOptions(), seconds)


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
