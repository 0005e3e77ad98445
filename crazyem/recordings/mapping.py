"""CSV mappings: which columns of a foreign file are which signals, in which units; one TOML file a format."""

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.signals.sample import SIGNALS
from crazyem.signals.vocabulary import STANDARD_GRAVITY

# unit in a file -> factor to SI
UNITS: dict[str, float] = {
    "1": 1.0,
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "m": 1.0,
    "mm": 1e-3,
    "m/s": 1.0,
    "mm/s": 1e-3,
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY,
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "rpm": 2.0 * math.pi / 60.0,
    "pwm": 1.0 / 65535.0,
    "V": 1.0,
    "mV": 1e-3,
    "N": 1.0,
}


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Columns of one signal.

    Attributes:
        columns: one a component.
        scale: factor to SI, sign included, one a component.
        packet: name of the onboard packet the columns came in, if the file's publisher interpolated it; else None.
        above: the signal is 1 where any column exceeds this, else 0 (for `flying`); None for plain columns.
        hold: s for which such a 1 is kept.
    """

    columns: tuple[str, ...]
    scale: tuple[float, ...]
    packet: str | None = None
    above: float | None = None
    hold: float = 0.0


@dataclass(frozen=True, slots=True)
class CsvMapping:
    """A CSV format: how to recognise it by its header, and what is in it (see recordings/mappings/*.toml)."""

    name: str
    title: str
    layout: str  # "wide" (a row an instant) or "long" (a row a variable)
    recognise: tuple[str, ...]
    time: tuple[str, float]
    signals: Mapping[str, SignalColumns]
    columns: Mapping[str, str]


def load_mapping(text: str, where: str) -> CsvMapping:
    """A mapping from its TOML text; `where` names it in error messages. Raises FileFormatError naming the key."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(f"{where}: not valid TOML ({error}).") from error
    layout = _get(table, "layout", str, where)
    if layout not in ("wide", "long"):
        raise FileFormatError(f'{where}: layout must be "wide" or "long", not "{layout}".')
    key = "signals" if layout == "wide" else "host_signals"
    signals = {
        name: _signal(name, entry, f"{where}: {key}.{name}", "columns" if layout == "wide" else "variables")
        for name, entry in table.get(key, {}).items()
    }
    time = table.get("time", {})
    columns = table.get("columns", {})
    if layout == "long":
        for needed in ("host_time", "block", "stamp_ms", "name", "value"):
            _get(columns, needed, str, f"{where}: columns")
    else:
        _get(time, "column", str, f"{where}: time")
    return CsvMapping(
        name=_get(table, "name", str, where),
        title=_get(table, "title", str, where),
        layout=layout,
        recognise=tuple(_get(table, "recognise", list, where)),
        time=(time.get("column", ""), _unit(time.get("unit", "s"), f"{where}: time.unit")),
        signals=signals,
        columns=columns,
    )


@functools.cache
def known_mappings() -> tuple[CsvMapping, ...]:
    """The mappings that ship with crazyem."""
    folder = resources.files("crazyem.recordings") / "mappings"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return tuple(load_mapping(f.read_text(encoding="utf-8"), f.name) for f in files)


def _signal(name: str, entry: Mapping[str, Any], where: str, key: str) -> SignalColumns:
    if name not in SIGNALS:
        raise FileFormatError(f"{where}: no such signal; known are {', '.join(SIGNALS)}.")
    columns = tuple(_get(entry, key, list, where))
    components = SIGNALS[name][0]
    above = entry.get("above")
    if above is None and len(columns) != components:
        raise FileFormatError(f"{where}.{key}: {name} has {components} components, not {len(columns)}.")
    factor = _unit(entry.get("unit", "1"), f"{where}.unit") * float(entry.get("scale", 1.0))
    signs = entry.get("sign", [1] * len(columns))
    if len(signs) != len(columns) or any(s not in (1, -1) for s in signs):
        raise FileFormatError(f"{where}.sign: needs 1 or -1 for each of the {len(columns)} columns.")
    return SignalColumns(
        columns=columns,
        scale=tuple(factor * s for s in signs),
        packet=entry.get("packet"),
        above=None if above is None else float(above),
        hold=float(entry.get("hold", 0.0)),
    )


def _unit(name: str, where: str) -> float:
    if name not in UNITS:
        raise FileFormatError(f'{where}: unknown unit "{name}"; known are {", ".join(UNITS)}.')
    return UNITS[name]


def _get(table: Mapping[str, Any], key: str, kind: type, where: str) -> Any:
    if key not in table:
        raise FileFormatError(f"{where}: the key {key} is missing.")
    if not isinstance(table[key], kind):
        raise FileFormatError(f"{where}: {key} must be a {kind.__name__}.")
    return table[key]
