"""CSV files that `crazyem export` wrote, read back to the recording they were made from."""

import csv
import gzip
import io
import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.columns import MARKED, Description, SignalEntry, name_and_unit
from crazyem.recordings.description import from_json
from crazyem.recordings.export import HOST_TIME, METADATA_SUFFIX, TIME
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.sample import SIGNALS, components

_BLOCK = 4 << 20  # bytes of text parsed at a time
_LONGEST_LINE = 4 << 20
_LARGEST_DESCRIPTION = 256 << 20
_UNPACKED = 64 << 20, 50  # a gzip file may grow to the first, or by the second, whichever is more

Floats = NDArray[np.float64]


def recognises(head: bytes) -> bool:
    """True if the header starts as ours do."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(f"{TIME},{HOST_TIME}".encode())


def read(path: Path, options: ReadOptions) -> Recording:
    """Read an exported recording.

    Frames, clocks, streams, metadata and events come from the -metadata.json beside the file; without it they are
    unknown, and a finding says so. Samples of a signal come in processing order.

    Raises: FileFormatError naming line or column.
    """
    table = _Table(path)
    blocks = list(table.blocks())
    return table.recording(blocks, 0)


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive stretches of at least `seconds` of an exported recording; events come with the first."""
    table = _Table(path)
    held: list[_Block] = []
    rows = 0
    for block in table.blocks():
        held.append(block)
        if not float(block.time[-1]) - float(held[0].time[0]) < seconds:
            yield table.recording(held, rows)
            rows += sum(b.time.size for b in held)
            held = []
    if held or not rows:
        yield table.recording(held, rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Some rows: (r,) stamps and host times; for each signal the rows with a sample of it, (k, c) values, marks."""

    time: Floats
    host_time: Floats
    row: list[NDArray[np.int64]]
    value: list[Floats]
    marked: list[NDArray[np.bool_]]


class _Table:
    """The file, a block of rows at a time, with what is known of its columns."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.findings: list[Finding] = []
        self.titles = self._header()
        self.description = self._description()
        self.columns = self.description.columns

    def _header(self) -> list[str]:
        with _open(self.path) as file:
            try:
                line = file.readline(_LONGEST_LINE).removeprefix(b"\xef\xbb\xbf")
            except (EOFError, OSError, zlib.error) as error:
                raise FileFormatError(f"{self.path} cannot be read ({error}).") from None
        try:
            titles = next(csv.reader([line.decode("utf-8")], strict=True), [])
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileFormatError(f"{self.path}: line 1 is not a CSV header ({error}).") from None
        if titles[:2] != [TIME, HOST_TIME] or len(titles) < 3:
            raise FileFormatError(f"{self.path}: line 1 is not the header of an exported recording.")
        return titles

    def _description(self) -> Description:
        beside = self.path.with_name(self.path.name.removesuffix(".gz") + METADATA_SUFFIX)
        if not beside.is_file():
            self._note(
                f"There is no {beside.name} beside it: frames, clocks and streams are not known.", Grade.DEGRADES
            )
            return _guessed(self.titles[2:])
        try:
            if beside.stat().st_size > _LARGEST_DESCRIPTION:
                raise ValueError("it is too large")
            notes = json.loads(beside.read_text(encoding="utf-8"))["notes"]
            description = from_json(next(n["crazyem"] for n in notes if "crazyem" in n))
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, StopIteration) as error:
            what = f"{type(error).__name__}: {error}" if isinstance(error, KeyError | TypeError) else str(error)
            raise FileFormatError(f"{beside} is not the description of an exported recording ({what}).") from None
        if [c.title for c in description.columns] != self.titles[2:]:
            self._note(f"{beside.name} describes other columns than the file has; it was left out.", Grade.DEGRADES)
            return _guessed(self.titles[2:])
        return description

    def _note(self, text: str, grade: Grade = Grade.HARMLESS) -> None:
        self.findings.append(note("integrity", text, grade))

    def blocks(self) -> Iterator[_Block]:
        """The rows of the file, in bounded memory. Raises FileFormatError naming line or column."""
        import pyarrow as pa
        from pyarrow import csv as pa_csv

        names = [str(i) for i in range(len(self.titles))]
        with _open(self.path) as raw:
            file = _WholeLines(raw, self.path)
            try:
                reader = pa_csv.open_csv(
                    pa.PythonFile(file, mode="r"),
                    read_options=pa_csv.ReadOptions(
                        column_names=names, skip_rows=1, block_size=_BLOCK, use_threads=False
                    ),
                    convert_options=pa_csv.ConvertOptions(
                        column_types={name: pa.float64() for name in names}, null_values=[""]
                    ),
                )
                first = 2
                for batch in reader:
                    if batch.num_rows:
                        yield self._block(batch, first)
                        first += batch.num_rows
            except pa.ArrowException as error:
                if "Empty CSV file" not in str(error):
                    raise FileFormatError(f"{self.path}: a line cannot be read ({_sentence(error)}).") from None
        if file.damage:
            self._note(file.damage, Grade.DEGRADES)

    def _block(self, batch: Any, first: int) -> _Block:
        time = batch.column(0).to_numpy(zero_copy_only=False)
        if batch.column(0).null_count:
            raise FileFormatError(f"{self.path}: row {first + int(np.argmax(np.isnan(time)))} has no time.")
        host = batch.column(1).to_numpy(zero_copy_only=False)
        rows, values, marks = [], [], []
        place = 2
        for entry in self.description.entries:
            count = len(entry.parts)
            parts = [batch.column(i) for i in range(place, place + count)]
            row = np.flatnonzero(np.logical_or.reduce([p.is_valid().to_numpy(zero_copy_only=False) for p in parts]))
            rows.append(row)
            values.append(np.column_stack([p.to_numpy(zero_copy_only=False)[row] for p in parts]))
            place += count
            marked = np.zeros(row.size, bool)
            if entry.marked:
                marked = batch.column(place).to_numpy(zero_copy_only=False)[row] == 1.0
                place += 1
            marks.append(marked)
        return _Block(time, host, rows, values, marks)

    def recording(self, blocks: list[_Block], first: int) -> Recording:
        """The recording that some consecutive blocks make; `first` is the number of their first row."""
        if not blocks:
            raise FileFormatError(f"{self.path}: there is a header but not a single sample.")
        starts = np.cumsum([0, *(b.time.size for b in blocks)])
        time = np.concatenate([b.time for b in blocks])
        host = np.concatenate([b.host_time for b in blocks])
        entries = self.description.entries
        signals = {}
        shared: dict[tuple[int, int, int], tuple[NDArray[np.int64], Floats, Floats]] = {}
        for place, entry in enumerate(entries):
            row = np.concatenate([b.row[place] + s for b, s in zip(blocks, starts[:-1], strict=True)])
            # signals of one stream have the same rows: one array of stamps for all of them
            key = (row.size, *((int(row[0]), int(row[-1])) if row.size else (0, 0)))
            known = shared.get(key)
            if known is None or not np.array_equal(known[0], row):
                known = shared[key] = (row, time[row], host[row])
            signals[entry.name] = SignalArray(
                known[1],
                np.concatenate([b.value[place] for b in blocks]),
                (row + first) * len(entries) + place,
                known[2],
                np.concatenate([b.marked[place] for b in blocks]),
                quantity=entry.quantity,
                unit=entry.unit,
                frame=entry.frame,
                clock=entry.clock,
                stream=entry.stream,
                source=entry.source,
            )
        known_of = self.description
        return Recording(
            str(self.path),
            known_of.source,
            signals,
            known_of.metadata or {},
            (*known_of.findings, *self.findings),
            known_of.events if first == 0 else (),
            known_of.origin,
        )


def _guessed(titles: list[str]) -> Description:
    """Signals from the titles of their columns alone."""
    pairs = [name_and_unit(title) for title in titles]
    names = [name for name, _ in pairs]
    entries = []
    while pairs:
        name, unit = pairs[0]
        entry = _vocabulary_entry(names[len(names) - len(pairs) :]) or SignalEntry(
            name, ("",), *_scalar(name, unit), "", "", (name,)
        )
        del pairs[: len(entry.parts)]
        if pairs and pairs[0][0] == f"{entry.name}_{MARKED}":
            del pairs[0]
            entry = replace(entry, marked=True)
        entries.append(entry)
    return Description("exported csv", tuple(entries))


def _scalar(name: str, unit: str) -> tuple[str, str, str]:
    """Quantity, unit and frame of a column that is a signal of its own."""
    quantity = name.split("@", maxsplit=1)[0]
    count, known, frame = SIGNALS.get(quantity, (0, "", ""))
    return (quantity, unit, frame) if count == 1 and unit == known else ("", unit, "")


def _vocabulary_entry(names: list[str]) -> SignalEntry | None:
    """The vector of the vocabulary whose components the first columns are: position_x, position_y, position_z."""
    for quantity, (count, unit, frame) in SIGNALS.items():
        parts = components(quantity)
        base = names[0].removesuffix(f"_{parts[0]}") if parts else ""
        if parts and base.split("@")[0] == quantity and names[:count] == [f"{base}_{part}" for part in parts]:
            return SignalEntry(base, parts, quantity, unit, frame, "", "", tuple(names[:count]))
    return None


def _sentence(error: Exception) -> str:
    return str(error).strip().rstrip(".")[:200]


def _open(path: Path) -> IO[bytes]:
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        return gzip.open(path, "rb") if packed else path.open("rb")  # type: ignore[return-value]
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read ({error.strerror or error}).") from None


class _WholeLines(io.RawIOBase):
    """A file as the parser reads it: up to its last newline, and as far as a damaged gzip file can be unpacked."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self.file, self.path = file, path
        self.damage = ""
        self._ready = b""
        self._tail = b""
        self._ended = False
        packed = isinstance(file, gzip.GzipFile)
        self._left = max(_UNPACKED[0], _UNPACKED[1] * path.stat().st_size) if packed else None

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        """At most `size` bytes; b"" at the end."""
        while not self._ready and not self._ended:
            self._fill()
        size = len(self._ready) if size < 0 else size
        result, self._ready = self._ready[:size], self._ready[size:]
        return result

    def _fill(self) -> None:
        more = self._more()
        if self._left is not None:
            self._left -= len(more)
            if self._left < 0:
                raise FileFormatError(f"{self.path} unpacks to far more than a recording of its size would; not read.")
        if not more:
            self._ended = True
            if self._tail and not self.damage:
                self.damage = "The last line has no end; it was cut and is left out."
            return
        head, newline, tail = more.rpartition(b"\n")
        if newline:
            self._ready, self._tail = self._tail + head + newline, tail
        else:
            self._tail += tail
        if len(self._tail) > _LONGEST_LINE:
            raise FileFormatError(f"{self.path}: a line is longer than {_LONGEST_LINE >> 20} MiB.")

    def _more(self) -> bytes:
        try:
            if isinstance(self.file, gzip.GzipFile):
                return self.file.read1(_BLOCK)  # unlike read, hands out what it has before it comes to the damage
            return self.file.read(_BLOCK)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            self.damage = f"The gzip file is damaged ({error}); the whole lines before that were read."
            return b""
        except OSError as error:
            raise FileFormatError(f"{self.path} cannot be read ({error.strerror or error}).") from None
