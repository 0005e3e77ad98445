"""What every reader gets: what the user has to tell it, and the bytes of a file, bounded against bombs."""

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path

from crazyem.errors import FileFormatError, UsageError


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a user may have to tell a reader.

    Attributes:
        mapping: TOML file that says which columns of a CSV are which signals (`--map`); None: by the header.
        motor: what motor.m1..4 of an old log is where the file holds no evidence (`--motor`): "duty" (PWM sent, after
            battery compensation) or "request" (thrust asked for, before it); None: say that it is not known.
        start, end: read only what was sampled between these times [s] of the recording's time axis (`--from`, `--to`);
            None: no limit.
        as_published: believe a preset's publisher instead of correcting what is known to be wrong (`--as-published`).
    """

    mapping: str | None = None
    motor: str | None = None
    as_published: bool = False
    start: float | None = None
    end: float | None = None


LARGEST_FILE = 4 << 30  # bytes of a plain file: hours of a uSD log at 1 kHz
LARGEST_UNPACKED = 1 << 30  # bytes of a gzip file, unpacked: a bomb has no end
_PIECE_BYTES = 1 << 20


def contents(path: Path, *, limit: int = LARGEST_UNPACKED, plain: int = LARGEST_FILE) -> bytes:
    """All bytes of a file, unpacked.

    Args:
        path: plain or gzip, told by content.
        limit: most bytes to unpack a gzip file to.
        plain: most bytes of one that is not packed.

    Raises: UsageError if it cannot be read, FileFormatError if it cannot be unpacked or is too large.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        if not packed:
            if path.stat().st_size > plain:
                raise FileFormatError(f"{path} is larger than {plain >> 20} MiB, more than can be read at once.")
            return path.read_bytes()
        data = bytearray()
        with gzip.open(path, "rb") as file:
            # in pieces: asking for `limit` bytes at once would set them aside at once
            while len(data) <= limit and (piece := file.read(_PIECE_BYTES)):
                data += piece
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(data) > limit:
        raise FileFormatError(f"{path} unpacks to more than {limit >> 20} MiB; unpack it yourself if it is sound.")
    return bytes(data)
