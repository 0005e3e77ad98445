"""The catalogue of effects: names, parameters, units, neutral values and ranges, and the check of a scenario's tables.

Source of names and units: the catalogue that host and simulator share (docs: firmware_sim_effects.md). An effect whose
parameters are all neutral changes no bit. `HIDDEN` lists effects outside the catalogue, for tests of a diagnosis on
physics without a model.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from firmware_sim.errors import ScenarioError, checked_number

Values = dict[str, Any]  # parameter -> number, None (the vehicle's own value) or tuple of stream names
LONGEST_DELAY = 0.1  # s
STREAMS = ("pose", "gyro", "accelerometer", "state")


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: its unit, default (None: the vehicle's own value) and range."""

    name: str
    unit: str
    default: float | None
    low: float
    high: float
    whole: bool = False  # an integer
    required: bool = False


@dataclass(frozen=True)
class Effect:
    """A named group of parameters. `streams`: also takes a list of stream names."""

    name: str
    parameters: tuple[Parameter, ...]
    streams: bool = False


def _xyz(unit: str, default: float | None, low: float, high: float, names: str = "x y z") -> tuple[Parameter, ...]:
    return tuple(Parameter(name, unit, default, low, high) for name in names.split())


def _rotor() -> Parameter:
    return Parameter("rotor", "", None, 1, 4, whole=True, required=True)


_ANGLES = "roll pitch yaw"

EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect("payload", (Parameter("mass", "kg", 0.0, 0.0, 1.0), *_xyz("m", 0.0, -0.3, 0.3))),
        Effect("thrust_scale", (Parameter("scale", "", 1.0, 0.1, 5.0),)),
        Effect(
            "rotor_fault",
            (_rotor(), Parameter("scale", "", 1.0, 0.0, 2.0), Parameter("onset_time", "s", 0.0, 0.0, 1e6)),
        ),
        Effect("center_of_mass", _xyz("m", 0.0, -0.1, 0.1)),
        Effect("linear_drag", _xyz("N s/m", 0.0, 0.0, 0.5)),
        Effect("quadratic_drag", _xyz("N s^2/m^2", 0.0, 0.0, 0.1)),
        Effect("velocity_moment", _xyz("N m s/m", 0.0, -5e-3, 5e-3, "roll_per_vy pitch_per_vx")),
        Effect("rate_damping", _xyz("N m s", 0.0, 0.0, 1e-3)),
        Effect("motor_lag", (Parameter("time_constant", "s", None, 0.0, 1.0),)),
        Effect("input_delay", (Parameter("delay", "s", 0.0, 0.0, LONGEST_DELAY),)),
        Effect("measurement_delay", (Parameter("delay", "s", 0.0, 0.0, LONGEST_DELAY),), streams=True),
        Effect(
            "battery_sag",
            (Parameter("gain_per_volt", "1/V", 0.0, -2.0, 2.0), Parameter("gain_per_second", "1/s", 0.0, -0.1, 0.1)),
        ),
        Effect("thrust_curve", (Parameter("slope_error", "", 0.0, -0.9, 3.0),)),
        Effect(
            "ground_effect",
            (Parameter("strength", "", 0.0, -0.5, 2.0), Parameter("height", "m", 0.1, 5e-3, 10.0)),
        ),
        Effect("wind", _xyz("m/s", 0.0, -30.0, 30.0)),
        Effect(
            "gusts",
            (
                Parameter("standard_deviation", "m/s", 0.0, 0.0, 10.0),
                Parameter("correlation_time", "s", 1.0, 0.01, 100.0),
            ),
        ),
        Effect("attitude_misalignment", _xyz("rad", 0.0, -math.pi, math.pi, _ANGLES)),
        Effect("accelerometer_misalignment", _xyz("rad", 0.0, -math.pi, math.pi, _ANGLES)),
        Effect("gyro_bias", _xyz("rad/s", 0.0, -1.0, 1.0)),
        Effect("velocity_scale", _xyz("", 1.0, 0.0, 3.0)),
        Effect("rotor_inertia", (Parameter("inertia", "kg m^2", 0.0, 0.0, 1e-6),)),
        Effect("inertia", _xyz("kg m^2", None, 1e-9, 1.0, "xx yy zz")),
        Effect("inertia_products", _xyz("kg m^2", None, -1.0, 1.0, "xy xz yz")),
        Effect("torque_scale", (Parameter("scale", "", 1.0, 0.0, 5.0),)),
        Effect("trim", _xyz("m", 0.0, -0.02, 0.02)),
        Effect(
            "suspended_load",
            (Parameter("mass", "kg", 0.0, 0.0, 0.5), Parameter("length", "m", 0.3, 0.02, 10.0)),
        ),
        Effect("rotor_sensor", (_rotor(), Parameter("scale", "", 1.0, 0.0, 3.0))),
    )
}

HIDDEN: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            "vibration",
            (_rotor(), Parameter("torque", "N m", 0.0, 0.0, 0.1), Parameter("ratio", "", 1.0, 1e-3, 2.0)),
        ),
        Effect(
            "magnetic_yaw",
            (Parameter("amplitude", "rad", 0.0, -math.pi, math.pi), Parameter("wavelength", "m", 1.0, 0.01, 1e3)),
        ),
        Effect("sticky_rotor", (_rotor(), Parameter("deadband", "", 0.0, 0.0, 1.0))),
        Effect(
            "cable_spring",
            (
                Parameter("stiffness", "N/m", 0.0, 0.0, 100.0),
                Parameter("length", "m", 0.0, 0.0, 100.0),
                *_xyz("m", 0.0, -100.0, 100.0),
            ),
        ),
    )
}


def parse_effects(table: Mapping[str, Any], source: str, section: str) -> dict[str, Values]:
    """Check the tables [section.NAME] of a file; section is "effects" or "hidden". Returns every parameter, in SI.

    Raises ScenarioError naming file and key.
    """
    known = EFFECTS if section == "effects" else HIDDEN
    parsed = {}
    for name, values in table.items():
        where = f"{source}: {section}.{name}"
        if name not in known:
            raise ScenarioError(f"{where} is not an effect (known: {', '.join(known)})")
        if not isinstance(values, dict):
            raise ScenarioError(f"{where} must be a table [{section}.{name}]")
        parsed[name] = _values(known[name], values, where)
    if all(parsed.get("battery_sag", {}).get(key) for key in ("gain_per_volt", "gain_per_second")):
        raise ScenarioError(f"{source}: {section}.battery_sag takes gain_per_volt or gain_per_second, not both")
    return parsed


def _values(effect: Effect, table: Mapping[str, Any], where: str) -> Values:
    known = [p.name for p in effect.parameters] + ["streams"] * effect.streams
    for entry in table:
        if entry not in known:
            raise ScenarioError(f"{where}.{entry} is not a parameter of this effect (known: {', '.join(known)})")
    values: Values = {}
    for p in effect.parameters:
        if p.name in table:
            values[p.name] = _number(table[p.name], p, f"{where}.{p.name}")
        elif p.required:
            raise ScenarioError(f"{where}.{p.name} is missing")
        else:
            values[p.name] = p.default
    if effect.streams:
        values["streams"] = _streams(table.get("streams", ["pose"]), f"{where}.streams")
    return values


def _number(value: Any, p: Parameter, where: str) -> float:
    number = checked_number(value, where, p.low, p.high, p.unit)
    if p.whole and not number.is_integer():
        raise ScenarioError(f"{where} must be a whole number, not {value!r}")
    return number


def _streams(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise ScenarioError(f"{where} must be a list of names of streams ({', '.join(STREAMS)})")
    for name in value:
        if not isinstance(name, str) or name not in STREAMS:
            raise ScenarioError(f"{where} may hold {', '.join(STREAMS)}, not {name!r}")
    return tuple(value)
