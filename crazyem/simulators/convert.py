"""Convert a vehicle to a simulator's file and back; report what the file cannot hold and the error this causes.

Every `Format` in a module of `formats/` is known by its name, and recognised by its text.

The cost of an omission is the distance between two models after half a second of flight from the same states. Without a
recording the reference flight is synthetic: a hundred starts of brisk flight (up to 1.5 m/s, 15 degrees, 1 rad/s) with
rotor commands around hover. With a recording, states and inputs come from the recording.
"""

import importlib
import math
import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.inputs import Inputs
from crazyem.diagnosis.prediction.horizon import UNITS, error_lengths, lengths, open_loop, windows
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.errors import FileFormatError, UsageError
from crazyem.notebook import finite
from crazyem.physics import folding
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.supply import THRUST_CURVE
from crazyem.physics.motion import RotorInput
from crazyem.physics.rotations import quaternion_from_rotation_vector
from crazyem.recordings.recording import Recording
from crazyem.simulators.constants import Constants, from_vehicle, impossible, objection, to_vehicle, without_effects
from crazyem.simulators.fields import Contradiction, Format, SimulatorFile, read, write
from crazyem.simulators.formats.rotorpy import ROTORPY, ROTORPY_JSON
from crazyem.vehicle import GRAVITY, Vehicle, preset_names

Array = NDArray[np.float64]
HORIZON = 0.5  # s
STARTS, SPACING, STEP = 100, 0.1, 0.01  # starts; s from one to the next; s between commands
SPEED, TILT, RATE = 1.5, math.radians(15.0), 1.0  # m/s, rad, rad/s: largest values of the synthetic flight
STIR = 0.04  # amplitude of the rotor commands around hover, relative to hover thrust
NOTHING = 1e-9  # smaller distances are rounding errors and shown as 0
_COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}


@dataclass(frozen=True, eq=False)
class Reference:
    """Starts and inputs. state (n, 13) as `predict.NAMES`; times (n, k) s."""

    inputs: Inputs
    state: Array
    times: Array


def reference_flight(vehicle: Vehicle) -> Reference:
    """The synthetic flight of a vehicle: thrust commands around hover."""
    count = round((STARTS * SPACING + 2.0 * HORIZON) / STEP)
    time = np.arange(count) * STEP
    # incommensurable frequencies [Hz], so that all starts differ
    waves = [np.sin(2.0 * np.pi * (f * time + k / 4.0)) for k, f in enumerate((0.83, 1.31, 1.97, 2.71))]
    stir = np.stack(waves, axis=1)
    thrust = vehicle.mass * GRAVITY / 4.0 * (1.0 + STIR * stir)
    rotor = RotorInput(time, np.ascontiguousarray(thrust), np.full(count, 3.85), time, measured=False, aged=False)
    begin = HORIZON + SPACING * np.arange(STARTS)
    phase = begin[:, None] * np.array([0.37, 0.53, 0.71])
    velocity = SPEED / math.sqrt(3.0) * np.sin(2.0 * np.pi * phase)
    turn = TILT * np.column_stack([np.sin(2.0 * np.pi * 0.61 * begin), np.cos(2.0 * np.pi * 0.43 * begin), 0.0 * begin])
    rate = RATE * np.sin(2.0 * np.pi * (phase[:, ::-1] + 0.2))
    attitude = quaternion_from_rotation_vector(turn)
    position = np.tile([0.0, 0.0, 2.0], (STARTS, 1))
    state = np.concatenate([position, velocity, attitude, rate], axis=1)
    inputs = Inputs(rotor, "motor_command", vehicle, (), 0.0, 0.0)
    return Reference(inputs, state, begin[:, None] + np.arange(0.0, HORIZON + STEP / 2, STEP))


def flown(reference: Reference, vehicle: Vehicle) -> Array:
    """(n, k, 13) predicted states of a vehicle from every start."""
    return Simulator(reference.inputs, vehicle=vehicle).run(reference.state, reference.times)


def rms_distance(first: Array, second: Array) -> dict[str, float]:
    """Root mean square distance of two predictions at their last moments, by quantity [m, m/s, rad, rad/s]."""
    found = {}
    for name, columns in _COLUMNS.items():
        length = lengths(first[:, -1, columns], second[:, -1, columns], attitude=name == "attitude")
        found[name] = float(np.sqrt(np.mean(np.square(length)))) if np.isfinite(length).all() else math.inf
    return found


def errors_after(recording: Recording, vehicles: Mapping[str, Vehicle]) -> dict[str, dict[str, float]]:
    """Open-loop errors after half a second along a recording, by vehicle and quantity.

    Raises: DataError if the recording has no whole states or no flight that is long enough.
    """
    found: dict[str, dict[str, float]] = {}
    at = None
    for name, vehicle in vehicles.items():
        shown = recorded(recording, vehicle)
        at = windows(shown, horizons=(HORIZON,)) if at is None else at
        length = error_lengths(open_loop(shown, at), at)
        found[name] = {q: float(np.sqrt(np.nanmean(np.square(v[:, -1])))) for q, v in length.items()}
    return found


def said(errors: Mapping[str, float]) -> str:
    """Distances for people."""
    return ", ".join(f"{errors[q] if abs(errors[q]) > NOTHING else 0.0:.2g} {unit}" for q, unit in UNITS.items())


OWN = "crazyem"  # a vehicle file


def discover(paths: Iterable[str], package: str = "") -> dict[str, Format]:
    """Every `Format` in the modules of some folders, sorted by `order` and name.

    Args:
        paths: folders.
        package: dotted name of the package of these folders; empty: top level.
    """
    modules = pkgutil.iter_modules(list(paths), f"{package}." if package else "")
    found = [v for m in modules for v in vars(importlib.import_module(m.name)).values() if isinstance(v, Format)]
    return {form.name: form for form in sorted(found, key=lambda form: (form.order, form.name))}


_FOLDER = importlib.import_module("crazyem.simulators.formats")
FORMATS = discover(_FOLDER.__path__, _FOLDER.__name__)
NAMES = (*(n for n in FORMATS if n != ROTORPY_JSON.name), OWN)


def format_named(name: str) -> Format:
    """A format by its name. Raises UsageError for an unknown one."""
    if name not in FORMATS:
        raise UsageError(f"unknown format '{name}' (known: {', '.join(NAMES)}).")
    return FORMATS[name]


def format_of(text: str, *, where: str) -> str:
    """The name of a text's format, `OWN` for a vehicle file.

    Raises: FileFormatError if no format fits.
    """
    for form in FORMATS.values():
        if form.recognises(text):
            return form.name
    if "cmd_f_coef" in text or "rpy_coef" in text:
        raise FileFormatError(
            f"{where}: a fitted closed-loop model of crazyflow holds no physical constants; fit it to flights instead"
        )
    if "thrust2torque" in text and "mass_thrust" in text:
        raise FileFormatError(f"{where}: gains of crazyflow's controller, not constants of a drone")
    if any(line.split("=")[0].strip() == "mass" for line in text.splitlines()) and "inertia" in text:
        return OWN
    raise FileFormatError(f"{where}: no file of a known simulator ({', '.join(NAMES)})")


# Quantities that a file holds or omits together: words for people, and the quantities.
GROUPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("rotor lag", ("lag",)),
    ("centre of mass", ("centre_x", "centre_y", "centre_z")),
    ("inertia", ("inertia_xx", "inertia_yy", "inertia_zz")),
    ("products of inertia", ("inertia_xy", "inertia_xz", "inertia_yz")),
    ("arms", ("arm_x", "arm_y")),
    ("drag by axis", ("drag_x", "drag_y", "drag_z")),
    ("quadratic drag", ("quadratic_drag_x", "quadratic_drag_y", "quadratic_drag_z")),
    ("damping of rotation", ("damping_x", "damping_y", "damping_z")),
)
EFFECT_OF = {constant: e.name for e in CATALOGUE.values() for constant in e.constants.values()}
OF_ROTORS = {
    "thrust_per_speed2": "thrust per squared rotor speed", "torque_per_thrust": "torque per thrust",
    "thrust_max": "largest thrust",
}  # fmt: skip
HELD = 1e-6  # relative difference up to which a file counts as holding a quantity
TOLERANCE_OF_NOTHING = {"centre": 1e-9, "lag": 1e-3}  # m, s: differences up to this count as 0


@dataclass(frozen=True)
class Omission:
    """Something that a file does not hold.

    Attributes:
        name: of the effect or constant. words: name for people.
        cost: distance between predictions with and without it after half a second, by quantity; on a recording, the
            increase of the error. None if it does not act on the motion from rotor thrusts.
        errors: on a recording, the prediction errors with and without it.
        why: reason, as a clause.
    """

    name: str
    words: str
    cost: dict[str, float] | None
    why: str
    errors: dict[str, dict[str, float]] | None = None

    def __str__(self) -> str:
        if self.errors is not None:
            return (
                f"{self.words}: {self.why}; error after {HORIZON:g} s {said(self.errors['with'])} with it, "
                f"{said(self.errors['without'])} without"
            )
        cost = f"; without it {HORIZON:g} s of flight are off by {said(self.cost)}" if self.cost is not None else ""
        return f"{self.words}: {self.why}{cost}"

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        found: dict[str, Any] = {"name": self.name, "words": self.words, "why": self.why, "horizon_s": HORIZON}
        found["cost"] = finite(self.cost)  # None where a model left the range of numbers
        if self.errors is not None:
            found["errors"] = finite(self.errors)
        return found


@dataclass(frozen=True)
class Source:
    """A file that was read: its vehicle, format and text."""

    vehicle: Vehicle
    format: str
    imported: SimulatorFile | None
    text: str


@dataclass(frozen=True)
class Conversion:
    """The result of `convert`.

    Attributes:
        text: of the file. format: its name.
        vehicle: the vehicle to convert. held: the vehicle that the file describes.
        omissions: effects and constants that the file does not hold.
        contradictions, remarks: of the source.
    """

    text: str
    format: str
    vehicle: Vehicle
    held: Vehicle
    omissions: tuple[Omission, ...]
    contradictions: tuple[Contradiction, ...] = ()
    remarks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "format": self.format, "vehicle": self.vehicle.name, "omissions": [one.to_json() for one in self.omissions],
            "contradictions": [c.to_json() for c in self.contradictions], "remarks": list(self.remarks),
        }  # fmt: skip


def load_source(
    name_or_path: str | Path,
    *,
    form: str | None = None,
    name: str | None = None,
    base: Vehicle | None = None,
    strict: bool = True,
) -> Source:
    """Load a preset, a vehicle file or a simulator's file as a vehicle.

    Args:
        form: format of the file; None: recognised by content.
        name: of the drone, if a file has several.
        base: vehicle that gives the values missing in a simulator's file.
        strict: contradictory fields are an error.

    Raises: UsageError: no such file, format or drone. FileFormatError: unusable file; the message names the field.
    """
    path = str(name_or_path)
    if form in (None, OWN) and path in preset_names():
        return Source(folding.load(path), OWN, None, "")
    text = read_text(path)
    kind = form or format_of(text, where=path)
    if kind == OWN:
        return Source(folding.load(path), OWN, None, text)
    imported = read(format_named(kind), text, where=path, name=name, strict=strict)
    return Source(to_vehicle(imported.constants, base), kind, imported, text)


def read_text(path: str) -> str:
    """The text of a file. Raises UsageError if there is none, FileFormatError if it is no text."""
    try:
        return Path(path).read_bytes().decode()
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not a text file") from None
    except OSError as error:
        presets = ", ".join(preset_names())
        raise UsageError(f"cannot read {path}: {error.strerror or error} (presets are {presets}).") from None


def convert(
    vehicle: Vehicle,
    to: str,
    *,
    template: str | None = None,
    where: str = "",
    name: str = "",
    suffix: str = "",
    flight: Recording | None = None,
    costs: bool = True,
) -> Conversion:
    """Write a vehicle as a simulator's file.

    Args:
        to: name of the format; `OWN` gives a vehicle file.
        template: text of a file of this format; only the constants in it change.
        where: name of the template, for errors.
        name: of the drone in the file; "": the vehicle's name.
        suffix: of the output file: `.json` makes rotorpy's dict JSON.
        flight: recording on which costs are computed; None: a synthetic flight.
        costs: whether to list omissions and their costs.

    Raises: UsageError for an unknown format or drone; FileFormatError if the vehicle lacks a value that the format
        needs, or the template cannot be used.
    """
    constants, left = from_vehicle(vehicle)
    if to == OWN:
        plain = to_vehicle(constants, without_effects(vehicle))
        kept = {n: v for n, v in vehicle.effects.items() if n in left}
        held = replace(plain, effects={**plain.effects, **kept}, name=name or vehicle.name)
        return Conversion(held.to_toml(), OWN, vehicle, held, ())
    form = format_named(to)
    if form is ROTORPY and template is None and suffix == ".json":
        form = ROTORPY_JSON
    named = "'{}'".format
    if problem := objection(constants, named) or impossible(constants, named):
        raise FileFormatError(f"vehicle {vehicle.name}: {problem}")
    if template is None and (lacking := _lacking(form, constants, name)):
        raise FileFormatError(
            f"vehicle {vehicle.name}: no {lacking}, which {form.words} needs (or a template that has it)"
        )
    text = write(form, constants, template=template, where=where, name=name)
    # contradictions of the template stay in the file and are no error
    written = read(form, text, where=where or f"the {form.name} file", name=name or None, strict=False).constants
    omissions = _omissions(vehicle, constants, left, written, flight) if costs else []
    base = replace(without_effects(vehicle), motor_time_constant=0.0)  # a file without a lag means no lag
    return Conversion(text, to, vehicle, to_vehicle(written, base), tuple(omissions))


# Key of a vehicle file -> its quantity, and the quantities in simulator files that need it.
NEEDED = {
    "rotor_constant": ("thrust_per_speed2", ("thrust_per_speed2",)),
    "arm": ("arm_x", ("arm", "arm_x", "arm_length")),
    "torque_per_thrust": ("torque_per_thrust", ("torque_per_thrust", "torque_per_speed2", "torque_max")),
    "thrust_max": ("thrust_max", ("thrust_max", "speed_max", "thrust_to_weight")),
}


def _lacking(form: Format, constants: Constants, name: str) -> str:
    """A key that a new file of this format needs and the vehicle lacks; "" if there is none."""
    document = form.open(form.skeleton(name or constants.name), "")
    drones = form.names(document)
    used = {f.quantity for f in form.fields(document, drones[0] if drones else "")}
    return next((k for k, (q, uses) in NEEDED.items() if getattr(constants, q) is None and used & {*uses}), "")


def _omissions(
    vehicle: Vehicle, full: Constants, left: list[str], held: Constants, flight: Recording | None
) -> list[Omission]:
    """What a file lacks of a vehicle. Each cost compares the complete vehicle with the vehicle without this one."""
    base = without_effects(vehicle)
    kept = {n: vehicle.effects[n] for n in left}

    def with_left(c: Constants, without: str = "") -> Vehicle:
        made = to_vehicle(c, base)
        return replace(made, effects={**made.effects, **{n: v for n, v in kept.items() if n != without}})

    variants: list[tuple[str, str, str, Vehicle]] = []
    for words, quantities in GROUPS:
        name = EFFECT_OF.get(quantities[0], "arm")
        if same(full, held, quantities) or (name == "arm" and full.arm_x is None):
            continue
        silent = all(getattr(held, q) is None for q in quantities)
        said = ", ".join(f"{held.or_(q, 0.0):.3g}" for q in quantities)
        why = "the file has no field for it" if silent else f"the file says {said}"
        if name == "arm" and silent:
            continue  # the constants of the rotors follow below
        changed: dict[str, Any] = {q: held.or_(q, 0.0) for q in quantities}
        variants.append((name, words, why, with_left(replace(full, **changed))))
    variants += [(n, n.replace("_", " "), "no simulator here has it", with_left(full, n)) for n in left]
    found = []
    for name, words, why, without in variants:
        cost, errors = _cost(with_left(full), without, flight)
        found.append(Omission(name, words, cost, why, errors))
    for quantity, words in OF_ROTORS.items():
        value, other = getattr(full, quantity), getattr(held, quantity)
        if value is not None and (other is None or not math.isclose(value, other, rel_tol=HELD)):
            why = "not in this file" if other is None else f"the file says {other:.4g}"
            found.append(Omission(quantity, words, None, why))
    if vehicle.thrust_curve:
        why = "a simulator is told rotor speeds or thrusts; the law from command and voltage stays in the vehicle file"
        found.append(Omission(THRUST_CURVE.name, "battery and thrust curve", None, why))
    return found


def _cost(
    vehicle: Vehicle, without: Vehicle, flight: Recording | None
) -> tuple[dict[str, float], dict[str, dict[str, float]] | None]:
    if flight is not None:
        errors = errors_after(flight, {"with": vehicle, "without": without})
        return {q: errors["without"][q] - errors["with"][q] for q in errors["with"]}, errors
    reference = reference_flight(vehicle)
    return rms_distance(flown(reference, vehicle), flown(reference, without)), None


def same(first: Constants, second: Constants, quantities: tuple[str, ...]) -> bool:
    """Whether the quantities agree; an unknown quantity counts as 0."""
    pairs = [(first.or_(q, 0.0), second.or_(q, 0.0)) for q in quantities]
    scale = max(max(abs(a), abs(b)) for a, b in pairs)
    floor = TOLERANCE_OF_NOTHING.get(quantities[0].split("_")[0], 0.0)
    # products of inertia are compared with the moments of inertia: products alone may all be near 0
    scale = max(scale, 1e-6 * first.or_("inertia_xx", 0.0)) if quantities[0] == "inertia_xy" else scale
    return all(abs(a - b) <= max(HELD * scale, floor) for a, b in pairs)


def known_formats() -> dict[str, str]:
    """Name and description of every format."""
    return {n: f.words for n, f in FORMATS.items() if n != ROTORPY_JSON.name}
