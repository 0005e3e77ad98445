"""MuJoCo: the free body of an MJCF. Inputs are thrust and torque, or one motor per rotor at sites of the body.

The menagerie's Crazyflie has one motor for the thrust and three motors with a gear of -1 for the torques.
"""

import math
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.simulators.documents.xml import Element, XmlDocument
from crazyem.simulators.fields import Field, Format, template

_FULL = ("xx", "yy", "zz", "xy", "xz", "yz")


def _body(document: XmlDocument) -> tuple[tuple[str, ...], Element]:
    """The path of the first body that is free, else of the first with a mass of its own, and the body."""
    bodies = document.all(("worldbody",), "body")
    free = [k for k, body in enumerate(bodies) if _is_free(body)]
    for k in [*free, *(k for k, body in enumerate(bodies) if body.all("inertial"))]:
        return ("worldbody", f"body[{k}]"), bodies[k]
    raise FileFormatError(f"{document.where}: no body with a freejoint or inertial, so there is no drone in this MJCF")


def _is_free(body: Element) -> bool:
    return bool(body.all("freejoint")) or any(j.attributes.get("type", ("",))[0] == "free" for j in body.all("joint"))


def _gear(motor: Element) -> list[float]:
    return [float(w) for w in motor.attributes.get("gear", ("1",))[0].split()]


def _motors(document: XmlDocument) -> list[tuple[int, Element]]:
    """Motors that push along the body's z axis."""
    motors = document.all(("actuator",), "motor")
    return [(k, m) for k, m in enumerate(motors) if len(_gear(m)) >= 3 and _gear(m)[2] > 0.0]


def _fields(document: XmlDocument, name: str) -> list[Field]:
    path, body = _body(document)
    inertial = body.all("inertial")
    if not inertial:
        raise FileFormatError(f"{document.where}: {body.name()}.inertial is missing")
    quaternion = inertial[0].attributes.get("quat", ("1 0 0 0",))[0].split()
    if [float(q) for q in quaternion[1:]] != [0.0, 0.0, 0.0]:
        raise FileFormatError(f"{document.where}: {body.name()}.inertial.quat turns the inertia, which is not read")
    where = (*path, "inertial")
    full = "fullinertia" in inertial[0].attributes
    kind, elements = ("@fullinertia", _FULL) if full else ("@diaginertia", _FULL[:3])
    found = [
        Field((*where, "@mass"), "mass", "kg"),
        *(Field((*where, kind, k), f"inertia_{a}", "kg m^2") for k, a in enumerate(elements)),
        *(Field((*where, "@pos", k), f"centre_{'xyz'[k]}", "m") for k in range(3)),
    ]
    motors = _motors(document)
    each = len(motors) == 4
    sites = {site.name(): k for k, site in enumerate(body.all("site"))}
    for k, motor in motors if len(motors) in (1, 4) else []:
        scale = 1.0 / _gear(motor)[2]
        limit = "thrust_max" if each else "total_thrust_max"
        found.append(Field(("actuator", f"motor[{k}]", "@ctrlrange", 1), limit, "N", factor=scale))
        site = sites.get(motor.attributes.get("site", ("",))[0])
        if each and site is not None:
            place = (*path, f"site[{site}]", "@pos")
            found += [Field((*place, a), f"arm_{'xy'[a]}", "m", magnitude=True) for a in (0, 1)]
            found.append(Field(("actuator", f"motor[{k}]", "@gear", 5), "torque_per_thrust", "m", magnitude=True))
    hover = "hover_thrust" if each else "weight"
    for k, _ in enumerate(document.all(("keyframe",), "key")):
        found += [
            Field(("keyframe", f"key[{k}]", "@ctrl", n), hover, "N", factor=1.0 / _gear(motor)[2], given=False)
            for n, motor in motors
        ]
    return found


def _write_more(document: XmlDocument, name: str, constants: Any) -> None:
    limits = {"x": constants.arm_y, "y": constants.arm_x, "z": constants.torque_per_thrust}
    if constants.thrust_max is None or "crazyem" not in document.root.attributes.get("model", ("",))[0]:
        return
    # only in our own skeleton: torque limits in a template are a choice of its author
    for k, axis in enumerate("xyz", start=1):
        arm = limits[axis]
        for side, sign in enumerate((-1.0, 1.0)):
            document.put(
                ("actuator", f"motor[{k}]", "@ctrlrange", side), sign * 2.0 * (arm or 0.0) * constants.thrust_max
            )


def tiny_limits(document: XmlDocument) -> list[str]:
    """A remark where torque motors can hardly turn the drone."""
    for k, motor in enumerate(document.all(("actuator",), "motor")):
        gear, limit = _gear(motor), document.get(("actuator", f"motor[{k}]", "@ctrlrange", 1))
        if limit and len(gear) == 6 and not any(gear[:3]) and max(map(abs, gear)) * limit < 1e-4:
            name = motor.name() or f"motor {k}"
            return [
                f"{name}.ctrlrange lets torques reach {max(map(abs, gear)) * limit:.0e} N m only; rotors reach 1e-3"
            ]
    return []


def _read_more(document: XmlDocument, name: str, found: dict[str, float]) -> list[str]:
    if found.get("total_thrust_max", 0.0) <= 0.0:
        found.pop("total_thrust_max", None)
    if math.isclose(found.get("thrust_max", 1.0), 0.0):
        found.pop("thrust_max")
    return tiny_limits(document)


MUJOCO = Format(
    name="mujoco",
    order=30,
    suffix=".xml",
    words="a MuJoCo model (MJCF)",
    open=XmlDocument,
    recognises=lambda text: "<mujoco" in text,
    fields=_fields,
    skeleton=template("mujoco.xml"),
    read_more=_read_more,
    write_more=_write_more,
    source="MuJoCo XML reference (inertial, actuator/motor, keyframe); mujoco_menagerie, bitcraze_crazyflie_2",
)
