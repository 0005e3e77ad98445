"""Recordings as tables for other programs: CSV with a CSVW description beside it, and Parquet; nothing is resampled.

A row holds consecutive samples with the same stamp. A field is empty (null) if the signal has no sample in the row, and
NaN if the sample is not a number.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from crazyem.atomic_file import new_file
from crazyem.errors import UsageError
from crazyem.recordings.columns import Column, Description, Rows, describe, rows_of
from crazyem.recordings.description import to_json
from crazyem.recordings.recording import Recording

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
    entry = column.entry
    about = {"signal": entry.name, "quantity": entry.quantity, "unit": column.unit, "frame": entry.frame}
    about |= {"clock": entry.clock, "stream": entry.stream, "source": _source(column)}
    if column.component is None:
        about["description"] = "true where the sample was not measured, or the sensor said that it has none"
    return {k: v for k, v in about.items() if v}


def _source(column: Column) -> str:
    source = column.entry.source
    if len(source) == len(column.entry.components) and column.component is not None:
        return source[column.component]
    return ", ".join(source)


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
