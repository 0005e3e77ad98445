"""Setpoints of a flight in a drawn world: take-off, hover, 20 s of a style, landing, at 100 Hz.

Some styles are those of `crazyem fly`; helix, vertical, oval, star and multisine are made here, in sizes and speeds
drawn for each flight. The setpoints depend only on a table of numbers.
"""

import csv
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.control.named_trajectories import DEFAULT_HEIGHT, trajectory_maker
from crazyem.control.trajectories import smooth_step, window

RATE = 100.0  # Hz
TAKE_OFF, HOVER, LANDING, STOPPED = 2.0, 3.0, 2.5, 0.5  # s
RAMP = 2.0  # s until a course has its full size
OWN = ("hover", "excite", "figure8", "fast", "low")  # of the tool, or through waypoints
MADE = ("helix", "vertical", "oval", "star", "multisine", "draught")
Table = dict[str, Any]


@dataclass(frozen=True)
class Course:
    """Setpoints. Times from the start of the motors [s]; world frame, m, m/s, m/s^2, rad, rad/s.

    Attributes:
        time: (n,). position, velocity, acceleration: (n, 3). yaw, yaw_rate: (n,).
        start, end: s between which the style is flown.
    """

    time: NDArray
    position: NDArray
    velocity: NDArray
    acceleration: NDArray
    yaw: NDArray
    yaw_rate: NDArray
    start: float
    end: float


def size_of(style: str, random: np.random.Generator) -> Table:
    """Sizes of a made style: lengths in m, periods in s; empty for the others."""
    uniform = random.uniform
    sizes: dict[str, Table] = {
        "helix": {"radius": uniform(0.2, 0.7), "height": uniform(0.1, 0.4), "period": uniform(3.0, 6.0),
                  "turns": float(random.choice((0.0, 1.0)))},
        "vertical": {"height": uniform(0.2, 0.4), "period": uniform(1.6, 4.0)},
        "oval": {"radius": uniform(0.6, 1.1), "width": uniform(0.3, 0.6), "period": uniform(4.0, 7.0),
                 "heading": uniform(-math.pi, math.pi)},
        "star": {"radius": uniform(0.5, 0.9), "period": uniform(1.6, 2.6)},
        "multisine": {"size": uniform(0.5, 1.5), "phases": uniform(0.0, 2 * math.pi, 20).round(3).tolist()},
    }  # fmt: skip
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in sizes.get(style, {}).items()}


def course(flight: Mapping[str, Any], duration: float) -> Course:
    """The setpoints of a drawn flight (style, waypoints, size), `duration` [s] of its style."""
    style, times = str(flight["style"]), np.arange(0.0, duration + 1e-9, 1.0 / RATE)
    if style in MADE and style != "draught":
        moved = _moved(style, flight["size"], times, duration)
    else:
        moved = _of_the_tool(flight, times, duration)
    up = np.array([smooth_step(t / TAKE_OFF)[0] for t in np.arange(0.0, TAKE_OFF, 1.0 / RATE)])
    down = np.array([smooth_step(t / LANDING)[0] for t in np.arange(0.0, LANDING, 1.0 / RATE)])
    still = np.zeros((round(HOVER * RATE), 4))
    still[:, 2] = DEFAULT_HEIGHT
    rise, sink = np.zeros((up.size, 4)), np.tile(moved[-1], (down.size, 1))
    rise[:, 2], sink[:, 2] = DEFAULT_HEIGHT * up, moved[-1, 2] + (-0.02 - moved[-1, 2]) * down
    path = np.concatenate([rise, still, moved, sink])
    velocity = np.gradient(path, 1.0 / RATE, axis=0)
    acceleration = np.gradient(velocity, 1.0 / RATE, axis=0)
    start = TAKE_OFF + HOVER
    return Course(
        np.arange(len(path)) / RATE, path[:, :3], velocity[:, :3], acceleration[:, :3], path[:, 3], velocity[:, 3],
        start, start + duration,
    )  # fmt: skip


def _of_the_tool(flight: Mapping[str, Any], times: NDArray, duration: float) -> NDArray:
    """(n, 4) place and yaw of a trajectory of `crazyem fly`."""
    style = "hover" if flight["style"] == "draught" else flight["style"]
    with tempfile.TemporaryDirectory() as folder:
        words = [style]
        if flight["waypoints"]:
            file = Path(folder) / "waypoints.csv"
            with file.open("w", newline="") as text:
                table = csv.DictWriter(text, list(flight["waypoints"][0]))
                table.writeheader()
                table.writerows(flight["waypoints"])
            words = ["waypoints", str(file)]
        path = trajectory_maker(words, duration)((0.0, 0.0, DEFAULT_HEIGHT), 0.0)
    references = [path.at(float(t)) for t in times]
    return np.array([(*r.position, r.yaw) for r in references])


def _moved(style: str, size: Table, times: NDArray, duration: float) -> NDArray:
    """(n, 4) position and yaw of a made style: from the hover point and back, with two ramps around its full size."""
    weight = np.array([window(float(t), duration=duration, ramp=RAMP)[0] for t in times])
    out = np.zeros((times.size, 4))
    angle = 2 * math.pi * times / size.get("period", 1.0)
    if style == "helix":
        out[:, 0], out[:, 1] = size["radius"] * np.cos(angle), size["radius"] * np.sin(angle)
        out[:, 2] = size["height"] * np.sin(angle / 4)
        out[:, 3] = size["turns"] * 0.6 * np.sin(angle / 2)
    elif style == "vertical":
        out[:, 2] = size["height"] * np.sin(angle)
    elif style == "oval":
        along, across = size["radius"] * np.sin(angle), size["width"] * np.cos(angle)
        c, s = math.cos(size["heading"]), math.sin(size["heading"])
        out[:, 0], out[:, 1] = c * along - s * across, s * along + c * across
    elif style == "star":  # to the next of five points and back to the middle
        point = np.floor(times / size["period"])
        reach = size["radius"] * np.sin(math.pi * times / size["period"]) ** 2
        out[:, 0], out[:, 1] = reach * np.cos(0.8 * math.pi * point), reach * np.sin(0.8 * math.pi * point)
    elif style == "multisine":
        frequencies = np.geomspace(0.15, 2.2, 5)
        phases = np.array(size["phases"]).reshape(4, 5)
        for axis, rms in enumerate((0.5, 0.5, 0.4, 2.0)):  # m/s^2, rad/s^2 of all lines together, at size 1
            for f, p in zip(frequencies, phases[axis]):
                most = min(size["size"] * rms * math.sqrt(2 / 5) / (2 * math.pi * f) ** 2, 0.25)
                out[:, axis] += most * np.sin(2 * math.pi * f * times + p)
    out *= weight[:, None]
    out[:, 2] += DEFAULT_HEIGHT
    return out
