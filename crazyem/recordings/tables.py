"""Signals from tables of firmware variables: the last step of every reader of firmware logs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from crazyem.recordings.recording import SignalArray
from crazyem.recordings.topics import Mapped, Topic, signals_of
from crazyem.signals.firmware_units import unit_of
from crazyem.signals.sample import SIGNALS
from crazyem.signals.vocabulary import DUTY_SOURCES, REQUEST_SOURCES, SOURCES, Source

MOTOR_MEANINGS = ("duty", "request")


@dataclass(frozen=True, slots=True, eq=False)
class Table(Topic):
    """Rows of firmware variables that were sampled together: a log block, a uSD event, a topic."""

    clock: str = "firmware"
    ctypes: Mapping[str, str] = field(default_factory=dict)  # firmware variable -> C type, where known

    def source_of(self, column: str) -> str:
        """The variable."""
        return column

    def raw_name(self, column: str, *, ambiguous: bool) -> str:
        """The variable, with the name of the table where several tables have it."""
        return f"{column}@{self.name}" if ambiguous or column in SIGNALS else column

    def unit_of(self, column: str) -> str:
        """Unit of a firmware variable, "" where unknown."""
        return unit_of(column)


@np.errstate(invalid="ignore")  # the cast to double turns a signalling NaN (damaged bytes) into a quiet one
def signals_from_tables(tables: Iterable[Table], *, motor: str | None) -> dict[str, SignalArray]:
    """Signals by name: first the vocabulary, each from its best source, then all other variables by their own names.

    Args:
        tables: of one recording.
        motor: meaning of motor.m1..4: "duty" (PWM sent, after battery compensation), "request" (thrust asked for,
            before compensation), or None if unknown; then motor.m1..4 stay columns without a meaning.
    """
    tables = tuple(tables)
    motors = {"duty": DUTY_SOURCES, "request": REQUEST_SOURCES, None: DUTY_SOURCES[:1]}[motor]
    chosen: dict[str, Mapped] = {}
    for source in (*motors, *(s for s in SOURCES if s.signal != "motor_command")):
        table = next((t for t in tables if set(source.variables) <= t.columns.keys()), None)
        if source.signal not in chosen and table is not None:
            chosen[source.signal] = _mapped(source, table)
    return signals_of(tables, [chosen[name] for name in SIGNALS if name in chosen], bounded=False)[0]


def _mapped(source: Source, table: Table) -> Mapped:
    columns = [table.columns[v] for v in source.variables]
    value = source.convert.many(columns)  # type: ignore[arg-type]
    # marked: the file has valid numbers, the conversion makes NaN of them (a rotor speed of 65535: "missing")
    sound = (
        None
        if np.isfinite(value).all()
        else np.logical_and.reduce([np.isfinite(np.asarray(c, float)) for c in columns])
    )
    return Mapped(source.signal, table, value, source.variables, sound)
