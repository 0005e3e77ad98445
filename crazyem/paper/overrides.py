"""Settings of the paper's simulation from NAME=VALUE, each checked for its type and a sane range."""

import math
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

from crazyem.errors import UsageError
from crazyem.paper.settings import Settings

# Nothing that flies, and no simulation of it that ends, is outside of these. Names without an entry: any finite number.
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


def settings_with(assignments: Iterable[str], base: Settings | None = None) -> Settings:
    """Settings with some values replaced.

    Args:
        assignments: NAME=VALUE each; numbers in SI, three numbers as x,y,z, waypoints as x,y,z;x,y,z;...

    Raises:
        UsageError: unknown name, a value of another type or out of range, or values that do not go together.
    """
    settings = base or Settings()
    known = {f.name: getattr(settings, f.name) for f in fields(settings)}
    changes: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals:
            raise UsageError(f"--set {assignment!r} is not NAME=VALUE.")
        if name not in known:
            raise UsageError(f"there is no setting {name!r} (`crazyem paper --settings` lists them).")
        changes[name] = _value(name, text.strip(), known[name])
    settings = replace(settings, **changes)
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
    if isinstance(like, str):
        if not 0 < len(text) <= 40 or not text.isprintable():
            raise UsageError(f"setting {name}: {text[:40]!r} is not a word.")
        return text
    if like and isinstance(like[0], tuple):
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
    low, high = _LIMITS.get(name, (-1e9, 1e9))
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
    """Name, value, unit and reason of every setting; the reason of a changed one is that of the value it had."""
    usual = Settings()
    entries = settings.describe()
    for entry in entries:
        default = getattr(usual, entry["name"])
        if entry["value"] != default:
            entry["reason"] = f"changed from {_text(default)} ({entry['reason']})"
    return entries


def describe_text(settings: Settings) -> str:
    """Every setting with its value, unit and reason, for people."""
    lines = []
    for entry in described(settings):
        value = _text(entry["value"])
        lines.append(f"{entry['name']} = {value} {entry['unit']}".rstrip())
        lines.append(f"    {entry['reason']}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    """As `--set` takes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        between = ";" if value and isinstance(value[0], tuple) else ","
        return between.join(_text(v) for v in value)
    return repr(value) if isinstance(value, float) else str(value)
