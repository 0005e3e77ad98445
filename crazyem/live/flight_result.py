"""The result of a flight, a watch or a replay: the estimate, the summary, and their history.

The summary is JSON for programs (names are an interface), text and a plot for people. The plot shows estimates with
their intervals over time, pushes and the height.
"""

import errno
import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from crazyem.errors import UsageError
from crazyem.estimation.result import Estimate
from crazyem.live.history import History
from crazyem.notebook import finite, html_table, new_figure, saved
from crazyem.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from crazyem.live.pipeline import Pipeline

MOST_POINTS = 2000  # points per curve
PANELS = (  # parameters, factor from SI, label
    (("mass",), 1e3, "mass [g]"),
    (("Ixx", "Iyy"), 1e6, "Ixx, Iyy [1e-6 kg m²]"),
    (("Izz",), 1e6, "Izz [1e-6 kg m²]"),
    (("motor_time_constant",), 1e3, "motor time constant [ms]"),
)


def figure_of(history: History, vehicle: Vehicle, *, title: str) -> "Figure":
    """The figure of a history. Raises MissingExtraError without matplotlib."""
    figure = new_figure(9, 11)
    import matplotlib

    track = history.track_array()
    estimates = history.estimates[:: max(1, len(history.estimates) // MOST_POINTS)] + history.estimates[-1:]
    t0 = track[0, 0] if len(track) else (estimates[0].time if estimates else 0.0)
    time = np.array([e.time for e in estimates]) - t0
    nominal = dict(zip(("mass", "Ixx", "Iyy", "Izz"), (vehicle.mass, *vehicle.inertia)))
    nominal["motor_time_constant"] = vehicle.motor_time_constant

    with matplotlib.rc_context({"font.size": 9}):
        axes = figure.subplots(5, 1, sharex=True)
        figure.suptitle(title)
        for axis, panel in zip(axes, PANELS):
            _draw_parameters(axis, *panel, estimates, time, nominal)
            for push in history.pushes:
                axis.axvline(push.time - t0, color="0.5" if push.verified else "red", linewidth=0.6, alpha=0.6)
        _draw_height(axes[4], track, t0)
    return figure


def _draw_parameters(
    axis: Any,
    names: Sequence[str],
    scale: float,
    label: str,
    estimates: Sequence[Estimate],
    time: np.ndarray,
    nominal: Mapping[str, float],
) -> None:
    """Values with intervals over `time` [s], (n,); the vehicle file's values dotted. The last values set the limits."""
    limits = []
    for i, name in enumerate(names):
        if not all(name in e.parameters for e in estimates) or not estimates:
            continue
        value = scale * np.array([e[name].value for e in estimates])
        ci = scale * np.array([e[name].ci95 for e in estimates])
        colour = f"C{i}"
        axis.plot(time, value, colour, label=name)
        axis.fill_between(time, ci[:, 0], ci[:, 1], color=colour, alpha=0.2, linewidth=0)
        axis.axhline(scale * nominal[name], color=colour, linestyle=":", linewidth=1)
        limits += [value[-1], scale * nominal[name], *ci[-1]]
    limits = [v for v in limits if np.isfinite(v)]
    if limits:
        low, high = min(limits), max(limits)
        margin = 0.6 * (high - low) + 0.02 * abs(high)
        axis.set_ylim(max(low - margin, 0.0), high + margin)
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    if len(names) > 1:
        axis.legend(loc="upper right")


def _draw_height(axis: Any, track: np.ndarray, t0: float) -> None:
    """Height and wanted height [m] of a track (n, 7), see `History.track_array`."""
    if len(track):
        thin = track[:: max(1, len(track) // MOST_POINTS)]
        axis.plot(thin[:, 0] - t0, thin[:, 3], "C0", label="height")
        if np.isfinite(thin[:, 6]).any():
            axis.plot(thin[:, 0] - t0, thin[:, 6], "k:", label="height wanted")
        axis.legend(loc="upper right")
    axis.set_ylabel("height [m]")
    axis.set_xlabel("time [s], drone's clock (dotted: vehicle file; vertical lines: pushes)")
    axis.grid(alpha=0.3)


def build_summary(
    *,
    log: str | None,
    vehicle: str,
    estimate: Estimate,
    history: History,
    update_seconds: Sequence[float],
    received: int,
    lost: int,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The summary object.

    Args:
        log: path of the recording.
        update_seconds: cost of each update, s.
        received, lost: log packets (live) or samples (foreign recordings).
        extra: further keys, such as the controller, the seed or the URI.
    """
    ms = 1e3 * np.asarray(update_seconds, dtype=float)
    rms, height = history.before_and_after()
    return {
        "log": log,
        "vehicle": vehicle,
        "estimates": estimate.to_json(),
        "pushes": [p.to_json() for p in history.pushes],
        "guard": history.guard or None,
        "steps": [step.to_json() for step in history.steps],
        "faults": [fault.to_json() for fault in history.faults],
        "monitored_s": history.monitored,
        "updates": estimate.updates,
        "update_ms": {
            "median": float(np.median(ms)) if ms.size else None,
            "p99": float(np.percentile(ms, 99)) if ms.size else None,
        },
        "samples": {"received": received, "lost": lost},
        "tracking_rms_m": rms,
        "height_error_m": height,
        "noise": dict(estimate.noise),
        "converged": estimate.converged,
        **(extra or {}),
        "notices": list(history.notices),
    }


def write_json(summary: Mapping[str, Any], path: str) -> None:
    """Write the summary to a file, or to standard output for '-'. Raises UsageError: the file cannot be written."""
    text = json.dumps(finite(summary), indent=2, allow_nan=False) + "\n"
    if path == "-":
        sys.stdout.write(text)
        return
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as e:
        raise UsageError(f"cannot write {path}: {e.strerror}.") from None


def check_writable(path: str | None) -> None:
    """Check before the flight that a result can be written after it.

    Raises: UsageError: the file cannot be opened for writing.
    """
    if path is None or path == "-":
        return
    target = Path(path)
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if target.exists() and not target.is_file():
            return  # a device or a pipe: opening it may block
        existed = target.exists()
        with target.open("ab"):  # only opening tests permissions and the file system reliably
            pass
        if not existed:
            target.unlink()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise UsageError(f"cannot write {path}: {why}.") from None


def text_summary(summary: Mapping[str, Any], estimate: Estimate) -> str:
    """A few lines for the terminal."""
    lines = [str(estimate)]
    lines += [
        f"mass changed at {s['time']:.2f} s: {s['before_kg']:.4g} -> {s['after_kg']:.4g} kg"
        for s in summary.get("steps", ())
        if s["real"]
    ]
    pushes = summary["pushes"]
    if pushes:
        unverified = sum(not p["verified"] for p in pushes)
        lines.append(f"pushes: {len(pushes)} parameter writes, {unverified} not confirmed")
    lines += guard_lines(summary.get("guard"))
    received, lost = summary["samples"]["received"], summary["samples"]["lost"]
    ms = summary["update_ms"]
    cost = f", {ms['median']:.2f} ms each (99 %: {ms['p99']:.2f} ms)" if ms["median"] is not None else ""
    lines.append(f"updates: {summary['updates']}{cost}; packets: {received} received, {lost} lost")
    for key, label, sign in (
        ("height_error_m", "mean height error", "+"),
        ("tracking_rms_m", "tracking error, rms", ""),
    ):
        before, after = summary[key]["before_push"], summary[key]["after_push"]
        if before is not None:
            then = f", {after:{sign}.3f} m after pushing" if after is not None else ""
            lines.append(f"{label}: {before:{sign}.3f} m{then}")
    lines += [f"note: {n}" for n in summary["notices"]]
    return "\n".join(lines)


def guard_lines(guard: Mapping[str, Any] | None) -> list[str]:
    """Lines about the guard: writes of a dry run, reverts, and the reason if nothing was pushed."""
    if not guard:
        return []
    decisions = guard["decisions"]
    lines = []
    if guard["mode"] == "dry run":
        values = {name: value for d in decisions if d["action"] == "would write" for name, value in d["writes"]}
        would = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
        lines.append(f"dry run: nothing was written{'; would have ended with ' + would if would else ''}")
    reverts = [d for d in decisions if d["action"] == "revert"]
    lines += [f"taken back at {d['time']:.1f} s: {d['reason']}" for d in reverts]
    held = [d for d in decisions if d["action"] == "hold"]
    if held and not any(d["action"] in ("write", "would write") for d in decisions):
        lines.append(f"nothing was pushed: {held[-1]['reason']}")
    return lines


def live_line(phase: str, seconds: float, estimate: Estimate | None, *, lost: int, pushes: int) -> str:
    """One line per second: phase, mass and inertia with 95 % half widths, losses, pushes."""
    head = f"{phase:<13.13} {seconds:6.1f} s"
    if estimate is None:
        return f"{head}  no estimate yet"
    parts = []
    for name, unit, scale in (("mass", " g", 1e3), ("Ixx", "", 1e6), ("Iyy", "", 1e6), ("Izz", " e-6 kg m2", 1e6)):
        p = estimate[name]
        parts.append(f"{name} {interval_text(p.value, p.ci95, p.identifiable, scale=scale)}{unit}")
    return f"{head}  {'  '.join(parts)}  lost {lost}  pushes {pushes}"


def interval_text(value: float, ci95: Sequence[float], identifiable: bool, *, scale: float) -> str:
    """A value with the half width of its interval, both times `scale`; with a question mark if not identifiable."""
    half = (ci95[1] - ci95[0]) / 2 * scale
    width = f"{half:.2f}" if half < 99 else ">99"  # keeps the line within a terminal
    return f"{value * scale:.2f}+-{width}{'' if identifiable else '?'}"


@dataclass(frozen=True, eq=False)
class FlightResult:
    """The result of `crazyem.fly` and `crazyem.replay`.

    Attributes:
        estimate: the final one, of the newest window.
        summary: for programs, with the keys of the command's JSON (docs/reference/json.md).
        history: track, estimates, writes and steps of mass over time.
        vehicle: the nominal one.
        title: of the flight, one line.
    """

    estimate: Estimate
    summary: Mapping[str, Any]
    history: History
    vehicle: Vehicle
    title: str

    def to_dict(self) -> dict[str, Any]:
        """The summary, ready for JSON: numbers that are not finite are None."""
        summary: dict[str, Any] = finite(self.summary)
        return summary

    def __str__(self) -> str:
        return text_summary(self.summary, self.estimate)

    def _repr_html_(self) -> str:
        rows = [(n, p.value, p.sd, *p.ci95, p.unit, p.reason) for n, p in self.estimate.parameters.items()]
        header = ("parameter", "value", "sd", "95 % from", "to", "unit", "not identifiable")
        return html_table(self.title, header, rows, self.summary["notices"])

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot of estimates with intervals over time, writes and height; saved to `path` if given.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        from crazyem.live.flight_result import figure_of

        return saved(figure_of(self.history, self.vehicle, title=self.title), path)


def result_of(
    pipeline: "Pipeline",
    vehicle: Vehicle,
    *,
    title: str,
    log: str | None,
    received: int,
    lost: int,
    extra: Mapping[str, Any],
    notices: Iterable[str] = (),
) -> FlightResult:
    """The result of a session that has ended; for the arguments see `build_summary`.

    notices: further sentences for the user. Raises DataError: there is no flight to estimate from.
    """
    history = pipeline.history
    for sentence in notices:
        history.notice(sentence)
    estimate = pipeline.finish()
    summary = build_summary(
        log=log, vehicle=vehicle.name, estimate=estimate, history=history,
        update_seconds=pipeline.estimator.update_seconds, received=received, lost=lost, extra=extra,
    )  # fmt: skip
    return FlightResult(estimate, summary, history, vehicle, title)
