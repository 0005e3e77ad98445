"""The summary plot: estimates with their intervals over time, pushes, and the tracking error."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from crazyem.estimation.result import Estimate
from crazyem.live.history import History
from crazyem.notebook import new_figure
from crazyem.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
