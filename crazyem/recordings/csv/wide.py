"""Read wide CSV files, one row per instant: at once, or in parts if they are larger than memory."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import GrowingArray
from crazyem.recordings.csv.interpolation import CONTEXT_ROWS
from crazyem.recordings.csv.mapping import CsvMapping
from crazyem.recordings.csv.signals import Layout, Rows, signals_of
from crazyem.recordings.csv.text import Columns, Damage, Header, read_columns
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import Recording
from crazyem.signals.sample import SIGNALS

Array = NDArray[np.float64]
_MOST_ROWS = 500_000  # in a part, at any stamps


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


class _Held:
    """Rows that are read but not yet returned, one array per column (a single copy of the data)."""

    def __init__(self) -> None:
        self.arrays: dict[int, GrowingArray] = {}
        self.rows = 0

    def add(self, block: Columns) -> None:
        """Append rows."""
        more = next((values.size for values in block.values()), 0)
        for c, values in block.items():
            self.arrays.setdefault(c, GrowingArray(float)).more(more)[:] = values
        self.rows += more

    def joined(self) -> Columns:
        """One array per column."""
        return {c: array.rows for c, array in self.arrays.items()}


def read_wide(path: Path, header: Header, mapping: CsvMapping, *, as_published: bool) -> Recording:
    """The whole file. Raises FileFormatError."""
    plan = _planned(path, header, mapping, as_published)
    damage = Damage()
    held = _Held()
    for block in read_columns(path, header, plan.needed, plan.wanted, damage, stamp=plan.stamp):
        held.add(block)
    if not held.rows:
        raise FileFormatError(f"{path}: there is a header but not a single sample.")
    columns = held.joined()
    held.arrays = {}
    stamp = _stamps(plan, columns, held.rows, 0)
    first = float(stamp[0]) + 0.0  # no minus zero
    origin = first if _reversible(stamp, first) else 0.0
    rows = Rows(stamp, origin, _named(plan, columns), (0, stamp.size))
    del columns, block  # so that each column can be freed when its signal exists
    return _recording(plan, rows, damage, last=True)


def read_wide_parts(
    path: Path, header: Header, mapping: CsvMapping, *, as_published: bool, seconds: float
) -> Iterator[Recording]:
    """The file in parts of about `seconds`; joined they equal the result of `read_wide`. Raises FileFormatError."""
    plan = _planned(path, header, mapping, as_published)
    origin = _origin(plan)
    damage = Damage()
    before: Columns = {}  # the last rows of the previous part, as neighbours
    flown: dict[str, float] = {}
    number = 0
    for part, after, ends in _parts(plan, damage, seconds):
        rows = next(iter(part.values())).size
        blocks = [block for block in (before, part, after) if block]
        window = {c: np.concatenate([block[c] for block in blocks]) for c in part}
        lead = next(iter(before.values())).size if before else 0
        end, starts = lead + rows, number == lead
        stamp = _stamps(plan, window, next(iter(window.values())).size, number - lead)
        kept = Rows(stamp, origin, _named(plan, window), (lead, end), number, starts=starts, ends=ends, flown=flown)
        yield _recording(plan, kept, damage, last=ends)
        number += rows
        before = {c: window[c][max(0, end - CONTEXT_ROWS) : end].copy() for c in window}


def _parts(plan: _Plan, damage: Damage, seconds: float) -> Iterator[tuple[Columns, Columns, bool]]:
    """(rows of a part, some rows after it, whether the part ends the file)."""
    held = _Held()
    number = 0
    blocks = read_columns(plan.path, plan.header, plan.needed, plan.wanted, damage, stamp=plan.stamp)
    # the rows held at the end may be several parts, because a part waits for its neighbours
    for block, neighbours in itertools.chain(zip(blocks, itertools.repeat(CONTEXT_ROWS)), [({}, 1)]):
        held.add(block)
        while (cut := _cut(plan, held, number, seconds, neighbours)) is not None:
            columns = held.joined()
            rest = {c: v[cut:].copy() for c, v in columns.items()}
            number += cut
            held = _Held()
            held.add(rest)
            yield {c: v[:cut] for c, v in columns.items()}, {c: v[:CONTEXT_ROWS] for c, v in rest.items()}, False
    if held.rows:
        yield held.joined(), {}, True
    elif not number:
        raise FileFormatError(f"{plan.path}: there is a header but not a single sample.")


def _cut(plan: _Plan, held: _Held, number: int, seconds: float, neighbours: int) -> int | None:
    """Number of rows of the next part, None if it is not complete yet."""
    if held.rows <= neighbours:
        return None
    stamp = _stamps(plan, held.joined(), held.rows, number)
    late = stamp >= stamp[0] + seconds
    cut = max(1, min(int(np.argmax(late)) if late.any() else held.rows + 1, _MOST_ROWS))
    return cut if cut + neighbours <= held.rows else None


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


def _named(plan: _Plan, columns: Columns) -> dict[str, Array]:
    return {plan.header.names[c]: values for c, values in columns.items()}


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
    notes = (*plan.notes, *damage_notes(damage, plan.header.names)) if last else plan.notes
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


def damage_notes(damage: Damage, names: Sequence[str] = ()) -> list[Finding]:
    """Findings about damaged lines and fields of a file whose columns have these names."""
    notes = []
    if damage.dropped:
        where = ", ".join(map(str, damage.lines)) + (", ..." if damage.dropped > len(damage.lines) else "")
        text = f"{damage.dropped} damaged lines were dropped (line {where}): {damage.first}."
        notes.append(note("integrity", text, Grade.DEGRADES, lines=float(damage.dropped)))
    if damage.cut_gzip:
        text = "The gzip file ends early; what was packed before its end was read."
        notes.append(note("integrity", text, Grade.DEGRADES))
    if damage.cut_line and not damage.cut_gzip:
        notes.append(note("integrity", "The last line is cut short and was dropped."))
    for column, count in damage.words.items():
        notes.append(note("integrity", f"{count} values in column {names[column]} are no numbers.", count=float(count)))
    return notes


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(name[:40] for name in names[:8])
    return shown + (f" and {len(names) - 8} more" if len(names) > 8 else "")
