"""Display of results in a notebook: HTML tables of escaped text, and figures of matplotlib."""

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazyem.errors import UsageError
from crazyem.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def html_table(title: str, header: Sequence[str], rows: Iterable[Sequence[object]], notes: Iterable[str] = ()) -> str:
    """A table for `_repr_html_`; every text is escaped."""
    head = "".join(f"<th>{escape(h)}</th>" for h in header)
    body = "".join(f"<tr>{''.join(f'<td>{escape(_cell(c))}</td>' for c in row)}</tr>" for row in rows)
    below = "".join(f"<p>{escape(note)}</p>" for note in notes)
    return (
        f"<p><strong>{escape(title)}</strong></p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        f"{below}"
    )


def _cell(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of this size [inch], without a window. Raises MissingExtraError without matplotlib."""
    require("matplotlib", "A plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def saved(figure: "Figure", path: str | Path | None) -> "Figure":
    """The figure, written to `path` unless that is None. Raises UsageError if the file cannot be written."""
    if path is not None:
        try:
            figure.savefig(path, dpi=110)
        except (OSError, ValueError) as error:
            raise UsageError(f"cannot write the plot {path}: {error}.") from None
    return figure


def finite(value: Any) -> Any:
    """The value for JSON, which has no NaN and no infinity: these become None; tuples become lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value
