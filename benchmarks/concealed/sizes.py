"""Effects that can be concealed: all of the catalogue with their ranges from weak to strong, and four outside of it.

Sizes are drawn log-uniformly between the two ends; `u` in [0, 1] says where (weak below 1/3, strong from 2/3).
Meaning and sign of every parameter: docs: firmware_sim_effects.md. All SI. At the strong ends the Lee
controller with the constants of the bare drone still flies.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyem.vehicle import Vehicle

Table = dict[str, Any]
Random = np.random.Generator


@dataclass(frozen=True)
class Concealed:
    """One effect that can be hidden.

    Attributes:
        draw: (u, random, nominal vehicle) -> parameters of [effects.NAME] or [hidden.NAME].
        sizes: parameter -> (weak end, strong end), for the page; the numbers `draw` uses.
        trajectories: styles that show it well.
        platform: "" for either.
        axes, regimes: outside the catalogue only: words; a right answer must contain one of them.
    """

    draw: Callable[[float, Random, Vehicle], Table]
    sizes: dict[str, tuple[float, float]]
    trajectories: tuple[str, ...] = ("excite", "figure8", "fast")
    platform: str = ""
    axes: tuple[str, ...] = ()
    regimes: tuple[str, ...] = ()


TURNING = ("excite", "fast")
QUICK = ("figure8", "fast")
DEGREE = math.radians(1.0)


def between(u: float, ends: tuple[float, float]) -> float:
    """Log-uniform between weak and strong."""
    return ends[0] * (ends[1] / ends[0]) ** u


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _sign(random: Random) -> float:
    return float(random.choice((-1.0, 1.0)))


def _table(**values: Any) -> Table:
    return {k: _rounded(v) if isinstance(v, float) else v for k, v in values.items()}


def _direction(random: Random, *, flat: float = 1.0) -> np.ndarray:
    """A unit vector; `flat` scales its z before it is normalised."""
    v = random.standard_normal(3) * (1.0, 1.0, flat)
    return v / np.linalg.norm(v)


def _plain(parameter: str, ends: tuple[float, float], *, around: float = 0.0, signs: tuple[float, ...] = (1.0,)) -> Any:
    """A drawer of one number: around + sign * size."""

    def draw(u: float, random: Random, vehicle: Vehicle) -> Table:
        return _table(**{parameter: around + float(random.choice(signs)) * between(u, ends)})

    return draw


def _vector(
    ends: tuple[float, float], names: str = "x y z", *, around: float = 0.0, flat: float = 1.0, positive: bool = False
) -> Any:
    """A drawer of a vector of that length in a random direction."""

    def draw(u: float, random: Random, vehicle: Vehicle) -> Table:
        v = between(u, ends) * _direction(random, flat=flat)
        v = np.abs(v) if positive else v
        return _table(**{n: around + float(x) for n, x in zip(names.split(), v)})

    return draw


def _payload(u: float, random: Random, vehicle: Vehicle) -> Table:
    mass = between(u, SIZES["payload"]["mass"]) * vehicle.mass
    x, y = random.uniform(-0.012, 0.012, 2)
    return _table(mass=mass, x=float(x), y=float(y), z=float(random.choice((-0.012, 0.012))))


def _rotor_fault(u: float, random: Random, vehicle: Vehicle) -> Table:
    table = _table(rotor=int(random.integers(1, 5)), scale=1.0 - between(u, SIZES["rotor_fault"]["loss"]))
    if random.random() < 0.5:
        table["onset_time"] = _rounded(float(random.uniform(14.0, 22.0)))  # in the air of either flight
    return table


def _drag(name: str) -> Any:
    def draw(u: float, random: Random, vehicle: Vehicle) -> Table:
        size = between(u, SIZES[name]["x, y"])
        x, y, z = size * random.uniform((0.8, 0.8, 0.4), (1.2, 1.2, 1.2))
        return _table(x=float(x), y=float(y), z=float(z))

    return draw


def _velocity_moment(u: float, random: Random, vehicle: Vehicle) -> Table:
    size = between(u, SIZES["velocity_moment"]["size"])
    roll, pitch = size * random.uniform(0.7, 1.3, 2)
    return _table(roll_per_vy=float(roll), pitch_per_vx=-float(pitch))


def _rate_damping(u: float, random: Random, vehicle: Vehicle) -> Table:
    x, y, z = between(u, SIZES["rate_damping"]["size"]) * random.uniform(0.6, 1.4, 3)
    return _table(x=float(x), y=float(y), z=float(z))


def _motor_lag(u: float, random: Random, vehicle: Vehicle) -> Table:
    change = between(u, SIZES["motor_lag"]["change"])
    longer = vehicle.motor_time_constant + change
    shorter = vehicle.motor_time_constant - change
    return _table(time_constant=longer if random.random() < 0.6 or shorter < 0.01 else shorter)


def _measurement_delay(u: float, random: Random, vehicle: Vehicle) -> Table:
    # A late pose fix ("pose") is not drawn: the logged state of the onboard filter is then not a delayed state.
    stream = str(random.choice(("state", "gyro")))
    delay = between(u, SIZES["measurement_delay"]["delay"])
    return {"delay": _rounded(delay / 2 if stream == "gyro" else delay), "streams": [stream]}


def _battery_sag(u: float, random: Random, vehicle: Vehicle) -> Table:
    if random.random() < 0.5:
        return _table(gain_per_volt=between(u, SIZES["battery_sag"]["gain_per_volt"]))
    return _table(gain_per_second=-between(u, SIZES["battery_sag"]["gain_per_second"]))


def _ground_effect(u: float, random: Random, vehicle: Vehicle) -> Table:
    return _table(strength=between(u, SIZES["ground_effect"]["strength"]), height=float(random.uniform(0.08, 0.25)))


def _gusts(u: float, random: Random, vehicle: Vehicle) -> Table:
    sd = between(u, SIZES["gusts"]["standard_deviation"])
    return _table(standard_deviation=sd, correlation_time=float(random.uniform(0.4, 2.0)))


def _misalignment(name: str) -> Any:
    def draw(u: float, random: Random, vehicle: Vehicle) -> Table:
        v = between(u, SIZES[name]["angle"]) * _direction(random, flat=0.7)
        return _table(roll=float(v[0]), pitch=float(v[1]), yaw=float(v[2]))

    return draw


def _velocity_scale(u: float, random: Random, vehicle: Vehicle) -> Table:
    size = between(u, SIZES["velocity_scale"]["change"]) * _sign(random)
    x, y, z = 1.0 + size * random.uniform((0.8, 0.8, 0.0), (1.2, 1.2, 1.0))
    return _table(x=float(x), y=float(y), z=float(z))


def _inertia(u: float, random: Random, vehicle: Vehicle) -> Table:
    changes = between(u, SIZES["inertia"]["change"]) * random.uniform(0.5, 1.5, 3)
    xx, yy, zz = np.array(vehicle.inertia) * (1.0 + changes)
    return _table(xx=float(xx), yy=float(yy), zz=float(min(zz, 0.98 * (xx + yy))))


def _inertia_products(u: float, random: Random, vehicle: Vehicle) -> Table:
    size = between(u, SIZES["inertia_products"]["share of Ixx"]) * vehicle.inertia[0]
    for _ in range(100):  # large vectors along some directions are impossible for a body
        x, y, z = size * _direction(random)
        moments = np.linalg.eigvalsh(np.diag(vehicle.inertia) + np.array([[0, x, y], [x, 0, z], [y, z, 0]]))
        if moments[-1] < 0.999 * moments[:-1].sum():
            return _table(xy=float(x), xz=float(y), yz=float(z))
    raise ValueError(f"no body has products of inertia of {size} kg m^2")


def _suspended_load(u: float, random: Random, vehicle: Vehicle) -> Table:
    mass = between(u, SIZES["suspended_load"]["share of mass"]) * vehicle.mass
    return _table(mass=mass, length=float(random.uniform(0.15, 0.6)))


def _rotor_sensor(u: float, random: Random, vehicle: Vehicle) -> Table:
    change = between(u, SIZES["rotor_sensor"]["change"]) * _sign(random)
    return _table(rotor=int(random.integers(1, 5)), scale=1.0 + change)


def _vibration(u: float, random: Random, vehicle: Vehicle) -> Table:
    return _table(
        rotor=int(random.integers(1, 5)),
        torque=between(u, SIZES["vibration"]["torque"]),
        ratio=float(random.uniform(0.010, 0.045)),  # of some 300 turns a second: 3 to 14 Hz, within the log's band
    )


def _magnetic_yaw(u: float, random: Random, vehicle: Vehicle) -> Table:
    return _table(amplitude=between(u, SIZES["magnetic_yaw"]["amplitude"]), wavelength=float(random.uniform(0.8, 2.5)))


def _sticky_rotor(u: float, random: Random, vehicle: Vehicle) -> Table:
    return _table(rotor=int(random.integers(1, 5)), deadband=between(u, SIZES["sticky_rotor"]["deadband"]))


def _cable_spring(u: float, random: Random, vehicle: Vehicle) -> Table:
    x, y = random.uniform(-0.8, 0.8, 2)
    stiffness = between(u, SIZES["cable_spring"]["stiffness"])
    return _table(stiffness=stiffness, length=0.4, x=float(x), y=float(y), z=0.0)


def _lift(u: float, random: Random, vehicle: Vehicle) -> Table:
    return _table(lift=between(u, SIZES["translational_lift"]["lift"]))


SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "payload": {"mass": (0.02, 0.15)},  # share of the drone's; within 12 mm of the middle on every axis
    "thrust_scale": {"change": (0.02, 0.15)},
    "rotor_fault": {"loss": (0.03, 0.18)},
    "center_of_mass": {"distance": (0.0004, 0.004)},
    "linear_drag": {"x, y": (0.003, 0.03)},
    "quadratic_drag": {"x, y": (0.003, 0.025)},
    "velocity_moment": {"size": (5e-6, 1e-4)},
    "rate_damping": {"size": (3e-6, 5e-5)},
    "motor_lag": {"change": (0.006, 0.03)},
    "input_delay": {"delay": (0.002, 0.015)},
    "measurement_delay": {"delay": (0.004, 0.03)},  # half of it for the gyro
    "battery_sag": {"gain_per_volt": (0.1, 0.8), "gain_per_second": (0.0008, 0.006)},
    "thrust_curve": {"slope_error": (0.05, 0.5)},
    "ground_effect": {"strength": (0.08, 0.6)},
    "wind": {"speed": (0.5, 4.0)},
    "gusts": {"standard_deviation": (0.5, 3.0)},
    "attitude_misalignment": {"angle": (0.5 * DEGREE, 5 * DEGREE)},
    "accelerometer_misalignment": {"angle": (0.5 * DEGREE, 5 * DEGREE)},
    "gyro_bias": {"size": (0.005, 0.06)},
    "velocity_scale": {"change": (0.03, 0.25)},
    "rotor_inertia": {"inertia": (5e-9, 1e-7)},
    "inertia": {"change": (0.08, 0.6)},
    "inertia_products": {"share of Ixx": (0.06, 0.35)},
    "torque_scale": {"change": (0.06, 0.4)},
    "suspended_load": {"share of mass": (0.03, 0.15)},
    "rotor_sensor": {"change": (0.01, 0.1)},
    "vibration": {"torque": (2e-5, 4e-4)},
    "magnetic_yaw": {"amplitude": (1.5 * DEGREE, 15 * DEGREE)},
    "sticky_rotor": {"deadband": (0.01, 0.06)},
    "cable_spring": {"stiffness": (0.01, 0.1)},
    "translational_lift": {"lift": (0.001, 0.006)},  # N s^2/m^2 of each rotor
}


def _of(name: str, draw: Any, *trajectories: str, **more: Any) -> tuple[str, Concealed]:
    known = trajectories or ("excite", "figure8", "fast")
    return name, Concealed(draw, SIZES[name], known, **more)


def _ends(name: str) -> tuple[float, float]:
    (ends,) = SIZES[name].values()
    return ends


BOTH = (-1.0, 1.0)
TILTS = ("roll", "pitch")
PLACES = ("position", "place", "height", "distance", "x", "y", "z")
CATALOGUE: dict[str, Concealed] = dict(
    (
        _of("payload", _payload),
        _of("thrust_scale", _plain("scale", _ends("thrust_scale"), around=1.0, signs=BOTH)),
        _of("rotor_fault", _rotor_fault),
        _of("center_of_mass", _vector(_ends("center_of_mass"), flat=0.5)),
        _of("linear_drag", _drag("linear_drag"), *QUICK),
        _of("quadratic_drag", _drag("quadratic_drag"), *QUICK),
        _of("velocity_moment", _velocity_moment, *QUICK),
        _of("rate_damping", _rate_damping, *TURNING),
        _of("motor_lag", _motor_lag, *TURNING),
        _of("input_delay", _plain("delay", _ends("input_delay")), *TURNING),
        _of("measurement_delay", _measurement_delay),
        # not on cf21bl: with a wrong thrust curve it does not arm, as its rotors must idle within a range of rpm
        _of("battery_sag", _battery_sag, platform="cf2"),
        _of("thrust_curve", _plain("slope_error", _ends("thrust_curve"), signs=BOTH), *TURNING, platform="cf2"),
        _of("ground_effect", _ground_effect, "low"),
        _of("wind", _vector(_ends("wind"), flat=0.2)),
        _of("gusts", _gusts),
        _of("attitude_misalignment", _misalignment("attitude_misalignment")),
        _of("accelerometer_misalignment", _misalignment("accelerometer_misalignment")),
        _of("gyro_bias", _vector(_ends("gyro_bias"))),
        _of("velocity_scale", _velocity_scale, *QUICK),
        _of("rotor_inertia", _plain("inertia", _ends("rotor_inertia")), *TURNING),
        _of("inertia", _inertia, *TURNING),
        _of("inertia_products", _inertia_products, *TURNING),
        _of("torque_scale", _plain("scale", _ends("torque_scale"), around=1.0, signs=BOTH), *TURNING),
        _of("suspended_load", _suspended_load),
        _of("rotor_sensor", _rotor_sensor, platform="cf21bl"),
    )
)
OUTSIDE: dict[str, Concealed] = dict(
    (
        _of("vibration", _vibration, axes=TILTS, regimes=("frequency", "band", "rotor", "thrust")),
        _of("magnetic_yaw", _magnetic_yaw, *QUICK, axes=("yaw",), regimes=PLACES),
        _of("sticky_rotor", _sticky_rotor, axes=(*TILTS, "yaw", "z"), regimes=("rotor", "thrust", "frequency")),
        _of("cable_spring", _cable_spring, *QUICK, axes=("x", "y", "z"), regimes=PLACES),
    )
)  # fmt: skip
# Only in a foreign simulator: thrust that grows with the square of the speed across the rotors.
FOREIGN_OUTSIDE: dict[str, Concealed] = dict(
    (_of("translational_lift", _lift, *QUICK, axes=("z",), regimes=("speed", "velocity", "airspeed", "fast")),)
)
# Pairs that no flight can distinguish from one of the two alone are not drawn.
ALIKE: tuple[frozenset[str], ...] = (
    frozenset({"payload", "thrust_scale", "suspended_load", "center_of_mass", "inertia", "inertia_products"}),
    frozenset({"inertia", "torque_scale", "inertia_products", "rotor_inertia"}),
    frozenset({"wind", "gusts", "accelerometer_misalignment", "attitude_misalignment"}),
    frozenset({"linear_drag", "quadratic_drag", "velocity_scale", "gusts"}),
    frozenset({"motor_lag", "input_delay", "measurement_delay", "rate_damping", "rotor_inertia"}),
    frozenset({"battery_sag", "thrust_curve", "thrust_scale"}),
    frozenset({"rotor_fault", "rotor_sensor", "center_of_mass"}),
    frozenset({"rotor_sensor", "battery_sag"}),  # each needs another drone
    frozenset({"rotor_sensor", "thrust_curve"}),
    # these lower the drone, as the controller does not know them; low flight would end on the floor
    frozenset(
        {"ground_effect", "thrust_scale", "payload", "battery_sag", "thrust_curve", "rotor_fault", "suspended_load"}
    ),
)
