"""The policy of the guard: rules for writes to a flying drone and for reverts; TOML <-> dataclasses.

`crazyem/policies/default.toml` is the shipped policy and explains every key.
"""

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.live.guard import WRITABLE_ESTIMATES, Limits
from crazyem.toml_file import is_number, parse_toml, read_text, toml_value

LARGEST_POLICY_FILE = 65536  # bytes
FAULT_ACTIONS = ("report", "stop", "land")  # report only; stop pushes, too; land as well, if crazyem flies the drone
END_RULES = ("keep", "good", "restore")


@dataclass(frozen=True)
class HealthLimits:
    """Conditions on the state of the drone for a write.

    Attributes:
        supervisor: whether the firmware's supervisor must report a flight without a fault.
        battery: V, least mean voltage of the last second. tilt: rad, largest tilt.
        stale: s, largest age of the newest estimate on the drone's clock.
    """

    supervisor: bool = True
    battery: float = 3.2
    tilt: float = math.radians(60.0)
    stale: float = 1.0


@dataclass(frozen=True)
class MonitorLimits:
    """Limits for the comparison of the flight after a write with the flight before it.

    Attributes:
        lead: s by which the setpoint may be ahead of the drone; this lead is no error. 0 with an expected response.
        high_pass: s, time constant of the high-pass on body rates: 1.6 Hz, above the frequencies of trajectories.
        high_pass_order: how often the rates pass it.
        before, settle, after: s, lengths of the stretches.
        unjudged: largest number of sets of writes before a verdict.
        tracking_ratio, tracking, tracking_alarm: position error, relative to before, and excess over before [m].
        innovation_ratio, innovation: normalised innovation, relative to before, and least value (standard deviations).
        oscillation_ratio, oscillation, oscillation_alarm: fast part of the body rates, relative to before, and excess
            over before [rad/s].
        incremental_oscillation: replaces `oscillation` [rad/s] after writes of control effectiveness, a loop gain.
        tilt_alarm: rad.
    """

    enabled: bool = True
    lead: float = 0.1  # not a key of a policy, like the next two: they belong to the controller
    high_pass: float = 0.1
    high_pass_order: int = 1
    before: float = 2.0
    settle: float = 0.5
    after: float = 2.5
    unjudged: int = 6
    tracking_ratio: float = 1.5
    tracking: float = 0.10
    tracking_alarm: float = 0.50
    innovation_ratio: float = 2.0
    innovation: float = 3.0
    oscillation_ratio: float = 2.5
    oscillation: float = 1.5
    oscillation_alarm: float = 8.0
    incremental_oscillation: float = 0.5
    tilt_alarm: float = math.radians(75.0)


@dataclass(frozen=True)
class EndRules:
    """Values left in the drone after a flight, one of `END_RULES` for each outcome of the flight."""

    landed: str = "keep"
    interrupted: str = "keep"
    failed: str = "restore"
    link_lost: str = "restore"


@dataclass(frozen=True)
class FaultRules:
    """The monitor of faults in flight.

    Attributes:
        enabled: whether the monitor runs. false_alarms_per_hour: of flight, of all its tests together.
        action: after a fault, one of `FAULT_ACTIONS`. resume: s for which the model must hold before pushes go on.
    """

    enabled: bool = True
    false_alarms_per_hour: float = 0.1
    action: str = "stop"
    resume: float = 2.0


@dataclass(frozen=True)
class Policy:
    """The rules of the guard for writes to a flying drone and for reverts.

    Attributes:
        limits: conditions on estimates. health: conditions on the drone's state.
        watch: comparison of the flight before and after a write. end: values left in the drone after the flight.
        monitor: of faults in flight.
    """

    name: str = "default"
    limits: Limits = field(default_factory=Limits)
    health: HealthLimits = field(default_factory=HealthLimits)
    watch: MonitorLimits = field(default_factory=MonitorLimits)
    end: EndRules = field(default_factory=EndRules)
    monitor: FaultRules = field(default_factory=FaultRules)

    def entries(self) -> dict[str, dict[str, Any]]:
        """Section -> key -> value, in the units of the file."""
        table: dict[str, dict[str, Any]] = {}
        for section, key, part, name, kind in _POLICY_KEYS:
            table.setdefault(section, {})[key] = kind.shown(getattr(getattr(self, part), name))
        return table

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        return {"name": self.name, **self.entries()}

    def to_toml(self, *, against: "Policy | None" = None) -> str:
        """The text of a policy file, which reads back as an equal policy; comments show differences to `against`."""
        lines = [f"name = {toml_value(self.name)}"]
        others = against.entries() if against else {}
        for section, values in self.entries().items():
            lines += ["", f"[{section}]"]
            for key, value in values.items():
                other = others.get(section, {}).get(key, value)
                remark = f" # {against.name}: {toml_value(other)}" if against and other != value else ""
                lines.append(f"{key} = {toml_value(value)}{remark}")
        return "\n".join(lines) + "\n"


Confirm = Callable[[str, threading.Event], bool]


@dataclass(frozen=True)
class WriteRules:
    """How estimates may reach the drone.

    Attributes:
        policy: see `Policy`.
        dry_run: make and record decisions, but write nothing.
        confirm: called once, in its own thread, before the first write, with the question and an event that is set when
            the answer is no longer needed; True allows pushes. None: no confirmation.
    """

    policy: Policy = field(default_factory=Policy)
    dry_run: bool = False
    confirm: Confirm | None = None

    @property
    def mode(self) -> str:
        """Text for the summary."""
        return "dry run" if self.dry_run else "push after confirmation" if self.confirm else "push"


@dataclass(frozen=True)
class _Kind:
    """Check and unit of a key: `read` gives the value in SI, or raises ValueError with the requirement."""

    read: Callable[[Any], Any]
    shown: Callable[[Any], Any] = lambda value: value


def _number(low: float, high: float, *, scale: float = 1.0) -> _Kind:
    def read(value: Any) -> float:
        if not is_number(value) or not low <= value <= high:
            raise ValueError(f"a number in [{low:g}, {high:g}]")
        return float(value) * scale

    return _Kind(read, lambda value: float(f"{value / scale:.12g}"))


def _range(low: float, high: float) -> _Kind:
    def read(value: Any) -> tuple[float, float]:
        if not isinstance(value, list) or len(value) != 2 or not all(map(is_number, value)):
            raise ValueError("two numbers, lower and upper")
        if not low <= value[0] < value[1] <= high:
            raise ValueError(f"rising and within [{low:g}, {high:g}]")
        return float(value[0]), float(value[1])

    return _Kind(read, list)


def _integer(low: int, high: int) -> _Kind:
    def read(value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ValueError(f"a whole number in [{low}, {high}]")
        return value

    return _Kind(read)


def _read_flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def _read_names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(v, str) and v in WRITABLE_ESTIMATES for v in value):
        raise ValueError(f"a list of {', '.join(WRITABLE_ESTIMATES)}")
    if ("Ixx" in value) != ("Iyy" in value):
        raise ValueError("without Ixx or with Iyy, too: roll and pitch share their scale of gains")
    return tuple(n for n in WRITABLE_ESTIMATES if n in value)


def _choice(among: tuple[str, ...]) -> _Kind:
    def read(value: Any) -> str:
        if value not in among:
            raise ValueError(f"one of {', '.join(among)}")
        return str(value)

    return _Kind(read)


_FLAG, _PARAMETERS, _END = _Kind(_read_flag), _Kind(_read_names, list), _choice(END_RULES)
_SECONDS, _SHARE, _RATIO = _number(0.0, 60.0), _number(0.0, 1.0), _number(1.0, 1000.0)
_DEGREE = math.radians(1.0)

# section, key, part of the policy, its field, kind
_POLICY_KEYS: tuple[tuple[str, str, str, str, _Kind], ...] = (
    ("push", "parameters", "limits", "parameters", _PARAMETERS),
    ("push", "interval_s", "limits", "interval", _number(0.05, 600.0)),
    ("push", "slew", "limits", "slew", _number(0.001, 0.5)),
    ("push", "unjudged_change", "limits", "unjudged", _SHARE),
    ("push", "agreement_time_s", "limits", "agreement_time", _SECONDS),
    ("mass", "bounds_kg", "limits", "mass_absolute", _range(1e-3, 100.0)),
    ("mass", "bounds_relative", "limits", "mass_bounds", _range(0.05, 20.0)),
    ("mass", "half_width", "limits", "mass_half_width", _SHARE),
    ("mass", "agreement", "limits", "mass_agreement", _SHARE),
    ("mass", "deadband", "limits", "mass_deadband", _SHARE),
    ("inertia", "bounds_kg_m2", "limits", "inertia_absolute", _range(1e-8, 100.0)),
    ("inertia", "bounds_relative", "limits", "inertia_bounds", _range(0.05, 20.0)),
    ("inertia", "half_width", "limits", "inertia_half_width", _SHARE),
    ("inertia", "agreement", "limits", "inertia_agreement", _SHARE),
    ("inertia", "deadband", "limits", "inertia_deadband", _SHARE),
    ("lag", "bounds_s", "limits", "lag_absolute", _range(1e-4, 1.0)),
    ("lag", "bounds_relative", "limits", "lag_bounds", _range(0.05, 20.0)),
    ("lag", "half_width", "limits", "lag_half_width", _SHARE),
    ("lag", "agreement", "limits", "lag_agreement", _SHARE),
    ("lag", "deadband", "limits", "lag_deadband", _SHARE),
    ("effectiveness", "bounds_relative", "limits", "effectiveness_bounds", _range(0.05, 20.0)),
    ("effectiveness", "slew", "limits", "effectiveness_slew", _number(0.001, 0.5)),
    ("effectiveness", "unjudged_change", "limits", "effectiveness_unjudged", _SHARE),
    ("effectiveness", "deadband", "limits", "effectiveness_deadband", _SHARE),
    ("effectiveness", "oscillation_rad_s", "watch", "incremental_oscillation", _number(0.0, 100.0)),
    ("mass_thrust", "bounds_per_N", "limits", "mass_thrust_absolute", _range(1e3, 1e7)),
    ("mass_thrust", "deadband", "limits", "mass_thrust_deadband", _SHARE),
    ("drag", "bounds_per_s", "limits", "drag_absolute", _range(0.0, 100.0)),
    ("drag", "slew_per_s", "limits", "drag_slew", _number(0.001, 10.0)),
    ("drag", "half_width", "limits", "drag_half_width", _SHARE),
    ("drag", "agreement", "limits", "drag_agreement", _SHARE),
    ("drag", "deadband", "limits", "drag_deadband", _SHARE),
    ("health", "supervisor", "health", "supervisor", _FLAG),
    ("health", "battery_V", "health", "battery", _number(0.0, 100.0)),
    ("health", "tilt_deg", "health", "tilt", _number(1.0, 180.0, scale=_DEGREE)),
    ("health", "stale_s", "health", "stale", _number(0.05, 60.0)),
    ("watch", "enabled", "watch", "enabled", _FLAG),
    ("watch", "before_s", "watch", "before", _number(0.5, 60.0)),
    ("watch", "settle_s", "watch", "settle", _SECONDS),
    ("watch", "after_s", "watch", "after", _number(0.5, 60.0)),
    ("watch", "unjudged_writes", "watch", "unjudged", _integer(1, 1000)),
    ("watch", "tracking_ratio", "watch", "tracking_ratio", _RATIO),
    ("watch", "tracking_m", "watch", "tracking", _number(0.0, 100.0)),
    ("watch", "tracking_alarm_m", "watch", "tracking_alarm", _number(0.0, 100.0)),
    ("watch", "innovation_ratio", "watch", "innovation_ratio", _RATIO),
    ("watch", "innovation_sd", "watch", "innovation", _number(0.0, 1e6)),
    ("watch", "oscillation_ratio", "watch", "oscillation_ratio", _RATIO),
    ("watch", "oscillation_rad_s", "watch", "oscillation", _number(0.0, 100.0)),
    ("watch", "oscillation_alarm_rad_s", "watch", "oscillation_alarm", _number(0.0, 100.0)),
    ("watch", "tilt_alarm_deg", "watch", "tilt_alarm", _number(1.0, 180.0, scale=_DEGREE)),
    ("end", "landed", "end", "landed", _END),
    ("end", "interrupted", "end", "interrupted", _END),
    ("end", "failed", "end", "failed", _END),
    ("end", "link_lost", "end", "link_lost", _END),
    ("monitor", "enabled", "monitor", "enabled", _FLAG),
    ("monitor", "false_alarms_per_hour", "monitor", "false_alarms_per_hour", _number(1e-6, 1000.0)),
    ("monitor", "action", "monitor", "action", _choice(FAULT_ACTIONS)),
    ("monitor", "resume_s", "monitor", "resume", _SECONDS),
)  # fmt: skip
_POLICY_PARTS = ("limits", "health", "watch", "end", "monitor")


def default_text() -> str:
    """The shipped policy, with its comments."""
    return (resources.files("crazyem") / "policies" / "default.toml").read_text(encoding="utf-8")


def load_policy(path: str | Path | None = None) -> Policy:
    """The policy of a file, or the shipped one.

    Raises:
        UsageError: no such file. FileFormatError: the file is not a policy; the message names the key.
    """
    if path is None:
        return parse_policy(default_text(), where="the default policy")
    return parse_policy(read_text(path, what="policy", largest=LARGEST_POLICY_FILE), where=str(path))


def parse_policy(source: str, *, where: str = "policy") -> Policy:
    """Policy from the text of a file; `where` names it in errors (FileFormatError)."""
    data = parse_toml(source, where=where)
    name = data.pop("name", "unnamed")
    if not isinstance(name, str) or not name.isprintable() or len(name) > 100:
        raise FileFormatError(f"{where}: key 'name' must be a short text")
    _check_names(data, where)
    policy = Policy(name=name)
    changes: dict[str, dict[str, Any]] = {part: {} for part in _POLICY_PARTS}
    for section, key, part, attribute, kind in _POLICY_KEYS:
        if key not in data.get(section, {}):
            continue
        value = data[section][key]
        try:
            changes[part][attribute] = kind.read(value)
        except ValueError as error:
            raise FileFormatError(f"{where}: key '{section}.{key}' must be {error}, got {str(value)[:60]!r}") from None
    return replace(policy, **{part: replace(getattr(policy, part), **c) for part, c in changes.items()})


def _check_names(data: Mapping[str, Any], where: str) -> None:
    known: dict[str, list[str]] = {}
    for section, key, *_ in _POLICY_KEYS:
        known.setdefault(section, []).append(key)
    for section, values in data.items():
        if section not in known:
            raise FileFormatError(f"{where}: unknown key '{section[:60]}' (known: name, {', '.join(known)})")
        if not isinstance(values, dict):
            raise FileFormatError(f"{where}: '{section}' must be a table [{section}]")
        for key in values:
            if key not in known[section]:
                raise FileFormatError(
                    f"{where}: unknown key '{section}.{key[:60]}' (known: {', '.join(known[section])})"
                )
