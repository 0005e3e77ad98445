"""tables.md and index.html: results of a run beside the paper's values; self-contained files."""

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from crazyem.paper.published_values import CONVERGENCE, CORRECTIONS, NOT_RESULTS
from crazyem.paper.table_text import Grid, grids, number, percent

Record = Mapping[str, Any]
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
