"""Settings of the paper's simulation, printed or not printed in the paper, each with the reason for its value.

NAME=VALUE changes a setting; type and range of the value are checked.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from crazyem.errors import UsageError


def _setting(default: Any, unit: str, reason: str) -> Any:
    return field(default=default, metadata={"unit": unit, "reason": reason})


@dataclass(frozen=True)
class Settings:
    """One interpretation ("reading") of the paper (SI). `described` lists every value with its reason.

    The defaults are the reading p5: gains, torque noise and position weights are chosen to reproduce Tables II to V.
    The reading `LITERAL` takes printed values as printed.
    """

    mass: float = _setting(0.18, "kg", "printed (VI-B)")
    inertia: tuple[float, float, float] = _setting((2.5e-4, 3.1e-4, 2.0e-4), "kg m^2", "printed (eq. 57)")
    dt: float = _setting(0.005, "s", "Q0 = 0.0707 = sqrt(h) with h = dt (eq. 119); 800 observations are then 4 s")
    duration: float = _setting(
        20.0, "s", "widths online over offline are 2.2 = sqrt(20 s / 4 s); five waypoints of 4 s each"
    )
    start: tuple[float, float, float] = _setting((0.5, 1.0, 0.0), "m", "printed (XI-A)")
    waypoints: tuple[tuple[float, float, float], ...] = _setting(
        ((4.0, 3.0, 3.0), (3.0, 5.0, 4.0), (6.0, 4.0, 5.0), (4.0, 3.0, 4.0), (2.0, 1.0, 5.0)), "m", "printed (XI-B)"
    )
    smooth: bool = _setting(
        False, "", "not said; smooth references tilt the drone too little for the mass that sensor C finds"
    )
    force_noise: float = _setting(
        0.005, "N sqrt(s)", "n0 ~ N(0, h) held for dt: sqrt(h dt); gives the printed spread of mass"
    )
    torque_noise: float = _setting(
        0.002, "N m sqrt(s)", "h need not hold for torque, too; the tables do not pin it (.002 to .005)"
    )
    position_sd: float = _setting(0.00707, "m", "R0 = 0.00707 (eq. 120)")
    velocity_sd: float = _setting(0.00707, "m/s", "R0 = 0.00707 (eq. 120)")
    attitude_sd: float = _setting(0.00707, "rad", "R0 = 0.00707 (eq. 120)")
    body_rate_sd: float = _setting(0.0707, "rad/s", "Fig. 5 shows errors of 0.15 rad/s; ten times R0 explains them")
    acceleration_sd: float = _setting(0.0707, "m/s^2", "not said; taken like the other inertial sensor's")
    angle_gain: float = _setting(20.0, "1/s", "printed 40 (eq. 19); 20 reproduces the widths of inertia")
    rate_gain: float = _setting(20.0, "1/s", "not said; 20 reproduces the widths of inertia")
    position_weight: float = _setting(
        225.0, "1/s^4", "not said; chosen by sensor C's mass, whose bias is tilt: 16 gives 3.7 %, 400 more than printed"
    )
    velocity_weight: float = _setting(90.0, "1/s^2", "not said; no overshoot at a waypoint")
    acceleration_limit: float = _setting(9.0, "m/s^2", "not said; a step of 5 m would else turn the drone over")
    filter_process: float = _setting(0.0707, "1", "printed Q0 (eq. 119), the same number for every state")
    filter_measurement: float = _setting(0.00707, "1", "printed R0 (eq. 120), the same number for every channel")
    filter_start: float = _setting(1.0, "1", "printed P0 (eq. 118)")
    window: int = _setting(800, "samples", "printed (XI-A2)")
    every: int = _setting(4, "samples", "printed (XI-A2)")
    mass_start: float = _setting(0.001, "kg", "printed (eq. 116)")
    inertia_start: tuple[float, float, float] = _setting((1e-4, 2e-4, 1e-4), "kg m^2", "printed (eq. 117)")
    substeps: int = _setting(1, "", "eq. 56 steps once per dt; more come closer to the differential equation")

    @property
    def steps(self) -> int:
        """Steps of dt in the flight."""
        return round(self.duration / self.dt)


P5 = Settings()

# Printed values as printed; missing values from Table I. Its errors have an sd over mean of 0.755 = sqrt(pi/2 - 1), so
# they are absolute values of a Gaussian error of one axis, 0.0128 m. The printed filter has this error with a sensor of
# 0.0139 m, and the printed angle error with the same number in rad/s. Rate gain, position weights and acceleration
# limit (8, out of 6 to 11) are chosen by Tables II to V.
LITERAL = Settings(
    torque_noise=0.005,  # n1:3 ~ N(0, h), the same h as thrust: 15 deg rms of tilt
    position_sd=0.0139, velocity_sd=0.0139, attitude_sd=0.0139, body_rate_sd=0.0139, acceleration_sd=0.0139,
    angle_gain=40.0,  # eq. 19
    rate_gain=20.0,  # at 15 some flights turn over, at 40 Izz has half its printed range
    position_weight=16.0, velocity_weight=4.0,
    acceleration_limit=8.0,  # 7 gives a third of the printed range of C's mass offline, 9 gives 2.6 times it online
)  # fmt: skip

READINGS = {"p5": P5, "literal": LITERAL}


# Limits of drones that can fly and of simulations that end.
_LIMITS: dict[str, tuple[float, float]] = {
    "mass": (1e-4, 100.0), "inertia": (1e-9, 10.0), "dt": (1e-4, 0.05), "duration": (0.1, 600.0),
    "start": (-1e3, 1e3), "waypoints": (-1e3, 1e3),
    "force_noise": (0.0, 10.0), "torque_noise": (0.0, 1.0),
    "position_sd": (1e-6, 10.0), "velocity_sd": (1e-6, 10.0), "attitude_sd": (1e-6, 1.0), "body_rate_sd": (1e-6, 10.0),
    "acceleration_sd": (1e-6, 100.0),
    "angle_gain": (0.01, 1e3), "rate_gain": (0.01, 1e3), "position_weight": (1e-6, 1e6), "velocity_weight": (1e-6, 1e6),
    "acceleration_limit": (0.1, 1e3),
    "filter_process": (1e-12, 1e3), "filter_measurement": (1e-12, 1e3), "filter_start": (1e-12, 1e6),
    "window": (20, 20_000), "every": (1, 20_000), "substeps": (1, 100),
    "mass_start": (1e-6, 100.0), "inertia_start": (1e-9, 10.0),
}  # fmt: skip
_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
MOST_WAYPOINTS = 100
MOST_STEPS = 200_000  # of a flight; its arrays then take some 100 MB
MOST_SUBSTEPS = 2_000_000


def settings_with(assignments: Iterable[str], base: Settings = P5) -> Settings:
    """Settings with some values replaced.

    Args:
        assignments: NAME=VALUE each; numbers in SI, three numbers as x,y,z, waypoints as x,y,z;x,y,z;...

    Raises: UsageError: unknown name, a value of another type or out of range, or values that do not go together.
    """
    known = {f.name: getattr(base, f.name) for f in fields(base)}
    changes: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals:
            raise UsageError(f"--set {assignment!r} is not NAME=VALUE.")
        if name not in known:
            raise UsageError(f"there is no setting {name!r} (`crazyem paper --settings` lists them).")
        changes[name] = _value(name, text.strip(), known[name])
    settings = replace(base, **changes)
    _together(settings)
    return settings


def _value(name: str, text: str, like: Any) -> Any:
    if isinstance(like, bool):
        if text.lower() not in _WORDS:
            raise UsageError(f"setting {name}: {text!r} is neither true nor false.")
        return _WORDS[text.lower()]
    if isinstance(like, int):
        number = _number(name, text)
        if number != int(number):
            raise UsageError(f"setting {name}: {text!r} is not a whole number.")
        return int(number)
    if isinstance(like, float):
        return _number(name, text)
    if isinstance(like[0], tuple):
        points = text.split(";")
        if len(points) > MOST_WAYPOINTS:
            raise UsageError(f"setting {name}: {len(points)} points are too many (at most {MOST_WAYPOINTS}).")
        return tuple(_numbers(name, point, len(like[0])) for point in points)
    return _numbers(name, text, len(like))


def _numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    parts = text.split(",")
    if len(parts) != count:
        raise UsageError(f"setting {name}: {text[:60]!r} is not {count} numbers with commas between them.")
    return tuple(_number(name, part) for part in parts)


def _number(name: str, text: str) -> float:
    low, high = _LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:  # catches NaN
        raise UsageError(f"setting {name}: {text[:40]!r} is not a number between {low:g} and {high:g}.")
    return value


def _together(s: Settings) -> None:
    if s.steps > MOST_STEPS or s.steps * s.substeps > MOST_SUBSTEPS:
        raise UsageError(
            f"a flight of {s.duration:g} s in steps of {s.dt:g} s and {s.substeps} substeps is too long "
            f"(at most {MOST_STEPS} steps, {MOST_SUBSTEPS} substeps)."
        )
    if s.window > s.steps:
        raise UsageError(f"a window of {s.window} samples is longer than the flight ({s.steps} steps).")
    if s.every > s.window:
        raise UsageError(f"an update every {s.every} samples leaves gaps between windows of {s.window}.")
    for name in ("inertia", "inertia_start"):
        largest = max(getattr(s, name))
        # no body is that flat; the paper's own start (1, 2, 1)e-4 lies on the limit
        if largest > 1.0001 * (sum(getattr(s, name)) - largest):
            raise UsageError(f"setting {name}: the largest moment of inertia is larger than the sum of the others.")


def described(settings: Settings) -> list[dict[str, Any]]:
    """Name, value, unit and reason of every setting; for a changed setting the reason of its default."""
    entries = []
    for f in fields(settings):
        value, reason = getattr(settings, f.name), f.metadata["reason"]
        if value != f.default:
            reason = f"changed from {_text(f.default)} ({reason})"
        entries.append({"name": f.name, "value": value, "unit": f.metadata["unit"], "reason": reason})
    return entries


def describe_text(settings: Settings) -> str:
    """Every setting with its value, unit and reason, for people."""
    return "\n".join(
        f"{e['name']} = {_text(e['value'])} {e['unit']}".rstrip() + f"\n    {e['reason']}" for e in described(settings)
    )


def _text(value: Any) -> str:
    """A value as text in the format of `--set`."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        between = ";" if isinstance(value[0], tuple) else ","
        return between.join(_text(v) for v in value)
    return repr(value) if isinstance(value, float) else str(value)
