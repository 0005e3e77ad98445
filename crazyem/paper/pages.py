"""tables.md and index.html: results of a run beside the paper's values; self-contained files.

The tables are Markdown, HTML and text from the same grids; the pages of docs/ use them, too.
"""

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from crazyem.paper.published_values import CONVERGENCE, CORRECTIONS, NOT_RESULTS, ONLINE_ITERATIONS, PARAMETERS, SENSORS

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Grid:
    """A table: title, column heads, rows of text, a note below."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self, *, heading: str = "##") -> str:
        """The table as Markdown, with a heading unless `heading` is empty."""
        lines = [f"{heading} {self.title}", ""] if heading else []
        lines += [_row(self.head), _row(["---"] * len(self.head)), *(_row(r) for r in self.rows)]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])

    def text(self) -> str:
        """The table as text for a terminal, columns aligned."""
        rows = (self.head, *self.rows)
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.head))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths)).rstrip() for row in rows]
        return "\n".join([self.title, *(f"  {line}" for line in lines)])

    def html(self) -> str:
        """The table as HTML, with a heading."""
        head = "".join(f"<th>{html.escape(c)}</th>" for c in self.head)
        body = "\n".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in self.rows)
        note = f"<p>{html.escape(self.note)}</p>" if self.note else ""
        return f"<h2>{html.escape(self.title)}</h2>\n<table>\n<tr>{head}</tr>\n{body}\n</table>\n{note}"


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"


# numbers ------------------------------------------------------------------------------------------------------


def span(values: Sequence[float] | None, parameter: str) -> str:
    """A range in kg, or in 1e-4 kg m^2."""
    if values is None:
        return "-"
    if parameter == "mass":
        return f"{values[0]:.4f} to {values[1]:.4f}"
    return f"{1e4 * values[0]:.3f} to {1e4 * values[1]:.3f}"


def percent(value: float | None, digits: int = 2, *, sign: bool = False) -> str:
    """A fraction as %."""
    return "-" if value is None else f"{100 * value:{'+' if sign else ''}.{digits}f} %"


def number(value: float | None, form: str = ".2f") -> str:
    """A number as text, or - for None."""
    return "-" if value is None else format(value, form)


def _of(cell: Record, method: str, key: str) -> Any:
    return None if not cell.get(method) else cell[method].get(key)


# grids --------------------------------------------------------------------------------------------------------


def grids(results: Record) -> list[Grid]:
    """Every table of the page: I to V, errors, convergence."""
    found = []
    if results.get("table1"):
        found.append(table1_grid(results["table1"]))
    found += [g for table in ("II", "III", "IV", "V") if (g := table_grid(results["cells"], table)) is not None]
    if results["cells"]:
        found.append(errors_grid(results["cells"]))
    if results["flights"]:
        found.append(convergence_grid(results["flights"]))
    return found


def table1_grid(table1: Record) -> Grid:
    """Table I."""
    words = {"mean": "mean", "sd": "standard deviation", "max": "largest"}
    rows = []
    for name, unit in (("position", "m"), ("angles", "rad")):
        for key, word in words.items():
            entry = table1[name][key]
            here = f"{entry['mean']:.2e} ({entry['low']:.2e} to {entry['high']:.2e})"
            label = "position error" if name == "position" else "Euler angle error"
            rows.append((f"{label}, {word} [{unit}]", f"{entry['paper']:.2e}", here))
    note = (
        f"Absolute errors of single axes. Here: mean over {table1['flights']} flights, in brackets the least and the "
        f"largest flight. Of Figure 5: {percent(table1['velocity_within']['mean'], 1)} of the velocity errors are "
        f"below 0.03 m/s, {percent(table1['rate_within']['mean'], 1)} of the rate errors below 0.15 rad/s. The "
        "angles are dead reckoning, so their error is nearly one number a flight, and one flight says little."
    )
    return Grid("Table I: pose estimation of the EKF", ("", "paper", "here"), tuple(rows), note)


_TABLE_TITLES = {
    "II": "offline estimated mass [kg]",
    "III": "offline estimated inertia [1e-4 kg m^2]",
    "IV": "online estimated mass [kg]",
    "V": "online estimated inertia [1e-4 kg m^2]",
}


def table_grid(cells: Iterable[Record], table: str) -> Grid | None:
    """One of Tables II to V; None if no run belongs to it."""
    chosen = [c for c in cells if c["table"] == table]
    if not chosen:
        return None
    rows = []
    for c in chosen:
        p = c["parameter"]
        name = f"{c['sensor']}, {SENSORS[c['sensor']]}" + ("" if p == "mass" else f": {p}")
        bound = c["bound"]
        limit = "-" if bound is None else f"{span(bound['range'], p)} ({percent(bound['sd'])})"
        rows.append((name, span(c["paper"]["range"], p), *_here(c, "published"), *_here(c, "crazyem"), limit))
        other = c.get("dead_reckoned")
        if other:
            words = ("its method, angles dead-reckoned", "-", span(other["range"], p), number(other["width_ratio"]))
            rows.append((f"{c['sensor']}: {p}, {words[0]}", *words[1:], "-", "-", "-", "-", "-"))
    counts = {m: sorted({n for c in chosen if (n := _of(c, m, "n"))}) for m in ("published", "crazyem")}
    said = "; ".join(f"{m}: {' or '.join(map(str, n))}" for m, n in counts.items() if n)
    note = (
        f"Ranges are least to largest value. Values behind each: paper 20 flights; {said}. width: of the range, "
        f"over the paper's{'' if table in ('II', 'III') else ', in brackets of whole curves after 8 s'}. "
        "bound: the range that as many values as here would have on average at the Cramer-Rao bound "
        "(20: 3.7 standard deviations, 60: 4.6), in brackets one standard deviation."
    )
    head = ("", "paper", "published, here", "width", "overlap", "crazyem", "width", "overlap", "bound")
    return Grid(f"Table {table}: {_TABLE_TITLES[table]}", head, tuple(rows), note)


def _here(cell: Record, method: str) -> tuple[str, str, str]:
    """The range of a method's values, its width over the paper's width, and whether it overlaps the paper's range."""
    if not cell[method]:
        return "-", "-", "-"
    found = cell[method]
    overlap = "yes" if found["overlap"] else "no"
    curve = found.get("curve_width_ratio")
    width = number(found["width_ratio"]) + ("" if curve is None else f" ({curve:.2f})")
    return span(found["range"], cell["parameter"]), width, overlap


def errors_grid(cells: Iterable[Record]) -> Grid:
    """Bias, error over the bound, coverage of every cell."""
    rows = []
    for c in cells:
        bound = c["bound"]
        rows.append(
            (
                f"{c['experiment']} {c['sensor']} {c['parameter']}",
                percent(c["paper"]["middle_bias"], sign=True),
                percent(_of(c, "published", "bias"), sign=True), number(_of(c, "published", "rms_over_bound")),
                percent(_of(c, "crazyem", "bias"), sign=True), number(_of(c, "crazyem", "rms_over_bound")),
                percent(_of(c, "crazyem", "coverage"), 0),
                percent(bound and bound["sd"]), percent(bound and bound["sd_noise_known"]),
            )
        )  # fmt: skip
    head = (
        "", "paper: middle of its range", "published: bias", "rms/bound", "crazyem: bias", "rms/bound",
        "95 % intervals that hold", "bound, sd", "bound if the noise were known",
    )  # fmt: skip
    note = (
        "bias: mean error. rms/bound: 1 is an efficient estimator; 20 flights give it to about 0.16. bound if the "
        "noise were known: both intensities declared known instead of estimated."
    )
    return Grid("Errors against the truth and the bound", head, tuple(rows), note)


def convergence_grid(flights: Iterable[Record]) -> Grid:
    """Online convergence times to the true values."""
    rows = []
    for f in flights:
        inertia = [f[f"{name}_25_first"] for name in PARAMETERS[1:]]
        rows.append(
            (
                f"{f['sensor']} {f['method']}", str(f["flights"]),
                f"{f['crashed_as_printed'] if f['method'] == 'published' else f['crashed']}",
                _times(f["mass_5_stays"]), _times(f["mass_1_stays"]),
                f"{number(_worst(inertia, 'median_s'))} ({number(_worst(inertia, 'worst_s'))})",
                number(f["tracking_over_known"], ".3f"),
            )
        )  # fmt: skip
    note = (
        "s of flight, median over flights and in brackets the worst: mass within 5 % and 1 % for good; inertia within "
        "25 % for the first time, the slowest axis. A published flight that crashed was flown again with estimates "
        "kept positive, and that is what all tables count. tracking: rms distance from the reference after the first "
        "window, over that of the controller that knows the parameters. The paper: about "
        f"{ONLINE_ITERATIONS} iterations, 4 s."
    )
    head = ("", "flights", "crashed", "mass to 5 % [s]", "mass to 1 % [s]", "inertia to 25 % [s]", "tracking")
    return Grid("Convergence online, from 0.001 kg", head, tuple(rows), note)


def _times(entry: Record) -> str:
    worst = f"{entry['never']} never" if entry["never"] else number(entry["worst_s"])
    return f"{number(entry['median_s'])} ({worst})"


def _worst(entries: Sequence[Record], key: str) -> float | None:
    values = [e[key] for e in entries]
    return None if any(v is None for v in values) else max(values)


PAPER = 'Zhao, "Online parameter estimation for the Crazyflie quadcopter through an EM algorithm"'

_CSS = """body { font: 15px/1.5 sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: 2px 8px; text-align: left; vertical-align: top; }
figure { display: inline-block; width: 48%; min-width: 24em; margin: 0.5em 0; vertical-align: top; }
figure img { width: 100%; }
figcaption { font-size: 13px; }"""


def corrections_grid() -> Grid:
    """Corrections without which the paper's algorithm does not run."""
    rows = tuple((c.equation, c.printed, c.used, c.why) for c in CORRECTIONS)
    note = "Everything else of the published method is as printed, wrong or not (docs/explanation/errata.md)."
    return Grid("Corrections to the published method", ("equation", "printed", "used", "why"), rows, note)


def settings_grid(settings: Iterable[Record]) -> Grid:
    """Every setting with its reason."""
    rows = tuple((s["name"], _value(s["value"]), s["unit"], s["reason"]) for s in settings)
    return Grid("Settings", ("name", "value", "unit", "reason"), rows)


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " ".join(f"({_value(v)})" if isinstance(v, list | tuple) else _value(v) for v in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def notes(results: Record) -> list[str]:
    """Sentences on how well the paper is reproduced, computed from the cells."""
    s = results["summary"]
    lines = []
    if "cells" in s:
        lines.append(
            f"Published method: {s['cells_overlapping']} of {s['cells']} cells overlap the paper's range"
            + (f"; not {', '.join(s['cells_not_overlapping'])}" if s["cells_not_overlapping"] else "")
            + "."
        )
        lines.append(_widths("Width of its ranges over the paper's", s["widths"]))
        if "widths_of_curves" in s:
            lines.append(
                _widths("The same if online ranges are read off the whole curves after 8 s", s["widths_of_curves"])
            )
    for experiment in ("offline", "online"):
        for group in ("mass", "inertia"):
            entry = s.get(f"crazyem_{experiment}_{group}")
            if entry:
                lines.append(
                    f"crazyem, {experiment}, {group}: largest bias {percent(entry['largest_bias'], sign=True)}"
                    f", rms error over the bound {number(entry['rms_over_bound'])}, 95 % intervals hold "
                    f"{percent(entry['coverage'], 1)}."
                )
    crashed = [f"{f['sensor']} {f['method']} {f['crashed']}" for f in results["flights"] if f["crashed"]]
    printed = [f"{f['sensor']} {f['crashed_as_printed']}" for f in results["flights"] if f["crashed_as_printed"]]
    if printed:
        lines.append(
            f"Published method as printed: online flights that crashed (sensor, how many): {', '.join(printed)}; they "
            "were flown again with estimates kept positive."
        )
    if crashed:
        lines.append(f"Online flights that crashed and are in no table: {', '.join(crashed)}.")
    lines.append(
        "The flights of sensors A, B and C share their seeds, offline even the flight, so their errors are correlated."
    )
    lines.append(
        "When the paper's curves have settled: " + "; ".join(f"{k[0]} {v}" for k, v in CONVERGENCE.items()) + "."
    )
    return lines


def _widths(what: str, widths: Record) -> str:
    out = widths["out_of_half_to_double"]
    return (
        f"{what}: geometric mean {number(widths['all'])} (mass {number(widths['mass'])}, inertia "
        f"{number(widths['inertia'])}), {number(widths['least'])} to {number(widths['largest'])}; "
        + (f"outside of 0.5 to 2: {', '.join(out)}." if out else "none outside of 0.5 to 2.")
    )


def tables_markdown(results: Record) -> str:
    """The content of tables.md."""
    blocks = [f"# {PAPER}: its tables", _from(results)]
    blocks += [grid.markdown() for grid in grids(results)]
    blocks += ["## Notes", "\n".join(f"- {line}" for line in notes(results))]
    blocks += [corrections_grid().markdown(), settings_grid(results["settings"]).markdown()]
    return "\n\n".join(blocks) + "\n"


def _from(results: Record) -> str:
    e = results["environment"]
    return (
        f"Made by `crazyem paper`, crazyem {e['crazyem']} (code {e['code']}), Python {e['python']}, "
        f"numpy {e['numpy']}, numba {e['numba']}, {e['system']} {e['machine']}. Mass in kg, inertia in 1e-4 kg m^2."
    )


def index_html(results: Record, figures: Sequence[Record]) -> str:
    """The content of index.html; figures as `figures.draw_all` returns them."""
    title = html.escape(PAPER)
    parts = [
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f"<style>\n{_CSS}\n</style>\n</head>\n<body>",
        f"<h1>{title}</h1>",
        "<p>Every result of the paper, made again: as printed, as its method gives it here, as crazyem's "
        "estimator gives it from the same kind of data, and the Cramer-Rao bound. Numbers: "
        '<a href="results.json">results.json</a>, <a href="tables.md">tables.md</a>.</p>',
        f"<p>{html.escape(_from(results))}</p>",
        "<ul>",
        *(f"<li>{html.escape(line)}</li>" for line in notes(results)),
        "</ul>",
        *(grid.html() for grid in grids(results)),
        "<h2>Figures</h2>",
        "<p>Red: the truth. Grey: the range the paper prints. Dashed: its method. Blue: crazyem. Not drawn, as they "
        f"show no results: {html.escape('; '.join(f'Figure {n}, {what}' for n, what in NOT_RESULTS.items()))}.</p>",
        *(_figure(f) for f in figures),
        corrections_grid().html(),
        settings_grid(results["settings"]).html(),
        "</body>\n</html>\n",
    ]
    return "\n".join(parts)


def _figure(figure: Record) -> str:
    name = f"figures/{figure['file']}"
    caption = html.escape(f"Figure {figure['number']}: {figure['caption']}. {figure['note']}")
    return (
        f'<figure id="{figure["file"]}"><a href="{name}.svg"><img src="{name}.png" alt="Figure {figure["number"]}" '
        f'loading="lazy"></a><figcaption>{caption} <a href="{name}.svg">SVG</a></figcaption></figure>'
    )
