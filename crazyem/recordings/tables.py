"""From tables of firmware variables to signals, a column at a time: what every reader of firmware logs ends with."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.recording import SignalArray
from crazyem.signals.firmware_units import unit_of
from crazyem.signals.sample import SIGNALS
from crazyem.signals.vocabulary import DUTY_SOURCES, REQUEST_SOURCES, SOURCES, Source

MEANINGS = ("duty", "request")


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of variables that were sampled together: a log block, a uSD event, a topic.

    Attributes:
        name: of the table; becomes the `stream` of its signals.
        columns: firmware variable -> (n,) raw values, firmware units, in the type they were stored in.
        time: (n,) s.
        order: (n,) position of each row among the rows of all tables of the recording, as processed.
        host_time: (n,) s since the epoch, None where unknown.
        clock: as in `SignalArray`.
        ctypes: firmware variable -> C type, where known.
    """

    name: str
    columns: Mapping[str, NDArray[np.generic]]
    time: NDArray[np.float64]
    order: NDArray[np.int64]
    host_time: NDArray[np.float64] | None = None
    clock: str = "firmware"
    ctypes: Mapping[str, str] = field(default_factory=dict)


def signals_from_tables(tables: Iterable[Table], *, motor: str | None) -> dict[str, SignalArray]:
    """Signals by name: those of the vocabulary from their best source, then every other variable under its own name.

    Args:
        tables: of one recording.
        motor: what motor.m1..4 is: "duty" (PWM sent, after battery compensation), "request" (thrust asked for, before
            it), or None where nobody knows; then it stays a column without a meaning.
    """
    tables = tuple(tables)
    chosen: dict[str, tuple[Table, Source]] = {}
    for source in _sources(motor):
        if source.signal not in chosen:
            table = next((t for t in tables if set(source.variables) <= t.columns.keys()), None)
            if table is not None:
                chosen[source.signal] = (table, source)
    used = {(table.name, v) for table, source in chosen.values() for v in source.variables}
    rest = [(table, name) for table in tables for name in table.columns if (table.name, name) not in used]
    several = {name for _, name in rest if sum(n == name for _, n in rest) > 1 or name in SIGNALS}
    # room for every signal of a row, so that orders are unique and follow the rows
    step = len(chosen) + len(rest)
    signals: dict[str, SignalArray] = {}
    place = 0
    for name in SIGNALS:
        if name in chosen:
            table, source = chosen[name]
            raw = [table.columns[v] for v in source.variables]
            value = source.convert.many(raw)  # type: ignore[arg-type]
            sound = np.logical_and.reduce([np.isfinite(np.asarray(c, float)) for c in raw])
            signals[name] = _array(table, value, place, step, name, source.variables, sound)
            place += 1
    for table, name in rest:
        value = np.asarray(table.columns[name], float)[:, None]
        label = f"{name}@{table.name}" if name in several else name
        signals[label] = _array(table, value, place, step, "", (name,), None)
        place += 1
    return signals


def _sources(motor: str | None) -> tuple[Source, ...]:
    first = {"duty": DUTY_SOURCES, "request": REQUEST_SOURCES, None: DUTY_SOURCES[:1]}[motor]
    return (*first, *(s for s in SOURCES if s.signal != "motor_command"))


def _array(
    table: Table,
    value: NDArray[np.float64],
    place: int,
    step: int,
    quantity: str,
    source: tuple[str, ...],
    sound: NDArray[np.bool_] | None,
) -> SignalArray:
    n = table.time.size
    # a NaN that decoding made of valid values (a rotor speed of 65535 is "missing") is ours, not the file's
    ours = np.zeros(n, bool) if sound is None else sound & ~np.isfinite(value).all(axis=1)
    unit, frame = SIGNALS[quantity][1:] if quantity else (unit_of(source[0]), "")
    return SignalArray(
        table.time,
        value,
        table.order * step + place,
        np.full(n, np.nan) if table.host_time is None else table.host_time,
        ours,
        quantity=quantity,
        unit=unit,
        frame=frame,
        clock=table.clock,
        stream=table.name,
        source=source,
    )
