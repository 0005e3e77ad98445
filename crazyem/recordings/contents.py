"""The bytes of a file, unpacked if it is a gzip file: never more memory than a limit, whatever the file claims."""

import gzip
import zlib
from pathlib import Path

from crazyem.errors import FileFormatError, UsageError

LARGEST_UNPACKED = 1 << 30  # bytes: a week of a cfclient CSV, ten hours of a uSD log at 1 kHz; a bomb has no end


def contents(path: Path, *, limit: int = LARGEST_UNPACKED) -> bytes:
    """All bytes of a file, unpacked.

    Args:
        path: plain or gzip, told by content.
        limit: most bytes to unpack a gzip file to.

    Raises: UsageError if it cannot be read, FileFormatError if it cannot be unpacked or is larger than `limit` then.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        if not packed:
            return path.read_bytes()
        with gzip.open(path, "rb") as file:
            data = file.read(limit + 1)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(data) > limit:
        raise FileFormatError(f"{path} unpacks to more than {limit >> 20} MiB; unpack it yourself if it is sound.")
    return data
