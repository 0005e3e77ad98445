"""rotorpy: the dict `quad_params` of a Python module, or the same as JSON. The module is read, never executed.

Rotor positions are from the centre of mass. k_d and k_z are drag per rotor speed, written for hover speed. They act at
the rotors and therefore also damp rotation, by drag times squared arm.
"""

from typing import Any

import numpy as np

from crazyem.errors import FileFormatError
from crazyem.simulators.constants import Constants, solved
from crazyem.simulators.documents.literal import LiteralDocument
from crazyem.simulators.fields import NOTHING, Field, Format, placed, read_positions, template

_ROTORS = ("r1", "r2", "r3", "r4")


def root_of(document: LiteralDocument) -> tuple[Any, ...]:
    """Where the dict of constants is."""
    for name in document.root:
        if "k_eta" in document.keys((name,)):
            return (name,)
        for key in document.keys((name,)):
            if "k_eta" in document.keys((name, key)):
                return (name, key)
    raise FileFormatError(f"{document.where}: no dict with k_eta and rotor_pos, so these are no parameters of rotorpy")


def _fields(document: LiteralDocument, name: str) -> list[Field]:
    root = root_of(document)
    products = {"Ixy": "inertia_xy", "Ixz": "inertia_xz", "Iyz": "inertia_yz"}
    return [
        Field((*root, "mass"), "mass", "kg"),
        *(Field((*root, f"I{a}"), f"inertia_{a}", "kg m^2") for a in ("xx", "yy", "zz")),
        *(Field((*root, key), quantity, "kg m^2") for key, quantity in products.items()),
        *(Field((*root, "rotor_pos", "r1", k), f"{what}_{'xyz'[k]}", "m", own=True)
          for what, axes in (("arm", 2), ("centre", 3)) for k in range(axes)),
        *(Field((*root, f"c_D{a}"), f"quadratic_drag_{a}", "N/(m/s)^2") for a in "xyz"),
        Field((*root, "k_eta"), "thrust_per_speed2", "N/(rad/s)^2"),
        Field((*root, "k_m"), "torque_per_speed2", "N m/(rad/s)^2"),
        Field((*root, "k_d"), "rotor_drag_xy", "N/(m/s)/(rad/s)"),
        Field((*root, "k_z"), "rotor_drag_z", "N/(m/s)/(rad/s)"),
        Field((*root, "tau_m"), "lag", "s"),
        Field((*root, "rotor_speed_max"), "speed_max", "rad/s"),
    ]  # fmt: skip


def _positions(document: LiteralDocument) -> np.ndarray:
    root = root_of(document)
    found = [[document.get((*root, "rotor_pos", r, k)) for k in range(3)] for r in _ROTORS]
    if document.get((*root, "num_rotors")) not in (None, 4.0):
        raise FileFormatError(f"{document.where}: num_rotors is not 4, and the models here are of quadrotors")
    if any(v is None for row in found for v in row):
        raise FileFormatError(f"{document.where}: rotor_pos must hold r1 to r4 with three numbers each")
    return np.array(found, float)


def _read_more(document: LiteralDocument, name: str, found: dict[str, float]) -> list[str]:
    values, remarks = read_positions(_positions(document), where=document.where, field="rotor_pos")
    found |= values
    root = root_of(document)
    drag = solved(found)
    if "drag_x" in drag and "drag_z" in drag:
        found["damping_x"] = drag["drag_z"] * found["arm_y"] ** 2
        found["damping_y"] = drag["drag_z"] * found["arm_x"] ** 2
        found["damping_z"] = drag["drag_x"] * (found["arm_x"] ** 2 + found["arm_y"] ** 2)
    for key, words in (("k_h", "translational lift"), ("k_flap", "flapping")):
        if document.get((*root, key)):
            remarks.append(f"{key} ({words}) is in none of crazyem's effects and is left out")
    return remarks


def _write_more(document: LiteralDocument, name: str, c: Constants) -> None:
    if c.arm_x is None or c.arm_y is None:
        return
    root, now = root_of(document), _positions(document)
    wanted = placed(now, c)
    for row, rotor in enumerate(_ROTORS):
        for k in range(3):
            if abs(wanted[row, k] - now[row, k]) > NOTHING * np.abs(wanted).max():
                document.put((*root, "rotor_pos", rotor, k), float(wanted[row, k]))


ROTORPY = Format(
    name="rotorpy",
    order=50,
    suffix=".py",
    words="the parameters of a rotorpy vehicle (Python or JSON)",
    open=LiteralDocument,
    recognises=lambda text: "k_eta" in text and "rotor_pos" in text,
    fields=_fields,
    skeleton=template("rotorpy.py.txt"),
    read_more=_read_more,
    write_more=_write_more,
    source="rotorpy 3.0, vehicles/multirotor.py (Multirotor)",
)
ROTORPY_JSON = Format(
    name="rotorpy-json", order=100, suffix=".json", words="the parameters of a rotorpy vehicle (JSON)",
    open=LiteralDocument,
    recognises=lambda text: False, fields=_fields, skeleton=template("rotorpy.json"),
    read_more=_read_more, write_more=_write_more, source=ROTORPY.source,
)  # fmt: skip
