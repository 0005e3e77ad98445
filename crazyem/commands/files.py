"""Find recordings from command line arguments (files, folders, patterns), and the target files of the results."""

import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crazyem.commands.output import complain
from crazyem.errors import FileFormatError, KnownFileError, UsageError
from crazyem.recordings import ReadOptions
from crazyem.recordings.csv.file import has_mapping
from crazyem.recordings.registry import READERS, reader_of

# Suffixes of CSV files that are taken from a folder. Many text files have commas, so name and columns must fit (with
# --map only the name). A file named by the user is always read.
_ANY_CSV, _CSV_NAMES = "CSV", (".csv", ".csv.gz", ".tsv", ".tsv.gz")
_RECORDING_SUFFIXES = (".gz", ".csv", ".tsv", ".txt", ".mcap", ".ulg", ".tlog", ".bin", ".db3")


@dataclass(frozen=True, slots=True)
class Found:
    """A recording to read.

    Attributes:
        path: file, or folder if the format is a folder.
        below: subfolder relative to the given folder ("" for a file given by name); results keep this structure.
    """

    path: Path
    below: str = ""


@dataclass(frozen=True, slots=True)
class Files:
    """The recordings for the arguments, in order, and the number of other files in the folders."""

    found: tuple[Found, ...]
    skipped: int = 0


def find(arguments: Sequence[str], *, mapping: str | None = None) -> Files:
    """Find the recordings given by files, folders (searched recursively) and patterns; each once.

    In folders and patterns, files without a known format are counted as skipped; hidden files in folders are ignored.
    A folder that is a recording itself (rosbag2, a cfclient session) counts as one.

    Args:
        mapping: --map; with it every CSV file in a folder is a recording, whatever its columns.

    Raises: UsageError if there is no recording.
    """
    search = _Search(mapped=mapping is not None)
    for name in arguments:
        search.argument(name)
    if not search.found:
        others = f" ({search.skipped} other files)" if search.skipped else ""
        raise UsageError(f"there is no recording in {', '.join(arguments)}{others}.")
    return Files(tuple(search.found), search.skipped)


class _Search:
    def __init__(self, *, mapped: bool) -> None:
        self.mapped = mapped
        self.found: list[Found] = []
        self.skipped = 0
        self._seen: set[str] = set()

    def argument(self, name: str) -> None:
        path = Path(name)
        if os.path.isdir(path):
            self._folder(path)
        elif os.path.exists(path) and not os.path.isfile(path):
            raise UsageError(f"{path} is neither a file nor a folder.")
        elif not os.path.lexists(path) and glob.has_magic(name):
            matches = sorted(glob.glob(name, recursive=True))
            if not matches:
                raise UsageError(f"nothing matches {name}.")
            for match in map(Path, matches):
                if match.is_dir():
                    self._folder(match)
                else:
                    self._file(match, "")
        else:
            self._take(path, "")  # the reader gives the error if it is missing

    def _file(self, path: Path, below: str) -> None:
        """Take a file if it is a recording, else count it as skipped. Nothing else is opened: a pipe would block."""
        if os.path.isfile(path) and _is_recording(path, mapped=self.mapped):
            self._take(path, below)
        else:
            self.skipped += 1

    def _folder(self, top: Path) -> None:
        if _is_recording_folder(top):
            self._take(top, "")
            return
        entered: set[tuple[int, int]] = set()  # avoids an endless loop by a link to a parent folder
        waiting = [top]
        while waiting:
            folder = waiting.pop()
            try:
                status = folder.stat()
                entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
            except OSError as error:
                complain(f"{folder} cannot be read: {error.strerror}")
                continue
            if (status.st_dev, status.st_ino) in entered:
                continue
            entered.add((status.st_dev, status.st_ino))
            inner = []
            for entry in entries:
                path = Path(entry.path)
                if entry.name.startswith("."):
                    continue
                if os.path.isdir(path):  # links are followed; False for a broken one
                    if _is_recording_folder(path):
                        self._take(path, _below(folder, top))
                    else:
                        inner.append(path)
                else:
                    self._file(path, _below(folder, top))
            waiting.extend(reversed(inner))

    def _take(self, path: Path, below: str) -> None:
        real = os.path.realpath(path)
        if real not in self._seen:
            self._seen.add(real)
            self.found.append(Found(path, below))


def _below(folder: Path, top: Path) -> str:
    relative = str(folder.relative_to(top))
    return "" if relative == "." else relative


def _is_recording(path: Path, *, mapped: bool) -> bool:
    try:
        reader = reader_of(path)
    except KnownFileError:
        # a Git LFS pointer of a recording is kept, so that the user sees an error; other pointers may be pictures
        return path.name.lower().endswith(_RECORDING_SUFFIXES)
    except FileFormatError:
        # unknown format; a .csv.gz file may be a damaged recording and is kept, so that the user sees an error
        return path.name.lower().endswith(".csv.gz")
    except UsageError:
        return True  # cannot be opened; the reader gives the error
    if reader.name != _ANY_CSV:
        return True
    if not path.name.lower().endswith(_CSV_NAMES):
        return False
    try:
        return mapped or has_mapping(path)
    except (FileFormatError, UsageError):
        return True  # damaged; the reader gives the error


def _is_recording_folder(path: Path) -> bool:
    try:
        return any(reader.recognises(path) for reader in READERS)
    except OSError:
        return False


def read_options(arguments: Any) -> ReadOptions:
    """Options of the reader: --map, --motor, --as-published; --from and --to if the command has them."""
    start, end = getattr(arguments, "start", None), getattr(arguments, "end", None)
    if start is not None and end is not None and not start < end:
        raise UsageError(f"--from {start:g} is not before --to {end:g}.")
    return ReadOptions(arguments.map, arguments.motor, arguments.as_published, start, end)


def stem(path: Path) -> str:
    """The name of a recording without the suffixes of its format; other dots in the name stay."""
    name = path.name or path.resolve().name
    lower = name.lower()
    while True:
        suffix = next((s for s in _RECORDING_SUFFIXES if lower.endswith(s) and len(lower) > len(s)), None)
        if suffix is None:
            return name
        name, lower = name[: -len(suffix)], lower[: -len(suffix)]


def targets(found: Sequence[Found], output: str | None, suffix: str, *, force: bool) -> list[Path]:
    """The target file of each recording's result.

    One recording: `output` itself, unless it is an existing folder. Several: `output` is a folder, created if
    necessary; subfolders are kept. None: beside each recording.

    Raises: UsageError if a result would replace a recording, another result, or (unless `force`) any file.
    """
    inputs = {os.path.realpath(f.path) for f in found}
    if output is not None and len(found) == 1 and not Path(output).is_dir() and not output.endswith(os.sep):
        result = [Path(output)]
    else:
        result = list(_in_folder(found, output, suffix))
    taken: dict[str, Path] = {}
    for one, target in zip(found, result, strict=True):
        real = os.path.realpath(target)
        if real in inputs:
            raise UsageError(f"{target} is a recording to be read; it is never written in place.")
        if real in taken:
            raise UsageError(f"{taken[real]} and {one.path} would both become {target}; convert them one at a time.")
        taken[real] = one.path
        if target.exists() and not force:
            raise UsageError(f"{target} exists already (--force replaces it).")
    for target in result:
        try:
            if output is not None and (len(found) > 1 or output.endswith(os.sep)):
                target.parent.mkdir(parents=True, exist_ok=True)
            if not target.parent.is_dir():
                raise UsageError(f"cannot write {target}: {target.parent} is no folder.")
        except OSError as error:
            raise UsageError(f"cannot write {target}: {error.strerror or error}.") from None
    return result


def _in_folder(found: Sequence[Found], output: str | None, suffix: str) -> Iterator[Path]:
    if output is not None and Path(output).exists() and not Path(output).is_dir():
        raise UsageError(f"{output} is not a folder; several recordings need one.")
    places = [(f.path.parent if output is None else Path(output) / f.below) for f in found]
    short = [place / f"{stem(f.path)}{suffix}" for place, f in zip(places, found, strict=True)]
    for place, f, name in zip(places, found, short, strict=True):
        # a.csv and a.mcap of one folder keep their whole names
        yield name if short.count(name) == 1 else place / f"{f.path.name}{suffix}"
