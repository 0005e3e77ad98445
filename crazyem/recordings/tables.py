"""Signals from tables of firmware variables: the last step of every reader of firmware logs."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.recording import SignalArray
from crazyem.recordings.topics import Topic
from crazyem.signals.firmware_units import unit_of
from crazyem.signals.sample import SIGNALS
from crazyem.signals.vocabulary import DUTY_SOURCES, REQUEST_SOURCES, SOURCES, Source

MOTOR_MEANINGS = ("duty", "request")


@dataclass(frozen=True, slots=True, eq=False)
class Table(Topic):
    """Rows of firmware variables that were sampled together: a log block, a uSD event, a topic.

    Attributes:
        ctypes: firmware variable -> C type, where known.
    """

    clock: str = "firmware"
    ctypes: Mapping[str, str] = field(default_factory=dict)


@np.errstate(invalid="ignore")  # the cast to double turns a signalling NaN (damaged bytes) into a quiet one
def signals_from_tables(tables: Iterable[Table], *, motor: str | None) -> dict[str, SignalArray]:
    """Signals by name: first the vocabulary, each from its best source, then all other variables by their own names.

    Args:
        tables: of one recording.
        motor: meaning of motor.m1..4: "duty" (PWM sent, after battery compensation), "request" (thrust asked for,
            before compensation), or None if unknown; then motor.m1..4 stay columns without a meaning.
    """
    tables = tuple(tables)
    chosen: dict[str, tuple[_Shared, Source]] = {}
    shared = [_Shared(table) for table in tables]
    for source in _sources(motor):
        if source.signal not in chosen:
            where = next((s for s in shared if set(source.variables) <= s.table.columns.keys()), None)
            if where is not None:
                chosen[source.signal] = (where, source)
    used = {(id(where), v) for where, source in chosen.values() for v in source.variables}
    rest = [(where, name) for where in shared for name in where.table.columns if (id(where), name) not in used]
    times = Counter(name for _, name in rest)
    # one place per vocabulary signal in a row makes the orders unique; all other variables share one place, because no
    # estimator uses them
    step = len(chosen) + 1
    signals: dict[str, SignalArray] = {}
    for place, name in enumerate(n for n in SIGNALS if n in chosen):
        where, source = chosen[name]
        columns = [where.table.columns[v] for v in source.variables]
        value = source.convert.many(columns)  # type: ignore[arg-type]
        signals[name] = where.array(value, place, step, quantity=name, source=source.variables, columns=columns)
    for where, name in rest:
        value = np.asarray(where.table.columns[name], float)[:, None]
        label = f"{name}@{where.table.name}" if times[name] > 1 or name in SIGNALS else name
        while label in signals:  # two tables with the same name
            label += "'"
        signals[label] = where.array(value, len(chosen), step, source=(name,))
    return signals


def _sources(motor: str | None) -> tuple[Source, ...]:
    first = {"duty": DUTY_SOURCES, "request": REQUEST_SOURCES, None: DUTY_SOURCES[:1]}[motor]
    return (*first, *(s for s in SOURCES if s.signal != "motor_command"))


class _Shared:
    """Arrays that all signals of a table share, made once to save memory."""

    def __init__(self, table: Table) -> None:
        self.table = table
        n = table.time.size
        self._host = np.full(n, np.nan) if table.host_time is None else table.host_time
        self._unmarked = np.zeros(n, bool)
        self._orders: dict[int, NDArray[np.int64]] = {}

    def array(
        self,
        value: NDArray[np.float64],
        place: int,
        step: int,
        *,
        quantity: str = "",
        source: tuple[str, ...],
        columns: Sequence[NDArray[np.generic]] = (),
    ) -> SignalArray:
        """A signal of this table; `columns`: the columns from which a vocabulary signal was converted."""
        marked = self._unmarked
        if columns and not (finite := np.isfinite(value)).all():
            # marked: the file has valid numbers, the conversion made NaN of them (a rotor speed of 65535: "missing")
            sound = np.logical_and.reduce([np.isfinite(np.asarray(c, float)) for c in columns])
            marked = sound & ~finite.all(axis=1)
        if place not in self._orders:
            self._orders[place] = self.table.order * step + place
        unit, frame = SIGNALS[quantity][1:] if quantity else (unit_of(source[0]), "")
        return SignalArray(
            self.table.time,
            value,
            self._orders[place],
            self._host,
            marked,
            quantity=quantity,
            unit=unit,
            frame=frame,
            clock=self.table.clock,
            stream=self.table.name,
            source=source,
        )
