"""Parse CSV text (plain or gzip) to columns of doubles, in blocks and bounded memory; damaged lines are located.

pyarrow parses each block, fast and with correct rounding. If pyarrow fails or finds another number of rows, this module
parses the block again line by line. So each error has a line and a column, and a bad line loses only itself.
"""

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.columns import unique_name
from crazyem.recordings.contents import opened
from crazyem.recordings.finding import Finding, Grade, note

BLOCK_BYTES = 4 << 20
LONGEST_LINE = 1 << 20  # bytes
MOST_COLUMNS = 4096
LARGEST_RATIO = 200  # size of text over gzip; flights reach 20, constant columns 100
_SMALL_TEXT = 64 << 20  # bytes; the ratio of smaller texts is not checked
_SNIFFED_LINES = 100  # lines that show whether a column has numbers or words
_DELIMITERS = (",", ";", "\t")
_MISSING_WORDS = ("", "nan", "null", "none", "na", "n/a", "#n/a")
_NULLS = sorted({form for n in _MISSING_WORDS for form in (n, n.upper(), n.capitalize())} | {"NaN"})
_BOOLEAN_WORDS = {"true": 1.0, "false": 0.0}

Columns = dict[int, NDArray[np.float64]]


@dataclass(slots=True)
class Damage:
    """Errors in the text, counted while reading."""

    rows: int = 0  # rows read
    dropped: int = 0  # damaged lines
    lines: list[int] = field(default_factory=list)  # numbers of the first damaged lines
    first: str = ""  # error in the first damaged line
    words: dict[int, int] = field(default_factory=dict)  # column -> number of values that are no numbers
    cut_line: bool = False  # the last line has no end
    cut_gzip: bool = False  # the file ends within a gzip stream

    def drop(self, line: int, what: str) -> None:
        """Count a damaged line."""
        self.dropped += 1
        self.first = self.first or what
        if len(self.lines) < 5:
            self.lines.append(line)

    def check(self, path: Path) -> None:
        """Raise FileFormatError if more than 1 % of the lines so far are damaged (another kind of file)."""
        if 100 * self.dropped > self.rows + self.dropped:
            raise FileFormatError(f"{path}: {self.first}.")

    def findings(self, names: Sequence[str] = ()) -> list[Finding]:
        """Findings about damaged lines and fields of a file whose columns have these names."""
        notes = []
        if self.dropped:
            where = ", ".join(map(str, self.lines)) + (", ..." if self.dropped > len(self.lines) else "")
            text = f"{self.dropped} damaged lines were dropped (line {where}): {self.first}."
            notes.append(note("integrity", text, Grade.DEGRADES, lines=float(self.dropped)))
        if self.cut_gzip:
            text = "The gzip file ends early; what was packed before its end was read."
            notes.append(note("integrity", text, Grade.DEGRADES))
        if self.cut_line and not self.cut_gzip:
            notes.append(note("integrity", "The last line is cut short and was dropped."))
        for column, count in self.words.items():
            notes.append(
                note("integrity", f"{count} values in column {names[column]} are no numbers.", count=float(count))
            )
        return notes


@dataclass(frozen=True, slots=True)
class Header:
    """The names in the first line, and the format of the other lines."""

    names: tuple[str, ...]  # of the columns, made unique
    repeated: tuple[str, ...]  # names that occurred more than once
    delimiter: str  # delimiter, decimal: characters
    decimal: str
    words: frozenset[int]  # columns of words (neither numbers nor true/false), by the first lines
    flags: frozenset[int]  # columns of true and false
    hollow: frozenset[int]  # columns without a name and without a value in the first lines


def parse_header_line(line: str) -> tuple[list[str], str]:
    """Names in a header line, and their delimiter: the most frequent of comma, semicolon and tab."""
    delimiter = max(_DELIMITERS, key=line.count)
    try:
        fields = next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])
    except csv.Error:
        return [], delimiter
    return [name.strip() for name in fields], delimiter


def read_header(path: Path) -> Header:
    """Header and dialect of a CSV file. Raises FileFormatError, UsageError."""
    block = next(text_blocks(path, Damage(), size=LONGEST_LINE), b"")
    if not block:
        raise FileFormatError(f"{path}: there is a header but not a single sample.")
    lines = block.split(b"\n", _SNIFFED_LINES + 1)
    try:
        given, delimiter = parse_header_line(lines[0].decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file (byte {error.start} is not UTF-8).") from error
    if len(given) > MOST_COLUMNS:
        raise FileFormatError(f"{path}: the header has {len(given)} columns, more than {MOST_COLUMNS}.")
    rows = [parse_fields(line, delimiter) for line in lines[1:-1] if line.strip()]
    rows = [row for row in rows if len(row) == len(given)]
    texts = [text for row in rows for text in row]
    comma = delimiter == ";" and any("," in t for t in texts) and not any("." in t for t in texts)
    decimal = "," if comma else "."
    words, flags, hollow = set(), set(), set()
    for column, name in enumerate(given):
        values = [row[column].strip() for row in rows]
        values = [v for v in values if v.lower() not in _MISSING_WORDS]
        bad = sum(not _is_number(v, decimal) for v in values)
        if 2 * bad > len(values):
            words.add(column)
        elif values and all(v.lower() in _BOOLEAN_WORDS for v in values):
            flags.add(column)
        elif not values and not name:
            hollow.add(column)
    wanted = [name or f"column {place}" for place, name in enumerate(given, start=1)]
    used: set[str] = set()
    names = tuple(unique_name(name, used) for name in wanted)
    repeated = tuple(dict.fromkeys(name for name, unique in zip(wanted, names) if name != unique))
    return Header(names, repeated, delimiter, decimal, frozenset(words), frozenset(flags), frozenset(hollow))


def read_columns(
    path: Path, header: Header, needed: Iterable[int], wanted: Iterable[int], damage: Damage, *, stamp: int | None
) -> Iterator[Columns]:
    """Columns of the file as doubles, in blocks of rows; empty fields are NaN, true and false are 1 and 0.

    Args:
        needed: columns whose values must be numbers; other lines are dropped and counted.
        wanted: further columns; a value that is no number becomes NaN and is counted.
        damage: filled in while reading.
        stamp: the column that must be finite in every row, or None.

    Raises: FileFormatError if more than 1 % of the lines so far are damaged, or the file cannot be unpacked.
    """
    needed = tuple(needed)
    columns = (*needed, *(c for c in wanted if c not in needed))
    line = 2
    for number, whole in enumerate(text_blocks(path, damage)):
        block = whole.partition(b"\n")[2] if number == 0 else whole
        if not block.strip():
            line += block.count(b"\n")
            continue
        parsed = _fast(block, header, columns)
        # the slow path locates rows without a stamp
        if parsed is None or (stamp is not None and not np.isfinite(parsed[stamp]).all()):
            parsed = _careful(block, line, header, needed, columns, damage, stamp)
        line += block.count(b"\n")
        rows = parsed[columns[0]].size if columns else 0
        damage.rows += rows
        damage.check(path)
        if rows:
            yield parsed


def text_blocks(path: Path, damage: Damage, size: int = BLOCK_BYTES) -> Iterator[bytes]:
    """Whole lines in blocks of about `size` bytes; text after the last line end is dropped and noted.

    A gzip file is unpacked piece by piece. A gzip file that ends early gives the text before its end.

    Raises: FileFormatError if a line is too long, a gzip file is damaged or exceeds `LARGEST_RATIO`;
        UsageError if the file cannot be read.
    """
    rest = b""
    total = 0
    with opened(path) as (raw, source, packed):
        while True:
            chunk, ended = _chunk(source, size, packed)
            damage.cut_gzip |= ended
            total += len(chunk)
            if packed and total > _SMALL_TEXT and total > LARGEST_RATIO * raw.tell():
                raise FileFormatError(
                    f"{path}: the gzip file unpacks to more than {LARGEST_RATIO} times its size; it is not read."
                )
            if not chunk:
                break
            block, newline, rest = (rest + chunk).rpartition(b"\n")
            if len(rest) > LONGEST_LINE:
                raise FileFormatError(f"{path}: there is a line of more than {LONGEST_LINE} bytes.")
            if newline:
                yield block + newline
            if ended:
                break
    damage.cut_line = bool(rest.strip())


def _chunk(source: IO[bytes], size: int, packed: bool) -> tuple[bytes, bool]:
    """Up to `size` bytes, and whether the gzip stream ends early there."""
    if not packed:
        return source.read(size), False
    parts: list[bytes] = []
    held = 0
    try:
        while held < size:
            part = source.read(min(1 << 13, size - held))  # small pieces: a stream that ends early loses the last one
            if not part:
                break
            parts.append(part)
            held += len(part)
    except EOFError:
        return b"".join(parts), True
    return b"".join(parts), False


def _fast(block: bytes, header: Header, columns: tuple[int, ...]) -> Columns | None:
    """The block parsed by pyarrow; None if pyarrow fails or the number of rows differs from that of lines."""
    names = [str(i) for i in range(len(header.names))]
    types = {str(c): pa.bool_() if c in header.flags else pa.float64() for c in columns}
    try:
        table = pyarrow.csv.read_csv(
            pa.BufferReader(block),
            read_options=pyarrow.csv.ReadOptions(column_names=names, use_threads=False, block_size=len(block) + 1),
            parse_options=pyarrow.csv.ParseOptions(delimiter=header.delimiter),
            convert_options=pyarrow.csv.ConvertOptions(
                check_utf8=False,
                column_types=types,
                include_columns=[str(c) for c in columns],
                null_values=_NULLS,
                true_values=["true", "True", "TRUE"],
                false_values=["false", "False", "FALSE"],
                strings_can_be_null=True,
                decimal_point=header.decimal,
            ),
        )
    except (pa.ArrowException, ValueError):
        return None
    if table.num_rows != block.count(b"\n"):
        return None
    return {c: table.column(str(c)).cast(pa.float64()).to_numpy() for c in columns}


def _careful(
    block: bytes,
    line: int,
    header: Header,
    needed: tuple[int, ...],
    columns: tuple[int, ...],
    damage: Damage,
    stamp: int | None,
) -> Columns:
    """The block parsed line by line; this function defines a valid row."""
    rows: list[list[float]] = []
    for number, raw in enumerate(block.split(b"\n")[:-1], start=line):
        if not raw.strip():
            continue
        fields = parse_fields(raw, header.delimiter)
        if len(fields) != len(header.names):
            damage.drop(number, f"line {number} has {len(fields)} fields, the header has {len(header.names)}")
            continue
        row = []
        odd = []
        for place, c in enumerate(columns):
            try:
                row.append(to_number(fields[c], header.decimal))
            except ValueError:
                if place < len(needed):
                    damage.drop(number, f"line {number}, column {header.names[c]}: {_shown(fields[c])} is not a number")
                    break
                row.append(math.nan)
                odd.append(c)
        else:
            if stamp is not None and not math.isfinite(row[columns.index(stamp)]):
                damage.drop(number, f"line {number} has no time (column {header.names[stamp]})")
                continue
            rows.append(row)
            for c in odd:
                damage.words[c] = damage.words.get(c, 0) + 1
    table = np.array(rows, float).reshape(len(rows), len(columns))
    return {c: np.ascontiguousarray(table[:, i]) for i, c in enumerate(columns)}


def to_number(text: str, decimal: str = ".") -> float:
    """A field as a double: NaN for an empty field and "NaN", 1 and 0 for true and false. Raises ValueError."""
    text = text.strip()
    low = text.lower()
    if low in _MISSING_WORDS:
        return math.nan
    if low in _BOOLEAN_WORDS:
        return _BOOLEAN_WORDS[low]
    if "_" in text or (decimal != "." and "." in text):
        raise ValueError(text)
    return float(text.replace(decimal, "."))


def _is_number(text: str, decimal: str) -> bool:
    try:
        to_number(text, decimal)
    except ValueError:
        return False
    return True


def parse_fields(line: bytes, delimiter: str) -> list[str]:
    """Fields of a line without its end; [] if its quotes are invalid."""
    text = line.decode("utf-8", "replace").rstrip("\r")
    if '"' not in text:
        return text.split(delimiter)
    try:
        return next(csv.reader(io.StringIO(text), delimiter=delimiter), [])
    except csv.Error:
        return []


def _shown(text: str) -> str:
    short = "".join(c if c.isprintable() else "?" for c in text[:20])
    return f'"{short}"'
