"""A recording as one table: components of signals as columns, samples as rows."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Event, Recording, SignalArray, about

# Units of the components where they differ within a signal.
_MIXED_UNITS: dict[str, tuple[str, ...]] = {"wrench_command": ("N", "N m", "N m", "N m")}
_RESERVED_NAMES = ("time", "host_time")
MARKED_COLUMN = "marked"


@dataclass(frozen=True, slots=True)
class SignalEntry:
    """All that is known of a signal besides its samples (see `SignalArray`)."""

    name: str  # in the recording
    components: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]  # their names, ("",) for a scalar
    quantity: str
    unit: str
    frame: str
    clock: str
    stream: str
    source: tuple[str, ...]
    marked: bool = False  # True if some of its samples are marked

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each component."""
        mixed, count = _MIXED_UNITS.get(self.quantity, ()), len(self.components)
        return mixed if len(mixed) == count else (self.unit,) * count


def entry_of(name: str, array: SignalArray) -> SignalEntry:
    """The entry of a signal."""
    count = array.value.shape[1]
    parts = array.components if len(array.components) == count else tuple(str(i) for i in range(count))
    return SignalEntry(name, ("",) if count == 1 else parts, **about(array), marked=bool(array.marked.any()))


@dataclass(frozen=True, slots=True)
class Description:
    """All that a recording holds besides samples; of a recording in parts: of all parts together."""

    source: str  # as in `Recording`
    entries: tuple[SignalEntry, ...]  # one a signal, in the order of the recording
    origin: float = 0.0  # origin, metadata, findings, events: as in `Recording`
    metadata: dict[str, dict[str, str]] | None = None
    findings: tuple[Finding, ...] = ()
    events: tuple[Event, ...] = ()

    @property
    def columns(self) -> tuple["Column", ...]:
        """The columns after `time` and `host_time`: components, and a flag for signals with marked samples."""
        used = set(_RESERVED_NAMES)
        columns = []
        for entry in self.entries:
            wanted = [f"{entry.name}_{part}" if part else entry.name for part in entry.components]
            units = list(entry.units)
            if entry.marked:
                wanted.append(f"{entry.name}_{MARKED_COLUMN}")
                units.append("")
            for component, (name, unit) in enumerate(zip(wanted, units, strict=True)):
                unique = unique_name(_printable(name), used)
                columns.append(Column(unique, unit, entry, component if component < len(entry.components) else None))
        return tuple(columns)


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table."""

    name: str  # unique, printable, without unit: "position_x", "voltage", "position_marked"
    unit: str  # of its numbers
    entry: SignalEntry  # the signal
    component: int | None  # number of the component; None for the flag of marked samples

    @property
    def title(self) -> str:
        """Header of a CSV column: "position_x [m]"; no brackets without a unit."""
        return f"{self.name} [{_printable(self.unit)}]" if self.unit else self.name


def unique_name(wanted: str, used: set[str]) -> str:
    """The name, with "#2", "#3", ... added if it is in `used`, to which the result is added."""
    name, number = wanted, 1
    while name in used:
        number += 1
        name = f"{wanted}#{number}"
    used.add(name)
    return name


def describe(parts: Iterable[Recording]) -> Description:
    """The description of a recording from all its parts; one part is in memory at a time."""
    source, origin = "", 0.0
    entries: dict[str, SignalEntry] = {}
    metadata: dict[str, dict[str, str]] = {}
    findings: dict[tuple[str, str, str], Finding] = {}
    events: list[Event] = []
    for part in parts:
        source, origin = part.source, part.origin
        for name, array in part.signals.items():
            entry = entry_of(name, array)
            known = entries.get(name)
            entries[name] = entry if known is None else replace(known, marked=known.marked or entry.marked)
        for section, values in part.metadata.items():
            metadata.setdefault(section, {}).update(values)
        for finding in part.findings:
            key = (finding.check, finding.signal, finding.text)
            known_finding = findings.get(key)
            if known_finding is None:
                findings[key] = finding
            else:
                findings[key] = replace(known_finding, intervals=(*known_finding.intervals, *finding.intervals))
        events.extend(part.events)
    return Description(source, tuple(entries.values()), origin, metadata, tuple(findings.values()), tuple(events))


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Consecutive rows of a table: runs of samples, in processing order, with one stamp and one host time."""

    time: NDArray[np.float64]  # (r,) s
    host_time: NDArray[np.float64]  # (r,) s since the epoch, NaN where unknown
    row: dict[str, NDArray[np.int64]]  # signal -> (n,) row of each of its samples, ascending
    sample: dict[str, NDArray[np.int64]]  # signal -> (n,) number of that sample in its array


def rows_of(recording: Recording, names: Iterable[str], *, samples: int = 1 << 16) -> Iterator[Rows]:
    """The named signals as rows, in blocks, so that the extra memory does not grow with the recording.

    Consecutive samples (in processing order) share a row if their stamps and host times are equal bit for bit and the
    columns of the later sample are further right. So row by row, from left to right, is the processing order.

    Args:
        names: in the order of the columns; names that the recording does not have are left out.
        samples: largest number of samples of a signal in a block.
    """
    arrays = {name: recording.signals[name] for name in names if name in recording.signals}
    # numbers of the samples in processing order; None if they are in this order already
    places = {
        name: None if (a.order[1:] >= a.order[:-1]).all() else np.argsort(a.order, kind="stable")
        for name, a in arrays.items()
    }
    orders = {name: a.order if (p := places[name]) is None else a.order[p] for name, a in arrays.items()}
    at, most = dict.fromkeys(arrays, 0), samples
    while any(at[name] < order.size for name, order in orders.items()):
        ends = _ends(orders, at, most)
        spans = {name: np.arange(at[name], ends[name]) for name in arrays}
        taken = {name: span if (p := places[name]) is None else p[span] for name, span in spans.items()}
        rows = _rows(arrays, taken)
        if any(ends[name] < order.size for name, order in orders.items()):
            if rows.time.size < 2:  # the first row may continue in the next block
                most *= 2
                continue
            rows = _without_last(rows)  # the last row may continue too
            ends = {name: at[name] + rows.row[name].size for name in arrays}
        yield rows
        at, most = ends, samples


def _ends(orders: dict[str, NDArray[np.int64]], at: dict[str, int], most: int) -> dict[str, int]:
    """End of the block for each signal: `most` samples of one signal, fewer of the others; at least one sample."""
    full = [order[at[name] + most] for name, order in orders.items() if at[name] + most < order.size]
    if not full:
        return {name: order.size for name, order in orders.items()}
    # samples with the same order stay together
    first = min(int(order[at[name]]) for name, order in orders.items() if at[name] < order.size)
    limit = max(int(min(full)), first + 1)
    return {name: int(np.searchsorted(order, limit)) for name, order in orders.items()}


def _rows(arrays: dict[str, SignalArray], taken: dict[str, NDArray[np.int64]]) -> Rows:
    """Rows of some samples of each signal."""
    order = np.concatenate([a.order[taken[name]] for name, a in arrays.items()])
    place = np.concatenate([np.full(t.size, i, np.int32) for i, t in enumerate(taken.values())])
    sample = np.concatenate(list(taken.values()))
    time = np.concatenate([np.asarray(a.time, float)[taken[name]] for name, a in arrays.items()])
    host = np.concatenate([np.asarray(a.host_time, float)[taken[name]] for name, a in arrays.items()])
    by_order = np.argsort(order, kind="stable")
    place, sample, time, host = place[by_order], sample[by_order], time[by_order], host[by_order]
    for stamps in (time, host):
        stamps[np.isnan(stamps)] = np.nan  # one bit pattern, so that unknown equals unknown
    starts = np.ones(time.size, bool)
    starts[1:] = (
        (time[1:].view(np.int64) != time[:-1].view(np.int64))
        | (host[1:].view(np.int64) != host[:-1].view(np.int64))
        | (place[1:] <= place[:-1])
    )
    row = np.cumsum(starts) - 1
    where = [np.flatnonzero(place == i) for i in range(len(arrays))]
    return Rows(
        time[starts],
        host[starts],
        {name: row[w] for name, w in zip(arrays, where, strict=True)},
        {name: sample[w] for name, w in zip(arrays, where, strict=True)},
    )


def _without_last(rows: Rows) -> Rows:
    count = rows.time.size - 1
    kept = {name: int(np.searchsorted(row, count)) for name, row in rows.row.items()}
    return Rows(
        rows.time[:count],
        rows.host_time[:count],
        {name: row[: kept[name]] for name, row in rows.row.items()},
        {name: sample[: kept[name]] for name, sample in rows.sample.items()},
    )


def _printable(name: str) -> str:
    """A name on one line of text; characters that cannot be printed become question marks."""
    return "".join(c if c.isprintable() else "?" for c in name)


def name_and_unit(title: str) -> tuple[str, str]:
    """Name and unit in the header of a column; unit "" without brackets."""
    found = re.fullmatch(r"(.*) \[([^\[\]]*)\]", title)
    return (found.group(1), found.group(2)) if found else (title, "")
