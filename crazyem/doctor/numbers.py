"""Check: values that are no numbers, values that no drone can have, and leaps that no drone can make."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.position_jumps import position_jumps
from crazyem.doctor.streams import NO_FLOAT_WARNINGS, listed, places
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.ordering import sound_rows
from crazyem.recordings.recording import Recording, SignalArray

Rows = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Limit:
    """What a quantity can be.

    Attributes:
        measure: (n, c) values to (n,) numbers that are compared.
        low, high: bounds; outside is impossible.
        words: what is impossible about it.
    """

    measure: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    low: float
    high: float
    words: str


def _norm(value: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.einsum("ij,ij->i", value, value))


def _largest(value: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.abs(value).max(axis=1)


def _extreme(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """The component that is furthest from the middle of 0..1."""
    low, high = value.min(axis=1), value.max(axis=1)
    return np.where(high - 0.5 > 0.5 - low, high, low)


# Wide: only what no drone of this kind can do. Gyros end at 35 (70) rad/s, accelerometers at 24 (32) g an axis, the
# fastest small rotors at 6000 rad/s; one to six cells give 2 to 26 V; smallest-three quaternions are unit within 0.002.
VALUE_LIMITS: dict[str, Limit] = {
    "position": Limit(_largest, 0.0, 1e4, "further than 10 km from the origin"),
    "velocity": Limit(_largest, 0.0, 150.0, "faster than 150 m/s"),
    "attitude": Limit(_norm, 0.98, 1.02, "not of unit length"),
    "body_rate": Limit(_largest, 0.0, 100.0, "faster than 100 rad/s"),
    "specific_force": Limit(_largest, 0.0, 400.0, "more than 400 m/s^2"),
    "acceleration": Limit(_largest, 0.0, 400.0, "more than 400 m/s^2"),
    "motor_command": Limit(_extreme, -1e-6, 1.0 + 1e-6, "outside 0..1"),
    "motor_request": Limit(_extreme, -1e-6, 1.0 + 1e-6, "outside 0..1"),
    "rotor_speed": Limit(_largest, 0.0, 8000.0, "faster than 8000 rad/s"),
    "voltage": Limit(lambda value: value[:, 0], 2.0, 26.0, "outside 2..26 V"),
}


ZERO_WITHOUT_SENSOR = {
    "voltage": "battery monitor",
    "rotor_speed": "rotor speed sensor",
}  # read 0 where they are not there
# What else the motors of a drone are told in: (words, unit in a mapping, lowest and highest of a typical value).
_MOTOR_UNITS = (
    ("pulse lengths in us", "us", 900.0, 2100.0),
    ("percent", "%", 2.0, 100.0),
    ("counts", "pwm", 3000.0, 65535.0),
)


def _unit_of_motors(array: SignalArray, values: NDArray[np.float64]) -> str:
    """What unit the numbers look like, as advice; "" for other quantities, and for no unit that is known."""
    if array.quantity not in ("motor_command", "motor_request"):
        return ""
    typical = float(np.median(values))
    for words, unit, low, high in _MOTOR_UNITS:
        if low <= typical <= high:
            return f'The numbers look like {words}: unit = "{unit}" in a mapping reads them as 0..1.'
    return ""


def _unconnected(name: str, array: SignalArray) -> Finding:
    sensor = ZERO_WITHOUT_SENSOR[array.quantity]
    return Finding(
        "numbers",
        Grade.HARMLESS,
        f"{name} reads 0 in all of its {array.time.size} samples: no {sensor} is connected, {name} is not measured.",
        signal=name,
        evidence={"samples": array.time.size},
        advice="Nothing to do, unless you expected it.",
    )


@NO_FLOAT_WARNINGS
def check(recording: Recording) -> list[Finding]:
    """NaN and infinities that are the file's own, impossible values and leaps, stamps that are no numbers."""
    found: list[Finding] = []
    unmapped: list[tuple[str, int]] = []
    for name, array in recording.signals.items():
        if array.time.size == 0:
            continue
        found += _stamps(name, array)
        sound = sound_rows(array.value)
        bad = ~sound & ~array.marked
        if bad.any():
            if array.quantity or "@" in name:
                found.append(_not_numbers(name, array, bad))
            else:
                unmapped.append((name, int(bad.sum())))
        limit = VALUE_LIMITS.get(array.quantity)
        if limit is not None:
            found += _impossible(name, array, limit, sound)
        if array.quantity == "position" and "velocity" not in recording.signals:
            found += position_jumps(name, array, furthest=VALUE_LIMITS["position"].high)
    if unmapped:
        names = [name for name, _ in unmapped]
        found.append(
            Finding(
                "numbers",
                Grade.HARMLESS,
                f"{listed(names)} hold values that are no numbers; nothing here uses these columns.",
                evidence={"columns": len(names), "samples": sum(count for _, count in unmapped)},
            )
        )
    return found


def _stamps(name: str, array: SignalArray) -> list[Finding]:
    bad = ~np.isfinite(array.time)
    if not bad.any():
        return []
    return [
        Finding(
            "numbers",
            Grade.UNUSABLE,
            f"{name} has {int(bad.sum())} samples whose stamp is not a number.",
            signal=name,
            evidence={"samples": int(bad.sum()), "share": float(bad.mean())},
            advice="Remove these rows from the source; a sample without a time says nothing.",
        )
    ]


def _not_numbers(name: str, array: SignalArray, bad: Rows) -> Finding:
    share = float(bad.mean())
    return Finding(
        "numbers",
        Grade.UNUSABLE if share > 0.5 else Grade.DEGRADES,
        f"{name} is not a number in {int(bad.sum())} of {bad.size} samples, and the file does not say why.",
        signal=name,
        intervals=places(array.time, bad),
        evidence={"samples": int(bad.sum()), "share": share},
        advice="Mark them as missing (--fix); a replay refuses them otherwise.",
        fix=Fix("mark", (name,), rows=np.flatnonzero(bad)),
    )


def _impossible(name: str, array: SignalArray, limit: Limit, sound: Rows) -> list[Finding]:
    if limit.measure is not _norm:
        low, high = float(array.value.min()), float(array.value.max())  # NaN fails both comparisons
        if low >= (limit.low if limit.low != 0.0 else -limit.high) and high <= limit.high:
            return []
    with np.errstate(invalid="ignore", over="ignore"):
        measure = limit.measure(array.value)
        bad = ((measure < limit.low) | (measure > limit.high)) & sound
    if not bad.any():
        return []
    if array.quantity in ZERO_WITHOUT_SENSOR and not array.value[sound].any():
        return [_unconnected(name, array)]
    share = float(bad.mean())
    good = measure[sound & ~bad]
    worst = measure[bad]
    worst_value = float(worst[int(np.argmax(np.abs(worst - 0.5 * (limit.low + limit.high))))])
    advice = "Mark them as missing (--fix); look at what wrote them."
    fix: Fix | None = Fix("mark", (name,), rows=np.flatnonzero(bad))
    if share > 0.2:
        advice, fix = "Check the unit and what the column means; do not use the signal as it is.", None
        advice = _unit_of_motors(array, measure[sound]) or advice
        if array.quantity == "voltage" and 2.0 <= float(np.median(measure[sound])) / 1000.0 <= 26.0:
            advice = "The numbers are millivolts; scale by 0.001 (--fix)."
            fix = Fix("scale", (name,), factor=(0.001,))
    evidence = {"samples": int(bad.sum()), "share": share, "worst": worst_value}
    if good.size:
        evidence["largest_possible"] = float(good.max())
    return [
        Finding(
            "numbers",
            Grade.UNUSABLE if share > 0.2 else Grade.DEGRADES,
            f"{name} is {limit.words} in {int(bad.sum())} of {bad.size} samples (worst {worst_value:.6g}).",
            signal=name,
            intervals=places(array.time, bad),
            evidence=evidence,
            advice=advice,
            fix=fix,
        )
    ]
