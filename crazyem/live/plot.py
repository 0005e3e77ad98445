"""The summary plot: estimates with their intervals over time, pushes, and the tracking error."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from crazyem.estimation.result import Estimate
from crazyem.live.history import History
from crazyem.notebook import new_figure, saved
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
        for axis, panel in zip(axes, PANELS):
            _draw_parameters(axis, *panel, estimates, time, nominal)
            for push in history.pushes:
                axis.axvline(push.time - t0, color="0.5" if push.verified else "red", linewidth=0.6, alpha=0.6)
from typing import TYPE_CHECKING, Any

import numpy as np

from crazyem.estimation.result import Estimate
