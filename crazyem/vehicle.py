"""A drone's nominal constants: a TOML file <-> one frozen dataclass, SI units throughout.

File format (all SI; `presets/*.toml` are examples):

    name = "cf2"
    mass = 0.029                      # kg
    inertia = [1.66e-5, 1.67e-5, 2.93e-5]  # kg m^2: Ixx, Iyy, Izz[, Ixy, Ixz, Iyz]
    arm = 0.0325                      # m, rotor offset along body x and y (one number, or [x, y])
    thrust_curve = [c0, c1, c2, c3]   # N per rotor, polynomial in motor volts, constant first; or
    rotor_constant = 3.7e-8           # N/(rad/s)^2, thrust of one rotor over its speed squared
    torque_per_thrust = 0.00699       # m, yaw torque of a rotor over its thrust
    motor_time_constant = 0.05        # s, first-order lag of rotor thrust
    thrust_max = 0.12                 # N per rotor
    battery_compensated = true        # the firmware compensates the battery voltage
    mass_sd = 0.5                     # optional: uncertainty of the value, standard deviation over the value
    inertia_sd = [0.5, 0.5, 0.7]      # optional: of Ixx, Iyy, Izz (one number for all three, or three)
    motor_time_constant_sd = 0.7      # optional
    [effects.NAME]                    # fitted effects, parameter = value
    [days]                            # optional: day-to-day variation of the drone, from healthy flights
    flights = 5                       # number of these flights
    thrust_sd = 0.01                  # of the thrust, relative
    trim_sd = [2e-4, 2e-4, 1e-4]      # of the trim (effects.trim), m
    [posterior]                       # optional, in a fitted file: joint posterior of these parameters
    parameters = ["inertia.xx", ...]  # effect.parameter
    mean = [...]
    covariance = [[...], ...]
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

from crazyem.errors import FileFormatError, UsageError
from crazyem.toml_file import is_number, parse_toml, read_text, toml_text

GRAVITY = 9.81  # m/s^2, as the firmware has it
LARGEST_SPREAD = 3.0  # largest standard deviation of a parameter's logarithm; a wider prior gives no information


@dataclass(frozen=True)
class Posterior:
    """Joint posterior of the fitted parameters of effects.

    Attributes:
        parameters: (k,) "effect.parameter".
        mean: (k,) of each parameter, in its unit.
        covariance: (k, k).
    """

    parameters: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Days:
    """Day-to-day variation of a drone, as standard deviations.

    Attributes:
        flights: number of healthy flights from which the variation is computed.
        thrust_sd: of the thrust, relative.
        trim_sd: of torque over thrust about x, y, z [m].
    """

    flights: int
    thrust_sd: float
    trim_sd: tuple[float, float, float]


@dataclass(frozen=True)
class Vehicle:
    """Nominal constants of one drone (SI). A vehicle without rotor data takes thrust and torque as its inputs.

    Attributes:
        name: of the drone.
        mass: kg.
        inertia: Ixx, Iyy, Izz [kg m^2] about the body axes (x forward, y left, z up).
        inertia_products: Ixy, Ixz, Iyz [kg m^2], elements of the inertia matrix.
        arm: rotor offset along body x and y [m].
        thrust_curve: polynomial of one rotor's thrust [N] in motor volts, constant first; empty if unknown.
        rotor_constant: thrust over squared rotor speed [N/(rad/s)^2], or None.
        torque_per_thrust: yaw torque of a rotor over its thrust [m].
        motor_time_constant: first-order lag of rotor thrust [s].
        thrust_max: of one rotor [N], the full scale of the firmware's commands.
        battery_compensated: whether the firmware scales commands by battery voltage.
        effects: fitted effects, name -> parameter -> value.
        mass_sd, inertia_sd, motor_time_constant_sd: standard deviation of the value over the value, the estimator's
            prior; None if the file has none (estimation/model.py has the defaults).
        posterior: joint posterior of the effects of a fitted vehicle, or None.
        days: day-to-day variation of the drone; None: unknown.
    """

    name: str
    mass: float
    inertia: tuple[float, float, float]
    inertia_products: tuple[float, float, float] = (0.0, 0.0, 0.0)
    arm: tuple[float, float] = (0.0, 0.0)
    thrust_curve: tuple[float, ...] = ()
    rotor_constant: float | None = None
    torque_per_thrust: float = 0.0
    motor_time_constant: float = 0.0
    thrust_max: float = math.inf
    battery_compensated: bool = True
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    mass_sd: float | None = None
    inertia_sd: tuple[float, float, float] | None = None
    motor_time_constant_sd: float | None = None
    posterior: Posterior | None = None
    days: Days | None = None

    def to_toml(self) -> str:
        """The vehicle as the text of a vehicle file; reading it back gives an equal vehicle."""
        table = {field.name: getattr(self, field.name) for field in fields(self)}
        table["inertia"] = self.inertia + (self.inertia_products if any(self.inertia_products) else ())
        table["thrust_curve"], table["effects"] = self.thrust_curve or None, self.effects or None
        for part in ("days", "posterior"):
            value = getattr(self, part)
            table[part] = None if value is None else asdict(value)
        del table["inertia_products"]
        return toml_text(table)


def preset_names() -> list[str]:
    """Names of the shipped vehicles."""
    folder = resources.files("crazyem") / "presets"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Read a shipped preset by name, or a vehicle file by path (anything that ends in .toml or names a file).

    Raises:
        UsageError: no preset and no file of that name, or the file cannot be read.
        FileFormatError: the file is not a vehicle file; the message names the key.
    """
    text = str(name_or_path)
    if text in preset_names():
        source = (resources.files("crazyem") / "presets" / f"{text}.toml").read_text()
        return parse_vehicle(source, where=f"preset {text}")
    path = Path(text)
    if not path.is_file():
        raise UsageError(f"unknown vehicle '{text}': no such file, and the presets are {', '.join(preset_names())}")
    return parse_vehicle(read_text(path, what="vehicle file"), where=str(path))


def parse_vehicle(source: str, *, where: str = "vehicle") -> Vehicle:
    """Vehicle from the text of a vehicle file; `where` names the text in errors (FileFormatError)."""
    data = parse_toml(source, where=where)
    known = {
        "name", "mass", "inertia", "arm", "thrust_curve", "rotor_constant", "torque_per_thrust",
        "motor_time_constant", "thrust_max", "battery_compensated", "effects", "mass_sd", "inertia_sd",
        "motor_time_constant_sd", "posterior", "days",
    }  # fmt: skip
    for key in data:
        if key not in known:
            raise FileFormatError(f"{where}: unknown key '{key}' (known: {', '.join(sorted(known))})")
    for key in ("name", "mass", "inertia"):
        if key not in data:
            raise FileFormatError(f"{where}: key '{key}' is missing")
    if not isinstance(data["name"], str):
        raise FileFormatError(f"{where}: key 'name' must be a text")
    inertia = _numbers(data, "inertia", where, lengths=(3, 6))
    moments, products = (inertia[0], inertia[1], inertia[2]), (inertia + (0.0,) * 3)[3:6]
    _check_inertia(moments, products, where)
    arm = _numbers(data, "arm", where, lengths=(1, 2)) if "arm" in data else (0.0,)
    curve = _numbers(data, "thrust_curve", where, lengths=range(2, 10)) if "thrust_curve" in data else ()
    has_rotors = "thrust_curve" in data or "rotor_constant" in data
    if has_rotors:
        for key in ("arm", "torque_per_thrust"):
            if key not in data:
                raise FileFormatError(f"{where}: key '{key}' is missing (the vehicle has rotors)")
    if not isinstance(data.get("battery_compensated", True), bool):
        raise FileFormatError(f"{where}: key 'battery_compensated' must be true or false")
    effects = data.get("effects", {})
    if not isinstance(effects, dict) or not all(isinstance(v, dict) for v in effects.values()):
        raise FileFormatError(f"{where}: key 'effects' must hold tables [effects.NAME]")
    return Vehicle(
        name=data["name"],
        mass=_positive(data, "mass", where),
        inertia=moments,
        inertia_products=(products[0], products[1], products[2]),
        arm=(arm[0], arm[-1]),
        thrust_curve=curve,
        rotor_constant=_positive(data, "rotor_constant", where) if "rotor_constant" in data else None,
        torque_per_thrust=_positive(data, "torque_per_thrust", where) if has_rotors else 0.0,
        motor_time_constant=_number(data, "motor_time_constant", where, 0.0, low=0.0, high=1.0),
        thrust_max=_number(data, "thrust_max", where, math.inf, low=1e-9),
        battery_compensated=data.get("battery_compensated", True),
        effects=effects,
        mass_sd=_spread(data, "mass_sd", where, 1),
        inertia_sd=_spread(data, "inertia_sd", where, 3),
        motor_time_constant_sd=_spread(data, "motor_time_constant_sd", where, 1),
        posterior=_posterior(data["posterior"], where) if "posterior" in data else None,
        days=_days(data["days"], where) if "days" in data else None,
    )


def _days(data: Any, where: str) -> Days:
    if not isinstance(data, dict) or set(data) != {"flights", "thrust_sd", "trim_sd"}:
        raise FileFormatError(f"{where}: [days] needs the keys flights, thrust_sd and trim_sd")
    if not isinstance(data["flights"], int) or isinstance(data["flights"], bool) or data["flights"] < 2:
        raise FileFormatError(f"{where}: key 'days.flights' must be a whole number, 2 or more")
    thrust, trim = _numbers(data, "thrust_sd", where, lengths=(1,)), _numbers(data, "trim_sd", where, lengths=(3,))
    if min(*thrust, *trim) <= 0.0:
        raise FileFormatError(f"{where}: keys 'days.thrust_sd' and 'days.trim_sd' must be larger than 0")
    return Days(data["flights"], thrust[0], (trim[0], trim[1], trim[2]))


def _posterior(data: Any, where: str) -> Posterior:
    import numpy as np

    names = data.get("parameters") if isinstance(data, dict) else None
    if not isinstance(names, list) or not all(isinstance(n, str) and n.count(".") == 1 for n in names):
        raise FileFormatError(f"{where}: key 'posterior.parameters' must list texts like 'inertia.xx'")
    mean, rows = data.get("mean"), data.get("covariance")
    try:
        values, matrix = np.array(mean, float), np.array(rows, float)
    except (TypeError, ValueError):
        raise FileFormatError(f"{where}: keys 'posterior.mean' and 'covariance' must hold numbers") from None
    if values.shape != (len(names),) or matrix.shape != (len(names), len(names)):
        raise FileFormatError(f"{where}: [posterior] needs {len(names)} means, and as many rows and columns")
    sound = bool(np.isfinite(values).all() and np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=1e-6))
    scale = np.sqrt(np.abs(np.diag(matrix))) if sound else values
    if not sound or np.linalg.eigvalsh(matrix / np.maximum(np.outer(scale, scale), 1e-300))[0] < -1e-6:
        raise FileFormatError(f"{where}: key 'posterior.covariance' is no covariance matrix")
    return Posterior(tuple(names), tuple(values.tolist()), tuple(tuple(row) for row in matrix.tolist()))


def _spread(data: Mapping[str, Any], key: str, where: str, count: int) -> Any:
    """One number, or `count` numbers (one in the file stands for all), each in (0, 3]; None if the key is missing."""
    if key not in data:
        return None
    values = _numbers(data, key, where, lengths=sorted({1, count}))
    if not all(0.0 < v <= LARGEST_SPREAD for v in values):
        raise FileFormatError(f"{where}: key '{key}' must lie in (0, {LARGEST_SPREAD:g}], got {data[key]!r}")
    return values[0] if count == 1 else (*values, *values, *values)[:count]


def _check_inertia(moments: tuple[float, ...], products: tuple[float, ...], where: str) -> None:
    import numpy as np

    xx, yy, zz = moments
    xy, xz, yz = products
    if min(moments) <= 0:
        raise FileFormatError(f"{where}: key 'inertia' must be positive, got {list(moments)}")
    if max(moments) > sum(moments) / 2 * (1 + 1e-9):
        raise FileFormatError(f"{where}: key 'inertia' breaks the triangle inequality: {list(moments)}")
    if np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] <= 0:
        raise FileFormatError(f"{where}: key 'inertia' is not a positive definite matrix")


def _number(
    data: Mapping[str, Any], key: str, where: str, default: float | None = None, *, low: float, high: float = math.inf
) -> float:
    value = data.get(key, default)
    if not is_number(value) or not low <= value <= high:
        raise FileFormatError(f"{where}: key '{key}' must be a number in [{low:g}, {high:g}], got {value!r}")
    return float(value)


def _positive(data: Mapping[str, Any], key: str, where: str) -> float:
    value = data.get(key)
    if not is_number(value) or not 0 < value < math.inf:
        raise FileFormatError(f"{where}: key '{key}' must be a positive number, got {value!r}")
    return float(value)


def _numbers(data: Mapping[str, Any], key: str, where: str, *, lengths: Any) -> tuple[float, ...]:
    value = data[key]
    values = value if isinstance(value, list) else [value]
    if len(values) not in lengths or not all(is_number(v) and math.isfinite(v) for v in values):
        wanted = " or ".join(str(n) for n in lengths)
        raise FileFormatError(f"{where}: key '{key}' must hold {wanted} finite numbers, got {value!r}")
    return tuple(float(v) for v in values)
