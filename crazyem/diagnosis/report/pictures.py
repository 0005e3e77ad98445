"""Pictures of a report: series as lines, drawn by matplotlib (imported on first use) into data URIs."""

import base64
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazyem.extras import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 1500  # points of a line; more are not visible
COLORS = ("#2f6f9f", "#d1603d", "#5a9367", "#8a6bbf", "#b58b00", "#4a4a4a")
ROLES = {"measured": "#222222", "recorded": "#222222", "before": "#d1603d", "after": "#2f6f9f"}


@dataclass(frozen=True, eq=False)
class Series:
    """One picture.

    Attributes:
        title: what the picture shows.
        x: (n,) numbers.
        lines: label -> (n,) values. Labels "measured", "before" and "after" have colours of their own.
        x_label, y_label: with the unit.
        section: "where" (the mismatch) or "fit" (before and after).
        shaded: intervals of x that are marked.
        level: half-width of a band around 0 of negligible values; 0: no band.
    """

    title: str
    x: Any
    lines: Mapping[str, Any]
    x_label: str = "time [s]"
    y_label: str = ""
    section: str = "where"
    shaded: Sequence[tuple[float, float]] = field(default_factory=tuple)
    level: float = 0.0


def data_uri(series: Series) -> str:
    """The picture as a data URI (SVG), which needs no other file.

    Raises: ValueError if a line has not as many values as there are x. MissingExtraError: no matplotlib.
    """
    require("matplotlib", "A picture")
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.style import context

    style = {
        "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#999999",
        "axes.labelcolor": "#333333", "xtick.color": "#555555", "ytick.color": "#555555", "svg.hashsalt": "crazyem",
        "axes.grid": True, "grid.color": "#e8e8e8", "axes.axisbelow": True, "path.simplify": True,
    }  # fmt: skip
    with warnings.catch_warnings(), context(style):
        warnings.simplefilter("ignore")  # missing letters of the font
        figure = Figure(figsize=(7.4, 2.3), layout="constrained")
        canvas = FigureCanvasSVG(figure)
        draw(figure.add_subplot(), series)
        buffer = io.BytesIO()
        canvas.print_svg(buffer, metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def draw(axes: "Axes", series: Series) -> None:
    """A picture into axes of matplotlib. Raises: ValueError if a line has not as many values as there are x."""
    lines = {str(label): np.asarray(values, float).ravel() for label, values in series.lines.items()}
    for label, values in lines.items():
        if values.size != len(series.x):
            raise ValueError(f"picture '{series.title}': line '{label}' has {values.size} values for {len(series.x)} x")
    x = np.asarray(series.x, float).ravel()
    for begin, end in series.shaded:
        if math.isfinite(begin) and math.isfinite(end):
            axes.axvspan(begin, max(end, begin + 1e-9), color="#f3d9a4", alpha=0.6, linewidth=0)
    if series.level > 0:
        axes.axhspan(-series.level, series.level, color="#e9eef2", linewidth=0, zorder=0)
    for k, (label, values) in enumerate(lines.items()):
        some, kept = thinned(x, values)
        wide = 1.6 if label in ("measured", "recorded") else 1.1
        axes.plot(some, kept, color=_color(label, k), linewidth=wide, label=_text(label))
    axes.set_xlabel(_text(series.x_label))
    axes.set_ylabel(_text(series.y_label))
    axes.margins(x=0.01)
    if len(lines) > 1:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), frameon=False, handlelength=1.2)


def _color(label: str, k: int) -> str:
    return ROLES.get(label.split(" ", maxsplit=1)[0].lower(), COLORS[k % len(COLORS)])


def thinned(x: NDArray, values: NDArray) -> tuple[NDArray, NDArray]:
    """At most about `MOST_POINTS` points with the same look: the smallest and the largest of each stretch."""
    if x.size <= MOST_POINTS:
        return x, values
    groups = np.array_split(np.arange(x.size), MOST_POINTS // 2)
    kept: list[int] = []
    for rows in groups:
        some = values[rows]
        if np.isfinite(some).any():
            kept += sorted({int(rows[np.nanargmin(some)]), int(rows[np.nanargmax(some)])})
        else:
            kept.append(int(rows[0]))
    return x[kept], values[kept]


def _text(text: str) -> str:
    """Text of recordings without formulas and control characters."""
    plain = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return plain.replace("\\", "/").replace("$", r"\$")[:120]
