"""gym-pybullet-drones: a URDF with `<properties>`. kf and km are per RPM squared; rotors have no lag.

Drag acts only in physics modes such as `pyb_drag`. Its coefficient is per rotor speed and written for hover speed.
Products of inertia are not written: Bullet would turn the base frame to the principal axes and change the attitude.
"""

from typing import Any

from crazyem.simulators.documents.xml import XmlDocument
from crazyem.simulators.fields import PLUS, Field, Format, template
from crazyem.simulators.formats.crazyflow import PER_RPM2

_BASE = ("link[name=base_link]", "inertial")


def _prop(k: int, axis: int) -> tuple[Any, ...]:
    return (f"link[name=prop{k}_link]", "inertial", "origin", "@xyz", axis)


def _is_plus(document: XmlDocument) -> bool:
    return any(abs(document.get(_prop(k, axis)) or 0.0) < 1e-6 for k in range(4) for axis in (0, 1))


def _fields(document: XmlDocument, name: str) -> list[Field]:
    arms = [] if _is_plus(document) else [
        Field(_prop(k, axis), f"arm_{'xy'[axis]}", "m", magnitude=True) for k in range(4) for axis in (0, 1)
    ]  # fmt: skip
    return [
        Field((*_BASE, "mass", "@value"), "mass", "kg"),
        *(Field((*_BASE, "inertia", f"@i{a}"), f"inertia_{a}", "kg m^2") for a in ("xx", "yy", "zz")),
        *(Field((*_BASE, "origin", "@xyz", k), f"centre_{'xyz'[k]}", "m") for k in range(3)),
        *(Field(("link[name=center_of_mass_link]", "inertial", "origin", "@xyz", k), f"centre_{'xyz'[k]}", "m")
          for k in range(3)),
        *arms,
        Field(("properties", "@arm"), "arm_length", "m"),
        Field(("properties", "@kf"), "thrust_per_speed2", "N/RPM^2", factor=PER_RPM2),
        Field(("properties", "@km"), "torque_per_speed2", "N m/RPM^2", factor=PER_RPM2),
        Field(("properties", "@thrust2weight"), "thrust_to_weight", ""),
        Field(("properties", "@drag_coeff_xy"), "rotor_drag_xy", "N/(m/s)/(rad/s)"),
        Field(("properties", "@drag_coeff_z"), "rotor_drag_z", "N/(m/s)/(rad/s)"),
    ]  # fmt: skip


def _read_more(document: XmlDocument, name: str, found: dict[str, float]) -> list[str]:
    products = [document.get((*_BASE, "inertia", f"@i{a}")) for a in ("xy", "xz", "yz")]
    turned = "products of inertia are left out: with them Bullet's base frame is not the body frame"
    return [*([PLUS] if _is_plus(document) else []), *([turned] if any(products) else [])]


GYM_PYBULLET_DRONES = Format(
    name="gym-pybullet-drones",
    order=20,
    suffix=".urdf",
    words="a URDF of gym-pybullet-drones",
    open=XmlDocument,
    recognises=lambda text: "<robot" in text and "<properties" in text and "kf=" in text,
    fields=_fields,
    skeleton=template("gym_pybullet_drones.urdf"),
    read_more=_read_more,
    source="gym-pybullet-drones, BaseAviary.py (_parseURDFParameters, _physics, _drag)",
)
