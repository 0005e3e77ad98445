"""Flights in CSV files (plain or gzip), through a mapping chosen by the header."""

import csv
import gzip
import io
import math
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.links.clock import StampUnwrapper
from crazyem.recordings.finding import note
from crazyem.recordings.interpolation import interpolated_rows
from crazyem.recordings.mapping import CsvMapping, SignalColumns, known_mappings
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.packets import signals_from_packets
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.packet import Block, Packet, Variable
from crazyem.signals.sample import SIGNALS, Sample


def recognises(head: bytes) -> bool:
    """True if the first line reads like a CSV header: text, at least two comma-separated names."""
    line = head.split(b"\n", 1)[0]
    try:
        names = _header(line.decode("utf-8-sig"))
    except UnicodeDecodeError:
        return False
    return len(names) > 1 and all(name.isprintable() for name in names)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a CSV flight. Raises FileFormatError naming the file and what is wrong with it."""
    try:
        raw = path.read_bytes()
        if raw[:2] == b"\x1f\x8b":
            raw = gzip.decompress(raw)
        text = raw.decode("utf-8-sig")
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise FileFormatError(f"{path} is not a readable gzip file ({error}).") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file (byte {error.start} is not UTF-8).") from error
    first, _, body = text.partition("\n")
    header = _header(first)
    for mapping in known_mappings():
        if set(mapping.recognise).issubset(header):
            break
    else:
        known = ", ".join(m.title for m in known_mappings())
        raise FileFormatError(f"{path}: the columns ({', '.join(header[:6])}, ...) are of no known format ({known}).")
    notices: list[str] = []
    reader = _read_wide if mapping.layout == "wide" else _read_long
    signals, metadata = reader(path, mapping, header, body, notices)
    if not any(array.time.size for array in signals.values()):
        raise FileFormatError(f"{path}: there is a header but not a single sample.")
    return Recording(str(path), f"csv:{mapping.name}", signals, metadata, tuple(note("mapping", n) for n in notices))


def _header(line: str) -> list[str]:
    return [name.strip() for name in line.strip().split(",")]


def _read_wide(
    path: Path, mapping: CsvMapping, header: list[str], body: str, notices: list[str]
) -> tuple[dict[str, SignalArray], dict[str, dict[str, str]]]:
    signals = {name: s for name, s in mapping.signals.items() if set(s.columns).issubset(header)}
    for name in mapping.signals.keys() - signals.keys():
        notices.append(f"The file has no columns for {name}.")
    wanted = list(dict.fromkeys([mapping.time[0], *(c for s in signals.values() for c in s.columns)]))
    missing = [c for c in wanted if c not in header]
    if missing:
        raise FileFormatError(f"{path}: the column {missing[0]} is missing.")
    table = _numbers(path, header, wanted, body, notices)
    columns = {name: table[:, i] for i, name in enumerate(wanted)}
    clock = columns[mapping.time[0]] * mapping.time[1]
    if not np.isfinite(clock).all():
        raise FileFormatError(f"{path}: row {int(np.argmin(np.isfinite(clock))) + 2} has no time.")
    time = clock - clock[0] if clock.size else clock
    if (np.diff(time) <= 0).any():
        notices.append(f"{int((np.diff(time) <= 0).sum())} rows do not come after the row before them in time.")

    straight: dict[str, NDArray[np.bool_]] = {}
    for packet in dict.fromkeys(s.packet for s in signals.values() if s.packet):
        members = dict.fromkeys(c for s in signals.values() if s.packet == packet for c in s.columns)
        straight[packet] = interpolated_rows(time, np.column_stack([columns[c] for c in members]))
        if straight[packet].any():
            share = 100.0 * straight[packet].mean()
            notices.append(
                f"{share:.1f} % of the {packet} samples lie on straight lines drawn across lost packets "
                f"(the longest {_longest(time, straight[packet]):.2f} s); they are treated as missing."
            )

    arrays = {}
    names = [name for name in SIGNALS if name in signals]
    rows = np.arange(time.size)
    for place, name in enumerate(names):
        source = signals[name]
        marked = np.zeros(time.size, bool)
        if source.above is None:
            value = np.column_stack([columns[c] * f for c, f in zip(source.columns, source.scale, strict=True)])
            if source.packet:
                marked = straight[source.packet]
                value[marked] = np.nan
        else:
            value = _held(time, np.column_stack([columns[c] for c in source.columns]), source)[:, None]
        arrays[name] = SignalArray(time, value, (rows * len(names) + place).astype(np.int64), clock, marked)
    return arrays, {"csv": {"mapping": mapping.name, "start_time": repr(float(clock[0])) if clock.size else ""}}


def _longest(time: NDArray[np.float64], rows: NDArray[np.bool_]) -> float:
    """Duration of the longest run of True [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8)))
    return float(max((time[last - 1] - time[first] for first, last in zip(edges[::2], edges[1::2])), default=0.0))


def _held(time: NDArray[np.float64], values: NDArray[np.float64], source: SignalColumns) -> NDArray[np.float64]:
    """1 where any column exceeded the threshold within the last `hold` seconds, else 0."""
    threshold = 0.0 if source.above is None else source.above
    on = (values > threshold).any(axis=1)
    last_on = np.maximum.accumulate(np.where(on, time, -math.inf))
    return (time - last_on <= source.hold).astype(float)


def _numbers(path: Path, header: list[str], wanted: list[str], body: str, notices: list[str]) -> NDArray[np.float64]:
    """(n, len(wanted)) table of the wanted columns; empty fields are NaN, a cut last line is dropped and reported."""
    where = [header.index(name) for name in wanted]
    if not body.strip():
        return np.empty((0, len(wanted)))
    if body.endswith("\n"):
        try:
            return np.loadtxt(io.StringIO(body), delimiter=",", usecols=where, ndmin=2, comments=None)
        except ValueError:
            pass  # empty fields, ragged or damaged rows: look at them one by one
    rows = []
    lines = list(csv.reader(io.StringIO(body)))
    for number, fields in enumerate(lines, start=2):
        if not fields:
            continue
        last = number == len(lines) + 1
        if len(fields) != len(header) or (last and not body.endswith("\n")):
            if last:
                notices.append("The last line is cut short and was dropped.")
                continue
            raise FileFormatError(f"{path}: line {number} has {len(fields)} fields, the header has {len(header)}.")
        rows.append([_number(path, number, header[i], fields[i]) for i in where])
    return np.array(rows, float).reshape(len(rows), len(wanted))


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        return float(text) if text.strip() else math.nan
    except ValueError:
        raise FileFormatError(f'{path}: line {line}, column {column}: "{text[:20]}" is not a number.') from None


def _read_long(
    path: Path, mapping: CsvMapping, header: list[str], body: str, notices: list[str]
) -> tuple[dict[str, SignalArray], dict[str, dict[str, str]]]:
    at = {key: header.index(column) for key, column in mapping.columns.items()}
    h, b, s, n, v = (at[key] for key in ("host_time", "block", "stamp_ms", "name", "value"))
    host_variables = {name for signal in mapping.signals.values() for name in signal.columns}
    # consecutive rows of one packet share block, stamp and arrival
    grouped: list[tuple[tuple[str, str, str], list[str], list[float]]] = []
    lines = list(csv.reader(io.StringIO(body)))
    for number, fields in enumerate(lines, start=2):
        if not fields:
            continue
        if len(fields) != len(header) or (number == len(lines) + 1 and not body.endswith("\n")):
            if number == len(lines) + 1:
                notices.append("The last line is cut short and was dropped.")
                continue
            raise FileFormatError(f"{path}: line {number} has {len(fields)} fields, the header has {len(header)}.")
        key = (fields[h], fields[b], fields[s])
        value = _number(path, number, fields[n], fields[v])
        if grouped and grouped[-1][0] == key and fields[n] not in grouped[-1][1]:
            grouped[-1][1].append(fields[n])
            grouped[-1][2].append(value)
        else:
            grouped.append((key, [fields[n]], [value]))

    layouts: dict[str, tuple[int, tuple[str, ...]]] = {}
    stamps: dict[int, list[int]] = {}
    items: list[Packet | Sample] = []
    unwrapper = StampUnwrapper()
    now = math.nan
    torn = 0
    for (host_text, block, stamp_text), names, values in grouped:
        host_time = _number(path, 0, mapping.columns["host_time"], host_text)
        if host_variables.issuperset(names):
            items.extend(_host_samples(mapping, names, values, now, host_time))
            continue
        identifier, layout = layouts.setdefault(block, (len(layouts), tuple(names)))
        if layout != tuple(names):
            torn += 1
            continue
        stamp = _number(path, 0, mapping.columns["stamp_ms"], stamp_text)
        if not math.isfinite(stamp):
            raise FileFormatError(f'{path}: "{stamp_text[:20]}" is not a firmware stamp.')
        time_ms = unwrapper.unwrap(int(stamp))
        now = time_ms / 1000.0
        stamps.setdefault(identifier, []).append(time_ms)
        items.append(Packet(identifier, time_ms, host_time, tuple(values)))
    if torn:
        notices.append(f"{torn} packets were incomplete and were dropped.")
    blocks = tuple(
        Block(i, tuple(Variable(name, "float") for name in names), _period(stamps.get(i, [])))
        for i, names in layouts.values()
    )
    metadata = {"blocks": {name: " ".join(names) for name, (_, names) in layouts.items()}}
    metadata["csv"] = {"mapping": mapping.name}
    return signals_from_packets(blocks, items, skip=frozenset(mapping.signals)), metadata


def _host_samples(
    mapping: CsvMapping, names: list[str], values: list[float], now: float, host_time: float
) -> list[Sample]:
    """What the host said itself, put on the firmware clock at the newest stamp seen (nothing before the first)."""
    given = dict(zip(names, values, strict=True))
    if not math.isfinite(now):
        return []
    return [
        Sample(signal, now, tuple(given[c] * f for c, f in zip(source.columns, source.scale, strict=True)), host_time)
        for signal, source in mapping.signals.items()
        if set(source.columns).issubset(given)
    ]


def _period(stamps: list[int]) -> int:
    return round(float(np.median(np.diff(stamps)))) if len(stamps) > 1 else 0
