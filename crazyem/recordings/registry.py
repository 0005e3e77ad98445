"""The reader for each file, chosen by the first bytes of the file, never by its name alone.

A reader for a new format needs a file with `recognises` and `read`, and a line in `READERS`.
"""

import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from crazyem.errors import FileFormatError, KnownFileError, UsageError
from crazyem.recordings.contents import ReadOptions, head_of
from crazyem.recordings.cut import cut, cut_parts
from crazyem.recordings.recording import Recording
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
