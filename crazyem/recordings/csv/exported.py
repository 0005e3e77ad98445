"""CSV files that `crazyem export` wrote, read back to the recording they were made from."""

import csv
import gzip
import json
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.columns import MARKED_COLUMN, Description, SignalEntry, name_and_unit
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.description import from_json
from crazyem.recordings.export import HOST_TIME, METADATA_SUFFIX, TIME
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.sample import SIGNALS, components

_BLOCK_BYTES = 2 << 20  # bytes of text parsed at a time
_LONGEST_LINE = 4 << 20
_LARGEST_DESCRIPTION = 256 << 20
_ARRAY_GROWTH = 1.25  # of arrays that are full
_MOST_AHEAD = 8.0
_UNPACKED_LIMITS = 64 << 20, 50  # a gzip file may grow to the first, or by the second, whichever is more

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
    held = _Held(table.description.entries)
    for batch, first, ahead in table.batches():
        held.add(batch, first, ahead, path)
    return table.recording(held)


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive stretches of at least `seconds` of an exported recording; events come with the first."""
    table = _Table(path)
    held = _Held(table.description.entries)
    for batch, first, _ in table.batches():
        held.add(batch, first, 1.0, path)
        if not float(held.time.rows[-1]) - float(held.time.rows[0]) < seconds:
            yield table.recording(held)
            held = _Held(table.description.entries, held.first + held.time.size)
    if held.time.size or not held.first:
        yield table.recording(held)


class _Growing:
    """(n,) or (n, width) values that rows are appended to."""

    def __init__(self, kind: type, width: int | None = None) -> None:
        self._array: NDArray[Any] = np.empty(0 if width is None else (0, width), kind)
        self.size = 0

    def more(self, count: int, ahead: float) -> NDArray[Any]:
        """Room for `count` rows after the last, to be filled; there may be `ahead` times as many in the end."""
        size = self.size + count
        if size > len(self._array):
            # what is never filled takes up no memory; but what the first lines promise is not all believed
            capacity = int(size * max(_ARRAY_GROWTH, min(1.05 * ahead, _MOST_AHEAD)))
            larger = np.empty((capacity, *self._array.shape[1:]), self._array.dtype)
            larger[: self.size] = self._array[: self.size]
            self._array = larger
        room = self._array[self.size : size]
        self.size = size
        return room

    @property
    def rows(self) -> NDArray[Any]:
        """The rows so far."""
        return self._array[: self.size]


class _Held:
    """Rows of the table that become one recording: stamps of all rows, and of each signal the rows that have it.

    Filled a batch at a time, straight from the text into the arrays of the signals: a flight is held once.
    """

    def __init__(self, entries: tuple[SignalEntry, ...], first: int = 0) -> None:
        self.entries = entries
        self.first = first  # number of its first row in the file
        self.time, self.host_time = _Growing(float), _Growing(float)
        self.value = [_Growing(float, len(entry.parts)) for entry in entries]
        self.order = [_Growing(np.int64) for _ in entries]
        self.marked = [_Growing(bool) for _ in entries]

    def add(self, batch: Any, line: int, ahead: float, path: Path) -> None:
        """Append a RecordBatch whose first row is `line` of the file. Raises FileFormatError naming the row."""
        count, before = batch.num_rows, self.first + self.time.size
        time = batch.column(0).to_numpy(zero_copy_only=False)
        if batch.column(0).null_count:
            raise FileFormatError(f"{path}: row {line + int(np.argmax(np.isnan(time)))} has no time.")
        self.time.more(count, ahead)[:] = time
        self.host_time.more(count, ahead)[:] = batch.column(1).to_numpy(zero_copy_only=False)
        column = 2
        for place, entry in enumerate(self.entries):
            parts = [batch.column(column + i) for i in range(len(entry.parts))]
            column += len(parts)
            row = _rows_with(parts, count)
            value = self.value[place].more(row.size, ahead)
            for i, part in enumerate(parts):
                value[:, i] = part.to_numpy(zero_copy_only=False)[row]
            self.order[place].more(row.size, ahead)[:] = (row + before) * len(self.entries) + place
            marked = self.marked[place].more(row.size, ahead)
            if entry.marked:
                marked[:] = batch.column(column).to_numpy(zero_copy_only=False)[row] == 1.0
                column += 1
            else:
                marked[:] = False

    def signals(self) -> dict[str, SignalArray]:
        """The signals; those of one stream share their stamps."""
        signals: dict[str, SignalArray] = {}
        shared: list[tuple[NDArray[np.int64], int, Floats, Floats]] = []
        for place, entry in enumerate(self.entries):
            order = self.order[place].rows
            # the same rows: orders that differ by the places of the signals alone
            known = next((k for k in shared if k[0].size == order.size and (order - k[0] == place - k[1]).all()), None)
            if known is None:
                known = (order, place, self._of(self.time, order), self._of(self.host_time, order))
                shared.append(known)
            signals[entry.name] = SignalArray(
                known[2],
                self.value[place].rows,
                order,
                known[3],
                self.marked[place].rows,
                quantity=entry.quantity,
                unit=entry.unit,
                frame=entry.frame,
                clock=entry.clock,
                stream=entry.stream,
                source=entry.source,
            )
        return signals

    def _of(self, stamps: _Growing, order: NDArray[np.int64]) -> Floats:
        """Stamps of the rows that a signal has."""
        if order.size == stamps.size:
            return stamps.rows
        return stamps.rows[order // len(self.entries) - self.first]


def _rows_with(parts: list[Any], count: int) -> NDArray[np.int64]:
    """Rows in which at least one of some columns has a value."""
    if any(not part.null_count for part in parts):
        return np.arange(count)
    return np.flatnonzero(np.logical_or.reduce([p.is_valid().to_numpy(zero_copy_only=False) for p in parts]))


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

    def batches(self) -> Iterator[tuple[Any, int, float]]:
        """The rows of the file, in bounded memory: (RecordBatch, line of its first row, how much longer the file is).

        Raises FileFormatError naming line or column.
        """
        import pyarrow as pa
        from pyarrow import csv as pa_csv

        names = [str(i) for i in range(len(self.titles))]
        reading = pa_csv.ReadOptions(column_names=names, block_size=2 * _LONGEST_LINE, use_threads=False)
        converting = pa_csv.ConvertOptions(column_types=dict.fromkeys(names, pa.float64()), null_values=[""])
        first = 2
        with _open(self.path) as raw:
            text = _Text(raw, self.path)
            text.skip_line()
            # a piece at a time, not as one stream: the threads that read ahead would keep what they had of each piece
            for piece in text.pieces():
                try:
                    table = pa_csv.read_csv(pa.py_buffer(piece), reading, convert_options=converting)
                except pa.ArrowException as error:
                    if "Empty CSV file" in str(error):
                        continue
                    raise FileFormatError(f"{self.path}: a line cannot be read ({_sentence(error)}).") from None
                for batch in table.to_batches():
                    yield batch, first, text.ahead
                    first += batch.num_rows
                    del batch
                del table
        if text.damage:
            self._note(text.damage, Grade.DEGRADES)

    def recording(self, held: _Held) -> Recording:
        """The recording that some consecutive rows make."""
        if not held.time.size:
            raise FileFormatError(f"{self.path}: there is a header but not a single sample.")
        known_of = self.description
        return Recording(
            str(self.path),
            known_of.source,
            held.signals(),
            known_of.metadata or {},
            (*known_of.findings, *self.findings),
            known_of.events if held.first == 0 else (),
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
        if pairs and pairs[0][0] == f"{entry.name}_{MARKED_COLUMN}":
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


class _Text:
    """The text of a file in pieces of whole lines: up to its last newline, or as far as a damaged gzip file goes."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self.file, self.path = file, path
        self.damage = ""
        self._size, self._taken = max(1, path.stat().st_size), 0
        self._tail = b""
        packed = isinstance(file, gzip.GzipFile)
        self._left = max(_UNPACKED_LIMITS[0], _UNPACKED_LIMITS[1] * self._size) if packed else None

    @property
    def ahead(self) -> float:
        """Size of the file over what was read of it, packed or not."""
        return self._size / max(1, self._taken)

    def skip_line(self) -> None:
        """Leave out the first line."""
        self.file.readline(_LONGEST_LINE)

    def pieces(self) -> Iterator[bytes]:
        """The rest, a few MiB at a time."""
        while more := self._more():
            if self._left is not None:
                self._left -= len(more)
                if self._left < 0:
                    raise FileFormatError(
                        f"{self.path} unpacks to far more than a recording of its size would; not read."
                    )
            file = self.file.fileobj if isinstance(self.file, gzip.GzipFile) else self.file
            self._taken = file.tell()
            end = more.rfind(b"\n") + 1
            if end:
                yield self._tail + more[:end]
                self._tail = more[end:]
            else:
                self._tail += more
            if len(self._tail) > _LONGEST_LINE:
                raise FileFormatError(f"{self.path}: a line is longer than {_LONGEST_LINE >> 20} MiB.")
        if self._tail and not self.damage:
            self.damage = "The last line has no end; it was cut and is left out."

    def _more(self) -> bytes:
        try:
            if isinstance(self.file, gzip.GzipFile):
                return self.file.read1(_BLOCK_BYTES)  # unlike read, hands out what it has before it comes to the damage
            return self.file.read(_BLOCK_BYTES)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            self.damage = f"The gzip file is damaged ({error}); the whole lines before that were read."
            return b""
        except OSError as error:
            raise FileFormatError(f"{self.path} cannot be read ({error.strerror or error}).") from None
