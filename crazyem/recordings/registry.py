"""Which reader opens which file: told by the file's first bytes, never by its name alone."""

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crazyem.errors import FileFormatError, UsageError
from crazyem.recordings import csv_file, mcap_file
from crazyem.recordings.recording import Recording

_HEAD_BYTES = 64 * 1024


@dataclass(frozen=True, slots=True)
class Reader:
    """A file format: `recognises` looks at the (decompressed) first bytes, `read` returns the recording."""

    name: str
    recognises: Callable[[bytes], bool]
    read: Callable[[Path], Recording]


READERS: tuple[Reader, ...] = (
    Reader("MCAP", mcap_file.recognises, mcap_file.read),
    Reader("CSV", csv_file.recognises, csv_file.read),
)


def open_recording(path: str | Path) -> Recording:
    """Read a flight from any file format we know.

    Raises: UsageError if there is no such file, FileFormatError if it is not a recording.
    """
    path = Path(path)
    if not path.exists():
        raise UsageError(f"{path}: no such file.")
    if path.is_dir():
        raise UsageError(f"{path} is a directory, not a recording.")
    head = _head(path)
    for reader in READERS:
        if reader.recognises(head):
            return reader.read(path)
    known = ", ".join(reader.name for reader in READERS)
    what = "is empty" if not head else f"is not a recording in a format known here ({known})"
    raise FileFormatError(f"{path} {what}.")


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as raw:
            start = raw.read(_HEAD_BYTES)
        if start[:2] == b"\x1f\x8b":
            with gzip.open(path, "rb") as packed:
                return packed.read(_HEAD_BYTES)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    return start
