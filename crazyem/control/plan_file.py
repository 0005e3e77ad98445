"""Plan files (TOML): a manoeuvre of `harmonics` and its limits, checked at every reading.

The format is in docs/reference/formats/plan.md. A file may come from any source. So its motion is computed from its
numbers, and must be within the limits in the file and within those of this module.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.control.harmonics import AXES, Axis, Harmonics
from crazyem.control.trajectories import MAX_ACCELERATION, Trajectory, Vector
from crazyem.errors import FileFormatError
from crazyem.toml_file import read_toml
from crazyem.vehicle import GRAVITY

FORMAT, VERSION = "crazyem-plan", 1
LONGEST = 300.0  # s; a Crazyflie's battery lasts less than ten minutes
SHORTEST_RAMP = 0.2  # s
MOST_LINES = 64  # harmonics of an axis
LARGEST_NUMBER = 1e6  # in a file, above every possible position, angle or frequency
HIGHEST_FREQUENCY = 10.0  # Hz; the attitude loops of these drones do not follow higher ones
LARGEST_BOX = 20.0  # m
LARGEST_TILT = 45.0  # deg; with more tilt, the thrust does not hold the height
LARGEST_YAW_RATE, LARGEST_YAW_ACCELERATION = 6.5, 60.0  # rad/s, rad/s^2
LEAST_HEIGHT = 0.1  # m, of the lowest point in the world frame, as for waypoints
GRID = 0.005  # s between the checked points of a plan
SLACK = 1.001  # factor on limits, for rounding errors in a file


@dataclass(frozen=True)
class PlanFile:
    """A plan: manoeuvre; box (3,) full widths, m; tilt, deg; vehicle for which it was made."""

    manoeuvre: Harmonics
    box: tuple[float, float, float]
    tilt: float
    vehicle: str


def read_plan(path: str | Path) -> PlanFile:
    """A plan that may be flown, from a file.

    Raises:
        UsageError: no such file. FileFormatError: one sentence that names the file and the key, or the exceeded limit.
    """
    data = read_toml(path, what="plan file")
    where = f"plan file {path}"
    if data.get("format") != FORMAT:
        raise FileFormatError(f"{where}: key 'format' must be '{FORMAT}'.")
    if data.get("version") != VERSION:
        raise FileFormatError(f"{where}: key 'version' must be {VERSION}.")
    duration = _number(data, "duration", where, 1.0, LONGEST)
    ramp = _number(data, "ramp", where, SHORTEST_RAMP, duration / 2)
    tilt = _number(data, "tilt", where, 0.1, LARGEST_TILT)
    box = _numbers(data, "box", where)
    if len(box) != 3 or not all(0.0 < v <= LARGEST_BOX for v in box):
        raise FileFormatError(f"{where}: key 'box' must hold three numbers up to {LARGEST_BOX:g} m.")
    axes = [_axis(data.get(name, {}), name, where) for name in AXES]
    manoeuvre = Harmonics(duration, ramp, (axes[0], axes[1], axes[2], axes[3]))
    plan = PlanFile(manoeuvre, (box[0], box[1], box[2]), tilt, str(data.get("vehicle", "")))
    _check(plan, where)
    return plan


def plan_trajectory(plan: PlanFile, *, path: str | Path, position: Vector, yaw: float) -> Trajectory:
    """The trajectory of a plan from the hover at `position` [m, world] with heading `yaw` [rad].

    Raises:
        FileFormatError: the plan would touch the ground from this position.
    """
    manoeuvre = plan.manoeuvre
    time = np.arange(0.0, manoeuvre.duration + GRID, GRID)
    lowest = position[2] + float(manoeuvre.derivatives(time)[0, :, 2].min())
    if lowest < LEAST_HEIGHT:
        raise FileFormatError(f"plan file {path} goes down to {lowest:.2f} m (at least {LEAST_HEIGHT:g} m).")
    return manoeuvre.trajectory(position, yaw, f"plan {Path(path).name}")


def _check(plan: PlanFile, where: str) -> None:
    """Check the plan against its own limits and those of this module. Raises FileFormatError."""
    time = np.arange(0.0, plan.manoeuvre.duration + GRID, GRID)
    place, speed, acceleration, _ = plan.manoeuvre.derivatives(time)
    far = np.abs(place[:, :3]).max(0)
    for name, reach, width in zip("xyz", far.tolist(), plan.box):
        if not reach <= SLACK * width / 2:
            raise FileFormatError(
                f"{where}: the manoeuvre leaves its box along {name} ({reach:.3g} m from its middle)."
            )
    most = float(np.linalg.norm(acceleration[:, :3], axis=1).max())
    if not most <= MAX_ACCELERATION:
        raise FileFormatError(f"{where}: the manoeuvre asks for {most:.3g} m/s^2 (at most {MAX_ACCELERATION:g}).")
    side = np.hypot(acceleration[:, 0], acceleration[:, 1])
    tilt = float(np.degrees(np.arctan2(side, GRAVITY + acceleration[:, 2])).max())
    if not tilt <= SLACK * plan.tilt:
        raise FileFormatError(f"{where}: the manoeuvre tilts by {tilt:.3g} degrees, more than its own {plan.tilt:g}.")
    turn, twist = (float(np.abs(v[:, 3]).max()) for v in (speed, acceleration))
    if not (turn <= LARGEST_YAW_RATE and twist <= LARGEST_YAW_ACCELERATION):
        raise FileFormatError(
            f"{where}: the manoeuvre turns by up to {turn:.3g} rad/s and {twist:.3g} rad/s^2 "
            f"(at most {LARGEST_YAW_RATE:g} and {LARGEST_YAW_ACCELERATION:g})."
        )


def _axis(table: Any, name: str, where: str) -> Axis:
    if not isinstance(table, dict):
        raise FileFormatError(f"{where}: key '{name}' must be a table.")
    if not table:
        return Axis()
    columns = [_numbers(table, key, f"{where}, [{name}]") for key in ("frequency", "cosine", "sine")]
    if len({len(c) for c in columns}) != 1 or len(columns[0]) > MOST_LINES:
        raise FileFormatError(
            f"{where}, [{name}]: frequency, cosine and sine must be of one length up to {MOST_LINES}."
        )
    if not all(0.0 < f <= HIGHEST_FREQUENCY for f in columns[0]):
        raise FileFormatError(f"{where}, [{name}]: frequencies must lie in (0, {HIGHEST_FREQUENCY:g}] Hz.")
    return Axis(*columns)


def _number(data: Mapping[str, Any], key: str, where: str, low: float, high: float) -> float:
    value = data.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise FileFormatError(f"{where}: key '{key}' must be a number in [{low:g}, {high:g}].")
    return float(value)


def _numbers(data: Mapping[str, Any], key: str, where: str) -> tuple[float, ...]:
    value = data.get(key)
    listed: list[Any] = value if isinstance(value, list) and len(value) <= MOST_LINES else [None]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < LARGEST_NUMBER for v in listed):
        raise FileFormatError(f"{where}: key '{key}' must hold at most {MOST_LINES} finite numbers.")
    return tuple(float(v) for v in listed)


def plan_toml(plan: PlanFile, comments: tuple[str, ...] = ()) -> str:
    """The text of a plan file, with `comments` at its beginning."""
    m = plan.manoeuvre
    lines = [*(f"# {c}" for c in comments), f'format = "{FORMAT}"', f"version = {VERSION}",
             f"vehicle = {_quoted(plan.vehicle)}", f"duration = {m.duration!r}  # s", f"ramp = {m.ramp!r}  # s",
             f"box = {list(plan.box)!r}  # m", f"tilt = {plan.tilt!r}  # deg"]  # fmt: skip
    for name, axis in zip(AXES, m.axes):
        unit = "rad" if name == "yaw" else "m"
        lines += ["", f"[{name}]"]
        for key, values, of in (
            ("frequency", axis.frequency, "Hz"),
            ("cosine", axis.cosine, unit),
            ("sine", axis.sine, unit),
        ):
            lines.append(f"{key} = [{', '.join(f'{v:.9g}' for v in values)}]  # {of}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else "_" for c in text) + '"'
