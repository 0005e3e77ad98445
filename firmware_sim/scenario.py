"""The scenario: true properties of the simulated drone, from a TOML file. The firmware's tables never show them.

Every key is listed in docs: firmware_sim.md with its default; a wrong key raises ScenarioError naming file and key.
"""

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from firmware_sim.errors import ScenarioError, checked_number
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.body import Body, loaded_body, replaced
from firmware_sim.plant.effects.catalogue import Values, parse_effects
from firmware_sim.plant.effects.constants import fill_effects, rotation
from firmware_sim.plant.payload_events import PayloadChanges, PayloadEvent, PointMass, carried, parse_events
from firmware_sim.plant.platforms import PLATFORMS, SQRT_HALF
from firmware_sim.plant.rigid_body import GRAVITY
from firmware_sim.plant.rotors import open_circuit
from firmware_sim.vehicle_file import read_toml, vehicle_tables


def key(default: Any, low: float, high: float, sizes: tuple[int, ...] = (0,)) -> Any:
    """A field of a section: default (None: the platform's), range of each number, allowed lengths (0: one number)."""
    return field(default=default, metadata={"low": low, "high": high, "sizes": sizes})


@dataclass(frozen=True)
class Vehicle:
    """The body and its rotors. kg, kg m^2 about the centre of mass in body axes, m, N, s."""

    mass: float = key(None, 1e-3, 5.0)
    inertia: tuple[float, ...] = key(None, -1.0, 1.0, (3, 6))  # Ixx, Iyy, Izz [, Ixy, Ixz, Iyz]
    arm: float | tuple[float, ...] = key(None, 5e-3, 1.0, (0, 2))  # rotor offset along body x and y (or both)
    thrust_curve: tuple[float, ...] = key(None, -100.0, 100.0, (1, 2, 3, 4, 5, 6))
    torque_per_thrust: float = key(None, 0.0, 1.0)
    thrust_max: float = key(None, 1e-3, 100.0)  # per rotor
    motor_time_constant: float = key(0.05, 0.0, 1.0)
    rotor_constant: float = key(None, 1e-12, 1.0)  # N/(rad/s)^2


@dataclass(frozen=True)
class Noise:
    """Process noise of the stochastic differential equation, per root second."""

    thrust: float = key(1e-3, 0.0, 1.0)  # N sqrt(s)
    torque: float | tuple[float, ...] = key(5e-6, 0.0, 1.0, (0, 3))  # N m sqrt(s)


@dataclass(frozen=True)
class Battery:
    """One cell. A h, ohm, W/N^1.5 per rotor, W, V."""

    capacity: float = key(None, 1e-3, 100.0)
    charge: float = key(1.0, 0.0, 1.0)  # fraction at boot
    resistance: float = key(0.12, 0.0, 10.0)
    power_coefficient: float = key(None, 0.0, 1e4)
    electronics_power: float = key(0.4, 0.0, 100.0)
    noise: float = key(0.003, 0.0, 1.0)  # sd of a measurement


@dataclass(frozen=True)
class Sensors:
    """Inertial sensors; densities per root hertz, counts of 16 bits (BMI088), bias sd per axis after calibration.

    Gyro noise: 0.1 deg/s rms at 1 kHz, as in the shared recordings of the real firmware.
    """

    gyro_noise: float = key(math.radians(0.1) / math.sqrt(500.0), 0.0, 1.0)  # rad/s/sqrt(Hz)
    gyro_resolution: float = key(math.radians(2000.0 / 32768), 0.0, 1.0)  # rad/s, one count; 0: none
    gyro_bias: float = key(math.radians(0.02), 0.0, 1.0)  # rad/s
    gyro_bias_walk: float = key(math.radians(0.002), 0.0, 1.0)  # rad/s/sqrt(s)
    accelerometer_noise: float = key(190e-6 * GRAVITY, 0.0, 10.0)  # m/s^2/sqrt(Hz)
    accelerometer_resolution: float = key(24.0 / 32768 * GRAVITY, 0.0, 10.0)  # m/s^2, one count; 0: none
    # Share of unreadable reports of rotor speed (value 65535): 191 of 263,764 in Busetto's flights.
    rotor_speed_invalid: float = key(7e-4, 0.0, 1.0)


@dataclass(frozen=True)
class Integration:
    """How the plant is integrated; the firmware's own clock always ticks in milliseconds."""

    step: float = key(1e-3, 1e-3, 4e-3)  # s, rounded to whole milliseconds


@dataclass(frozen=True)
class Estimator:
    """The onboard estimate: its predictions, and its built-in fixes of position (and attitude).

    Slip and rate of fixes reproduce two properties of flights of the real firmware: the logged attitude drifts against
    the gyro by 0.2 ms/s, and the estimator finds a noise of 6 mm/s in the logged velocity in figure 8.
    """

    prediction_rate: float = key(100.0, 1.0, 1000.0)  # Hz, PREDICT_RATE of estimator_kalman.c
    prediction_slip: float = key(0.002, 0.0, 1.0)  # share of predictions that are 1 ms late; each delays all later ones
    positioning: str = field(default="pose", metadata={"choices": ("pose", "position", "none")})
    rate: float = key(30.0, 1.0, 1000.0)  # Hz
    position_noise: float = key(0.001, 0.0, 1.0)  # m
    attitude_noise: float = key(0.005, 0.0, 1.0)  # rad


@dataclass(frozen=True)
class Start:
    """Pose of the drone at boot."""

    position: tuple[float, ...] = key((0.0, 0.0, 0.0), -30.0, 30.0, (3,))
    velocity: tuple[float, ...] = key((0.0, 0.0, 0.0), -30.0, 30.0, (3,))
    yaw: float = key(0.0, -math.pi, math.pi)


@dataclass(frozen=True)
class Ground:
    """The flat floor."""

    height: float = key(0.0, -1e6, 30.0)
    friction: float = key(0.6, 0.0, 10.0)


@dataclass(frozen=True)
class Link:
    """The radio: losses of log packets on the way to the host. Requests and their replies are never lost here."""

    loss: float = key(0.0, 0.0, 0.99)  # share of log packets that never arrive
    burst: float = key(1.0, 1.0, 1000.0)  # packets lost in a row, mean


@dataclass(frozen=True)
class Scenario:
    """A whole scenario; by default a cf2 with 2.1+ propellers of nominal mass."""

    platform: str = "cf2"
    vehicle: Vehicle = field(default_factory=Vehicle)
    noise: Noise = field(default_factory=Noise)
    battery: Battery = field(default_factory=Battery)
    sensors: Sensors = field(default_factory=Sensors)
    integration: Integration = field(default_factory=Integration)
    estimator: Estimator = field(default_factory=Estimator)
    start: Start = field(default_factory=Start)
    ground: Ground = field(default_factory=Ground)
    link: Link = field(default_factory=Link)
    parameters: dict[str, float] = field(default_factory=dict)
    effects: dict[str, Values] = field(default_factory=dict)
    hidden: dict[str, Values] = field(default_factory=dict)
    payload: tuple[PayloadEvent, ...] = ()

    def section(self, name: str, table: dict[str, Any], prefix: str) -> Any:
        """A section with the checked values of a table; `prefix` goes before a key's name in messages."""
        section = getattr(self, name)
        known = {f.name: f for f in fields(section)}
        values: dict[str, Any] = {}
        for entry, value in table.items():
            where = f"{prefix}{entry}"
            if entry not in known:
                raise ScenarioError(f"{where} is not a key of a scenario (known: {', '.join(known)})")
            rule = known[entry].metadata
            if "choices" not in rule:
                values[entry] = _numbers(value, where, rule["low"], rule["high"], rule["sizes"])
            elif value in rule["choices"]:
                values[entry] = value
            else:
                raise ScenarioError(f"{where} must be one of {', '.join(rule['choices'])}, not {value!r}")
        return replace(section, **values)

    def body(self, events: int = 0) -> Body:
        """The body after the first `events` payload events: the vehicle's with its effects and payloads."""
        mass = _or(self.vehicle.mass, PLATFORMS[self.platform].mass)
        return loaded_body(mass, self.inertia(), self.effects, carried(self._load(), self.payload[:events]))

    def _load(self) -> list[PointMass]:
        """Payloads carried from the start."""
        p = self.effects.get("payload", {"mass": 0.0})
        return [(p["mass"], (p["x"], p["y"], p["z"]))] if p["mass"] > 0.0 else []

    def inertia(self) -> np.ndarray:
        """Inertia matrix (3, 3) of the bare vehicle, kg m^2, body axes."""
        values = self.vehicle.inertia or PLATFORMS[self.platform].inertia
        xx, yy, zz, xy, xz, yz = (*values, 0.0, 0.0, 0.0)[:6]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def truth(self, events: int = 0) -> np.ndarray:
        """The plant's constants as the compiled code reads them (plant/layout.py), after the first `events` events."""
        c, v, platform = np.zeros(at.TRUTH_SIZE), self.vehicle, PLATFORMS[self.platform]
        body = self.body(events)
        J = body.inertia
        c[at.MASS] = body.mass
        c[at.INERTIA : at.INERTIA + 9] = J.ravel()
        c[at.INERTIA_INV : at.INERTIA_INV + 9] = np.linalg.inv(J).ravel()
        c[at.ARM], c[at.ARM_Y] = np.broadcast_to(_or(v.arm, SQRT_HALF * platform.arm_length), 2)
        curve = _or(v.thrust_curve, platform.curve)
        c[at.CURVE : at.CURVE + len(curve)] = curve
        c[at.TORQUE_PER_THRUST] = _or(v.torque_per_thrust, platform.torque_per_thrust)
        c[at.THRUST_MAX] = _or(v.thrust_max, platform.rotor_thrust_limit)
        c[at.MOTOR_TAU] = _or(self.effects.get("motor_lag", {}).get("time_constant"), v.motor_time_constant)
        c[at.ROTOR_CONSTANT] = _or(v.rotor_constant, platform.rotor_constant)
        c[at.NOISE_THRUST] = self.noise.thrust
        c[at.NOISE_TORQUE : at.NOISE_TORQUE + 3] = self.noise.torque
        c[at.CAPACITY] = 3600.0 * _or(self.battery.capacity, platform.capacity)
        c[at.RESISTANCE] = self.battery.resistance
        c[at.POWER_COEFFICIENT] = _or(self.battery.power_coefficient, platform.power_coefficient)
        c[at.ELECTRONICS_POWER] = self.battery.electronics_power
        c[at.VBAT_NOISE] = self.battery.noise
        c[at.FLOOR] = self.ground.height
        c[at.FRICTION] = self.ground.friction
        fill_effects(c, self.effects, self.hidden, _or(v.mass, platform.mass), body.center_of_mass)
        if self.payload:  # the centre of mass may move, and the time since take-off is kept with effects only
            c[[at.EFFECT_ROTORS, at.EFFECT_BODY, at.EFFECT_SENSING]] = 1.0
        arm = max(c[at.ARM], c[at.ARM_Y])
        c[at.FEET_REACH] = 1.5 * arm
        c[at.CONTACT_FREQUENCY : at.CONTACT_FREQUENCY + 3] = _contact(
            c[at.STANDING_MASS], arm, J, self.integration.step
        )
        c[at.INTEGRATION_STEP] = max(1.0, round(1000.0 * self.integration.step))
        c[at.GYRO_NOISE] = self.sensors.gyro_noise
        c[at.GYRO_BIAS : at.GYRO_BIAS + 3] = self.sensors.gyro_bias
        c[at.GYRO_WALK] = self.sensors.gyro_bias_walk
        c[at.ACC_NOISE] = self.sensors.accelerometer_noise
        c[at.GYRO_STEP], c[at.ACC_STEP] = self.sensors.gyro_resolution, self.sensors.accelerometer_resolution
        c[at.PREDICT_PERIOD] = max(1, round(1000.0 / self.estimator.prediction_rate))
        c[at.PREDICT_SLIP] = _bound(self.estimator.prediction_slip)
        c[at.RPM_INVALID] = _bound(self.sensors.rotor_speed_invalid)
        c[at.FIX_KIND] = ("none", "position", "pose").index(self.estimator.positioning)
        c[at.FIX_PERIOD] = max(1, round(1000.0 / self.estimator.rate))
        c[at.FIX_POSITION] = self.estimator.position_noise
        c[at.FIX_ATTITUDE] = self.estimator.attitude_noise
        return c

    def payload_changes(self) -> PayloadChanges | None:
        """Payload events in flight; None without any."""
        if not self.payload:
            return None
        return PayloadChanges(self.payload, [self.truth(n + 1) for n in range(len(self.payload))])

    def board(self) -> np.ndarray:
        """The constants compiled into the platform's firmware; they do not depend on the true values."""
        b, platform = np.zeros(at.BOARD_SIZE), PLATFORMS[self.platform]
        b[at.B_ARM] = SQRT_HALF * platform.arm_length
        b[at.B_TORQUE_PER_THRUST] = platform.torque_per_thrust
        b[at.B_THRUST_MIN], b[at.B_THRUST_MAX] = platform.thrust_min, platform.thrust_max
        b[at.B_CURVE : at.B_CURVE + 4] = platform.curve
        b[at.B_REQUIRE_ARMING] = b[at.B_BRUSHLESS] = float(platform.brushless)
        return b

    def start_state(self) -> np.ndarray:
        """The plant's state at boot: rotors still, battery rested."""
        x = np.zeros(at.STATE_SIZE)
        x[at.POS : at.POS + 3], x[at.VEL : at.VEL + 3] = self.start.position, self.start.velocity
        x[at.QUAT], x[at.QUAT + 3] = math.cos(self.start.yaw / 2), math.sin(self.start.yaw / 2)
        x[at.CHARGE] = 3600.0 * _or(self.battery.capacity, PLATFORMS[self.platform].capacity) * self.battery.charge
        x[at.VOLTS] = open_circuit(self.battery.charge)
        standing = self.start.position[2] <= self.ground.height
        x[at.FEET] = 4.0 if standing else 0.0
        if standing:
            x[at.POS + 2] = self.ground.height
            x[at.ACC + 2] = GRAVITY
        yaw, (cx, cy, cz) = self.start.yaw, self.body().center_of_mass
        x[at.POS] += math.cos(yaw) * cx - math.sin(yaw) * cy
        x[at.POS + 1] += math.sin(yaw) * cx + math.cos(yaw) * cy
        x[at.POS + 2] += cz
        x[at.LOAD + 2] = -1.0
        if "accelerometer_misalignment" in self.effects:
            x[at.ACC : at.ACC + 3] = rotation(self.effects["accelerometer_misalignment"]).T @ x[at.ACC : at.ACC + 3]
        return x


def _bound(share: float) -> float:
    """The bound that a standard normal number exceeds with probability `share`."""
    ends = {0.0: math.inf, 1.0: -math.inf}
    return ends[share] if share in ends else NormalDist().inv_cdf(1.0 - share)


def _or(value: Any, default: Any) -> Any:
    return default if value is None else value


def _contact(mass: float, arm: float, J: np.ndarray, step: float) -> tuple[float, float, float]:
    """The floor's stiffness [rad/s], damping ratio and stick [1/s], slow enough for steps of `step` s.

    A foot moves the body's inertia about the opposite edge, so rocking is faster than vertical motion by `rocking`.
    """
    rocking = max(1.0, mass * arm * arm / float(np.linalg.eigvalsh(J)[0]))
    fast, damped = 0.4 / step, 0.25 / step
    frequency = min(120.0, fast / math.sqrt(rocking))
    return frequency, min(0.7, damped / (frequency * rocking)), min(frequency, fast / rocking)


def load_scenario(path: Path | None) -> Scenario:
    """Read a scenario file; None gives the default. Raises ScenarioError with one sentence naming file and key."""
    if path is None:
        return Scenario()
    return parse_scenario(read_toml(path), str(path), folder=path.parent)


def parse_scenario(table: dict[str, Any], source: str, folder: Path | None = None) -> Scenario:
    """Check a scenario's table and build it; source names the file in messages. Raises ScenarioError.

    folder: base of a relative vehicle_file (default: the working directory).
    """
    platform = table.get("platform", "cf2")
    known = [f.name for f in fields(Scenario) if f.name != "platform"]
    if not isinstance(platform, str) or platform not in PLATFORMS:
        raise ScenarioError(f"{source}: platform must be one of {', '.join(PLATFORMS)}, not {platform!r}")
    scenario = Scenario(platform=platform)
    if "vehicle_file" in table:
        scenario = _of_vehicle_file(scenario, table["vehicle_file"], source, folder or Path())
    for name, value in table.items():
        if name in ("platform", "vehicle_file"):
            continue
        if name not in known:
            raise ScenarioError(f"{source}: {name} is not part of a scenario (known: {', '.join(known)})")
        if not isinstance(value, dict):
            raise ScenarioError(f"{source}: {name} must be a section [{name}]")
        if name == "parameters":
            scenario = replace(scenario, parameters=_parameters(value, source))
        elif name in ("effects", "hidden"):
            checked: Any = getattr(scenario, name) | parse_effects(value, source, name)
            scenario = replace(scenario, **{name: checked})
        elif name == "payload":
            continue  # below: it depends on the effects, wherever they stand
        else:
            scenario = replace(scenario, **{name: scenario.section(name, value, f"{source}: {name}.")})
    _check_body(scenario, source)
    if "payload" in table:
        events = parse_events(table["payload"], source, loaded=bool(scenario._load()))
        scenario = replace(scenario, payload=events)
    return scenario


def _of_vehicle_file(scenario: Scenario, value: Any, source: str, folder: Path) -> Scenario:
    """The scenario with constants and effects of a vehicle file; the scenario's own keys override them later."""
    if not isinstance(value, str):
        raise ScenarioError(f"{source}: vehicle_file must be the path of a vehicle file, not {value!r}")
    path = folder / value
    vehicle, effects = vehicle_tables(path)
    scenario = replace(
        scenario,
        vehicle=scenario.section("vehicle", vehicle, f"{path}: "),
        effects=parse_effects(effects, str(path), "effects"),
    )
    _check_body(scenario, str(path))
    return scenario


def _numbers(value: Any, where: str, low: float, high: float, sizes: tuple[int, ...]) -> float | tuple[float, ...]:
    if isinstance(value, list):
        if len(value) not in sizes or len(value) == 0:
            wanted = " or ".join("one number" if n == 0 else f"{n} numbers" for n in sizes)
            raise ScenarioError(f"{where} must be {wanted}, not a list of {len(value)}")
        return tuple(checked_number(v, where, low, high) for v in value)
    if 0 not in sizes:
        raise ScenarioError(f"{where} must be a list of {' or '.join(map(str, sizes))} numbers")
    return checked_number(value, where, low, high)


def _parameters(table: dict[str, Any], source: str) -> dict[str, float]:
    """Boot values of firmware parameters: "group.name" = number, quoted or as nested tables."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat.update({f"{name}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {name: value})
    return {name: checked_number(v, f'{source}: parameters."{name}"', -1e9, 1e9) for name, v in flat.items()}


def _check_body(scenario: Scenario, source: str) -> None:
    """Raises ScenarioError for an inertia matrix that no body can have."""
    if scenario.vehicle.inertia is not None:
        _check_inertia(scenario.inertia(), f"{source}: vehicle.inertia")
    changed = [name for name in ("inertia", "inertia_products") if name in scenario.effects]
    if changed:
        _check_inertia(replaced(scenario.inertia(), scenario.effects), f"{source}: effects.{changed[-1]}")
    if scenario.platform != "cf21bl" and "rotor_sensor" in scenario.effects:
        raise ScenarioError(f"{source}: effects.rotor_sensor needs platform cf21bl, {scenario.platform} has no sensors")


def _check_inertia(J: np.ndarray, where: str) -> None:
    principal = np.linalg.eigvalsh(J)
    if principal[0] < 1e-9:
        raise ScenarioError(f"{where} is not positive definite")
    if principal[2] > (principal[0] + principal[1]) * 1.000001:
        raise ScenarioError(f"{where} breaks the triangle inequality, no body has it")
