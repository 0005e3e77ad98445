"""Several drones in one process: the swarm file, the way from take-off to the trajectory, and distances between drones.

A swarm file is TOML; missing keys have the values of the command line:

    [[drone]]
    name = "alpha"                      # of the recording and in the summary; default: drone0, drone1, ...
    uri = "radio://0/80/2M/E7E7E7E701"
    vehicle = "cf2"
    trajectory = "figure8"              # or ["waypoints", "path.csv"], relative to the swarm file
    offset = [0.5, 0.0, 0.2]            # m, world: from above its take-off place to where its trajectory begins
"""

import itertools
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.control.trajectories import Reference, Trajectory, Vector, smooth_step
from crazyem.errors import FileFormatError, UsageError
from crazyem.toml_file import read_toml

MOST_DRONES = 100  # drones
LARGEST_SWARM_FILE = 1 << 18  # bytes
# m, least distance of two drones: three times the width of a Crazyflie, outside its strongest downwash
CLOSEST_DISTANCE = 0.3
LARGEST_OFFSET = 20.0  # m, largest component of an offset
TRANSIT_SPEED = 0.5  # m/s, mean speed on the way to an offset
DISTANCE_STEP, MOST_DISTANCE_STEPS = 0.1, 2000  # s between checks of distances along trajectories; most checks
SWITCH_INTERVAL = 0.0005  # s; the interpreter's 5 ms would be an eighth of an update's budget at every switch
DRONE_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")
_DRONE_KEYS = ("name", "uri", "vehicle", "trajectory", "offset")

Maker = Callable[[Vector, float], Trajectory]


@dataclass(frozen=True)
class Member:
    """One drone of a swarm: link, vehicle and trajectory. trajectory: words of the command line; offset: m, world."""

    name: str
    uri: str
    vehicle: str = "cf2"
    trajectory: tuple[str, ...] = ("hover",)
    offset: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Course:
    """Take-off place, begin of the trajectory [m, world], and the whole path of a drone after its hover."""

    stand: Vector
    begin: Vector
    path: Trajectory


def shorten_switch_interval() -> None:
    """Let threads switch ten times as often as by default, because many of them wait for each other."""
    sys.setswitchinterval(SWITCH_INTERVAL)


def members_of(uris: Sequence[str], *, vehicle: str, trajectory: Sequence[str]) -> list[Member]:
    """Drones of the command line. Raises UsageError: too many, or one twice."""
    if len(uris) > MOST_DRONES:
        raise UsageError(f"at most {MOST_DRONES} drones can be flown or watched at once, not {len(uris)}.")
    if double := _doubles(uris):
        raise UsageError(f"{double[0]} is given twice.")
    return [Member(f"drone{i}", uri, vehicle, tuple(trajectory)) for i, uri in enumerate(uris)]


def read_swarm(path: str | Path, *, vehicle: str, trajectory: Sequence[str]) -> list[Member]:
    """The drones of a swarm file.

    Args:
        vehicle, trajectory: defaults for drones without these keys.

    Raises: FileFormatError: not a swarm file; the message names the drone and the key. UsageError: no such file.
    """
    table = read_toml(path, what="swarm file", largest=LARGEST_SWARM_FILE)
    entries = table.pop("drone", None)
    if table:
        raise FileFormatError(f"{path}: {next(iter(table))} is not part of a swarm (only [[drone]] is).")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise FileFormatError(f"{path}: a swarm needs at least one [[drone]].")
    if len(entries) > MOST_DRONES:
        raise FileFormatError(f"{path}: a swarm has at most {MOST_DRONES} drones, not {len(entries)}.")
    members = [
        _member(entry, f"{path}: drone {i}", Member(f"drone{i}", "", vehicle, tuple(trajectory)), Path(path).parent)
        for i, entry in enumerate(entries)
    ]
    for what in ("name", "uri"):
        if double := _doubles([getattr(m, what) for m in members]):
            raise FileFormatError(f"{path}: two drones have the {what} {double[0]}.")
    return members


def _doubles(values: Sequence[str]) -> list[str]:
    return [value for i, value in enumerate(values) if value in values[:i]]


def _member(entry: Mapping[str, Any], where: str, base: Member, folder: Path) -> Member:
    unknown = next((key for key in entry if key not in _DRONE_KEYS), None)
    if unknown is not None:
        raise FileFormatError(f"{where}: {unknown} is not a key of a drone (known: {', '.join(_DRONE_KEYS)}).")
    values: dict[str, Any] = {}
    for key in ("uri", "vehicle", "name"):
        if key in entry:
            if not isinstance(entry[key], str) or not entry[key]:
                raise FileFormatError(f"{where}: {key} must be a text, not {entry[key]!r}.")
            values[key] = entry[key]
    if "uri" not in values:
        raise FileFormatError(f"{where}: uri is missing.")
    if not DRONE_NAME.fullmatch(values.get("name", "a")):
        raise FileFormatError(f"{where}: name must be 1 to 40 letters, digits, - or _, not {values['name']!r}.")
    if "vehicle" in values and (folder / values["vehicle"]).is_file():
        values["vehicle"] = str(folder / values["vehicle"])
    if "trajectory" in entry:
        values["trajectory"] = _words(entry["trajectory"], where, folder)
    if "offset" in entry:
        values["offset"] = _vector(entry["offset"], f"{where}: offset")
    return replace(base, **values)


def _words(value: Any, where: str, folder: Path) -> tuple[str, ...]:
    words = [value] if isinstance(value, str) else value
    if not isinstance(words, list) or not words or not all(isinstance(w, str) and w for w in words):
        raise FileFormatError(f'{where}: trajectory must be a name or ["waypoints", FILE], not {value!r}.')
    if words[0] == "waypoints" and len(words) == 2:
        return "waypoints", str(folder / words[1])
    return tuple(words)


def _vector(value: Any, where: str) -> Vector:
    if not isinstance(value, list) or len(value) != 3:
        raise FileFormatError(f"{where} must be 3 numbers, not {value!r}.")
    for v in value:
        if isinstance(v, bool) or not isinstance(v, int | float) or not -LARGEST_OFFSET <= v <= LARGEST_OFFSET:
            raise FileFormatError(f"{where} must lie between {-LARGEST_OFFSET:g} and {LARGEST_OFFSET:g} m, not {v!r}.")
    return float(value[0]), float(value[1]), float(value[2])


def with_offset(make: Maker, offset: Vector) -> Maker:
    """Trajectories that begin `offset` [m, world] away, after a transit that starts and ends at rest."""
    distance = math.hypot(*offset)
    if distance == 0.0:
        return make
    # The polynomial's top speed is 35/16 of its mean.
    duration = max(2.0, distance / TRANSIT_SPEED)

    def maker(position: Vector, yaw: float) -> Trajectory:
        goal = (position[0] + offset[0], position[1] + offset[1], position[2] + offset[2])
        inner = make(goal, yaw)

        def at(t: float) -> Reference:
            if t >= duration:
                return inner.at(t - duration)
            s = smooth_step(t / duration)
            rates = [s[n] / duration**n for n in (1, 2, 3)]
            velocity, acceleration, jerk = ((r * offset[0], r * offset[1], r * offset[2]) for r in rates)
            place = tuple(p + s[0] * o for p, o in zip(position, offset))
            return Reference((place[0], place[1], place[2]), velocity, acceleration, jerk, yaw=yaw)

        return Trajectory(inner.name, inner.duration + duration, at)

    return maker


def check_distances(courses: Mapping[str, Course]) -> None:
    """Refuse drones that would come too close, under the assumption that all trajectories begin at the same time.

    Raises:
        UsageError: two drones stand, begin or fly closer than `CLOSEST_DISTANCE`; the sentence names them, the
            distance and the time.
    """
    for a, b in itertools.combinations(courses, 2):
        for what in ("stand", "begin"):
            distance = math.dist(getattr(courses[a], what), getattr(courses[b], what))
            if not distance >= CLOSEST_DISTANCE:  # also true for NaN, an unknown position
                raise UsageError(
                    f"{a} and {b} {what} {distance:.2f} m apart, less than {CLOSEST_DISTANCE:g} m: not flown."
                )
    longest = max((c.path.duration for c in courses.values()), default=0.0)
    times = np.linspace(0.0, longest, 2 + min(math.ceil(longest / DISTANCE_STEP), MOST_DISTANCE_STEPS))
    tracks = {name: np.array([c.path.at(float(t)).position for t in times]) for name, c in courses.items()}
    for a, b in itertools.combinations(tracks, 2):
        distances = np.linalg.norm(tracks[a] - tracks[b], axis=1)
        worst = int(np.argmin(distances))
        if distances[worst] < CLOSEST_DISTANCE:
            raise UsageError(
                f"{a} and {b} would come within {distances[worst]:.2f} m of each other {times[worst]:.1f} s into their "
                f"trajectories, less than {CLOSEST_DISTANCE:g} m: not flown."
            )
