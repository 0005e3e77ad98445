"""CSV mappings: the columns and units of the signals in files of other programs; one TOML file per format."""

import functools
import math
from collections.abc import Callable, Mapping
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


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


# kind of a value: whether a value is of it, and the words after the name of its key in an error
_Kind = tuple[Callable[[Any], bool], str]
_TEXT: _Kind = (lambda v: isinstance(v, str), " must be a text")
_FLAG: _Kind = (lambda v: isinstance(v, bool), " must be a true or false")
_LIST: _Kind = (lambda v: isinstance(v, list), " must be a list")
_TABLE: _Kind = (lambda v: isinstance(v, dict), " must be a table")
_NUMBER: _Kind = (_is_number, ": must be a finite number")
_TEXTS: _Kind = (lambda v: isinstance(v, list) and all(isinstance(n, str) for n in v), " must be a list of texts")
_PLAIN: _Kind = (lambda v: isinstance(v, (str, int, float)), " must be a number, a text, true or false")
_ANY: _Kind = (lambda v: True, "")

_MAPPING = {
    **dict.fromkeys(("name", "title", "layout"), _TEXT),
    **dict.fromkeys(("time", "claims", "units", "packets", "signals", "host_signals", "columns"), _TABLE),
    "recognise": _TEXTS,
}
_TIME = {"column": _TEXT, "unit": _TEXT, "clock": _TEXT, "rate_hz": _NUMBER}
_PUBLISHED = {**dict.fromkeys(("unit", "scale", "offset"), _ANY), "sign": _LIST}
_PUBLISHED |= dict.fromkeys(("frame", "order", "direction"), _TEXT)
_ENTRY = _PUBLISHED | {"published": _TABLE, "missing": _ANY, "rotors": _LIST, "corners": _FLAG}
_ENTRY |= dict.fromkeys(("columns", "variables"), _TEXTS) | dict.fromkeys(("above", "hold", "pole_pairs"), _NUMBER)
_ENTRY |= dict.fromkeys(("packet", "stream", "clock", "attitude"), _TEXT)


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
    _check(table, _MAPPING, where)
    layout = table.get("layout", "wide")
    if layout not in ("wide", "long"):
        raise FileFormatError(f'{where}: layout must be "wide" or "long", not "{layout}".')
    key, columns_key = ("signals", "columns") if layout == "wide" else ("host_signals", "variables")
    entries = table.get(key, {})
    _check(entries, dict.fromkeys(entries, _TABLE), f"{where}: {key}.")
    signals = {n: _signal(n, e, f"{where}: {key}.{n}", columns_key) for n, e in entries.items()}
    published = {n: _signal(n, _claimed(e), f"{where}: {key}.{n}", columns_key) for n, e in entries.items()}
    time, columns, claims = (table.get(section, {}) for section in ("time", "columns", "claims"))
    _check(time, _TIME, f"{where}: time")
    for section, kind in (("columns", _TEXT), ("units", _TEXT), ("packets", _TEXTS), ("claims", _PLAIN)):
        _check(table.get(section, {}), dict.fromkeys(table.get(section, {}), kind), f"{where}: {section}.")
    rate = float(time.get("rate_hz", math.nan))
    if layout == "long":
        _require(columns, f"{where}: columns", "host_time", "block", "stamp_ms", "name", "value")
    elif "rate_hz" not in time:
        _require(time, f"{where}: time", "column")
    elif not (0.0 < rate < math.inf) or "column" in time:
        raise FileFormatError(f"{where}: time needs a column, or a positive rate_hz for rows without stamps.")
    name = table.get("name", Path(where).stem)
    return CsvMapping(
        name=name,
        title=table.get("title", name),
        layout=layout,
        recognise=tuple(table.get("recognise", ())),
        time=(time.get("column", ""), time_divisor(time.get("unit", "s"), f"{where}: time.unit")),
        signals=signals,
        columns=dict(columns),
        published=published,
        rate=rate,
        clock=time.get("clock", ""),
        units=dict(table.get("units", {})),
        packets={packet: tuple(names) for packet, names in table.get("packets", {}).items()},
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
    _check(entry, _ENTRY, where)
    _check(entry.get("published", {}), _PUBLISHED, f"{where}.published")
    _require(entry, where, key)
    columns, above = tuple(entry[key]), entry.get("above")
    if above is None:
        columns, order = _ordered(quantity, columns, entry, where, key)
    else:
        order = tuple(range(len(columns)))
    signs = entry.get("sign", [1] * len(columns))
    if len(signs) != len(columns) or any(s not in (1, -1) for s in signs):
        raise FileFormatError(f"{where}.sign: needs 1 or -1 for each of the {len(columns)} columns.")
    frame, axes = _frame(quantity, entry, where)
    missing = entry.get("missing", _unreadable(quantity, entry.get("unit")))
    missing = missing if isinstance(missing, list) else [missing]
    if any(m != "" and (isinstance(m, bool) or not isinstance(m, (int, float))) for m in missing):
        raise FileFormatError(f'{where}.missing: must be numbers, or "" for fields without a number.')
    direction = entry.get("direction", "body to world")
    if direction not in ("body to world", "world to body"):
        raise FileFormatError(f'{where}.direction: must be "body to world" or "world to body", not "{direction}".')
    packet = entry.get("packet")
    factors, offsets = _factors(quantity, len(columns), entry, above, where)
    corners = entry.get("corners", False)
    if corners and len(columns) != 1:
        raise FileFormatError(f"{where}.corners: only for signals of one column.")
    return SignalColumns(
        quantity=quantity,
        columns=columns,
        # factors, signs and scales are written in the order of the file's columns
        scale=tuple(float(factors[i] * signs[i]) for i in order),
        offset=tuple(offsets[0][i] * signs[i] + offsets[1][i] for i in order) if any(map(any, offsets)) else (),
        packet=packet,
        stream=entry.get("stream", packet or "rows"),
        clock=entry.get("clock"),
        frame=frame,
        axes=axes,
        inverted=direction == "world to body",
        attitude=entry.get("attitude", "attitude"),
        missing=tuple(float(m) for m in missing if m != ""),
        empty_is_missing="" in missing,
        above=None if above is None else float(above),
        hold=float(entry.get("hold", 0.0)),
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
        given = tuple(f"m{r}" for r in entry["rotors"])
    elif "order" in entry:
        text = entry["order"]
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
    given = (entry.get(key, default) for key, default in (("unit", ""), ("scale", 1.0), ("offset", 0.0)))
    units, scales, offsets = (value if isinstance(value, list) else [value] * count for value in given)
    if len(units) != count or not all(isinstance(u, str) for u in units):
        raise FileFormatError(f"{where}.unit: must be a text, or one for each of the {count} columns.")
    if len(scales) != count or not all(_is_number(s) and s != 0 for s in scales):
        raise FileFormatError(f"{where}.scale: must be a number other than 0, or one for each of the {count} columns.")
    if len(offsets) != count or not all(map(_is_number, offsets)):
        raise FileFormatError(f"{where}.offset: must be a number, or one for each of the {count} columns.")
    added = tuple(float(o) for o in offsets)
    if above is not None:
        return tuple(float(s) for s in scales), ((0.0,) * count, added)
    pairs = entry.get("pole_pairs")
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
    words = entry.get("frame", "").replace("to", " ").replace(",", " ").split()
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


def _check(table: Mapping[str, Any], kinds: Mapping[str, _Kind], where: str) -> None:
    """Raise FileFormatError if a table has an unknown key or a value of another kind."""
    for key, value in table.items():
        if key not in kinds:
            raise FileFormatError(f"{where}: unknown key {key!r:.60}; known are {', '.join(sorted(kinds))}.")
        fits, words = kinds[key]
        if not fits(value):
            between = "" if where.endswith(".") else "." if words.startswith(":") else ": "
            raise FileFormatError(f"{where}{between}{key}{words}.")


def _require(table: Mapping[str, Any], where: str, *keys: str) -> None:
    for key in keys:
        if key not in table:
            raise FileFormatError(f"{where}: the key {key} is missing.")
