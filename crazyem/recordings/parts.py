"""Recordings too large for memory, read in parts if their reader can do so."""

import os
from collections.abc import Iterator
from pathlib import Path

from crazyem.errors import UsageError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import reader_of

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
