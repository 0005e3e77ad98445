"""Trajectories by name, for the command line, scripts and swarm files; and waypoint files.

A waypoint file (CSV or TOML) becomes a quintic spline through its points, at rest at both ends.
"""

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from crazyem.control.plan_file import plan_trajectory, read_plan
from crazyem.control.trajectories import MAX_ACCELERATION, Reference, Trajectory, Vector, excite, figure8, hover
from crazyem.errors import FileFormatError, UsageError
from crazyem.toml_file import parse_toml, read_text

DEFAULT_SPEED = 0.5  # m/s
MAX_POSITION = 32.767  # m, the range of a full-state setpoint
WAYPOINT_COLUMNS = {"x", "y", "z", "yaw", "time", "speed"}


def read_waypoints(path: str | Path) -> list[dict[str, float]]:
    """Rows of a waypoint file.

    CSV: a header with x, y, z [m, world] and optionally yaw [rad], time [s since the start] or speed [m/s towards this
    point]. TOML: an array of tables `[[waypoints]]` with the same keys.

    Raises:
        UsageError: no such file. FileFormatError: the message names the file and the row or key.
    """
    path = Path(path)
    text = read_text(path, what="waypoint file")
    rows: list[dict[str, object]]
    if path.suffix.lower() == ".toml":
        found = parse_toml(text, where=f"waypoint file {path}").get("waypoints")
        if not isinstance(found, list) or not all(isinstance(r, dict) for r in found):
            raise FileFormatError(f"waypoint file {path} has no [[waypoints]] tables.")
        rows = found
    else:
        reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
        rows = [{str(k).strip(): v for k, v in r.items() if v not in (None, "")} for r in reader]
    out = []
    for i, row in enumerate(rows, start=1):
        unknown = set(row) - WAYPOINT_COLUMNS
        if unknown:
            raise FileFormatError(f"waypoint file {path} has the unknown column '{sorted(unknown)[0]}'.")
        missing = [k for k in ("x", "y", "z") if k not in row]
        if missing:
            raise FileFormatError(f"waypoint file {path}, point {i}: '{missing[0]}' is missing.")
        values: dict[str, float] = {}
        for key, raw in row.items():
            try:
                value = float(str(raw))
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise FileFormatError(f"waypoint file {path}, point {i}: '{key}' is not a number.")
            values[key] = value
        if abs(values["x"]) > MAX_POSITION or abs(values["y"]) > MAX_POSITION or not 0.1 <= values["z"] <= MAX_POSITION:
            raise FileFormatError(
                f"waypoint file {path}, point {i} is out of range (|x|, |y| up to {MAX_POSITION} m, z from 0.1 m)."
            )
        if values.get("speed", 1.0) <= 0:
            raise FileFormatError(f"waypoint file {path}, point {i}: 'speed' must be positive.")
        out.append(values)
    if not out:
        raise FileFormatError(f"waypoint file {path} has no waypoints.")
    return out


def _times(points: NDArray[np.float64], rows: Sequence[dict[str, float]], path: str | Path) -> NDArray[np.float64]:
    """Time [s] at each of points (n, 3); the first point is the start at 0, `rows` are the others."""
    times = [0.0]
    for i, row in enumerate(rows):
        distance = float(np.linalg.norm(points[i + 1] - points[i]))
        if "time" in row:
            times.append(row["time"])
        else:
            # Acceleration from rest and to rest takes additional time.
            rest = 1.0 if i in (0, len(rows) - 1) else 0.0
            times.append(times[-1] + max(distance / row.get("speed", DEFAULT_SPEED), 0.5) + rest)
    if not np.all(np.diff(times) > 0.05):
        raise FileFormatError(f"the times in waypoint file {path} do not increase (first point after 0 s).")
    return np.array(times)


def waypoints(*, path: str | Path, position: Vector, yaw: float = 0.0) -> Trajectory:
    """A smooth path from the hover at `position` [m, world] and `yaw` [rad] through the points of a file.

    Raises:
        FileFormatError: the file cannot be used, or the path needs more than `MAX_ACCELERATION`.
    """
    rows = read_waypoints(path)
    points = np.array([position, *([r["x"], r["y"], r["z"]] for r in rows)])
    yaws = [yaw]
    for r in rows:
        yaws.append(r.get("yaw", yaws[-1]))
    times = _times(points, rows, path)
    columns = np.column_stack([points, np.unwrap(yaws)])
    ends = [(1, np.zeros(4)), (2, np.zeros(4))]  # at rest
    spline = make_interp_spline(times, columns, k=5, bc_type=(ends, ends))
    derivatives = [spline, spline.derivative(1), spline.derivative(2), spline.derivative(3)]
    duration = float(times[-1])

    grid = np.linspace(0.0, duration, 500)
    worst = float(np.abs(derivatives[2](grid)[:, :3]).max())
    if worst > MAX_ACCELERATION:
        raise FileFormatError(
            f"the path in waypoint file {path} asks for {worst:.1f} m/s^2 (at most {MAX_ACCELERATION:g}): "
            "give it more time or less speed."
        )
    if float(spline(grid)[:, 2].min()) < 0.05:
        raise FileFormatError(f"the smooth path through waypoint file {path} would touch the ground: slow it down.")

    def at(t: float) -> Reference:
        t = min(max(t, 0.0), duration)
        p, v, a, j = (d(t) for d in derivatives)
        return Reference(
            position=(float(p[0]), float(p[1]), float(p[2])),
            velocity=(float(v[0]), float(v[1]), float(v[2])),
            acceleration=(float(a[0]), float(a[1]), float(a[2])),
            jerk=(float(j[0]), float(j[1]), float(j[2])),
            yaw=float(p[3]),
            yaw_rate=float(v[3]),
        )

    return Trajectory(f"waypoints {Path(path).name}", duration, at)


DEFAULT_HEIGHT = 1.0  # m above the take-off point, start of every named trajectory
TrajectoryMaker = Callable[[Vector, float], Trajectory]  # arguments: position [m, world] and heading [rad] at the start


_MAKERS: dict[str, Callable[..., Trajectory]] = {"hover": hover, "figure8": figure8, "excite": excite}


def _made(name: str, position: Vector, yaw: float, duration: float) -> Trajectory:
    return _MAKERS[name](position=position, yaw=yaw, duration=duration)


def trajectory_maker(words: Sequence[str], duration: float) -> TrajectoryMaker:
    """The maker of a trajectory for words such as ("figure8",) or ("waypoints", "FILE").

    Args:
        words: a name and its arguments.
        duration: s; waypoints and plans have their own.

    Raises:
        UsageError: an unknown name or a missing file name. FileFormatError: the file cannot be used.
    """
    name, *rest = words
    if name in ("waypoints", "plan") and len(rest) != 1:
        raise UsageError(f"--trajectory {name} needs one FILE.")
    if name == "waypoints":
        read_waypoints(rest[0])  # report errors before the start
        return lambda position, yaw: waypoints(path=rest[0], position=position, yaw=yaw)
    if name == "informative" and not rest:
        raise UsageError("--trajectory informative is planned in flight, for one drone at a time.")
    if name == "plan":
        read = read_plan(rest[0])
        return lambda position, yaw: plan_trajectory(read, path=rest[0], position=position, yaw=yaw)
    if name not in _MAKERS or rest:
        raise UsageError(
            f"unknown trajectory '{' '.join(words)}' "
            "(hover, figure8, excite, informative, waypoints FILE, or plan FILE)."
        )
    return lambda position, yaw: _made(name, position, yaw, duration)


def duration_note(words: Sequence[str], duration: float) -> str:
    """One line if the duration of the trajectory differs from the requested one, else ""."""
    known = words[0] in _MAKERS
    made = _made(words[0], (0.0, 0.0, DEFAULT_HEIGHT), 0.0, duration).duration if known else duration
    if math.isclose(made, duration):
        return ""
    return f"{words[0]} flies whole periods and ends where it began: {made:g} s instead of {duration:g} s"
