"""The constants of a drone that simulators use, in SI: one type between a vehicle file and all simulator files.

Checks find constants that no drone has: impossible inertias, and numbers that suggest a wrong unit in a file.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.motion import active, body_of, gain, vehicle_values
from crazyem.vehicle import GRAVITY, Vehicle

SHORTEST_LAG = 1e-3  # s: stands for a lag of 0 in files, because simulators divide by the lag; read back as 0


@dataclass(frozen=True)
class Constants:
    """A quadrotor in SI; None: unknown. Body axes x forward, y left, z up, origin in the middle of the rotors.

    Attributes:
        name: of the drone.
        mass: kg.
        inertia_xx, ..., inertia_yz: elements of the matrix about the centre of mass [kg m^2].
        centre_x, centre_y, centre_z: centre of mass from the middle of the rotors [m].
        arm_x, arm_y: rotor offsets [m].
        thrust_per_speed2: of a rotor [N/(rad/s)^2].
        torque_per_thrust: yaw torque of a rotor over its thrust [m].
        thrust_max: of a rotor [N].
        lag: first-order time constant of a rotor [s].
        drag_x, drag_y, drag_z: force against the velocity in body axes [N s/m].
        quadratic_drag_x, ...: force against speed times velocity [N s^2/m^2].
        damping_x, damping_y, damping_z: torque against the body rate [N m s].
    """

    name: str
    mass: float | None = None
    inertia_xx: float | None = None
    inertia_yy: float | None = None
    inertia_zz: float | None = None
    inertia_xy: float | None = None
    inertia_xz: float | None = None
    inertia_yz: float | None = None
    centre_x: float | None = None
    centre_y: float | None = None
    centre_z: float | None = None
    arm_x: float | None = None
    arm_y: float | None = None
    thrust_per_speed2: float | None = None
    torque_per_thrust: float | None = None
    thrust_max: float | None = None
    lag: float | None = None
    drag_x: float | None = None
    drag_y: float | None = None
    drag_z: float | None = None
    quadratic_drag_x: float | None = None
    quadratic_drag_y: float | None = None
    quadratic_drag_z: float | None = None
    damping_x: float | None = None
    damping_y: float | None = None
    damping_z: float | None = None

    def or_(self, quantity: str, default: float) -> float:
        """The value of a quantity, or a default if the value is unknown."""
        value = getattr(self, quantity)
        return default if value is None else float(value)


NUMBERS = tuple(f.name for f in fields(Constants) if f.name != "name")


def hover_speed(c: Constants) -> float:
    """Rotor speed at which four rotors carry the weight [rad/s]; NaN where unknown."""
    if c.mass is None or not c.thrust_per_speed2:
        return math.nan
    return math.sqrt(c.mass * GRAVITY / (4.0 * c.thrust_per_speed2))


# Quantities in files that follow from the constants: quantity -> quantities that give it, formula.
DERIVED: dict[str, tuple[tuple[str, ...], Callable[..., float]]] = {
    "torque_per_speed2": (("thrust_per_speed2", "torque_per_thrust"), lambda k, r: k * r),
    "speed_max": (("thrust_max", "thrust_per_speed2"), lambda t, k: math.sqrt(t / k)),
    "thrust_to_weight": (("thrust_max", "mass"), lambda t, m: 4.0 * t / (m * GRAVITY)),
    "arm_length": (("arm_x", "arm_y"), math.hypot),
    "arm": (("arm_x", "arm_y"), lambda x, y: math.sqrt(x * y)),
    "weight": (("mass",), lambda m: m * GRAVITY),
    "hover_thrust": (("mass",), lambda m: m * GRAVITY / 4.0),
    "total_thrust_max": (("thrust_max",), lambda t: 4.0 * t),
    "torque_max": (("thrust_max", "torque_per_thrust"), lambda t, r: t * r),
    "hover_share": (("mass", "thrust_max"), lambda m, t: m * GRAVITY / (4.0 * t)),
    "hover_speed_share": (("mass", "thrust_max"), lambda m, t: math.sqrt(m * GRAVITY / (4.0 * t))),
    "drag": (("drag_x", "drag_y", "drag_z"), lambda x, y, z: (x + y + z) / 3.0),
    "damping": (("damping_x", "damping_y", "damping_z"), lambda x, y, z: (x + y + z) / 3.0),
    "rotor_drag_xy": (("drag_x", "drag_y", "hover_speed"), lambda x, y, w: (x + y) / (8.0 * w)),
    "rotor_drag_z": (("drag_z", "hover_speed"), lambda z, w: z / (4.0 * w)),
}

# The inverse of DERIVED: quantity, quantities that give it, formula. The first formula with known inputs applies.
SOLVED: tuple[tuple[str, tuple[str, ...], Callable[..., float]], ...] = (
    ("mass", ("weight",), lambda w: w / GRAVITY),
    ("torque_per_thrust", ("torque_per_speed2", "thrust_per_speed2"), lambda q, k: q / k),
    ("thrust_max", ("total_thrust_max",), lambda t: t / 4.0),
    ("thrust_max", ("speed_max", "thrust_per_speed2"), lambda w, k: k * w * w),
    ("thrust_max", ("thrust_to_weight", "mass"), lambda r, m: r * m * GRAVITY / 4.0),
    ("torque_per_thrust", ("torque_max", "thrust_max"), lambda q, t: q / t),
    ("arm_x", ("arm",), lambda a: a),
    ("arm_y", ("arm",), lambda a: a),
    ("arm_x", ("arm_length",), lambda a: a / math.sqrt(2.0)),
    ("arm_y", ("arm_length",), lambda a: a / math.sqrt(2.0)),
    *((f"drag_{a}", ("drag",), lambda d: d) for a in "xyz"),
    *((f"damping_{a}", ("damping",), lambda d: d) for a in "xyz"),
    ("hover_speed", ("mass", "thrust_per_speed2"), lambda m, k: math.sqrt(m * GRAVITY / (4.0 * k))),
    *((f"drag_{a}", ("rotor_drag_xy", "hover_speed"), lambda d, w: 4.0 * d * w) for a in "xy"),
    ("drag_z", ("rotor_drag_z", "hover_speed"), lambda d, w: 4.0 * d * w),
)


def value_of(c: Constants, quantity: str) -> float:
    """The value of a quantity of `Constants` or `DERIVED`; NaN if unknown."""
    if quantity == "hover_speed":
        return hover_speed(c)
    if quantity not in DERIVED:
        return c.or_(quantity, math.nan)
    needs, function = DERIVED[quantity]
    values = [value_of(c, n) for n in needs]
    return math.nan if any(map(math.isnan, values)) else function(*values)


def solved(found: Mapping[str, float]) -> dict[str, float]:
    """The quantities of a file, and all quantities that follow from them by `SOLVED`."""
    values = dict(found)
    for target, needs, function in SOLVED:
        if target not in values and all(n in values for n in needs):
            try:
                values[target] = function(*(values[n] for n in needs))
            except (ZeroDivisionError, ValueError, OverflowError):
                continue
    return values


def from_vehicle(vehicle: Vehicle) -> tuple[Constants, list[str]]:
    """The constants of a vehicle, and the names of its effects that no constant can express.

    Exact for inertia, centre of mass and payload (one body), scales of thrust and torque, lag, drag and damping.
    """
    effects = active(vehicle.effects, vehicle)
    values, own = {effect.name: given for effect, given in effects}, vehicle_values(vehicle)
    body = body_of(vehicle, {effect.name: given for effect, given in effects if effect.body})
    thrust, torque = gain(effects, "thrust"), gain(effects, "torque")
    has_rotors = bool(vehicle.thrust_curve) or vehicle.rotor_constant is not None
    constant, limit = vehicle.rotor_constant, vehicle.thrust_max
    matrix = body.inertia
    found: dict[str, float | None] = {
        "mass": body.mass,
        **{f"inertia_{a}{b}": matrix["xyz".index(a), "xyz".index(b)] for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")},
        **{f"centre_{a}": body.centre["xyz".index(a)] for a in "xyz"},
        "arm_x": vehicle.arm[0] * torque if has_rotors else None,
        "arm_y": vehicle.arm[1] * torque if has_rotors else None,
        "thrust_per_speed2": None if constant is None else constant * thrust,
        "torque_per_thrust": vehicle.torque_per_thrust * torque if has_rotors else None,
        "thrust_max": limit * thrust if math.isfinite(limit) else None,
    }
    for effect in CATALOGUE.values():
        if effect.body is None:
            complete = values.get(effect.name) or effect.complete({}, own.get(effect.name, {}))
            found |= {constant: complete[name] for name, constant in effect.constants.items()}
    left = [effect.name for effect, _ in effects if not (effect.body or effect.gain or effect.constants)]
    return Constants(vehicle.name, **{n: None if v is None else float(v) for n, v in found.items()}), left


def without_effects(vehicle: Vehicle) -> Vehicle:
    """The vehicle without its effects; effects that scale the thrust go into the thrust curve."""
    thrust = gain(active(vehicle.effects, vehicle), "thrust")
    return replace(vehicle, effects={}, thrust_curve=tuple(c * thrust for c in vehicle.thrust_curve))


def to_vehicle(c: Constants, base: Vehicle | None = None) -> Vehicle:
    """The vehicle with these constants; all else comes from `base`, such as the law from command to thrust.

    Raises: ValueError: no mass or no inertia.
    """
    matrix = inertia_of(c)
    if c.mass is None or matrix is None:
        raise ValueError("a vehicle needs a mass and an inertia")
    plain = Vehicle(c.name, c.mass, (0.0, 0.0, 0.0)) if base is None else base
    effects: dict[str, dict[str, float]] = {}
    for effect in CATALOGUE.values():
        values = {name: c.or_(constant, 0.0) for name, constant in effect.constants.items()}
        if effect.own is None and any(values.values()):
            effects[effect.name] = values
    return replace(
        plain,
        name=c.name,
        mass=c.mass,
        inertia=(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[2, 2])),
        inertia_products=(float(matrix[0, 1]), float(matrix[0, 2]), float(matrix[1, 2])),
        arm=(c.or_("arm_x", plain.arm[0]), c.or_("arm_y", plain.arm[1])),
        rotor_constant=plain.rotor_constant if c.thrust_per_speed2 is None else c.thrust_per_speed2,
        torque_per_thrust=c.or_("torque_per_thrust", plain.torque_per_thrust),
        motor_time_constant=c.or_("lag", plain.motor_time_constant),
        thrust_max=c.or_("thrust_max", plain.thrust_max),
        effects=effects,
        mass_sd=None,
        inertia_sd=None,
        motor_time_constant_sd=None,
    )


def inertia_of(c: Constants) -> np.ndarray | None:
    """Inertia matrix (3, 3) [kg m^2]; None if a moment is unknown. Unknown products are 0."""
    if c.inertia_xx is None or c.inertia_yy is None or c.inertia_zz is None:
        return None
    xy, xz, yz = (c.or_(f"inertia_{a}", 0.0) for a in ("xy", "xz", "yz"))
    return np.array([[c.inertia_xx, xy, xz], [xy, c.inertia_yy, yz], [xz, yz, c.inertia_zz]])


# Speed at hover of a point at the arm's length from a rotor's axis [m/s]: 56 for a 0.5 kg hummingbird, 65 for a
# Crazyflie, 130 for a 2 kg X500. Rotor speeds in RPM instead of rad/s differ by a factor of 9.5 and leave this range.
TIP_SPEED = (15.0, 250.0)
RPM = 60.0 / (2.0 * math.pi)  # rev/min of one rad/s
# Inertia about x over mass times squared arm: 0.5 for a Crazyflie; 2 for four masses at the rotors.
SPREAD_OF_MASS = (0.02, 20.0)


def objection(c: Constants, label: Callable[[str], str]) -> str:
    """Why no drone can have these constants: one clause that names the field; "" if a drone can.

    Args:
        label: quantity -> its name in the file.
    """
    if c.mass is None:
        return f"{label('mass')} is missing"
    if not (0.0 < c.mass < math.inf):
        return f"{label('mass')} must be a positive number, got {c.mass:g}"
    for name in ("inertia_xx", "inertia_yy", "inertia_zz"):
        value = getattr(c, name)
        if value is None:
            return f"{label(name)} is missing"
        if not (0.0 < value < math.inf):
            return f"{label(name)} must be a positive number, got {value:g}"
    return _inertia(c, label) or _rotors(c, label)


def _inertia(c: Constants, label: Callable[[str], str]) -> str:
    matrix = inertia_of(c)
    assert matrix is not None
    assert c.mass is not None
    values = np.linalg.eigvalsh(matrix)
    if values[0] <= 0.0:
        return f"{label('inertia_xy')} and its neighbours: the inertia is not a positive definite matrix"
    if c.arm_x and c.arm_y:
        ratio = float(matrix[0, 0]) / (c.mass * c.arm_y**2)
        if not SPREAD_OF_MASS[0] < ratio < SPREAD_OF_MASS[1]:
            return (
                f"{label('inertia_xx')} does not fit {label('mass')} and {label('arm_x')}: it is {ratio:.2g} times "
                "mass times squared arm, and 0.1 to 2 is usual; are the units kg, m and kg m^2?"
            )
    return ""


def impossible(c: Constants, label: Callable[[str], str]) -> str:
    """A clause if the moments of inertia violate the triangle inequality, so that no body has them; else ""."""
    matrix = inertia_of(c)
    if matrix is None:
        return ""
    values = np.linalg.eigvalsh(matrix)
    if values[2] > values[:2].sum() * (1.0 + 1e-6):
        worst = max(("inertia_xx", "inertia_yy", "inertia_zz"), key=lambda n: getattr(c, n))
        return (
            f"{label(worst)} is larger than the other two moments together "
            f"({values[2]:.3g} > {values[0]:.3g} + {values[1]:.3g} kg m^2), which no body has"
        )
    return ""


def _rotors(c: Constants, label: Callable[[str], str]) -> str:
    for name in ("arm_x", "arm_y", "thrust_per_speed2", "torque_per_thrust", "thrust_max"):
        value = getattr(c, name)
        if value is not None and not (0.0 < value < math.inf):
            return f"{label(name)} must be a positive number, got {value:g}"
    if c.lag is not None and not (0.0 <= c.lag <= 1.0):
        return f"{label('lag')} must lie between 0 and 1 s, got {c.lag:g}"
    if c.thrust_per_speed2 is None or not c.arm_x or not c.arm_y:
        return ""
    tip = hover_speed(c) * math.sqrt(c.arm_x * c.arm_y)
    if TIP_SPEED[0] < tip < TIP_SPEED[1]:
        return ""
    hint = ""
    if TIP_SPEED[0] < tip / RPM < TIP_SPEED[1]:
        hint = "; as N per RPM^2 it would fit"
    elif TIP_SPEED[0] < tip * RPM < TIP_SPEED[1]:
        hint = "; as N per (rad/s)^2 it would fit"
    return (
        f"{label('thrust_per_speed2')} cannot be in the unit of this file: the drone would hover at "
        f"{hover_speed(c):.3g} rad/s, {tip:.2g} m/s at the length of an arm{hint}"
    )
