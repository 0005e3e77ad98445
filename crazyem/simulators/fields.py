"""Formats as tables of fields, and how to read and write a file by such a table.

A field holds the place, the quantity and the unit of a number. Reading takes a quantity from its first field; further
fields of the same quantity must agree. Writing fills all fields. Rotor positions relative to the centre of mass, as in
some files, become arms and centre of mass, and back.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError, UsageError
from crazyem.simulators.constants import NUMBERS, SHORTEST_LAG, Constants, impossible, objection, solved, value_of
from crazyem.simulators.documents.spliced import Path, said

AGREE = 0.01  # relative difference up to which two fields agree
SAME = 1e-9  # relative difference up to which a number in a template stays unchanged


class Document(Protocol):
    """A text with numbers at paths."""

    where: str

    @property
    def text(self) -> str: ...
    def get(self, path: Path) -> float | None: ...
    def put(self, path: Path, value: float) -> None: ...


@dataclass(frozen=True)
class Field:
    """A number in a file: `factor` times a quantity plus `offset`.

    Attributes:
        path: of the number in the file.
        quantity: of `Constants`, or one that follows from them (`constants.DERIVED`).
        unit: of the number in the file.
        magnitude: only the absolute value is the quantity; the sign gives the side or spin direction of a rotor.
        checked: whether the number must agree with other fields.
        given: whether reading may take the quantity from this field.
        own: the format's own functions read and write this number; the field gives only its name and unit.
    """

    path: Path
    quantity: str
    unit: str
    factor: float = 1.0
    offset: float = 0.0
    magnitude: bool = False
    checked: bool = True
    given: bool = True
    own: bool = False

    @property
    def label(self) -> str:
        """For people."""
        return said(self.path)

    def read(self, number: float) -> float:
        """The quantity for a number in the file."""
        return ((abs(number) if self.magnitude else number) - self.offset) / self.factor

    def written(self, value: float, now: float | None) -> float:
        """The number in the file for a quantity; `now` is the present number."""
        number = value * self.factor + self.offset
        return -number if self.magnitude and now is not None and now < 0.0 else number


@dataclass(frozen=True)
class Contradiction:
    """Two fields of which only one can be right."""

    field: str
    value: float
    other: str
    expected: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.field} is {self.value:.4g} {self.unit}, and by {self.other} it is {self.expected:.4g} {self.unit}"
        )

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "field": self.field, "value": self.value, "expected_by": self.other, "expected": self.expected,
            "unit": self.unit,
        }  # fmt: skip


@dataclass(frozen=True)
class SimulatorFile:
    """A file that was read.

    Attributes:
        format: name of the format.
        where: name of the file.
        name: of the drone in the file, "" if the format holds one drone only.
        constants: of the drone.
        fields: of the file.
        contradictions: between its fields.
        remarks: further notes on the file, a sentence each.
    """

    format: str
    where: str
    name: str
    constants: Constants
    fields: tuple[Field, ...]
    contradictions: tuple[Contradiction, ...] = ()
    remarks: tuple[str, ...] = ()

    def label(self, quantity: str) -> str:
        """A quantity as the file calls it."""
        return label_of(self.fields, quantity)


def label_of(fields: Sequence[Field], quantity: str) -> str:
    """Label of the first field of a quantity, else of a field from which the quantity follows, else its own name."""
    names = [quantity, *_GIVERS.get(quantity, ())]
    found = next((f for n in names for f in fields if f.quantity == n), None)
    return quantity if found is None else f"{found.label} [{found.unit}]"


_GIVERS = {
    "torque_per_thrust": ("torque_per_speed2", "torque_max"), "thrust_max": ("speed_max", "thrust_to_weight",
    "total_thrust_max"), "arm_x": ("arm", "arm_length"), "arm_y": ("arm", "arm_length"),
    **{f"drag_{a}": ("drag", "rotor_drag_xy") for a in "xy"}, "drag_z": ("drag", "rotor_drag_z"),
    **{f"damping_{a}": ("damping",) for a in "xyz"},
}  # fmt: skip


def template(file: str, *, named: Callable[[str], str] = str) -> Callable[[str], str]:
    """A `skeleton` function for a format: a file of the folder templates with the drone's name for each @NAME@.

    Args:
        file: name of the template.
        named: converts the drone's name to the format's spelling.
    """

    def skeleton(name: str) -> str:
        text = (resources.files("crazyem.simulators") / "templates" / file).read_text(encoding="utf-8")
        return text.replace("@NAME@", named(name))

    return skeleton


@dataclass(frozen=True)
class Format:
    """A simulator's kind of file.

    Attributes:
        name: on the command line.
        suffix: of its files.
        words: description for people.
        open: text and file name -> document.
        recognises: whether a text has this format.
        fields: the table: document and name of the drone -> fields.
        skeleton: name of the drone -> text of a new file, used without a template.
        source: where the fields are documented.
        names: document -> names of its drones; empty if the format holds one drone only.
        read_more: document, drone and quantities found so far -> remarks. Adds the quantities that need more than one
            number of the file (masses of propellers, laws that are no parabola).
        write_more: the same for writing; called last.
        order: formats are listed and tried on a text in this order (then by name).
    """

    name: str
    suffix: str
    words: str
    open: Callable[[str, str], Any]
    recognises: Callable[[str], bool]
    fields: Callable[[Any, str], list[Field]]
    skeleton: Callable[[str], str]
    source: str
    names: Callable[[Any], list[str]] = field(default=lambda document: [])
    read_more: Callable[[Any, str, dict[str, float]], list[str]] = field(default=lambda document, name, found: [])
    write_more: Callable[[Any, str, Constants], None] = field(default=lambda document, name, constants: None)
    order: int = 50


def read(form: Format, text: str, *, where: str, name: str | None = None, strict: bool = True) -> SimulatorFile:
    """Read the constants of a file.

    Args:
        name: of the drone, if the file has several.
        strict: contradictory fields and physically impossible inertias are errors.

    Raises: FileFormatError that names the field; UsageError for an unknown drone.
    """
    document = form.open(text, where)
    drone = drone_of(form, document, name)
    fields = form.fields(document, drone)
    found: dict[str, float] = {}
    for f in fields:
        number = None if f.own else document.get(f.path)
        if number is not None and not math.isfinite(number):
            raise FileFormatError(f"{where}: {f.label} must be a finite number, got {number:g}")
        if number is not None and f.given and f.quantity not in found:
            found[f.quantity] = f.read(number)
    remarks = form.read_more(document, drone, found)
    values = {n: v for n, v in solved(found).items() if n in NUMBERS}
    if "lag" in values and 0.0 < values["lag"] <= SHORTEST_LAG * (1.0 + AGREE):
        values["lag"] = 0.0
    stem = where.replace("\\", "/").rsplit("/", 1)[-1].split(".")[0]
    constants = Constants(drone or stem or "drone", **values)
    problem = objection(constants, lambda q: label_of(fields, q))
    if problem:
        raise FileFormatError(f"{where}: {problem}")
    if wrong := impossible(constants, lambda q: label_of(fields, q)):
        if strict:
            raise FileFormatError(f"{where}: {wrong}")
        remarks = [wrong, *remarks]
    contradictions = tuple(_contradictions(document, fields, constants))
    if contradictions and strict:
        raise FileFormatError(f"{where}: {contradictions[0]}")
    return SimulatorFile(form.name, where, drone, constants, tuple(fields), contradictions, tuple(remarks))


def _contradictions(document: Document, fields: Sequence[Field], constants: Constants) -> list[Contradiction]:
    found: list[Contradiction] = []
    firsts: dict[str, Field] = {}
    for f in fields:
        if f.own:
            continue
        first = firsts.setdefault(f.quantity, f)
        number, expected = document.get(f.path), value_of(constants, f.quantity)
        if number is None or not f.checked or not math.isfinite(expected):
            continue
        said_here, wanted = f.read(number), expected
        scale = max(abs(said_here), abs(wanted))
        if abs(said_here - wanted) > AGREE * scale and scale > 1e-12:
            other = first.label if first is not f else _needed(f.quantity, fields)
            found.append(Contradiction(f.label, number, other, f.written(wanted, number), f.unit))
    return found


def _needed(quantity: str, fields: Sequence[Field]) -> str:
    """The fields from which a quantity follows."""
    needs = _FOLLOWS.get(quantity, ())
    labels = dict.fromkeys(label_of(fields, n).split(" [")[0] for n in needs)
    return " and ".join(labels) or "other fields"


_FOLLOWS = {
    "torque_per_speed2": ("thrust_per_speed2", "torque_per_thrust"), "speed_max": ("thrust_max", "thrust_per_speed2"),
    "thrust_to_weight": ("thrust_max", "mass"), "arm_length": ("arm_x", "arm_y"), "arm": ("arm_x", "arm_y"),
    "weight": ("mass",), "total_thrust_max": ("thrust_max",), "torque_max": ("thrust_max", "torque_per_thrust"),
    "hover_share": ("mass", "thrust_max"), "hover_speed_share": ("mass", "thrust_max"),
}  # fmt: skip


def write(form: Format, constants: Constants, *, template: str | None = None, where: str = "", name: str = "") -> str:
    """The text of a file with these constants; all else comes from the template.

    Raises: UsageError where the constants lack what every file of this format needs, or for an unknown drone.
    """
    text = form.skeleton(name or constants.name) if template is None else template
    document = form.open(text, where or f"the {form.name} template")
    drone = drone_of(form, document, name or None)
    constants = replace(
        constants, lag=max(constants.or_("lag", 0.0), SHORTEST_LAG) if constants.lag is not None else None
    )
    before = _said_before(form, text, document.where, drone)
    for f in form.fields(document, drone):
        value = value_of(constants, f.quantity)
        if f.own or math.isnan(value):
            continue
        now = document.get(f.path)
        if now is not None and _stays(f, now, value, before):
            continue
        number = f.written(value, now)
        if now is None and number == 0.0:
            continue  # a missing number means 0
        if now is None or abs(number - now) > SAME * max(abs(number), abs(now)):
            document.put(f.path, number)
    if before is not None and math.isclose(before.or_("lag", -1.0), constants.or_("lag", -2.0), rel_tol=SAME):
        constants = replace(constants, lag=None)  # an unchanged lag stays as the template has it
    form.write_more(document, drone, constants)
    return str(document.text)


def _said_before(form: Format, text: str, where: str, drone: str) -> Constants | None:
    """The constants of a template; None if they cannot be read."""
    try:
        return read(form, text, where=where, name=drone or None, strict=False).constants
    except FileFormatError:
        return None


def _stays(f: Field, now: float, value: float, before: Constants | None) -> bool:
    """Whether a number in a template can stay: its quantity is unchanged and, for a checked field, it still agrees."""
    if before is None or not math.isclose(value_of(before, f.quantity), value, rel_tol=SAME):
        return False
    return not f.checked or math.isclose(f.read(now), value, rel_tol=AGREE)


def drone_of(form: Format, document: Any, name: str | None) -> str:
    """Name of the requested drone in a file. Raises UsageError if unknown or ambiguous."""
    names = form.names(document)
    if not names:
        return ""
    if name is None and len(names) == 1:
        return names[0]
    if name in names:
        return str(name)
    asked = f"no drone '{name}'" if name else "several drones"
    raise UsageError(f"{document.where}: {asked} in this file; --name chooses one of {', '.join(names)}.")


Array = NDArray[np.float64]
EQUAL = 1e-3  # relative difference of arms up to which four rotors are the corners of a rectangle
NOTHING = 1e-10  # relative to the largest arm or moment of inertia of a drone: smaller values are rounding errors
PLUS = "the rotors lie on the body axes (a plus); it is read as the same drone turned by 45 degrees"


def read_positions(positions: Array, *, where: str, field: str) -> tuple[dict[str, float], list[str]]:
    """Arms and centre of mass of rotor positions (4, 3) [m] from the centre of mass, FLU, and remarks.

    Raises: FileFormatError where they are not the corners of a rectangle.
    """
    if positions.shape != (4, 3) or not np.isfinite(positions).all():
        raise FileFormatError(f"{where}: {field} must hold four positions of three numbers")
    middle = positions.mean(axis=0)
    around = positions - middle
    remarks = []
    if is_plus(positions):
        s = math.sqrt(0.5)
        around, remarks = around @ np.array([[s, -s, 0.0], [s, s, 0.0], [0.0, 0.0, 1.0]]).T, [PLUS]
    arms = np.abs(around[:, :2])
    arm = arms.mean(axis=0)
    quadrants = {(bool(x > 0), bool(y > 0)) for x, y in around[:, :2]}
    if len(quadrants) != 4 or not np.allclose(arms, arm, rtol=EQUAL, atol=0.0):
        raise FileFormatError(f"{where}: {field}: the four rotors are not the corners of a rectangle")
    found = {"arm_x": float(arm[0]), "arm_y": float(arm[1])}
    # the mean of positions has a rounding error even if the centre of mass is in the middle
    centre = np.where(np.abs(middle) < NOTHING * arm.max(), 0.0, -middle)
    return found | {f"centre_{a}": float(c) for a, c in zip("xyz", centre)}, remarks


def placed(now: Array, c: Constants) -> Array:
    """Rotor positions (4, 3) [m] with these arms and centre; each rotor keeps its side in `now`."""
    around = now - now.mean(axis=0)
    arm = np.array([c.or_("arm_x", math.nan), c.or_("arm_y", math.nan)])
    if is_plus(now):
        length = math.hypot(*arm)
        around = np.sign(np.where(np.abs(around) < 0.1 * np.abs(around).max(), 0.0, around)) * [length, length, 0.0]
    else:
        around = np.column_stack([np.sign(around[:, :2]) * arm, np.zeros(4)])
    found: Array = around - np.array([c.or_(f"centre_{a}", 0.0) for a in "xyz"])
    return found


def is_plus(positions: Array) -> bool:
    """Whether rotors lie on the body axes."""
    around = np.abs((positions - positions.mean(axis=0))[:, :2])
    return bool((around.min(axis=1) < 0.1 * around.max(axis=1)).all())
