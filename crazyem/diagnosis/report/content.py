"""Content of a report as sections of paragraphs, lists and tables: the same for the page and for the terminal.

It is made from the diagnosis' JSON document alone, so that anyone can write the report again. A missing key leaves out
its part.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from crazyem.diagnosis.report.verdict import (
    QUANTITIES,
    Document,
    alike,
    effect_words,
    items,
    number,
    per_cent,
    quantity,
    short,
    spaced,
    span,
    table,
    tables,
    verdict,
    words_of,
)
from crazyem.physics.effects.catalogue import CATALOGUE

MOST_RANKED = 12
LIKELIHOOD = (
    "Gain is log-likelihood beyond the model without it: each unit makes the data e times as probable. Held out is the "
    "same on data that it was not fitted to."
)
AXES = "Axes are those of the body; of velocities those of the world."
FREE = (
    "No file says these exactly, so every fit leaves them free about what is expected, by a usual standard deviation."
)


@dataclass(frozen=True)
class Cell:
    """Text with a tone: "better", "worse", "strong" or none."""

    text: str
    tone: str = ""


@dataclass(frozen=True)
class Bar:
    """A value and its interval beside the neutral value (`none`), in per cent of a picture's width."""

    none: float
    low: float
    value: float
    high: float


@dataclass(frozen=True)
class Items:
    """A list; `warn` marks a reservation."""

    items: tuple[str, ...]
    title: str = ""
    warn: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of texts, `Cell`, `Bar` or a share in per cent; `right` are columns of numbers."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    right: tuple[int, ...] = ()
    title: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a report; `pictures`: the `Series.section` of its pictures; `page`: for the page alone."""

    title: str
    parts: tuple[str | Items | Table, ...]
    pictures: str = ""
    page: bool = False


def sections(document: Document) -> list[Section]:
    """All sections of a report; some may have no part."""
    return [
        Section("What is missing from the model", (*_effects(document), *_groups(document))),
        Section("Where simulation and flight part", tuple(_where(document)), "where"),
        Section("Before and after, open loop", tuple(_fit(document)), "fit"),
        Section("What remains unknown", tuple(_unknown(document))),
        Section("Against the simulated flight", tuple(_against(table(document.get("against"))))),
        Section("What was left free", tuple(_free(document)), page=True),
        Section("How the candidates compare", tuple(_ranking(document)), page=True),
        Section("Remarks", tuple(_listed(_texts(document.get("notices"))))),
    ]


def facts(document: Document) -> list[tuple[str, str]]:
    """Recordings and vehicle of the diagnosis, with their names."""
    found = []
    for key, words in (("recordings", "recordings"), ("held_out_recordings", "kept apart"), ("vehicle", "vehicle")):
        if document.get(key):
            found.append((words, ", ".join(_texts(document[key]))))
    return found


def _effects(document: Document) -> list[str | Table]:
    rows: list[tuple[Any, ...]] = []
    for effect in tables(document.get("effects")):
        sure, held = number(effect.get("confidence")), table(effect.get("evidence")).get("held_out_nats")
        begin: tuple[Any, ...] = (
            Cell(words_of(effect), "strong"), "" if sure is None else f"{100 * sure:.0f} %", short(held, ".0f"),
        )  # fmt: skip
        for name, entry in table(effect.get("parameters")).items():
            found = entry if isinstance(entry, Mapping) else {"value": entry}
            if not found.get("chosen"):
                rows.append((*begin, *_parameter(str(effect.get("name")), str(name), found)))
                begin = ("", "", "")
        if begin[0]:
            rows.append((*begin, "", "", "", ""))
    if not rows:
        return ["None of the effects of the catalogue is claimed."]
    heads = ("effect", "probability", "gain held out", "parameter", "value", "95 % interval", "against none")
    return [Table(heads, tuple(rows), (1, 2, 4, 5)), LIKELIHOOD]


def _parameter(effect: str, name: str, found: Mapping[str, Any]) -> tuple[Any, ...]:
    known = next((p for p in CATALOGUE[effect].parameters if p.name == name), None) if effect in CATALOGUE else None
    value, unit, sd, ends = (found.get(k) for k in ("value", "unit", "sd", "ci95"))
    unit = "" if unit is None else unit
    bar = _bar(number(value), [number(e) for e in items(ends)], number(known.neutral) if known else None)
    words = known.description if known else spaced(name)
    return words, Cell(quantity(value, unit, sd), "strong"), span(ends, value, unit, sd), bar or ""


def _bar(value: float | None, ends: Sequence[float | None], none: float | None) -> Bar | None:
    """The bar of an interval, which shows whether the interval contains the neutral value; None if one is missing."""
    if value is None or none is None or len(ends) != 2 or ends[0] is None or ends[1] is None or ends[0] > ends[1]:
        return None
    left, right = min(none, ends[0], value), max(none, ends[1], value)
    wide = (right - left) or 1.0
    left, wide = left - 0.06 * wide, 1.12 * wide
    return Bar(*(round(100 * (x - left) / wide, 2) for x in (none, ends[0], value, ends[1])))


def _groups(document: Document) -> list[Items]:
    groups = [f"{' and '.join(map(effect_words, g))} cannot be told apart in this flight" for g in alike(document)]
    separate = _texts(document.get("would_separate"))
    title = f"What would tell {'them apart' if groups else 'more'}"
    return [*_listed(groups, warn=True), *_listed(separate, title=title)]


def _where(document: Document) -> list[str | Table]:
    found = _findings(document.get("where"))
    return [*found, AXES] if found else []


def _findings(found: Any, title: str = "") -> list[Table]:
    rows = []
    for entry in tables(found):
        times = [short(t) for t in items(entry.get("interval"))]
        when = f"{' to '.join(times)} s" if len(times) == 2 else ""
        size = quantity(entry.get("effect_size"), entry.get("unit", ""), entry.get("sd"))
        rows.append(
            (spaced(entry.get("signal", "")), str(entry.get("axis", "")), str(entry.get("regime", "")), when, size)
        )
    return [Table(("signal", "axis", "regime", "when", "size"), tuple(rows), (4,), title)] if rows else []


def _fit(document: Document) -> Iterable[str | Table]:
    fit = table(document.get("fit"))
    for part, words in (("held_out", "Flight kept apart"), ("train", "Flight it was fitted to")):
        both = table(fit.get(part))
        before, spoilt = table(both.get("before")), {(e.get("quantity"), e.get("horizon_s")) for e in _plain(both)}
        starts = f", {before['starts']} starts" if number(before.get("starts")) else ""
        after = both.get("after") if tables(document.get("effects")) else None
        yield from _horizons(before, table(after), spoilt, words + starts)
        if both.get("vehicle"):
            yield from _horizons(before, table(both["vehicle"]), set(), f"{words}, by what belongs to the drone alone")
    closed = [(k, number(v)) for k, v in table(fit.get("gap_closed")).items()]
    shares = [f"{spaced(k)} {100 * v:.0f} %" for k, v in closed if v is not None]
    if shares and document.get("mismatch"):
        yield f"Of the mean square error at the longest horizon the fit took away: {', '.join(shares)}."


def _plain(both: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Entries of "worse" whose quantity is a text and whose horizon is a number."""
    return [e for e in tables(both.get("worse")) if isinstance(e.get("quantity"), str) and number(e.get("horizon_s"))]


def _horizons(before: Mapping[str, Any], after: Mapping[str, Any], spoilt: set[Any], title: str) -> list[Table]:
    """Rms errors at each horizon: before, after and the change; errors before alone if there are none after."""
    ahead = [number(h) for h in items(before.get("horizon_s"))]
    rows = []
    for name in QUANTITIES:
        one, two = table(before.get(name)), table(after.get(name))
        first, second = ([number(v) for v in items(e.get("rms"))] for e in (one, two))
        cells = []
        for k, horizon in enumerate(ahead[: len(first)]):
            a, b = first[k], second[k] if k < len(second) else None
            change = f" ({per_cent(b / a - 1.0)})" if a and b is not None else ""
            bad = (name, horizon) in spoilt
            tone = "worse" if bad else "better" if a is not None and b is not None and b < a else ""
            arrow = f" → {short(b)}{change}{' worse' * bad}" if second else ""
            cells.append(Cell(short(a) + arrow, tone))
        if cells:
            rows.append((f"{spaced(name)} [{one.get('unit', '')}]", *cells, *[""] * (len(ahead) - len(cells))))
    heads = ("rms error after", *(f"{1e3 * h:g} ms" if h is not None else "" for h in ahead))
    return [Table(heads, tuple(rows), tuple(range(1, len(heads))), title)] if rows and ahead else []


def _unknown(document: Document) -> Iterable[str | Items | Table]:
    left = table(document.get("unexplained"))
    if left.get("found") is False:
        yield "Nothing is left over after the fit beyond the noise."
    else:
        yield from _findings(left.get("where"), "Left over after the fit")
        share = number(left.get("explained_share"))
        if left.get("found") and share is not None and tables(document.get("effects")):
            yield f"The effects explain {100 * share:.0f} % of the structure that was found."
    reasons: dict[str, list[str]] = {}
    for entry in items(document.get("not_identifiable")):
        known = isinstance(entry, Mapping)
        name, reason = (entry.get("name"), entry.get("reason", "")) if known else (entry, "")
        reasons.setdefault(str(reason), []).append(effect_words(name))
    texts = [f"{', '.join(names)}{f': {reason}' if reason else ''}" for reason, names in reasons.items()]
    yield from _listed(texts, title="What this flight could not reveal")


def _free(document: Document) -> list[str | Table]:
    rows = []
    for entry in tables(document.get("left_free")):
        unit = str(entry.get("unit", ""))
        value = Cell(quantity(entry.get("value"), unit, entry.get("sd")), "strong")
        expected, usual = (quantity(entry.get(k), unit) for k in ("expected", "usual"))
        rows.append((str(entry.get("words", "")), str(entry.get("parameter", "")), value, expected, usual))
    heads = ("quantity", "of", "value", "expected", "usual sd")
    return [FREE, Table(heads, tuple(rows), (2, 3, 4))] if rows else []


def _ranking(document: Document) -> list[str | Table]:
    entries = tables(document.get("ranking"))
    best = max((number(e.get("held_out_nats")) or 0.0 for e in entries), default=0.0)
    named = {str(e.get("name")) for e in tables(document.get("effects"))}
    rows = []
    for entry in entries[:MOST_RANKED]:
        held = number(entry.get("held_out_nats"))
        share = 100 * max(held or 0.0, 0.0) / best if best > 0 else 0.0
        words = spaced(entry["words"]) if entry.get("words") else effect_words(entry.get("name", ""))
        note = str(entry.get("note", "")) or ("told" if str(entry.get("name")) in named else "")
        rows.append((words, short(entry.get("gain_nats"), ".1f"), short(held, ".1f"), round(share, 1), note))
    heads = ("candidate", "gain", "held out", "", "")
    return [Table(heads, tuple(rows), (1, 2)), LIKELIHOOD] if rows else []


def _against(compared: Mapping[str, Any]) -> list[str | Table]:
    """Differences from a simulated flight of the same mission, signal by signal."""
    rows = [
        (spaced(name), quantity(e.get("rms"), e.get("unit", "")), quantity(e.get("largest"), e.get("unit", "")))
        for name, e in table(compared.get("signals")).items()
        if isinstance(e, Mapping)
    ]
    said = f"{compared.get('simulated', '')}: {short(compared.get('seconds'))} s of the same mission"
    return [said, Table(("signal", "rms difference", "largest"), tuple(rows), (1, 2))] if rows else []


def _listed(texts: Sequence[str], *, title: str = "", warn: bool = False) -> list[Items]:
    return [Items(tuple(texts), title, warn)] if texts else []


def _texts(value: Any) -> list[str]:
    """The texts of a list, or a single text as a list."""
    return [str(v) for v in items(value)] if isinstance(value, list | tuple) else [str(value)] if value else []


MOST_ROWS = 12  # rows of a table


def text_of(document: Document) -> str:
    """The diagnosis for a terminal, without the sections for the page alone."""
    lines = [verdict(document)]
    for section in sections(document):
        if section.page or not section.parts:
            continue
        lines += ["", section.title]
        for part in section.parts:
            if isinstance(part, Table):
                lines += _columns(part)
            elif isinstance(part, Items):
                lines += [f"  {part.title}:"] * bool(part.title) + [f"  - {text}" for text in part.items]
            else:
                lines.append(f"  {part}")
    return "\n".join(lines)


def _columns(table: Table) -> Iterator[str]:
    rows = [[_cell_text(cell) for cell in row] for row in table.rows[:MOST_ROWS]]
    used = [k for k in range(len(table.heads)) if any(row[k] for row in rows)]
    width = {k: max(len(row[k]) for row in [list(table.heads), *rows]) for k in used}
    if table.title:
        yield f"  {table.title}"
    for row in [list(table.heads), *rows]:
        cells = (row[k].rjust(width[k]) if k in table.right else row[k].ljust(width[k]) for k in used)
        yield "    " + "  ".join(cells).rstrip()
    if len(table.rows) > MOST_ROWS:
        yield f"    and {len(table.rows) - MOST_ROWS} more"


def _cell_text(cell: Any) -> str:
    """A cell as text; "" for a picture."""
    return "" if isinstance(cell, Bar | float) else cell.text if isinstance(cell, Cell) else str(cell)
