"""A vehicle file as the truth of a scenario: `vehicle_file = "PATH.toml"`, the format in which crazyem keeps drones.

TOML, SI: name, mass, inertia (3 or 6), arm (one number or [x, y]), thrust_curve (1 to 6 coefficients, constant first),
rotor_constant, torque_per_thrust, motor_time_constant, thrust_max (full scale of commands; inf: no limit),
battery_compensated and *_sd (not used here), and tables [effects.NAME]. mass and inertia are required. Other missing
values are the platform's.
"""

import tomllib
from pathlib import Path
from typing import Any

from firmware_sim.errors import ScenarioError
from firmware_sim.plant.platforms import LIMIT_OVER_FULL_SCALE

LARGEST_VEHICLE_FILE = 1 << 20  # bytes; such a file has a few hundred
NO_LIMIT = 100.0  # N per rotor, where its limit is larger or unknown
_VEHICLE = (
    *("mass", "inertia", "arm", "thrust_curve", "rotor_constant"),
    *("torque_per_thrust", "motor_time_constant", "thrust_max"),
)
_IGNORED = ("name", "battery_compensated", "mass_sd", "inertia_sd", "motor_time_constant_sd")


def read_toml(path: Path) -> dict[str, Any]:
    """The table of a small TOML file. Raises ScenarioError naming the file."""
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST_VEHICLE_FILE + 1)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(data) > LARGEST_VEHICLE_FILE:
        raise ScenarioError(f"{path}: larger than {LARGEST_VEHICLE_FILE} bytes, not a scenario or vehicle file")
    try:
        return tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ScenarioError(f"{path}: not a TOML file ({error})") from error


def vehicle_tables(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The content of a vehicle file as tables [vehicle] and [effects] of a scenario, not yet checked for range.

    Raises ScenarioError naming the file and the key.
    """
    table = read_toml(path)
    for entry in table:
        if entry not in (*_VEHICLE, *_IGNORED, "effects"):
            known = ", ".join((*_VEHICLE, *_IGNORED, "effects"))
            raise ScenarioError(f"{path}: {entry} is not a key of a vehicle file (known: {known})")
    for entry in ("mass", "inertia"):
        if entry not in table:
            raise ScenarioError(f"{path}: {entry} is missing")
    effects = table.get("effects", {})
    if not isinstance(effects, dict):
        raise ScenarioError(f"{path}: effects must hold tables [effects.NAME]")
    vehicle = {entry: table[entry] for entry in _VEHICLE if entry in table}
    full_scale = vehicle.get("thrust_max")
    if isinstance(full_scale, (int, float)) and not isinstance(full_scale, bool) and full_scale > 0.0:
        vehicle["thrust_max"] = min(LIMIT_OVER_FULL_SCALE * full_scale, NO_LIMIT)
    arm = vehicle.get("arm")
    if isinstance(arm, list) and len(arm) == 1:
        vehicle["arm"] = arm[0]
    return vehicle, effects
