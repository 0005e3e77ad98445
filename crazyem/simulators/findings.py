"""Compare a simulator's file with flights, in the file's names and units: a finding for each field, and alternatives
for mass and thrust, because flights identify only their ratio."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.simulators.constants import Constants, from_vehicle, value_of
from crazyem.simulators.fields import Field, SimulatorFile
from crazyem.vehicle import Vehicle

SURE = 1.96  # standard deviations of a 95 % interval
TOLERANCE = 0.05  # relative deviation of a number in a file up to which the number may stay
GAUGE = (
    "flights tell thrust over mass and torque over inertia, not each alone: mass, inertia, thrust and drag may all be "
    "larger by one factor; weigh the drone and say --mass"
)
HEAVY = ("N", "kg")  # units that have a mass in them


@dataclass(frozen=True)
class FieldFinding:
    """A field of a file, with its value in the file and by the flights.

    Attributes:
        field, unit: as in the file. quantity: its name in `Constants`.
        value: in the file; NaN if missing.
        fitted, sd: estimate from the flights, in the file's unit; sd is NaN if flights give no information.
        off: whether the file's value lies outside the 95 % interval, and by more than `tolerance`.
        why: a note for people, "" if none.
    """

    field: str
    unit: str
    quantity: str
    value: float
    fitted: float
    sd: float
    off: bool
    why: str = ""

    @property
    def known(self) -> bool:
        """Whether flights give information on this field."""
        return math.isfinite(self.sd)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        return self.fitted - SURE * self.sd, self.fitted + SURE * self.sd

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if not self.known:
            return f"{self.field} {self.value:.4g}{unit}: {self.why or 'nothing speaks against it'}"
        low, high = self.interval
        change = f"{self.value:.4g} -> " if math.isfinite(self.value) else "not set -> "
        return f"{self.field} {change}{self.fitted:.4g}{unit} (95 %: {low:.4g} to {high:.4g})" + (
            f"; {self.why}" if self.why else ""
        )

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        known = self.known
        return {
            "field": self.field, "unit": self.unit, "quantity": self.quantity,
            "value": self.value if math.isfinite(self.value) else None, "fitted": self.fitted if known else None,
            "sd": self.sd if known else None, "ci95": list(self.interval) if known else None, "off": self.off,
            "why": self.why,
        }  # fmt: skip


def field_findings(
    imported: SimulatorFile,
    before: Vehicle,
    fitted: Vehicle,
    effects: Sequence[Mapping[str, Any]],
    not_identifiable: Mapping[str, str],
    *,
    looked_for: Collection[str] | None = None,
    tolerance: float = TOLERANCE,
) -> list[FieldFinding]:
    """A finding for every quantity of a file, each quantity once.

    Args:
        before: the vehicle of the file. fitted: the vehicle with the diagnosed effects.
        effects: of the diagnosis' document: name, and parameters with value and sd.
        not_identifiable: effect -> why flights give no information on it.
        looked_for: effects that the diagnosis tried; None: all.
    """
    old, new = from_vehicle(before)[0], from_vehicle(fitted)[0]
    moved = _moved(fitted, effects)
    found = []
    for f in _once(imported.fields):
        value, now = value_of(old, f.quantity), value_of(new, f.quantity)
        if math.isnan(value):
            continue
        sd = math.hypot(*(value_of(c, f.quantity) - now for c in moved)) if moved else 0.0
        changed = abs(now - value) > 1e-9 * max(abs(now), abs(value)) or sd > 1e-9 * abs(now)
        shown, fits = f.written(value, None), f.written(now, None)
        if not changed:
            reason = _reason(f.quantity, not_identifiable, looked_for)
            found.append(FieldFinding(f.label, f.unit, f.quantity, shown, shown, math.nan, False, reason))
            continue
        spread = abs(f.factor) * sd
        off = abs(fits - shown) > max(SURE * spread, tolerance * max(abs(shown), abs(fits)))
        found.append(FieldFinding(f.label, f.unit, f.quantity, shown, fits, spread, off))
    return found


def _once(fields: Sequence[Field]) -> list[Field]:
    """The first field of each quantity, among fields that are checked and give their quantity."""
    seen: dict[str, Field] = {}
    for f in fields:
        if f.checked and f.given:
            seen.setdefault(f.quantity, f)
    return list(seen.values())


def _moved(fitted: Vehicle, effects: Sequence[Mapping[str, Any]]) -> list[Constants]:
    """The fitted constants, once for each fitted parameter, with this parameter raised by one standard deviation."""
    found = []
    for effect in effects:
        present = fitted.effects.get(effect["name"])
        if present is None:
            continue
        for name, number in effect["parameters"].items():
            if number.get("chosen") or not number.get("sd"):
                continue
            further = {**present, name: present.get(name, number["value"]) + number["sd"]}
            found.append(from_vehicle(replace(fitted, effects={**fitted.effects, effect["name"]: further}))[0])
    return found


def _reason(quantity: str, not_identifiable: Mapping[str, str], looked_for: Collection[str] | None) -> str:
    names = _about(quantity) or _about(quantity.partition("_")[0])
    reason = next((f"flights do not tell: {not_identifiable[n]}" for n in names if n in not_identifiable), "")
    unasked = looked_for is not None and not any(n in looked_for for n in names)
    return reason or ("not looked for" if unasked else "")


def _about(quantity: str) -> list[str]:
    """Effects whose absence makes a quantity look wrong, the closest first."""
    found = [(e.about.index(quantity), e.name) for e in CATALOGUE.values() if quantity in e.about]
    return [name for _, name in sorted(found)]


def rescaled(vehicle: Vehicle, mass: float) -> Vehicle:
    """The same motion with another mass: every force, torque and inertia changes by the same factor.

    Args:
        mass: weighed mass of the whole drone [kg].
    """
    factor = mass / from_vehicle(vehicle)[0].or_("mass", vehicle.mass)
    units = {(e.name, p.name): p.unit for e in CATALOGUE.values() for p in e.parameters}
    effects = {
        name: {
            key: value * factor if value is not None and units[name, key].startswith(HEAVY) else value
            for key, value in values.items()
        }
        for name, values in vehicle.effects.items()
    }
    constant = vehicle.rotor_constant
    return replace(
        vehicle,
        mass=vehicle.mass * factor,
        inertia=(vehicle.inertia[0] * factor, vehicle.inertia[1] * factor, vehicle.inertia[2] * factor),
        inertia_products=(
            vehicle.inertia_products[0] * factor, vehicle.inertia_products[1] * factor,
            vehicle.inertia_products[2] * factor,
        ),
        thrust_curve=tuple(c * factor for c in vehicle.thrust_curve),
        rotor_constant=None if constant is None else constant * factor,
        thrust_max=vehicle.thrust_max * factor,
        effects=effects,
    )  # fmt: skip


def alternatives(imported: SimulatorFile, fitted: Vehicle, mass: float) -> list[dict[str, Any]]:
    """The fitted constants of a file, once with the given mass and once with the mass that keeps the file's thrust."""
    old, new = imported.constants, from_vehicle(fitted)[0]
    if old.thrust_per_speed2 is None or new.thrust_per_speed2 is None or new.mass is None:
        return []
    of_thrust = new.mass * old.thrust_per_speed2 / new.thrust_per_speed2
    found = []
    for words, total in (("the mass of the file is right", mass), ("the thrust of the file is right", of_thrust)):
        c = from_vehicle(rescaled(fitted, total))[0]
        numbers = {
            f.label: f.written(value_of(c, f.quantity), None)
            for f in _once(imported.fields) if f.quantity in ("mass", "thrust_per_speed2") or f.quantity in _MOMENTS
        }  # fmt: skip
        found.append({"if": words, "fields": numbers})
    return found


_MOMENTS = ("inertia_xx", "inertia_yy", "inertia_zz")
