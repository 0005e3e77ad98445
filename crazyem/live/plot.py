"""The summary plot: estimates with their intervals over time, pushes, and the tracking error."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crazyem.live.history import History
from crazyem.notebook import new_figure, saved
from crazyem.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_POINTS = 2000  # points per curve


def write_plot(path: str | Path, history: History, vehicle: Vehicle, *, title: str) -> None:
    """Draw `history` into a PNG (or any format matplotlib knows by the suffix).

    Raises:
        UsageError: the file cannot be written. MissingExtraError: no matplotlib.
    """
    saved(figure_of(history, vehicle, title=title), path)


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
        panels = (
            (axes[0], ("mass",), 1e3, "mass [g]"),
            (axes[1], ("Ixx", "Iyy"), 1e6, "Ixx, Iyy [1e-6 kg m²]"),
            (axes[2], ("Izz",), 1e6, "Izz [1e-6 kg m²]"),
            (axes[3], ("motor_time_constant",), 1e3, "motor time constant [ms]"),
        )
        for axis, names, scale, label in panels:
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
            for push in history.pushes:
                axis.axvline(push.time - t0, color="0.5" if push.verified else "red", linewidth=0.6, alpha=0.6)
        last = axes[4]
        if len(track):
            thin = track[:: max(1, len(track) // MOST_POINTS)]
            last.plot(thin[:, 0] - t0, thin[:, 3], "C0", label="height")
            if np.isfinite(thin[:, 6]).any():
                last.plot(thin[:, 0] - t0, thin[:, 6], "k:", label="height wanted")
            last.legend(loc="upper right")
        last.set_ylabel("height [m]")
        last.set_xlabel("time [s], drone's clock (dotted: vehicle file; vertical lines: pushes)")
        last.grid(alpha=0.3)
    return figure
