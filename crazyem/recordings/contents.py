"""What every reader gets: what the user has to tell it, the bytes of a file, bounded, and arrays that rows fill."""

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

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


def pieces(path: Path, size: int) -> Iterator[bytes]:
    """The bytes of a file, plain or gzip (told by content), unpacked, up to `size` of them at a time.

    Raises: UsageError if it cannot be read, FileFormatError if it is a gzip file that cannot be unpacked, or that
        unpacks to more than `LARGEST_UNPACKED`.
    """
    taken = 0
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        with cast(IO[bytes], gzip.open(path, "rb")) if packed else path.open("rb") as file:
            while piece := file.read(size):
                taken += len(piece)
                if packed and taken > LARGEST_UNPACKED:
                    most = f"{LARGEST_UNPACKED >> 20} MiB"
                    raise FileFormatError(f"{path} unpacks to more than {most}; unpack it yourself if it is sound.")
                yield piece
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def contents(path: Path) -> bytes:
    """All bytes of a file, unpacked. Raises as `pieces`; FileFormatError if it is larger than `LARGEST_FILE`."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if size > LARGEST_FILE:
        raise FileFormatError(f"{path} is larger than {LARGEST_FILE >> 20} MiB, more than can be read at once.")
    return b"".join(pieces(path, max(size, 1)))  # a plain file in one piece, which is not copied


class GrowingArray:
    """(n,) or (n, width) values to which rows are appended; a flight is held once, not as a list of blocks.

    Args:
        kind: numpy type of the values.
        width: of a row; None for single values.
        expected: rows, as far as known: saves moving the array while it grows.
    """

    def __init__(self, kind: Any, width: int | None = None, *, expected: int = 0) -> None:
        self._array: NDArray[Any] = np.empty(expected if width is None else (expected, width), kind)
        self.size = 0

    def more(self, count: int) -> NDArray[Any]:
        """Room for `count` rows after the last, to be filled."""
        first, self.size = self.size, self.size + count
        if self.size > len(self._array):
            # what is never filled takes up no memory
            larger = np.empty((max(self.size, 2 * first), *self._array.shape[1:]), self._array.dtype)
            larger[:first] = self._array[:first]
            self._array = larger
        return self._array[first : self.size]

    @property
    def rows(self) -> NDArray[Any]:
        """The rows so far."""
        return self._array[: self.size]

    def take(self) -> NDArray[Any]:
        """The rows, handed over and not kept; a copy where much of the array was not filled."""
        array, size = self._array, self.size
        self._array, self.size = np.empty((0, *array.shape[1:]), array.dtype), 0
        return array[:size] if len(array) - size < len(array) // 16 else array[:size].copy()
