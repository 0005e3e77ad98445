"""Figures 3-5 and 8-37 of the paper, drawn from the records of this run: paper's method dashed, crazyem beside it."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.atomic_file import write_file
from crazyem.extras import require
from crazyem.paper.flight import Flight, fly
from crazyem.paper.published_values import FIGURES, PARAMETERS, PUBLISHED_RANGES, UNITS, PaperFigure
from crazyem.paper.settings import Settings

Record = Mapping[str, Any]
DENSE_UPDATES, UPDATE_STRIDE = 100, 5  # of online curves: the first 100 updates, then every fifth; more is not visible
STATE_EVERY = 5  # rows of the state plots
_DPI = 100
_STYLE: Any = {
    "font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "crazyem", "axes.grid": True, "grid.alpha": 0.3,
    "legend.fontsize": 8,
}  # fmt: skip
_PUBLISHED = {"color": "C1", "linestyle": "--", "linewidth": 0.7, "alpha": 0.8}
_CRAZYEM = {"color": "C0", "linestyle": "-", "linewidth": 0.7, "alpha": 0.8}


def draw_all(records: Sequence[Record], settings: Settings, folder: Path) -> list[dict[str, Any]]:
    """Draw every figure for which there are records into figure_NN.png and figure_NN.svg.

    Args:
        records: as `experiments.run_task` gives them.
        settings: of the run; the flights of Fig. 3-5 and of the offline paths are flown again.
        folder: where to; must exist.

    Returns: number, file (without suffix), caption, note (differences from the paper's figure) of each, in order.

    Raises: UsageError: a file cannot be written. MissingExtraError: no matplotlib.
    """
    require("matplotlib", "The paper's figures")
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    known: Flight | None = None
    done = []
    with matplotlib.rc_context(_STYLE):
        for wanted in FIGURES:
            mine = [r for r in records if r["experiment"] == wanted.experiment and r["sensor"] == wanted.sensor]
            runs = {m: [r for r in mine if r["method"] == m] for m in ("published", "crazyem")}
            if not mine or (wanted.experiment != "table1" and not any(runs.values())):
                continue
            if known is None and wanted.experiment != "online":
                known = fly(settings, 0)
            figure = Figure(figsize=(7.0, 6.0) if wanted.kind != "path" else (6.0, 5.0))
            FigureCanvasAgg(figure)
            if wanted.experiment == "table1":
                note = _states(figure, wanted, known)
            elif wanted.kind == "path":
                note = _path(figure, wanted, settings, known, runs)
            elif wanted.experiment == "offline":
                note = _offline(figure, wanted, settings, runs)
            else:
                note = _online(figure, wanted, settings, runs)
            figure.suptitle(f"Figure {wanted.number}: {wanted.caption}", fontsize=10)
            stem = f"figure_{wanted.number:02d}"
            _save(figure, folder / stem)
            done.append({"number": wanted.number, "file": stem, "caption": wanted.caption, "note": note})
    return done


def _save(figure: Any, path: Path) -> None:
    kinds: tuple[tuple[str, dict[str, Any]], ...] = (
        (".png", {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": 3}}),
        (".svg", {"metadata": {"Date": None, "Creator": None}}),
    )
    for suffix, options in kinds:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix[1:], dpi=_DPI, **options)
        write_file(path.with_suffix(suffix), buffer.getvalue())


# states and paths ---------------------------------------------------------------------------------------------


def _states(figure: Any, wanted: PaperFigure, flight: Flight | None) -> str:
    assert flight is not None
    data = {"state": flight.truth, "estimate": flight.estimate, "error": flight.estimate - flight.truth}[wanted.kind]
    rows = slice(0, flight.size, STATE_EVERY)
    panels = (
        ("position [m]", "xyz", 3e-2), ("velocity [m/s]", "xyz", 3e-2),
        ("angles [rad]", ("roll", "pitch", "yaw"), 3e-2), ("body rate [rad/s]", "xyz", 0.15),
    )  # fmt: skip
    for i, (axis, (label, names, limit)) in enumerate(zip(figure.subplots(4, 1, sharex=True), panels)):
        for j, (name, colour) in enumerate(zip(names, ("k", "g", "b"))):
            axis.plot(flight.time[rows], data[rows, 3 * i + j], colour, linewidth=0.8, label=name)
        if wanted.kind == "error":
            axis.axhline(limit, color="r", linewidth=0.8, linestyle=":")
            axis.axhline(-limit, color="r", linewidth=0.8, linestyle=":")
        axis.set_ylabel(label)
        axis.legend(loc="upper right", ncols=3)
    axis.set_xlabel("time [s]")
    figure.subplots_adjust(left=0.11, right=0.98, top=0.93, bottom=0.08, hspace=0.12)
    return "One flight, seed 0." + (" Dotted: what the paper says errors stay below." if wanted.kind == "error" else "")


def _path(
    figure: Any, wanted: PaperFigure, settings: Settings, known: Flight | None, runs: Mapping[str, Sequence[Record]]
) -> str:
    axis = figure.add_subplot(projection="3d")
    points = np.array([settings.start, *settings.waypoints])
    axis.plot(*points.T, "k^", markersize=5, label="start and waypoints")
    if wanted.experiment == "offline":
        assert known is not None
        axis.plot(*known.truth[: known.size : STATE_EVERY, :3].T, "C0", linewidth=1, label="flown")
        note = (
            "One flight, seed 0. Offline the sensor only matters afterwards: Figures 8, 13 and 18 are the same flight."
        )
    else:
        for method, style, width in (("crazyem", "C0-", 1.0), ("published", "C1--", 1.5)):
            for record in runs[method][:1]:
                axis.plot(*np.array(record["path"]).T, style, linewidth=width, label=f"{method} in the loop")
        note = "One flight of each method, seed 0; they differ while the parameters are being found."
    for name in "xyz":
        getattr(axis, f"set_{name}label")(f"{name} [m]")
    low, high = points.min(axis=0) - 0.5, points.max(axis=0) + 0.5
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.legend(loc="upper left")
    figure.subplots_adjust(left=0.02, right=0.95, top=0.95, bottom=0.05)
    return note


# convergence --------------------------------------------------------------------------------------------------


Marks = tuple[float, float, float]  # ends of the paper's range, truth


def _panels(figure: Any, wanted: PaperFigure, settings: Settings, label: str) -> tuple[Any, Any, int, float, Marks]:
    """Two axes, whole and enlarged, with the truth in red and the paper's range; also column, scale and marks."""
    column = PARAMETERS.index(wanted.parameter)
    scale = 1.0 if wanted.parameter == "mass" else 1e4
    truth = scale * (settings.mass, *settings.inertia)[column]
    whole, near = figure.subplots(2, 1, sharex=True)
    low, high = (scale * v for v in PUBLISHED_RANGES[wanted.experiment, wanted.sensor][wanted.parameter])
    for axis in (whole, near):
        axis.axhspan(low, high, color="0.5", alpha=0.2, linewidth=0, label="paper's range")
        axis.axhline(truth, color="r", linewidth=1.2, label="true", zorder=3)
        axis.set_ylabel(f"{wanted.parameter} [{'1e-4 ' if scale != 1 else ''}{UNITS[wanted.parameter]}]")
    whole.set_ylim(0, 2 * truth)
    near.set_xlabel(label)
    figure.subplots_adjust(left=0.12, right=0.98, top=0.93, bottom=0.09, hspace=0.1)
    return whole, near, column, scale, (low, high, truth)


def _enlarge(axis: Any, settled: Sequence[float], marks: Marks) -> None:
    """Limits that hold the settled values, the paper's range and the truth."""
    truth = marks[2]
    values = [v for v in (*settled, *marks) if np.isfinite(v)]
    low, high = max(min(values), 0.5 * truth), min(max(values), 2 * truth)
    margin = 0.15 * (high - low) or 0.01 * truth
    axis.set_ylim(low - margin, high + margin)


def _lines(axis: Any, x: NDArray, curves: Sequence[NDArray], style: Mapping[str, Any], label: str) -> None:
    """Draw all curves as one line with gaps: several times faster than separate lines."""
    if curves:
        gap = [np.nan]
        ys = np.concatenate([part for curve in curves for part in (curve, gap)])
        xs = np.concatenate([part for curve in curves for part in (x[: len(curve)], gap)])
        axis.plot(xs, ys, label=label, **style)


def _column(rows: Any, column: int, scale: float) -> NDArray:
    """A column of a record's list of rows, null as NaN."""
    return scale * np.array([np.nan if row[column] is None else row[column] for row in rows], float)


def _offline(figure: Any, wanted: PaperFigure, settings: Settings, runs: Mapping[str, Sequence[Record]]) -> str:
    whole, near, column, scale, marks = _panels(figure, wanted, settings, "EM iteration")
    published = [_column(r["theta"], column, scale) for r in runs["published"]]
    settled = [c[-1] for c in published]
    last = max((len(c) - 1 for c in published), default=20)
    histories = [_column(r["theta"], column, scale) for r in runs["crazyem"] if r.get("theta")]
    limits = scale * np.array([r["ci95"][column] for r in runs["crazyem"]], float).reshape(-1, 2)
    finals = _column([r["final"] for r in runs["crazyem"]], column, scale)
    at = last + 1 + 0.25 * np.arange(len(finals))
    settled += limits.ravel().tolist()
    for axis in (whole, near):
        _lines(axis, np.arange(last + 1), published, _PUBLISHED, f"published, {len(published)} runs")
        _lines(axis, np.arange(max(map(len, histories), default=0)), histories, _CRAZYEM, "crazyem")
        axis.vlines(at, limits[:, 0], limits[:, 1], "C0", linewidth=1, label="crazyem, 95 % intervals")
        axis.plot(at, finals, "C0.", markersize=3)
    _enlarge(near, settled, marks)
    whole.legend(loc="upper right")
    return "Below, enlarged. crazyem's estimates with their 95 % intervals stand at the right, one for each flight."


def _online(figure: Any, wanted: PaperFigure, settings: Settings, runs: Mapping[str, Sequence[Record]]) -> str:
    label = f"update (every {settings.every} steps of {1e3 * settings.dt:g} ms)"
    whole, near, column, scale, marks = _panels(figure, wanted, settings, label)
    settled: list[float] = []
    for method, style in (("published", _PUBLISHED), ("crazyem", _CRAZYEM)):
        curves = [_column(r["theta"], column, scale) for r in runs[method]]
        longest = max(map(len, curves), default=0)
        shown = np.array([i for i in range(longest) if i < DENSE_UPDATES or i % UPDATE_STRIDE == 0], int)
        settled += [v for r in runs[method] for w in r["windows"] if (v := w["value"][column]) is not None and v > 0]
        thinned = [c[shown[shown < len(c)]] for c in curves]
        for axis in (whole, near):
            _lines(axis, shown, thinned, style, f"{method}, {len(curves)} runs")
    settled = [scale * v for v in settled]
    for record in runs["crazyem"][:1]:
        rows, ci95 = _band(record, column, scale)
        for axis in (whole, near):
            axis.fill_between(rows, ci95[:, 0], ci95[:, 1], color="C0", alpha=0.2, linewidth=0, label="95 % interval")
    _enlarge(near, settled, marks)
    whole.legend(loc="upper right")
    return "Below, enlarged; the first updates are outside. The band is crazyem's 95 % interval in the first flight."


def _band(record: Record, column: int, scale: float) -> tuple[NDArray, NDArray]:
    """(n,) updates and (n, 2) limits of the stored intervals."""
    rows, limits = [], []
    for row, interval in zip(record["interval_rows"], record["intervals"]):
        if interval is not None and None not in interval[column]:
            rows.append(row)
            limits.append([scale * v for v in interval[column]])
    return np.array(rows, int), np.array(limits, float).reshape(-1, 2)
