"""rosbag2 recordings (MCAP storage) of crazyswarm2 and others."""

from pathlib import Path

from crazyem.errors import FileFormatError
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.recording import Recording


def recognises(head: bytes) -> bool:
    """True if a file starting with these bytes is one."""
    return False


def read(path: Path, options: ReadOptions) -> Recording:
    """Read one."""
    raise FileFormatError(f"{path}: this format cannot be read yet.")
