"""CSV files of cfclient: one file per log block, merged by their stamps; a folder is one session and one recording.

cfclient (src/cfclient/utils/logdatawriter.py) makes a folder for each connection, <config>/logdata/YYYYmmddTHH-MM-SS.
It adds a file <block>-YYYYmmddTHH-MM-SS.csv each time the user switches on the writing of a block. The first line is
"Timestamp" and the variables. Each further line has the firmware stamp (the low 24 bits of its ms) and the values as
Python prints them, so every float is exact. Rows are in order of arrival; the file has no host times and no types.
"""

import contextlib
import io
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, UsageError
from crazyem.links.clock import STAMP_MODULUS
from crazyem.recordings import motor_meaning
from crazyem.recordings.contents import ReadOptions, contents, head_of
from crazyem.recordings.csv.file import read as read_csv
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import Recording
from crazyem.recordings.stamps import Fault, finding
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.topics import ranks

_VARIABLE = re.compile(r"[A-Za-z_]\w*\.[\w\[\]]+")
_FILE_NAME = re.compile(r"(.+)-(\d{8}T\d\d-\d\d-\d\d)\.csv(\.gz)?")
_DATE_FORMAT = "%Y%m%dT%H-%M-%S"
_ONE_SESSION = 120.0  # s; largest spread of the estimated times of switch-on in one session
_MOST_FILES = 256  # in a folder
_MOST_SIBLINGS = 32  # files beside a single file that are checked
_RECORDING_SUFFIXES = {"", ".mcap", ".ulg", ".tlog", ".db3", ".parquet"}  # suffixes of other recordings


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One file."""

    path: Path
    block: str  # name of the log block; the file name if it does not follow the pattern of cfclient
    date: datetime | None  # start of writing, local time of the host; None if not in the file name
    variables: tuple[str, ...]  # names of the columns
    stamp: NDArray[np.int64]  # (n,) ms, unwrapped from the first
    values: NDArray[np.float64]  # (n, k)


def recognises(head: bytes) -> bool:
    """True if the first line is "Timestamp" with names like "group.variable", or "Timestamp" alone."""
    line = _first_line(head)
    return bool(_variables(line)) or _is_time(line)


def recognises_folder(path: Path) -> bool:
    """True if every CSV file in a folder is from cfclient, and all are from one session.

    One session means: dates in file names and first stamps give the same time of switch-on; files without a date all
    have different variables. A folder that also holds recordings of other kinds is a folder of recordings.
    """
    files = _files(path)
    others = [f for f in path.iterdir() if f.is_file() and not f.name.startswith(".") and f not in files]
    if not 0 < len(files) <= _MOST_FILES or any(f.suffix in _RECORDING_SUFFIXES for f in others):
        return False
    starts: list[float] = []
    undated: list[bytes] = []
    for file in files:
        head = _head(file)
        if not recognises(head):
            return False
        date, stamp = _named(file)[1], _first_stamp(head)
        if date is None:
            undated.append(_first_line(head))
        elif stamp is not None:
            starts.append((date - datetime(2000, 1, 1)).total_seconds() - stamp / 1000.0)
    return len(set(undated)) == len(undated) and _spread(starts) <= _ONE_SESSION


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a folder of log blocks, or one block alone. Time is the stamp in seconds, unwrapped (`origin` is 0).

    Rows whose stamps are not 24-bit ms are left out, with a finding.

    Raises: FileFormatError naming the file and line; UsageError if a file cannot be read.
    """
    if options.mapping is not None and path.is_file() and not _first_line(_head(path)).startswith(b"Timestamp"):
        return read_csv(path, options)  # not written by cfclient: the mapping of the user applies
    findings: list[Finding] = []
    faults: list[Fault] = []
    folder = path.is_dir()
    parts = [_read_file(file, findings, faults) for file in (_files(path) if folder else [path])]
    full = [part for part in parts if part.stamp.size]
    if not full:
        raise FileFormatError(f"{path}: there is a header but not a single row.")
    for part in parts:
        if not part.stamp.size:
            findings.append(note("integrity", f"{part.path.name} has a header and not a single row."))
    if not folder:
        with contextlib.suppress(OSError, UsageError):
            others = len(_files(path.parent)) - 1
            if 0 < others < _MOST_SIBLINGS and recognises_folder(path.parent):
                text = f"{others} more files of the session lie beside it; read the folder to have them too."
                findings.append(note("integrity", text, files=others))
    full = _aligned(full)
    tables = _tables(full)
    section = {"session": path.name if folder else path.parent.name}
    section |= {f"file.{part.path.name}": f"{part.block}: {' '.join(part.variables)}" for part in full}
    metadata = {"cfclient": section}
    meaning = motor_meaning.decide(tables, given=options.motor, metadata=metadata)
    signals = signals_from_tables(tables, motor=meaning.meaning)
    findings += finding(faults, signals)
    return Recording(str(path), "csv:cfclient", signals, metadata | meaning.metadata, (*findings, *meaning.findings))


def _files(folder: Path) -> list[Path]:
    try:
        found = [f for f in folder.iterdir() if f.name.endswith((".csv", ".csv.gz")) and not f.name.startswith(".")]
        return sorted(f for f in found if f.is_file())
    except OSError as error:
        raise UsageError(f"{folder} cannot be read: {error.strerror or error}.") from error


def _head(file: Path) -> bytes:
    try:
        return head_of(file)
    except (FileFormatError, UsageError):
        return b""


def _named(file: Path) -> tuple[str, datetime | None]:
    """Block and date in a file's name."""
    found = _FILE_NAME.fullmatch(file.name)
    if not found:
        return file.name.removesuffix(".gz").removesuffix(".csv"), None
    try:
        return found[1], datetime.strptime(found[2], _DATE_FORMAT)
    except ValueError:
        return found[1], None


def _first_line(data: bytes) -> bytes:
    """The first line that is not blank, without its end."""
    return data.removeprefix(b"\xef\xbb\xbf").lstrip(b"\r\n").split(b"\n", 1)[0].strip()


def _variables(line: bytes) -> tuple[str, ...]:
    """Names of the variables in a header line; () for other lines."""
    first, *names = line.decode("latin-1").split(",")
    return tuple(names) if _is_time(first.encode()) and all(_VARIABLE.fullmatch(name) for name in names) else ()


def _is_time(name: bytes) -> bool:
    """Whether a column has the stamps: "Timestamp" of cfclient, or "timestamp" of other scripts."""
    return name.strip().lower() == b"timestamp"


def _first_stamp(head: bytes) -> int | None:
    rows = head.removeprefix(b"\xef\xbb\xbf").lstrip(b"\r\n").split(b"\n", 2)
    field = rows[1].split(b",", 1)[0].strip() if len(rows) > 1 else b""
    return int(field) if field.isdigit() and len(field) < 12 else None


def _spread(starts: list[float]) -> float:
    """Largest difference between times [s], modulo the wrap of the stamps."""
    wrap = STAMP_MODULUS / 1000.0
    offsets = [(s - starts[0] + 0.5 * wrap) % wrap for s in starts]
    return max(offsets) - min(offsets) if offsets else 0.0


def _read_file(path: Path, findings: list[Finding], faults: list[Fault]) -> _Part:
    data = contents(path).removeprefix(b"\xef\xbb\xbf")
    header = _first_line(data)
    variables = _variables(header)
    if _is_time(header):
        raise FileFormatError(
            f"{path}: a file of cfclient with stamps only: its log block has no variables. Give the block variables in "
            "cfclient (Settings, Logging configurations) and fly again."
        )
    if not variables:
        raise FileFormatError(f"{path}: the first line is not a header of cfclient (Timestamp,group.variable,...).")
    if len(set(variables)) < len(variables):
        raise FileFormatError(f"{path}: the header names a variable twice.")
    start = data.index(header) + len(header)
    body = data[start:].lstrip(b" \t\r")
    line = data[:start].count(b"\n") + 1
    body, end, rest = body.rpartition(b"\n")
    body += end
    if end and rest.strip():
        findings.append(note("integrity", f"{path.name}: the last line has no end, it may be cut, and was dropped."))
    segments = [
        _numbers(path, text, len(variables) + 1, line + offset)
        for offset, text in _segments(path, header, body, line, findings)
    ]
    table = np.concatenate(segments)
    stamp = table[:, 0]
    sound = (stamp >= 0) & (stamp == np.floor(stamp)) & (stamp < STAMP_MODULUS)
    block, date = _named(path)
    if not sound.all():
        example = float(stamp[int(np.argmin(sound))])
        if not sound.any():
            raise FileFormatError(f"{path}: {example:g} is not a stamp of the firmware, which are 24 bits of ms.")
        faults.append(Fault(block, int((~sound).sum()), stamp.size, "left out", example / 1000.0))
        table = table[sound]
    return _Part(path, block, date, variables, _unwrapped(table[:, 0].astype(np.int64)), table[:, 1:])


def _segments(
    path: Path, header: bytes, body: bytes, line: int, findings: list[Finding]
) -> Iterator[tuple[int, bytes]]:
    """(number of lines before, text) of the rows after each header: a file may be joined from several."""
    if b"timestamp" not in body.lower():
        yield 0, body
        return
    lines = body.split(b"\n")
    first, again = 0, []
    for number, text in enumerate(lines):
        if not text.lower().startswith(b"timestamp"):
            continue
        if text.strip() != header:
            raise FileFormatError(f"{path}: line {line + number} is a header with other variables than the first.")
        again.append(line + number)
        yield first, b"\n".join(lines[first:number])
        first = number + 1
    yield first, b"\n".join(lines[first:])
    if again:
        said = (
            f"{path.name}: the header stands {len(again)} more times (first in line {again[0]}); "
            "what follows may be another flight."
        )
        advice = "Look for a clock that jumps back, and use the parts one at a time (--from, --to)."
        findings.append(Finding("integrity", Grade.DEGRADES, said, advice=advice))


def _numbers(path: Path, text: bytes, width: int, line: int) -> NDArray[np.float64]:
    """(n, width) of comma-separated text whose first line is number `line` of the file."""
    numbers = array("d")
    for number, row in enumerate(io.BytesIO(text), start=line):
        if not row.strip():
            continue
        fields = row.rstrip(b"\n").split(b",")
        if len(fields) != width:
            raise FileFormatError(f"{path}: line {number} has {len(fields)} fields, the header has {width}.")
        try:
            if b"_" in row:
                raise ValueError
            numbers.extend(map(float, fields))
        except ValueError:
            shown = ascii(row[:40].decode("latin-1").rstrip("\n"))
            raise FileFormatError(f"{path}: line {number} holds something that is not a number: {shown}.") from None
    return np.array(numbers, float).reshape(-1, width)


def _unwrapped(stamp: NDArray[np.int64]) -> NDArray[np.int64]:
    """Continuous ms: each stamp is within half a wrap (8388 s) of the previous one."""
    half = STAMP_MODULUS // 2
    steps = (np.diff(stamp) + half) % STAMP_MODULUS - half
    return np.concatenate([stamp[:1], stamp[:1] + np.cumsum(steps)])


def _aligned(parts: Sequence[_Part]) -> list[_Part]:
    """Parts with stamps on one axis: the 24-bit clock may wrap between the starts of two files."""
    parts = sorted(parts, key=lambda p: (p.date or datetime.min, p.path.name))
    first = parts[0]
    result = []
    for part in parts:
        apart = float(part.stamp[0] - first.stamp[0])
        waited = (part.date - first.date).total_seconds() * 1000.0 if part.date and first.date else 0.0
        wraps = round((waited - apart) / STAMP_MODULUS)
        result.append(replace(part, stamp=part.stamp + wraps * STAMP_MODULUS))
    return result


def _tables(parts: Sequence[_Part]) -> list[Table]:
    """One table per block, in the order of `parts`; several files of a block are joined, gaps remain."""
    blocks: dict[tuple[str, tuple[str, ...]], list[_Part]] = {}
    for part in parts:
        blocks.setdefault((part.block, part.variables), []).append(part)
    stamps = [np.concatenate([p.stamp for p in group]) for group in blocks.values()]
    # rows of a file stay in order, even where its clock jumps back
    orders = ranks([np.maximum.accumulate(s) for s in stamps])
    tables: list[Table] = []
    names: set[str] = set()
    for ((block, variables), group), stamp, order in zip(blocks.items(), stamps, orders, strict=True):
        name = block if block not in names else f"{block}#{len(names) + 1}"
        names.add(name)
        values = np.concatenate([p.values for p in group])
        columns = {variable: values[:, i] for i, variable in enumerate(variables)}
        tables.append(Table(name, columns, stamp / 1000.0, order))
    return tables
