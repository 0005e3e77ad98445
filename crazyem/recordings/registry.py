"""The reader for each file, chosen by the first bytes of the file, never by its name alone.

A reader for a new format needs a file with `recognises` and `read`, and a line in `READERS`.
"""

import importlib
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

    def recognises(self, head: bytes) -> bool:
        return self.has("recognises") and bool(self._module().recognises(head))

    def recognises_folder(self, path: Path) -> bool:
        return self.has("recognises_folder") and bool(self._module().recognises_folder(path))

    def read(self, path: Path, options: ReadOptions) -> Recording:
        recording = self._module().read(path, options)
        assert isinstance(recording, Recording)
        return cut(screened(recording), options.start, options.end)

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
        if path.is_dir():
            for reader in READERS:
                if reader.recognises_folder(path):
                    return reader
            raise UsageError(f"{path} is a directory, not a recording.")
        if not path.exists():
            raise UsageError(f"{path}: no such file.")
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    head = head_of(path)
    for reader in READERS:
        if reader.recognises(head):
            return reader
    refusal = next((why for start, why in _REFUSALS if head.startswith(start)), None)
    if refusal is not None:
        raise KnownFileError(f"{path} {refusal}")
    what = "is empty" if not head else f"is not a recording in a format known here ({known})"
    raise FileFormatError(f"{path} {what}.")
