"""Compares one answer with one truth. All definitions of the score are here, in small functions."""

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from crazyem.vehicle import Vehicle
from firmware_sim.plant.effects.catalogue import EFFECTS

from .sizes import FOREIGN_OUTSIDE, OUTSIDE

CONFIDENT = 0.5  # confidence above which a name is a claim
DETECTABLE = 10.0  # nats of an ideal observer
STRONG = 2.0 / 3.0  # strength from which an effect counts as strong
DISCRETE = ("rotor", "streams")
Document = Mapping[str, Any]


def without(result: Document, aside: Collection[str]) -> dict[str, Any]:
    """An answer without the effects `aside`, which are not judged: they count neither as alarm nor as found.

    A mismatch by these effects alone, with nothing left unexplained, is no mismatch.
    """
    effects = [e for e in result.get("effects") or [] if e.get("name") not in aside]
    groups = [[n for n in group if n not in aside] for group in result.get("indistinguishable") or []]
    removed = len(effects) < len(result.get("effects") or [])
    mismatch = bool(result.get("mismatch")) and (bool(effects) or leaves_structure(result) or not removed)
    kept = [g for g in groups if len(g) > 1]
    return {**result, "effects": effects, "indistinguishable": kept, "mismatch": mismatch}


def leaves_structure(result: Document) -> bool:
    """Whether an answer reports something that no effect explains: `found` of `unexplained`, or any entry of a list."""
    left = result.get("unexplained")
    return bool(left.get("found", left.get("where"))) if isinstance(left, Mapping) else bool(left)


def named(result: Document | None) -> list[str]:
    """Names of the effects that an answer reports, in its order; `unexplained` is not an effect."""
    if not result or not result.get("mismatch"):
        return []
    return [e["name"] for e in result.get("effects") or [] if e.get("name") != "unexplained"]


def grouped(result: Document, one: str, other: str) -> bool:
    """Whether the answer declares these two look-alikes."""
    return any(one in group and other in group for group in result.get("indistinguishable") or [])


def in_a_group(result: Document, name: str) -> bool:
    """Whether the answer declares a look-alike of this effect."""
    return any(name in group and len(group) > 1 for group in result.get("indistinguishable") or [])


def credit(truth: str, result: Document | None) -> float:
    """1: named first and alone; 0.5: in a group declared indistinguishable that holds the first name; else 0."""
    names = named(result)
    if not names or result is None:
        return 0.0
    if names[0] == truth:
        return 0.5 if in_a_group(result, truth) else 1.0
    return 0.5 if grouped(result, truth, names[0]) else 0.0


def right_pair(truth: Iterable[str], result: Document | None) -> bool:
    """Whether the answer names both effects and no other."""
    return sorted(named(result)) == sorted(truth)


def pair_up_to_groups(truth: Iterable[str], result: Document | None) -> bool:
    """Whether the answer names two effects, each a true one or a declared look-alike of it."""
    names, (a, b) = named(result), tuple(truth)
    if result is None or len(names) != 2:
        return False

    def same(x: str, y: str) -> bool:
        return x == y or grouped(result, x, y)

    return (same(names[0], a) and same(names[1], b)) or (same(names[0], b) and same(names[1], a))


def neutral(effect: str, parameter: str, vehicle: Vehicle) -> float:
    """The value at which the effect is absent; for some parameters the nominal vehicle's value."""
    own = dict(zip(("xx", "yy", "zz"), vehicle.inertia)) | dict(zip(("xy", "xz", "yz"), vehicle.inertia_products))
    own["time_constant"] = vehicle.motor_time_constant
    default = next(p.default for p in EFFECTS[effect].parameters if p.name == parameter)
    return own[parameter] if default is None else default


def entry(effect: str, result: Document | None) -> Document | None:
    """The answer's entry of an effect; None if not named."""
    if effect not in named(result) or result is None:
        return None
    found: Document = next(e for e in result["effects"] if e["name"] == effect)
    return found


def same_rotor(table: Document, found: Document) -> bool:
    """Whether the discrete parameters (rotor, stream) are right; True without any."""
    if "rotor" not in table:
        return True
    told = _value((found.get("parameters") or {}).get("rotor"))
    return told is not None and int(told) == int(table["rotor"])


def coverage(table: Document, found: Document) -> list[tuple[str, bool | None]]:
    """For every number of the truth: whether the 95 % interval holds it; None where the answer gives no interval.

    An onset is uncertain by one step only; `onset_error` judges it.
    """
    out: list[tuple[str, bool | None]] = []
    for parameter, true in table.items():
        if parameter in (*DISCRETE, "onset_time"):
            continue
        told = (found.get("parameters") or {}).get(parameter)
        interval = told.get("ci95") if isinstance(told, Mapping) else None
        if not interval or None in interval or not all(math.isfinite(x) for x in interval):
            out.append((parameter, None))
        else:
            out.append((parameter, interval[0] <= true <= interval[1]))
    return out


def errors(effect: str, table: Document, found: Document, vehicle: Vehicle) -> dict[str, float]:
    """Error of every quantity relative to its departure from neutral; x, y, z (one unit) are one vector quantity.

    For a thrust 5 % too high, an answer of 6 % has an error of 20 %. A missing quantity has an error of 100 %.
    """
    units = {p.name: p.unit for p in EFFECTS[effect].parameters}
    by_unit: dict[str, list[tuple[float, float]]] = {}
    for parameter, true in table.items():
        if parameter in (*DISCRETE, "onset_time"):
            continue
        base = neutral(effect, parameter, vehicle)
        told = _value((found.get("parameters") or {}).get(parameter))
        by_unit.setdefault(units[parameter], []).append((true - base, (base if told is None else told) - base))
    out = {}
    for unit, rows in by_unit.items():
        size = math.sqrt(sum(t * t for t, _ in rows))
        if size > 0.0:
            out[unit] = math.sqrt(sum((t - f) ** 2 for t, f in rows)) / size
    return out


def onset_error(table: Document, found: Document) -> float | None:
    """Time [s] between estimated and true onset; None if either is missing."""
    told = _value((found.get("parameters") or {}).get("onset_time"))
    return abs(told - table["onset_time"]) if told is not None and "onset_time" in table else None


def _value(parameter: Any) -> float | None:
    value = parameter.get("value") if isinstance(parameter, Mapping) else parameter
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


# outside the catalogue

_TURNS = {"x": "roll", "y": "pitch", "z": "yaw"}
_ROTATIONAL = ("torque", "rate", "attitude", "angular", "moment", "gyro", "rotation")


def places(document: Any) -> list[tuple[str, str]]:
    """(axis, regime) of every {"signal", "axis", "regime"} anywhere in a JSON value; turns are roll, pitch, yaw."""
    out: list[tuple[str, str]] = []
    if isinstance(document, Mapping):
        if isinstance(document.get("axis"), str):
            axis, signal = document["axis"].lower(), str(document.get("signal", "")).lower()
            turned = _TURNS.get(axis, axis) if any(word in signal for word in _ROTATIONAL) else axis
            out.append((turned, str(document.get("regime", "")).lower()))
        for value in document.values():
            out += places(value)
    elif isinstance(document, list | tuple):
        for value in document:
            out += places(value)
    return out


def outside(name: str, result: Document | None) -> dict[str, bool]:
    """Checks of an answer to physics outside the catalogue: unexplained, axis, regime, wrong name."""
    wanted = (OUTSIDE | FOREIGN_OUTSIDE)[name]
    said = bool(result and result.get("mismatch") and leaves_structure(result))
    found = places((result or {}).get("unexplained")) or places((result or {}).get("where"))
    right = [regime for axis, regime in found if axis in wanted.axes]
    confident = [
        e for e in (result or {}).get("effects") or [] if e["name"] in named(result) and _confidence(e) > CONFIDENT
    ]
    return {
        "unexplained": said,
        "axis": said and bool(right),
        "regime": said and any(word in regime.replace("_", " ").split() for regime in right for word in wanted.regimes),
        "wrong_name": bool(confident),
    }


def _confidence(effect: Document) -> float:
    value = effect.get("confidence")
    return float(value) if isinstance(value, int | float) else 1.0


def claims(truth: Iterable[str], result: Document | None) -> list[tuple[float, bool]]:
    """(confidence, right) of every name that an answer gives; a declared look-alike of a true one counts as right."""
    names, held = set(named(result)), set(truth)
    out = []
    for effect in (result or {}).get("effects") or []:
        name = effect["name"]
        if name in names and result is not None:
            out.append((_confidence(effect), name in held or any(grouped(result, name, t) for t in held)))
    return out
