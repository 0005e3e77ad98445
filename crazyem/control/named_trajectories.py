"""Trajectories by the words that name them, on a command line, in a script or in a swarm file."""

import math
from collections.abc import Callable, Sequence

from crazyem.control.trajectories import Trajectory, Vector, excite, figure8, hover
from crazyem.control.waypoints import read_waypoints, waypoints
from crazyem.errors import UsageError

DEFAULT_HEIGHT = 1.0  # m above the take-off point, at which every named trajectory begins
TrajectoryMaker = Callable[[Vector, float], Trajectory]  # from the position [m, world] and heading [rad] at its begin


def _made(name: str, position: Vector, yaw: float, duration: float) -> Trajectory:
    if name == "hover":
        return hover(position=position, yaw=yaw, duration=duration)
    if name == "figure8":
        return figure8(position=position, yaw=yaw, duration=duration)
    return excite(position=position, yaw=yaw, duration=duration)


def trajectory_maker(words: Sequence[str], duration: float) -> TrajectoryMaker:
    """From words such as ("figure8",) or ("waypoints", "FILE") to a maker of trajectories.

    Args:
        words: a name and what belongs to it.
        duration: s; waypoints have their own.

    Raises:
        UsageError: an unknown name or a missing file name. FileFormatError: waypoints that cannot be used.
    """
    name, *rest = words
    if name == "waypoints":
        if len(rest) != 1:
            raise UsageError("--trajectory waypoints needs one FILE.")
        read_waypoints(rest[0])  # complain before anything is started
        return lambda position, yaw: waypoints(path=rest[0], position=position, yaw=yaw)
    if name not in ("hover", "figure8", "excite") or rest:
        raise UsageError(f"unknown trajectory '{' '.join(words)}' (hover, figure8, excite, or waypoints FILE).")
    return lambda position, yaw: _made(name, position, yaw, duration)


def duration_note(words: Sequence[str], duration: float) -> str:
    """One line where the trajectory of these words takes another time than asked for, "" where it does not."""
    made = duration if words[0] == "waypoints" else _made(words[0], (0.0, 0.0, DEFAULT_HEIGHT), 0.0, duration).duration
    if math.isclose(made, duration):
        return ""
    return f"{words[0]} flies whole periods and ends where it began: {made:g} s instead of {duration:g} s"
