"""Read flights from CSV files (plain or gzip) with a mapping that the user gives or the header determines."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import GrowingArray, ReadOptions
from crazyem.recordings.csv.long import read_long
from crazyem.recordings.csv.mapping import CsvMapping, known_mappings, mapping_for
from crazyem.recordings.csv.signals import CONTEXT_ROWS, Layout, Rows, signals_of
from crazyem.recordings.csv.text import Columns, Damage, Header, parse_header_line, read_columns, read_header
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording
from crazyem.signals.sample import SIGNALS

_MOST_ROWS = 500_000  # in a part, at any stamps


def recognises(head: bytes) -> bool:
    """True if the first line looks like a CSV header: text with at least two names and delimiters."""
    try:
        names, _ = parse_header_line(head.split(b"\n", 1)[0].decode("utf-8-sig"))
    except UnicodeDecodeError:
        return False
    return len(names) > 1 and all(name.isprintable() for name in names)


def has_mapping(path: Path) -> bool:
    """Whether a shipped mapping knows the columns of this file. Raises FileFormatError if it has no readable header."""
    columns = set(read_header(path).names)
    return any(set(mapping.recognise) <= columns for mapping in known_mappings())


@dataclass(frozen=True, slots=True)
class _Plan:
    """How to read the file, known before the first row."""

    path: Path
    header: Header
    mapping: CsvMapping
    layout: Layout
    stamp: int | None
    needed: tuple[int, ...]
    wanted: tuple[int, ...]
    notes: tuple[Finding, ...]
    as_published: bool


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a CSV flight. Raises FileFormatError naming the file and what is wrong with it."""
    return next(read_parts(path, options, math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Read a CSV flight in parts of about `seconds` each, in bounded memory.

    The joined arrays of a signal, with `order`, equal those of `read`; each part has its own findings. Files in long
    form come in one part. Raises FileFormatError, possibly after some parts.
    """
    header = read_header(path)
    mapping = mapping_for(header.names, options.mapping, path)
    if mapping.layout == "long":
        yield read_long(path, header, mapping, options)
        return
    plan = _planned(path, header, mapping, options.as_published)
    origin = _origin(plan) if seconds < math.inf else None
    damage = Damage()
    before: Columns = {}  # the last rows of the previous part, as neighbours
    flown: dict[str, float] = {}
    number = 0
    for part, after, ends in _parts(plan, damage, seconds):
        lead, count = _rows_in(before), _rows_in(part)
        end = lead + count
        window = {c: _joined([block[c] for block in (before, part, after) if block]) for c in part}
        del part
        stamp = _stamps(plan, window, end + _rows_in(after), number - lead)
        if origin is None:
            first = float(stamp[0]) + 0.0  # no minus zero
            origin = first if _reversible(stamp, first) else 0.0
        before = {c: window[c][max(0, end - CONTEXT_ROWS) : end].copy() for c in window}
        # only the rows hold the columns, so that each column can be freed when its signal exists
        columns = {header.names[c]: window.pop(c) for c in list(window)}
        rows = Rows(stamp, origin, columns, (lead, end), number, starts=number == lead, ends=ends, flown=flown)
        yield _recording(plan, rows, damage, last=ends)
        number += count


def _rows_in(columns: Columns) -> int:
    return next((values.size for values in columns.values()), 0)


def _joined(blocks: list[Array]) -> Array:
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def _parts(plan: _Plan, damage: Damage, seconds: float) -> Iterator[tuple[Columns, Columns, bool]]:
    """(rows of a part, some rows after it, whether the part ends the file)."""
    held: dict[int, GrowingArray] = {}
    columns: Columns = {}
    number = 0
    blocks = read_columns(plan.path, plan.header, plan.needed, plan.wanted, damage, stamp=plan.stamp)
    # the rows held at the end may be several parts, because a part waits for its neighbours
    for block, neighbours in itertools.chain(zip(blocks, itertools.repeat(CONTEXT_ROWS)), [({}, 1)]):
        columns = _appended(held, block)
        while (cut := _cut(plan, columns, number, seconds, neighbours)) is not None:
            rest = {c: v[cut:].copy() for c, v in columns.items()}
            number += cut
            yield {c: v[:cut] for c, v in columns.items()}, {c: v[:CONTEXT_ROWS] for c, v in rest.items()}, False
            held = {}
            columns = _appended(held, rest)
    if columns:
        held = {}
        yield {c: columns.pop(c) for c in list(columns)}, {}, True
    elif not number:
        raise FileFormatError(f"{plan.path}: there is a header but not a single sample.")


def _appended(held: dict[int, GrowingArray], block: Columns) -> Columns:
    """All rows, one array per column (a single copy of the data), after those of a block are appended to `held`."""
    for c, values in block.items():
        held.setdefault(c, GrowingArray(float)).more(values.size)[:] = values
    return {c: array.rows for c, array in held.items() if array.size}


def _cut(plan: _Plan, columns: Columns, number: int, seconds: float, neighbours: int) -> int | None:
    """Number of rows of the next part, None if it is not complete yet."""
    count = _rows_in(columns)
    if count <= neighbours or seconds == math.inf:
        return None
    stamp = _stamps(plan, columns, count, number)
    late = stamp >= stamp[0] + seconds
    cut = max(1, min(int(np.argmax(late)) if late.any() else count + 1, _MOST_ROWS))
    return cut if cut + neighbours <= count else None


def _origin(plan: _Plan) -> float:
    """The first stamp if adding it to the times gives all stamps exactly, else 0; reads all stamps once."""
    if plan.stamp is None:
        return 0.0
    first = math.nan
    # with all needed columns, so that the same damaged lines are dropped as in the main pass
    for block in read_columns(plan.path, plan.header, plan.needed, (), Damage(), stamp=plan.stamp):
        stamp = _stamps(plan, block, 0, 0)
        first = float(stamp[0]) + 0.0 if math.isnan(first) else first
        if not _reversible(stamp, first):
            return 0.0
    return 0.0 if math.isnan(first) else first


def _reversible(stamp: Array, first: float) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool((first + (stamp - first) == stamp).all())


def _stamps(plan: _Plan, columns: Columns, rows: int, number: int) -> Array:
    if plan.stamp is None:
        return (number + np.arange(rows)) / plan.mapping.rate
    with np.errstate(over="ignore"):
        return columns[plan.stamp] / plan.mapping.time[1]


def _planned(path: Path, header: Header, mapping: CsvMapping, as_published: bool) -> _Plan:
    given = mapping.published if as_published else mapping.signals
    present = set(header.names)
    notes = [
        note("mapping", f"The file has no columns for {name}.")
        for name, s in given.items()
        if not present.issuperset(s.columns)
    ]
    # first the vocabulary in its order, as in the live loop; then further measurements
    ranked = [*(n for n in SIGNALS if n in given), *(n for n in given if n not in SIGNALS)]
    signals = {n: given[n] for n in ranked if present.issuperset(given[n].columns)}
    if not signals and given:
        name, source = next(iter(given.items()))
        gone = next(c for c in source.columns if c not in present)
        raise FileFormatError(
            f"{path}: no signal of the mapping {mapping.name} is in the file; "
            f"{name}, for one, needs the column {gone[:60]}."
        )
    for name, source in signals.items():
        if source.frame and source.attitude not in signals:
            raise FileFormatError(
                f"{path}: {name} is given in the {source.frame} frame, but there is no {source.attitude} to turn it."
            )
    at = {name: place for place, name in enumerate(header.names)}
    time = mapping.time[0]
    if time not in at:  # loggers write "Time" or "time"
        time = next((name for name in at if name.lower() == time.lower()), time)
    if time and time not in at:
        raise FileFormatError(f"{path}: the column {time}, which has the time, is missing.")
    stamp = at[time] if time else None
    if stamp is None:
        text = f"There are no stamps; rows are taken to be {1.0 / mapping.rate:g} s apart."
        notes.append(note("mapping", text, Grade.DEGRADES))
    if header.repeated:
        notes.append(note("mapping", f"Columns occur more than once: {_some(header.repeated)}; the first one counts."))
    needed = dict.fromkeys(([] if stamp is None else [stamp]) + [at[c] for s in signals.values() for c in s.columns])
    rest = [c for c in range(len(header.names)) if c not in needed and c not in header.hollow]
    words = [header.names[c] for c in rest if c in header.words]
    if words:
        notes.append(note("mapping", f"Columns of words are not kept: {_some(words)}."))
    wanted = tuple(c for c in rest if c not in header.words)
    packet_of = {c: p for p, members in mapping.packets.items() for c in members}
    taken = set(signals)
    raw = {}
    for c in wanted:
        column = header.names[c]
        name = f"column:{column}" if column in taken or column.partition("@")[0] in SIGNALS else column
        taken.add(name)
        raw[column] = (name, mapping.units.get(column, ""), packet_of.get(column))
    packets = {
        p: tuple(dict.fromkeys(c for s in signals.values() if s.packet == p for c in s.columns))
        + tuple(c for c in mapping.packets.get(p, ()) if c in raw)
        for p in dict.fromkeys([*(s.packet for s in signals.values() if s.packet), *mapping.packets])
    }
    layout = Layout(signals, raw, {p: members for p, members in packets.items() if members}, mapping.clock)
    return _Plan(path, header, mapping, layout, stamp, tuple(needed), wanted, tuple(notes), as_published)


def _recording(plan: _Plan, rows: Rows, damage: Damage, *, last: bool) -> Recording:
    start = float(rows.stamp[rows.keep[0]]) if plan.stamp is not None else math.nan
    signals, findings = signals_of(plan.layout, rows)
    notes = (*plan.notes, *damage.findings(plan.header.names)) if last else plan.notes
    metadata = {
        "csv": {
            "mapping": plan.mapping.name,
            "title": plan.mapping.title,
            "as_published": str(plan.as_published).lower(),
            "start_time": "" if math.isnan(start) else repr(start),
        }
    }
    if plan.mapping.claims:
        metadata["claims"] = dict(plan.mapping.claims)
    return Recording(
        str(plan.path), f"csv:{plan.mapping.name}", signals, metadata, (*notes, *findings), origin=rows.origin
    )


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(name[:40] for name in names[:8])
    return shown + (f" and {len(names) - 8} more" if len(names) > 8 else "")
