"""OmniDrones: the YAML beside a drone's USD file. Constants are per (rad/s)^2.

OmniDrones multiplies its `drag_coef` by zero, so it has no effect; it is neither read nor written.
"""

import math

from crazyem.errors import FileFormatError
from crazyem.simulators.constants import Constants
from crazyem.simulators.documents.tables import YamlDocument
from crazyem.simulators.fields import PLUS, Field, Format, template

_ROTORS = ("rotor_configuration",)
_LISTS = (
    ("force_constants", "thrust_per_speed2", "N/(rad/s)^2"),
    ("moment_constants", "torque_per_speed2", "N m/(rad/s)^2"),
    ("max_rotation_velocities", "speed_max", "rad/s"),
)


def _fields(document: YamlDocument, name: str) -> list[Field]:
    return [
        Field(("mass",), "mass", "kg"),
        *(Field(("inertia", a), f"inertia_{a}", "kg m^2") for a in ("xx", "yy", "zz", "xy", "xz", "yz")),
        *(Field((*_ROTORS, "arm_lengths", k), "arm_length", "m", own=True) for k in range(4)),
        *(Field((*_ROTORS, key, k), quantity, unit) for key, quantity, unit in _LISTS for k in range(4)),
    ]


def _arms(document: YamlDocument) -> tuple[list[float], list[float]]:
    """Lengths [m] and angles [rad] of four arms. Raises FileFormatError where a number is missing."""
    found: list[list[float]] = []
    for key in ("arm_lengths", "rotor_angles"):
        values = [document.get((*_ROTORS, key, k)) for k in range(4)]
        if document.length((*_ROTORS, key)) != 4 or any(v is None for v in values):
            raise FileFormatError(f"{document.where}: rotor_configuration.{key} must hold four numbers")
        found.append([float(v) for v in values if v is not None])
    return found[0], found[1]


def _is_plus(angles: list[float]) -> bool:
    return all(min(abs(math.cos(a)), abs(math.sin(a))) < 0.1 for a in angles)


def _read_more(document: YamlDocument, name: str, found: dict[str, float]) -> list[str]:
    lengths, angles = _arms(document)
    if max(lengths) - min(lengths) > 0.01 * max(lengths):
        raise FileFormatError(f"{document.where}: rotor_configuration.arm_lengths differ from rotor to rotor")
    if _is_plus(angles):
        found["arm_length"] = lengths[0]
        return [PLUS]
    found["arm_x"] = sum(n * abs(math.cos(a)) for n, a in zip(lengths, angles)) / 4.0
    found["arm_y"] = sum(n * abs(math.sin(a)) for n, a in zip(lengths, angles)) / 4.0
    return []


def _write_more(document: YamlDocument, name: str, c: Constants) -> None:
    if c.arm_x is None or c.arm_y is None:
        return
    lengths, angles = _arms(document)
    length = math.hypot(c.arm_x, c.arm_y)
    for k in range(4):
        if abs(length - lengths[k]) > 1e-9 * length:
            document.put((*_ROTORS, "arm_lengths", k), length)
        wanted = math.atan2(math.copysign(c.arm_y, math.sin(angles[k])), math.copysign(c.arm_x, math.cos(angles[k])))
        if not _is_plus(angles) and abs(math.remainder(wanted - angles[k], 2.0 * math.pi)) > 1e-9:
            document.put((*_ROTORS, "rotor_angles", k), wanted)


OMNIDRONES = Format(
    name="omnidrones",
    order=80,
    suffix=".yaml",
    words="a drone's YAML of OmniDrones",
    open=YamlDocument,
    recognises=lambda text: "rotor_configuration" in text and "force_constants" in text and "<" not in text[:1],
    fields=_fields,
    skeleton=template("omnidrones.yaml"),
    read_more=_read_more,
    write_more=_write_more,
    source="OmniDrones, robots/drone/multirotor.py and actuators/rotor_group.py",
)
