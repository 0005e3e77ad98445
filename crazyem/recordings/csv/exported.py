"""Read CSV files of `crazyem export` back to the exported recording."""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.columns import MARKED_COLUMN, Description, SignalEntry, name_and_unit
from crazyem.recordings.contents import GrowingArray, ReadOptions
from crazyem.recordings.csv.text import BLOCK_BYTES, LONGEST_LINE, Damage, text_blocks
from crazyem.recordings.export import HOST_TIME, METADATA_SUFFIX, TIME, from_json
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording, SignalArray, about
from crazyem.signals.sample import SIGNALS, components

_LARGEST_DESCRIPTION = 256 << 20  # bytes


def recognises(head: bytes) -> bool:
    """True if the header starts like that of an exported CSV."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(f"{TIME},{HOST_TIME}".encode())


def read(path: Path, options: ReadOptions) -> Recording:
    """Read an exported recording.

    Frames, clocks, streams, metadata and events come from the -metadata.json beside the file; without it they are
    unknown, and a finding says so. Samples of a signal come in processing order.

    Raises: FileFormatError naming line or column.
    """
    return next(read_parts(path, options, seconds=math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive parts of at least `seconds` of an exported recording; the first has the events."""
    findings: list[Finding] = []
    titles = _titles(path)
    known = _description(path, titles, findings)

    def recording() -> Recording:
        if not held.time.size:
            raise FileFormatError(f"{path}: there is a header but not a single sample.")
        found, events = (*known.findings, *findings), known.events if held.first == 0 else ()
        return Recording(str(path), known.source, held.signals(), known.metadata or {}, found, events, known.origin)

    held = _Held(known.entries)
    for batch, first in _batches(path, titles, findings):
        held.add(batch, first, path)
        if not float(held.time.rows[-1]) - float(held.time.rows[0]) < seconds:
            yield recording()
            held = _Held(known.entries, held.first + held.time.size)
    if held.time.size or not held.first:
        yield recording()


class _Held:
    """Rows of the table for one recording: stamps of all rows, and for each signal the rows with a sample.

    Batches of the text are copied directly to the arrays of the signals, so a flight is in memory once.
    """

    def __init__(self, entries: tuple[SignalEntry, ...], first: int = 0) -> None:
        self.entries = entries
        self.first = first  # number of its first row in the file
        self.time, self.host_time = GrowingArray(float), GrowingArray(float)
        self.value = [GrowingArray(float, len(entry.components)) for entry in entries]
        self.order = [GrowingArray(np.int64) for _ in entries]
        self.marked = [GrowingArray(bool) for _ in entries]

    def add(self, batch: Any, line: int, path: Path) -> None:
        """Append a RecordBatch whose first row is `line` of the file. Raises FileFormatError naming the row."""
        count, before = batch.num_rows, self.first + self.time.size
        time = batch.column(0).to_numpy(zero_copy_only=False)
        if batch.column(0).null_count:
            raise FileFormatError(f"{path}: row {line + int(np.argmax(np.isnan(time)))} has no time.")
        self.time.more(count)[:] = time
        self.host_time.more(count)[:] = batch.column(1).to_numpy(zero_copy_only=False)
        column = 2
        for place, entry in enumerate(self.entries):
            parts = [batch.column(column + i) for i in range(len(entry.components))]
            column += len(parts)
            row = np.arange(count)  # the rows in which at least one of the columns has a value
            if all(part.null_count for part in parts):
                valid = [p.is_valid().to_numpy(zero_copy_only=False) for p in parts]
                row = np.flatnonzero(np.logical_or.reduce(valid))
            value = self.value[place].more(row.size)
            for i, part in enumerate(parts):
                value[:, i] = part.to_numpy(zero_copy_only=False)[row]
            self.order[place].more(row.size)[:] = (row + before) * len(self.entries) + place
            flags = batch.column(column).to_numpy(zero_copy_only=False)[row] == 1.0 if entry.marked else False
            self.marked[place].more(row.size)[:] = flags
            column += entry.marked

    def signals(self) -> dict[str, SignalArray]:
        """The signals; those of one stream share their stamps."""
        signals: dict[str, SignalArray] = {}
        shared: list[tuple[NDArray[np.int64], int, Array, Array]] = []
        for place, entry in enumerate(self.entries):
            order = self.order[place].rows
            # same rows: the orders differ only by the places of the signals
            known = next((k for k in shared if k[0].size == order.size and (order - k[0] == place - k[1]).all()), None)
            if known is None:
                every = order.size == self.time.size
                rows = slice(None) if every else order // len(self.entries) - self.first
                known = (order, place, self.time.rows[rows], self.host_time.rows[rows])
                shared.append(known)
            value, marked = self.value[place].rows, self.marked[place].rows
            signals[entry.name] = SignalArray(known[2], value, order, known[3], marked, **about(entry))
        return signals


def _titles(path: Path) -> list[str]:
    """The titles of the columns."""
    line = next(text_blocks(path, Damage(), size=LONGEST_LINE), b"").partition(b"\n")[0]
    try:
        titles = next(csv.reader([line.decode("utf-8-sig")], strict=True), [])
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: line 1 is not a CSV header ({error}).") from None
    if titles[:2] != [TIME, HOST_TIME] or len(titles) < 3:
        raise FileFormatError(f"{path}: line 1 is not the header of an exported recording.")
    return titles


def _description(path: Path, titles: list[str], findings: list[Finding]) -> Description:
    """The description beside the file; without it signals from the titles alone, and a finding with the reason."""
    beside = path.with_name(path.name.removesuffix(".gz") + METADATA_SUFFIX)
    why = f"There is no {beside.name} beside it: frames, clocks and streams are not known."
    if beside.is_file():
        try:
            if beside.stat().st_size > _LARGEST_DESCRIPTION:
                raise ValueError("it is too large")
            notes = json.loads(beside.read_text(encoding="utf-8"))["notes"]
            description = from_json(next(n["crazyem"] for n in notes if "crazyem" in n))
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, StopIteration) as error:
            what = f"{type(error).__name__}: {error}" if isinstance(error, KeyError | TypeError) else str(error)
            raise FileFormatError(f"{beside} is not the description of an exported recording ({what}).") from None
        if [c.title for c in description.columns] == titles[2:]:
            return description
        why = f"{beside.name} describes other columns than the file has; it was left out."
    findings.append(note("integrity", why, Grade.DEGRADES))
    return _guessed(titles[2:])


def _batches(path: Path, titles: list[str], findings: list[Finding]) -> Iterator[tuple[Any, int]]:
    """The rows of the file, in bounded memory: (RecordBatch, line of its first row).

    Raises FileFormatError naming line or column.
    """
    import pyarrow as pa
    from pyarrow import csv as pa_csv

    names = [str(i) for i in range(len(titles))]
    reading = pa_csv.ReadOptions(column_names=names, block_size=2 * BLOCK_BYTES, use_threads=False)
    converting = pa_csv.ConvertOptions(column_types=dict.fromkeys(names, pa.float64()), null_values=[""])
    damage = Damage()
    first = 2
    # in blocks, not as one stream, whose read-ahead threads would keep each block in memory
    for number, block in enumerate(text_blocks(path, damage)):
        rows = block if number else block.partition(b"\n")[2]
        if not rows.strip():
            continue
        try:
            table = pa_csv.read_csv(pa.py_buffer(rows), reading, convert_options=converting)
        except pa.ArrowException as error:
            why = str(error).strip().rstrip(".")[:200]
            raise FileFormatError(f"{path}: a line cannot be read ({why}).") from None
        for batch in table.to_batches():
            yield batch, first
            first += batch.num_rows
    findings += damage.findings()


def _guessed(titles: list[str]) -> Description:
    """Signals from the titles of their columns alone."""
    pairs = [name_and_unit(title) for title in titles]
    entries = []
    while pairs:
        entry = _first_entry(pairs)
        del pairs[: len(entry.components)]
        if pairs and pairs[0][0] == f"{entry.name}_{MARKED_COLUMN}":
            del pairs[0]
            entry = replace(entry, marked=True)
        entries.append(entry)
    return Description("exported csv", tuple(entries))


def _first_entry(pairs: list[tuple[str, str]]) -> SignalEntry:
    """The signal in the first columns: a vector (position_x, position_y, position_z), else a scalar."""
    name, unit = pairs[0]
    for quantity, (count, known, frame) in SIGNALS.items():
        parts, names = components(quantity), tuple(n for n, _ in pairs[:count])
        base = name.removesuffix(f"_{parts[0]}") if parts else ""
        if parts and base.split("@")[0] == quantity and names == tuple(f"{base}_{part}" for part in parts):
            return SignalEntry(base, parts, quantity, known, frame, "", "", names)
    quantity = name.split("@", maxsplit=1)[0]
    count, known, frame = SIGNALS.get(quantity, (0, "", ""))
    if count != 1 or unit != known:
        quantity, frame = "", ""
    return SignalEntry(name, ("",), quantity, unit, frame, "", "", (name,))
