"""CSV mappings: the columns and units of the signals in files of other programs; one TOML file per format."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, UsageError
from crazyem.recordings.csv.mapping_units import counts_turns, is_electrical, time_divisor, unit_factor, unit_offset
from crazyem.signals.sample import SIGNALS, components
from crazyem.toml_file import parse_toml, read_text

BODY_AXES, WORLD_AXES = ("FLU", "FRD"), ("ENU", "NED")
_MOTOR_SIGNALS = ("motor_command", "motor_request", "rotor_speed")
_ANGLE_SIGNALS = ("euler", "setpoint_euler")

_TOP_KEYS = {
    "name", "title", "layout", "recognise", "time", "claims", "units", "packets", "signals", "host_signals", "columns",
}  # fmt: skip
_TIME_KEYS = {"column", "unit", "clock", "rate_hz"}
_CLAIMABLE = {"unit", "frame", "sign", "scale", "offset", "order", "direction"}
_ENTRY_KEYS = _CLAIMABLE | {
    "columns", "variables", "packet", "stream", "clock", "missing", "above", "hold", "rotors", "pole_pairs", "attitude",
    "corners", "published",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Columns of one signal."""

    quantity: str  # key of `SIGNALS`; the name of the signal up to its "@"
    columns: tuple[str, ...]  # in the order of the components of the signal. Three for an attitude as roll, pitch, yaw.
    scale: tuple[float, ...]  # factor to SI with sign, one per column
    offset: tuple[float, ...] = ()  # SI, added after the factor, one per column; () for none
    # name of the onboard packet of the columns, if the publisher interpolated lost packets; else None
    packet: str | None = None
    stream: str = ""  # signals with the same stream were sampled together
    clock: str | None = None  # name of the clock of the stamps; None: the clock of the rows
    frame: str = ""  # frame of a vector in the file, if not that of the signal: "body" or "world"; else ""
    # of the frames in the file, such as ("FRD", "NED"); signals have FLU and ENU
    axes: tuple[str, str] = ("FLU", "ENU")
    inverted: bool = False  # the rotation in the file is from world to body
    attitude: str = "attitude"  # the attitude signal that rotates a vector from the other frame
    missing: tuple[float, ...] = ()  # values that mean "not measured"
    empty_is_missing: bool = False  # empty fields also mean "not measured", according to the publisher
    # the signal is 1 if any column exceeds this threshold, else 0 (for `flying`); None for plain columns
    above: float | None = None
    hold: float = 0.0  # s for which the signal stays 1 afterwards
    corners: bool = False  # a slower stream was linearly interpolated at the rows; its samples are the corners

    def converted(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, c) SI from numbers of the file; changes `value` in place."""
        value *= self.scale
        if self.offset:
            value += self.offset
        return value


@dataclass(frozen=True, slots=True)
class CsvMapping:
    """A CSV format: its header and its contents (docs/reference/formats/csv.md)."""

    name: str  # name, title: for people
    title: str
    layout: str  # "wide" (one row per instant) or "long" (one row per variable)
    recognise: tuple[str, ...]  # columns that identify the format
    time: tuple[str, float]  # name of the time column ("" with `rate`), and the divisor from its stamps to seconds
    signals: Mapping[str, SignalColumns]  # signal name -> its columns, with known errors corrected
    columns: Mapping[str, str]  # of the long form: role -> column name
    # the same as the publisher states; differs from `signals` where the publisher is wrong
    published: Mapping[str, SignalColumns] = field(default_factory=dict)
    rate: float = math.nan  # Hz, rate of rows without stamps, else NaN
    clock: str = ""  # name of the clock of the rows; "host" means seconds since the epoch
    units: Mapping[str, str] = field(default_factory=dict)  # of columns that are no signal
    packets: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # packet -> its columns that are no signal
    # statements of the publisher about the whole recording, e.g. mass_kg.
    claims: Mapping[str, str] = field(default_factory=dict)


def load_mapping(text: str, where: str) -> CsvMapping:
    """A mapping from its TOML text; `where` names it in error messages. Raises FileFormatError naming the key."""
    table = parse_toml(text, where=where)
    _known(table, _TOP_KEYS, where)
    layout = _get(table, "layout", str, where, "wide")
    if layout not in ("wide", "long"):
        raise FileFormatError(f'{where}: layout must be "wide" or "long", not "{layout}".')
    key, columns_key = ("signals", "columns") if layout == "wide" else ("host_signals", "variables")
    entries = _get(table, key, dict, where, {})
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            raise FileFormatError(f"{where}: {key}.{name} must be a table.")
    signals = {n: _signal(n, e, f"{where}: {key}.{n}", columns_key) for n, e in entries.items()}
    published = {n: _signal(n, _claimed(e), f"{where}: {key}.{n}", columns_key) for n, e in entries.items()}
    time = _get(table, "time", dict, where, {})
    _known(time, _TIME_KEYS, f"{where}: time")
    columns = _entries(table, "columns", where)
    rate = _number(time, "rate_hz", f"{where}: time", math.nan)
    if layout == "long":
        for needed in ("host_time", "block", "stamp_ms", "name", "value"):
            _get(columns, needed, str, f"{where}: columns")
    elif "rate_hz" not in time:
        _get(time, "column", str, f"{where}: time")
    elif not (0.0 < rate < math.inf) or "column" in time:
        raise FileFormatError(f"{where}: time needs a column, or a positive rate_hz for rows without stamps.")
    name = _get(table, "name", str, where, Path(where).stem)
    claims = _entries(table, "claims", where, (str, int, float, bool), "a number, a text, true or false")
    return CsvMapping(
        name=name,
        title=_get(table, "title", str, where, name),
        layout=layout,
        recognise=_names(table, "recognise", where, ()),
        time=(
            _get(time, "column", str, f"{where}: time", ""),
            time_divisor(_get(time, "unit", str, f"{where}: time", "s"), f"{where}: time.unit"),
        ),
        signals=signals,
        columns=columns,
        published=published,
        rate=rate,
        clock=_get(time, "clock", str, f"{where}: time", ""),
        units=_entries(table, "units", where),
        packets={p: _names(table["packets"], p, f"{where}: packets") for p in _get(table, "packets", dict, where, {})},
        claims={k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in claims.items()},
    )


@functools.cache
def known_mappings() -> tuple[CsvMapping, ...]:
    """The mappings that ship with crazyem, those with most required columns first."""
    folder = resources.files("crazyem.recordings.csv") / "mappings"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    loaded = (load_mapping(f.read_text(encoding="utf-8"), f.name) for f in files)
    return tuple(sorted(loaded, key=lambda m: -len(m.recognise)))


def mapping_for(header: tuple[str, ...], given: str | None, path: Path) -> CsvMapping:
    """The mapping of a file with this header.

    Args:
        given: name of a shipped mapping (or its part before "_": "nanodrone"), or path of a TOML file; None: by the
            header.
        path: of the file, for messages.

    Raises: UsageError if there is no such mapping file, FileFormatError if it is broken or the header is not known.
    """
    shipped = {mapping.name: mapping for mapping in known_mappings()}
    columns = set(header)
    family = [m for m in known_mappings() if given is None or m.name == given or m.name.startswith(f"{given}_")]
    if given is not None and not family:
        return load_mapping(_text_of(Path(given), shipped), given)
    for mapping in family:
        if given == mapping.name or (mapping.recognise and columns.issuperset(mapping.recognise)):
            return mapping
    known = ", ".join(m.title for m in known_mappings())
    shown = ", ".join(name[:40] for name in header[:6])
    raise FileFormatError(
        f"{path}: the columns ({shown}, ...) are of no known format ({known}); say what they are with --map FILE.toml."
    )


def _text_of(path: Path, shipped: Mapping[str, CsvMapping]) -> str:
    try:
        return read_text(path, what="mapping")
    except UsageError as error:
        raise UsageError(f"{error} Shipped ones are {', '.join(shipped)}.") from None


def _claimed(entry: Mapping[str, Any]) -> dict[str, Any]:
    published = entry.get("published", {})
    return {**entry, **published} if isinstance(published, dict) else dict(entry)


def _signal(name: str, entry: Mapping[str, Any], where: str, key: str) -> SignalColumns:
    quantity, at, origin = name.partition("@")
    if quantity not in SIGNALS or (at and not origin):
        raise FileFormatError(f"{where}: no such signal; known are {', '.join(SIGNALS)}.")
    _known(entry, _ENTRY_KEYS, where)
    _known(_get(entry, "published", dict, where, {}), _CLAIMABLE, f"{where}.published")
    columns = _names(entry, key, where)
    above = _number(entry, "above", where, None)
    if above is None:
        columns, order = _ordered(quantity, columns, entry, where, key)
    else:
        order = tuple(range(len(columns)))
    signs = _get(entry, "sign", list, where, [1] * len(columns))
    if len(signs) != len(columns) or any(s not in (1, -1) for s in signs):
        raise FileFormatError(f"{where}.sign: needs 1 or -1 for each of the {len(columns)} columns.")
    frame, axes = _frame(quantity, entry, where)
    missing = entry.get("missing", _unreadable(quantity, entry.get("unit")))
    missing = missing if isinstance(missing, list) else [missing]
    if any(m != "" and (isinstance(m, bool) or not isinstance(m, (int, float))) for m in missing):
        raise FileFormatError(f'{where}.missing: must be numbers, or "" for fields without a number.')
    direction = _get(entry, "direction", str, where, "body to world")
    if direction not in ("body to world", "world to body"):
        raise FileFormatError(f'{where}.direction: must be "body to world" or "world to body", not "{direction}".')
    packet = _get(entry, "packet", str, where, None)
    factors, offsets = _factors(quantity, len(columns), entry, above, where)
    corners = bool(_get(entry, "corners", bool, where, False))
    if corners and len(columns) != 1:
        raise FileFormatError(f"{where}.corners: only for signals of one column.")
    return SignalColumns(
        quantity=quantity,
        columns=columns,
        # factors, signs and scales are written in the order of the file's columns
        scale=tuple(float(factors[i] * signs[i]) for i in order),
        offset=tuple(offsets[0][i] * signs[i] + offsets[1][i] for i in order) if any(map(any, offsets)) else (),
        packet=packet,
        stream=_get(entry, "stream", str, where, packet or "rows"),
        clock=_get(entry, "clock", str, where, None),
        frame=frame,
        axes=axes,
        inverted=direction == "world to body",
        attitude=_get(entry, "attitude", str, where, "attitude"),
        missing=tuple(float(m) for m in missing if m != ""),
        empty_is_missing="" in missing,
        above=above,
        hold=_number(entry, "hold", where, 0.0) or 0.0,
        corners=corners,
    )


def _unreadable(quantity: str, unit: object) -> list[float]:
    """Default of `missing`: 65535, the largest 16-bit number, for rotor speeds from speed controllers."""
    units = unit if isinstance(unit, list) else [unit]
    counted = quantity == "rotor_speed" and all(isinstance(u, str) and counts_turns(u) for u in units)
    return [65535.0] if counted else []


def _ordered(
    quantity: str, columns: tuple[str, ...], entry: Mapping[str, Any], where: str, key: str
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Columns in the order of the components of the signal, and the place of each in the given columns."""
    count = SIGNALS[quantity][0]
    labels = components(quantity)
    if quantity == "attitude" and len(columns) == 3:
        count, labels = 3, components("euler")
    if len(columns) != count:
        raise FileFormatError(f"{where}.{key}: {quantity} has {count} components, not {len(columns)}.")
    given: tuple[str, ...] = labels
    if "rotors" in entry:
        if quantity not in _MOTOR_SIGNALS:
            raise FileFormatError(f"{where}.rotors: only for motor_command, motor_request and rotor_speed.")
        given = tuple(f"m{r}" for r in _get(entry, "rotors", list, where))
    elif "order" in entry:
        text = _get(entry, "order", str, where)
        given = tuple(text) if len(text) == count == 4 else tuple(text.replace(",", " ").split())
    if sorted(given) != sorted(labels):
        what = "rotors" if "rotors" in entry else "order"
        raise FileFormatError(f"{where}.{what}: must name each of {', '.join(labels) or 'one component'} once.")
    order = tuple(given.index(label) for label in labels) if labels else (0,)
    return tuple(columns[i] for i in order), order


def _factors(
    quantity: str, count: int, entry: Mapping[str, Any], above: float | None, where: str
) -> tuple[tuple[float, ...], tuple[tuple[float, ...], tuple[float, ...]]]:
    """Factors to SI in the order of the columns in the file, and two offsets: of the unit, and of the mapping."""
    units = entry.get("unit", "")
    units = units if isinstance(units, list) else [units] * count
    scales = entry.get("scale", 1.0)
    scales = scales if isinstance(scales, list) else [scales] * count
    offsets = entry.get("offset", 0.0)
    offsets = offsets if isinstance(offsets, list) else [offsets] * count
    if len(units) != count or not all(isinstance(u, str) for u in units):
        raise FileFormatError(f"{where}.unit: must be a text, or one for each of the {count} columns.")
    if len(scales) != count or not all(_is_number(s) and s != 0 for s in scales):
        raise FileFormatError(f"{where}.scale: must be a number other than 0, or one for each of the {count} columns.")
    if len(offsets) != count or not all(map(_is_number, offsets)):
        raise FileFormatError(f"{where}.offset: must be a number, or one for each of the {count} columns.")
    added = tuple(float(o) for o in offsets)
    if above is not None:
        return tuple(float(s) for s in scales), ((0.0,) * count, added)
    pairs = _number(entry, "pole_pairs", where, None)
    if any(map(is_electrical, units)) and not (pairs and pairs > 0):
        raise FileFormatError(f"{where}.pole_pairs: erpm needs the number of pole pairs of the motor.")
    if pairs and not all(map(is_electrical, units)):
        raise FileFormatError(f"{where}.pole_pairs: only for the unit erpm.")
    turned = "euler" if quantity == "attitude" and count == 3 else quantity
    order = _component_order(turned, entry, count)
    if "unit" not in entry:
        ours = SIGNALS[turned][1].split(", ")
        units = [ours[min(c, len(ours) - 1)] for c in order]
    factors = [unit_factor(u, turned, c, f"{where}.unit") for u, c in zip(units, order, strict=True)]
    zeros = tuple(unit_offset(u, turned, c) * float(s) for u, c, s in zip(units, order, scales, strict=True))
    return tuple(f * float(s) / (pairs or 1.0) for f, s in zip(factors, scales, strict=True)), (zeros, added)


def _component_order(quantity: str, entry: Mapping[str, Any], count: int) -> list[int]:
    """Component of each column in the file (only a wrench has components of different kinds)."""
    if quantity != "wrench_command" or "order" not in entry:
        return list(range(count))
    return [components(quantity).index(label) for label in entry["order"].replace(",", " ").split()]


def _frame(quantity: str, entry: Mapping[str, Any], where: str) -> tuple[str, tuple[str, str]]:
    """("body", "world", or "" for the frame of the signal; axes of body and world)."""
    words = _get(entry, "frame", str, where, "").replace("to", " ").replace(",", " ").split()
    known = ("body", "world", *BODY_AXES, *WORLD_AXES)
    unknown = next((word for word in words if word not in known), None)
    if unknown is not None:
        raise FileFormatError(f'{where}.frame: unknown frame "{unknown}"; known are {", ".join(known)}.')
    ours = SIGNALS[quantity][2]
    if words and "world" not in ours and "body" not in ours:
        raise FileFormatError(f"{where}.frame: {quantity} has no frame.")
    body = next((word for word in reversed(words) if word in BODY_AXES), "FLU")
    world = next((word for word in reversed(words) if word in WORLD_AXES), "ENU")
    if quantity == "attitude" or quantity in _ANGLE_SIGNALS:
        if (body == "FRD") != (world == "NED") and quantity != "attitude":
            raise FileFormatError(f'{where}.frame: angles are either "FLU to ENU" or "FRD to NED".')
        return "", (body, world)
    frames = {"body" if word in ("body", *BODY_AXES) else "world" for word in words}
    if len(frames) > 1:
        raise FileFormatError(f"{where}.frame: {quantity} is given either in the body or in the world, not in both.")
    own = "body" if "body" in ours else "world"
    if frames <= {own}:
        return "", (body, world)
    if quantity.startswith(("position", "setpoint_position", "wrench")):
        raise FileFormatError(f"{where}.frame: {quantity} is given in the {own}, nothing else makes sense.")
    return frames.pop(), (body, world)


def _known(table: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise FileFormatError(f"{where}: unknown key {key!r:.60}; known are {', '.join(sorted(known))}.")


_REQUIRED = object()


def _get(table: Mapping[str, Any], key: str, kind: type, where: str, default: Any = _REQUIRED) -> Any:
    if key not in table:
        if default is _REQUIRED:
            raise FileFormatError(f"{where}: the key {key} is missing.")
        return default
    if not isinstance(table[key], kind):
        names = {dict: "table", str: "text", bool: "true or false"}
        raise FileFormatError(f"{where}: {key} must be a {names.get(kind, kind.__name__)}.")
    return table[key]


def _names(table: Mapping[str, Any], key: str, where: str, default: Any = _REQUIRED) -> tuple[str, ...]:
    names = tuple(_get(table, key, list, where, default))
    if not all(isinstance(n, str) for n in names):
        raise FileFormatError(f"{where}: {key} must be a list of texts.")
    return names


def _entries(table: Mapping[str, Any], key: str, where: str, kinds: Any = str, what: str = "a text") -> dict[str, Any]:
    """The table below a key; all its values must be of certain types, which `what` names in the error."""
    entries = _get(table, key, dict, where, {})
    for name, value in entries.items():
        if not isinstance(value, kinds):
            raise FileFormatError(f"{where}: {key}.{name} must be {what}.")
    return dict(entries)


def _number(table: Mapping[str, Any], key: str, where: str, default: float | None) -> Any:
    value = table.get(key, default)
    if value is not default and not _is_number(value):
        raise FileFormatError(f"{where}.{key}: must be a finite number.")
    return value if value is None else float(value)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
