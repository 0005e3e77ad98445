"""Shared by all readers: options of the user, the bytes of a file with a bounded size, and arrays that grow."""

import contextlib
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
    """Options of the user for a reader.

    Attributes:
        mapping: TOML file that says which columns of a CSV are which signals (`--map`); None: by the header.
        motor: meaning of motor.m1..4 where the file holds no evidence (`--motor`): "duty" (PWM sent, after battery
            compensation) or "request" (thrust asked for, before compensation); None: a finding says it is unknown.
        start, end: read only samples between these times [s] on the time axis of the recording (`--from`, `--to`);
            None: no limit.
        as_published: do not correct the known errors of published data sets (`--as-published`).
    """

    mapping: str | None = None
    motor: str | None = None
    as_published: bool = False
    start: float | None = None
    end: float | None = None


LARGEST_FILE = 4 << 30  # bytes of a plain file: hours of a uSD log at 1 kHz
LARGEST_UNPACKED = 1 << 30  # bytes of a gzip file, unpacked: guards against decompression bombs
_HEAD_BYTES = 64 * 1024


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[IO[bytes], IO[bytes], bool]]:
    """A plain or gzip file (recognised by its content), its unpacked content, and whether it is packed.

    Raises: UsageError if the file cannot be read, FileFormatError if a gzip file cannot be unpacked.
    """
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            yield raw, cast(IO[bytes], gzip.GzipFile(fileobj=raw)) if packed else raw, packed
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def pieces(path: Path, size: int) -> Iterator[bytes]:
    """The bytes of a file, unpacked, in pieces of up to `size` bytes.

    Raises: as `opened`; FileFormatError if a gzip file unpacks to more than `LARGEST_UNPACKED`.
    """
    taken = 0
    with opened(path) as (_, file, packed):
        while piece := file.read(size):
            taken += len(piece)
            if packed and taken > LARGEST_UNPACKED:
                most = f"{LARGEST_UNPACKED >> 20} MiB"
                raise FileFormatError(f"{path} unpacks to more than {most}; unpack it yourself if it is sound.")
            yield piece


def head_of(path: Path) -> bytes:
    """The first bytes of a file, unpacked if it is a gzip file. Raises as `pieces`."""
    return next(pieces(path, _HEAD_BYTES), b"")


def contents(path: Path) -> bytes:
    """All bytes of a file, unpacked. Raises as `pieces`; FileFormatError if it is larger than `LARGEST_FILE`."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if size > LARGEST_FILE:
        raise FileFormatError(f"{path} is larger than {LARGEST_FILE >> 20} MiB, more than can be read at once.")
    return b"".join(pieces(path, max(size, 1)))  # one piece: no copy


class GrowingArray:
    """(n,) or (n, width) values to which rows are appended, so that a flight is in memory once.

    Args:
        kind: numpy type of the values.
        width: of a row; None for single values.
        expected: number of rows, if known; saves copies while the array grows.
    """

    def __init__(self, kind: Any, width: int | None = None, *, expected: int = 0) -> None:
        self._array: NDArray[Any] = np.empty(expected if width is None else (expected, width), kind)
        self.size = 0

    def more(self, count: int) -> NDArray[Any]:
        """Room for `count` rows after the last, to be filled."""
        first, self.size = self.size, self.size + count
        if self.size > len(self._array):
            # pages of memory that are never filled are never allocated
            larger = np.empty((max(self.size, 2 * first), *self._array.shape[1:]), self._array.dtype)
            larger[:first] = self._array[:first]
            self._array = larger
        return self._array[first : self.size]

    @property
    def rows(self) -> NDArray[Any]:
        """The rows so far."""
        return self._array[: self.size]

    def take(self) -> NDArray[Any]:
        """The rows, which this object then drops; a copy if much of the array was not filled."""
        array, size = self._array, self.size
        self._array, self.size = np.empty((0, *array.shape[1:]), array.dtype), 0
        return array[:size] if len(array) - size < len(array) // 16 else array[:size].copy()
