"""Recordings as tables for other programs: CSV with a CSVW description beside it, and Parquet; nothing is resampled.

A row holds consecutive samples with the same stamp. A field is empty (null) if the signal has no sample in the row, and
NaN if the sample is not a number.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote

import msgspec
import numpy as np
from numpy.typing import NDArray

from crazyem.atomic_file import new_file
from crazyem.errors import UsageError
from crazyem.recordings.columns import Column, Description, Rows, SignalEntry, describe, rows_of
from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Event, Recording

_LARGEST_ROW = 2**62


class _Event(msgspec.Struct, rename={"time": "time_s"}):
    """An `Event` in the file."""

    time: float
    kind: str
    data: dict[str, Any]


class _File(msgspec.Struct):
    """A `Description` in the file; missing keys and other types are refused."""

    version: Literal[1]
    source: str
    origin_s: float
    signals: tuple[SignalEntry, ...]
    findings: tuple[Finding, ...]
    events: tuple[_Event, ...]
    metadata: dict[str, dict[str, Any]] = {}


def to_json(description: Description) -> dict[str, Any]:
    """For `json.dumps(..., allow_nan=False)`."""
    return {
        "version": 1,
        "source": description.source,
        "origin_s": _plain(float(description.origin)),
        "signals": msgspec.to_builtins(description.entries),
        "metadata": _plain(description.metadata or {}),
        "findings": [_plain(f.to_dict(np.ndarray.tolist)) for f in description.findings],
        "events": [_plain({"time_s": float(e.time), "kind": e.kind, "data": e.data}) for e in description.events],
    }


def from_json(table: Any) -> Description:
    """Inverse of `to_json`. Raises ValueError with the reason."""
    if not isinstance(table, dict):
        raise ValueError("it is no table")
    table = {key: value if key == "metadata" else _back(value) for key, value in table.items()}
    file = msgspec.convert(table, _File, dec_hook=_rows)
    return Description(
        file.source,
        file.signals,
        file.origin_s,
        {name: {key: str(value) for key, value in section.items()} for name, section in file.metadata.items()},
        file.findings,
        tuple(Event(event.time, event.kind, event.data) for event in file.events),
    )


def _plain(value: Any) -> Any:
    """The value in types of JSON; NaN becomes {"number": "nan"}, infinities likewise."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": repr(value)}
    if isinstance(value, bytes):
        return {"bytes": value.hex()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _back(value: Any) -> Any:
    if isinstance(value, list):
        return [_back(v) for v in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {"number"} and value["number"] in ("nan", "inf", "-inf"):
        return float(value["number"])
    if set(value) == {"bytes"} and isinstance(value["bytes"], str):
        return bytes.fromhex(value["bytes"])
    return {k: _back(v) for k, v in value.items()}


def _rows(kind: type, value: Any) -> NDArray[np.int64]:
    """Rows of a fix: the only numpy array in a finding."""
    rows = msgspec.convert(value, list[Annotated[int, msgspec.Meta(ge=0, le=_LARGEST_ROW)]])
    return np.array(rows, np.int64)


TIME, HOST_TIME = "time [s]", "host_time [s]"
METADATA_SUFFIX = "-metadata.json"  # CSVW: where programs look for the description of a CSV
EXPORT_SUFFIXES = (".csv", ".parquet")
_BLOCK_ROWS = 65536  # rows of a block; bounds the memory used besides the recording
_TIME_COLUMNS = {"time": "on the clock of the recording", "host_time": "since the epoch, clock of the host"}


def export(recording: Recording, path: str | Path, *, force: bool = False) -> Description:
    """Write a recording to `path`: .csv (and its -metadata.json) or .parquet.

    A temporary file beside the target replaces it when complete.

    Raises: UsageError if the suffix is another one, the file exists (unless `force`), or it cannot be written.
    """
    return export_parts(lambda: iter((recording,)), path, force=force)


def export_parts(parts: Any, path: str | Path, *, force: bool = False) -> Description:
    """As `export`, for a recording in parts: one part is in memory at a time.

    Args:
        parts: function without arguments that returns the parts; called twice, for the columns and the samples.
    """
    path = Path(path)
    write = {".csv": _write_csv, ".parquet": _write_parquet}.get(path.suffix.lower())
    if write is None:
        raise UsageError(f"{path}: an export ends in {' or '.join(EXPORT_SUFFIXES)}.")
    description = describe(parts())
    with new_file(path, force=force) as temporary:
        write(description, parts(), temporary)
        if write is _write_csv:
            beside = path.with_name(path.name + METADATA_SUFFIX)
            with new_file(beside, force=force) as other:
                text = json.dumps(csvw(description, path.name), indent=1, allow_nan=False, ensure_ascii=True)
                other.write_text(text + "\n", encoding="utf-8")
    return description


def _blocks(description: Description, parts: Iterable[Recording], schema: Any) -> Iterator[Any]:
    """The table as consecutive RecordBatches."""
    import pyarrow as pa

    names = [entry.name for entry in description.entries]
    columns = description.columns
    for recording in parts:
        for rows in rows_of(recording, names):
            for first in range(0, rows.time.size, _BLOCK_ROWS):
                last = min(first + _BLOCK_ROWS, rows.time.size)
                host = rows.host_time[first:last]
                arrays = [pa.array(rows.time[first:last]), pa.array(host, mask=np.isnan(host))]
                arrays += [_filled(recording, rows, column, first, last) for column in columns]
                yield pa.record_batch(arrays, schema=schema)


def _filled(recording: Recording, rows: Rows, column: Column, first: int, last: int) -> Any:
    """Rows `first` to `last` - 1 of a column; null where the signal has no sample."""
    import pyarrow as pa

    array = recording.signals.get(column.entry.name)
    flag = column.component is None
    values = np.zeros(last - first, bool if flag else float)
    absent = np.ones(last - first, bool)
    if array is not None:
        row = rows.row[column.entry.name]
        a, b = np.searchsorted(row, (first, last))
        here, sample = row[a:b] - first, rows.sample[column.entry.name][a:b]
        values[here] = array.marked[sample] if flag else array.value[sample, column.component]
        absent[here] = False
    return pa.array(values, mask=absent)


def _write_csv(description: Description, parts: Iterable[Recording], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import csv as pa_csv

    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow([TIME, HOST_TIME, *(c.title for c in description.columns)])
    plain = _schema(description)
    schema = pa.schema([f.with_type(pa.int8()) if f.type == pa.bool_() else f for f in plain])  # 1, not "true"
    with path.open("wb") as file:
        file.write(header.getvalue().encode("utf-8", "replace"))
        options = pa_csv.WriteOptions(include_header=False)
        with pa_csv.CSVWriter(file, schema, write_options=options) as writer:
            for block in _blocks(description, parts, plain):
                writer.write(block.cast(schema))


def _write_parquet(description: Description, parts: Iterable[Recording], path: Path) -> None:
    from pyarrow import parquet

    about = {"crazyem": to_json(description), "PANDAS_ATTRS": attributes(description)}
    texts = {key: json.dumps(value, allow_nan=False) for key, value in about.items()}
    schema = _schema(description).with_metadata(texts)
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for block in _blocks(description, parts, schema):
            writer.write_batch(block)


def _schema(description: Description) -> Any:
    """The Arrow schema of the table; fields have the known properties of their columns."""
    import pyarrow as pa

    known = [(name, pa.float64(), {"unit": "s", "description": text}) for name, text in _TIME_COLUMNS.items()]
    known += [(c.name, pa.bool_() if c.component is None else pa.float64(), _about(c)) for c in description.columns]
    return pa.schema(
        pa.field(name, kind, metadata={k: v.encode("utf-8", "replace") for k, v in about.items()})
        for name, kind, about in known
    )


def _about(column: Column) -> dict[str, str]:
    """The known properties of a column, by name."""
    entry, part = column.entry, column.component
    one = part is not None and len(entry.source) == len(entry.components)
    source = entry.source[part or 0] if one else ", ".join(entry.source)
    about = {"signal": entry.name, "quantity": entry.quantity, "unit": column.unit, "frame": entry.frame}
    about |= {"clock": entry.clock, "stream": entry.stream, "source": source}
    if column.component is None:
        about["description"] = "true where the sample was not measured, or the sensor said that it has none"
    return {k: v for k, v in about.items() if v}


def attributes(description: Description) -> dict[str, Any]:
    """For `DataFrame.attrs`: units, frames, clocks, streams and sources by column; origin; source of the recording."""
    result: dict[str, Any] = {"units": {"time": "s", "host_time": "s"}}
    for key, plural in (
        ("unit", "units"), ("frame", "frames"), ("clock", "clocks"), ("stream", "streams"), ("source", "sources"),
    ):  # fmt: skip
        found = {c.name: about[key] for c in description.columns if key in (about := _about(c))}
        result[plural] = result.get(plural, {}) | found
    origin = float(description.origin)
    return result | {"origin_s": origin if math.isfinite(origin) else None, "recording": description.source}


def csvw(description: Description, name: str) -> dict[str, Any]:
    """The CSVW description (https://www.w3.org/TR/tabular-metadata/) of an exported CSV called `name`."""
    columns: list[dict[str, Any]] = [
        {"titles": f"{key} [s]", "name": key, "datatype": "double", "schema:unitText": "s", "dc:description": text}
        for key, text in _TIME_COLUMNS.items()
    ]
    for column in description.columns:
        about = _about(column)
        kind: Any = {"base": "boolean", "format": "1|0"} if column.component is None else "double"
        entry: dict[str, Any] = {"titles": column.title, "name": quote(column.name, safe=""), "datatype": kind}
        for key, term in (
            ("unit", "schema:unitText"), ("frame", "dc:description"), ("source", "dc:source"),
        ):  # fmt: skip
            if key in about:
                entry[term] = about[key]
        columns.append(entry)
    return {
        "@context": "http://www.w3.org/ns/csvw",
        "url": quote(name.encode("utf-8", "surrogateescape")),
        "dialect": {"header": True, "delimiter": ",", "encoding": "utf-8"},
        "tableSchema": {"columns": columns},
        "notes": [{"crazyem": to_json(description)}],
    }
