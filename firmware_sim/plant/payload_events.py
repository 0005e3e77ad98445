"""Payloads attached and released in flight: mass, centre of mass and inertia step, momentum is conserved.

A released payload has the velocity of its place on the drone, so the drone's velocity does not jump. An attached one
joins in a plastic impact: linear and angular momentum are the sums of both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_sim.errors import ScenarioError, checked_number
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import matrix

MOST_EVENTS = 32  # events of a scenario
_BODY = [
    *range(at.MASS, at.INERTIA_INV + 9),
    *range(at.CONTACT_FREQUENCY, at.CONTACT_STICK + 1),
    at.STANDING_MASS,
    *range(at.COM, at.COM + 3),
]  # constants of the plant that a payload changes
_KEYS = {
    "attach": ("action", "time", "after", "mass", "position", "velocity"),
    "release": ("action", "time", "after"),
}


@dataclass(frozen=True)
class PayloadEvent:
    """One payload is attached or released.

    Attributes:
        action: attach, or release (of the payload attached last).
        time: s after `after`: "start" (boot) or "take-off" (when the feet first left the floor).
        mass: kg. position: m, body axes, from the geometric origin.
        velocity: m/s, world, of the payload before it is attached; None: it moves with the drone.
    """

    action: str
    time: float
    after: str = "start"
    mass: float = 0.0
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    velocity: tuple[float, ...] | None = None


PointMass = tuple[float, tuple[float, ...]]  # kg; m, body


def carried(first: Sequence[PointMass], events: Sequence[PayloadEvent]) -> list[PointMass]:
    """Point masses carried after `events`, `first` before them. Raises IndexError for a release without a payload."""
    load = list(first)
    for event in events:
        if event.action == "attach":
            load.append((event.mass, event.position))
        else:
            load.pop()
    return load


class PayloadChanges:
    """Changes a running flight's constants and state when its events are due, in their order.

    Args:
        events: of the scenario. truths: the plant's constants after each of them.
    """

    def __init__(self, events: Sequence[PayloadEvent], truths: Sequence[np.ndarray]) -> None:
        self._waiting = list(zip(events, truths, strict=True))

    def due(self, tick: int, state: np.ndarray) -> bool:
        """Whether the next event happens before the millisecond `tick`."""
        if not self._waiting:
            return False
        event = self._waiting[0][0]
        passed = float(tick) if event.after == "start" else float(state[at.AIRBORNE]) or -1.0
        return passed >= 1000.0 * event.time

    def apply(self, truth: np.ndarray, state: np.ndarray) -> None:
        """Apply the next event; changes both arrays in place."""
        event, after = self._waiting.pop(0)
        change_body(truth, state, after, event)


def change_body(truth: np.ndarray, state: np.ndarray, after: np.ndarray, event: PayloadEvent) -> None:
    """From the body of `truth` to that of `after`: the geometric origin stays, momentum is conserved."""
    R: Any = np.empty((3, 3))
    matrix(state, at.QUAT, R)
    old, new = truth[at.COM : at.COM + 3].copy(), after[at.COM : at.COM + 3]
    position, velocity = state[at.POS : at.POS + 3], state[at.VEL : at.VEL + 3]
    w = state[at.OMEGA : at.OMEGA + 3].copy()
    position += R @ (new - old)
    if event.action == "release":
        velocity += R @ np.cross(w, new - old)
    else:
        r, mass, total = np.array(event.position), truth[at.MASS], after[at.MASS]
        joining = velocity + R @ np.cross(w, r - old) if event.velocity is None else np.array(event.velocity)
        J = truth[at.INERTIA : at.INERTIA + 9].reshape(3, 3)
        spin = J @ w + mass * np.cross(old - new, R.T @ velocity) + event.mass * np.cross(r - new, R.T @ joining)
        velocity[:] = (mass * velocity + event.mass * joining) / total
        state[at.OMEGA : at.OMEGA + 3] = after[at.INERTIA_INV : at.INERTIA_INV + 9].reshape(3, 3) @ spin
    state[at.ASLEEP] = 0.0
    truth[_BODY] = after[_BODY]


def parse_events(table: Any, source: str, *, loaded: bool) -> tuple[PayloadEvent, ...]:
    """The events of [[payload.events]]; `loaded`: whether a payload is carried from the start.

    Raises:
        ScenarioError: one sentence naming file, event and key.
    """
    if not isinstance(table, Mapping) or set(table) != {"events"} or not isinstance(table["events"], list):
        raise ScenarioError(f"{source}: payload holds events only: [[payload.events]]")
    if len(table["events"]) > MOST_EVENTS:
        raise ScenarioError(f"{source}: payload.events must be at most {MOST_EVENTS}, there are {len(table['events'])}")
    events = tuple(_event(e, f"{source}: payload.events[{n}]") for n, e in enumerate(table["events"]))
    load = int(loaded)
    for n, event in enumerate(events):
        load += 1 if event.action == "attach" else -1
        if load < 0:
            raise ScenarioError(f"{source}: payload.events[{n}] releases a payload, but none is carried then")
    return events


def _event(table: Any, where: str) -> PayloadEvent:
    if not isinstance(table, Mapping) or table.get("action") not in _KEYS:
        raise ScenarioError(f"{where}.action must be one of {', '.join(_KEYS)}")
    known = _KEYS[table["action"]]
    for name in table:
        if name not in known:
            raise ScenarioError(f"{where}.{name} is not a key of '{table['action']}' (known: {', '.join(known)})")
    values: dict[str, Any] = {"action": table["action"], "after": table.get("after", "start")}
    if values["after"] not in ("start", "take-off"):
        raise ScenarioError(f"{where}.after must be one of start, take-off, not {values['after']!r}")
    values["time"] = _number(table, "time", where, 0.0, 1e6)
    if table["action"] == "attach":
        values["mass"] = _number(table, "mass", where, 1e-6, 1.0)
        for name, limit in (("position", 0.3), ("velocity", 30.0)):
            if name in table:
                values[name] = _vector(table[name], f"{where}.{name}", limit)
    return PayloadEvent(**values)


def _number(table: Mapping[str, Any], name: str, where: str, low: float, high: float) -> float:
    if name not in table:
        raise ScenarioError(f"{where}.{name} is missing")
    return checked_number(table[name], f"{where}.{name}", low, high)


def _vector(value: Any, where: str, limit: float) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != 3:
        raise ScenarioError(f"{where} must be a list of 3 numbers")
    return tuple(checked_number(v, where, -limit, limit) for v in value)
