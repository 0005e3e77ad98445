"""A case of a foreign world: a drone of RotorPy (extra `bench`), whose physics and controller are not ours.

Effects are hidden by a change of RotorPy's parameters and of its log; the vehicle file has the published constants.
This module defines the effects that can be hidden, and the vehicle file. `foreign` flies the case. All SI.
"""

import importlib
import math
from typing import Any

import numpy as np

from crazyem.vehicle import Vehicle

from . import conditions
from .conditions import factor, rounded
from .paths import FLIGHTS
from .sizes import CATALOGUE, DEGREE, FOREIGN_OUTSIDE, OUTSIDE, Random

Table = dict[str, Any]
PLATFORMS = {"crazyflie": "crazyflie_params", "crazyfliebrushless": "crazyfliebrushless_params"}
SUPPLY = 4.0  # V, constant: RotorPy has no battery
HIDEABLE = (
    "payload", "thrust_scale", "rotor_fault", "center_of_mass", "linear_drag", "quadratic_drag", "velocity_moment",
    "motor_lag", "input_delay", "measurement_delay", "battery_sag", "thrust_curve", "wind", "gusts",
    "attitude_misalignment", "accelerometer_misalignment", "gyro_bias", "velocity_scale", "inertia", "inertia_products",
    "torque_scale", "rotor_sensor",
)  # fmt: skip
ABROAD = {**OUTSIDE, **FOREIGN_OUTSIDE}
BEFORE_ROTORS = {"motor_lag", "input_delay", "thrust_curve", "battery_sag"}  # visible in commands, not in speeds
STEPS, STEP_SHARES = (2, 4, 5), (0.5, 0.3, 0.2)  # ms, of the simulator and its controller
PERIODS = {2: (2, 4, 10, 20), 4: (4, 8, 12, 20), 5: (5, 10, 15, 20)}  # ms of the log
PERIOD_SHARES = (0.15, 0.2, 0.4, 0.25)
POSE, TURN, SPEED = (0.3e-3, 3e-3), (1.5e-3, 15e-3), (2e-3, 2e-2)  # m, rad, m/s: noise of pose and velocity
GYRO, FELT = (2e-3, 2e-2), (0.02, 0.2)  # rad/s, m/s^2: noise of a sample
MOTOR_NOISE = (0.2, 2.0)  # rad/s a step, sd: thrust noise with the memory of the rotors' lag


def constants(platform: str) -> Table:
    """RotorPy's table of a drone, without translational lift (unknown to our files) and with possible inertia.

    The published moments of the crazyflie break the triangle inequality by 1 %: Izz is 0.98 of the sum of the others.
    The brushless drone's attitude gains oscillate at 13 Hz with steps of 4 ms: both drones use SE3Control's defaults.
    """
    module = importlib.import_module(f"rotorpy.vehicles.{PLATFORMS[platform]}")
    c = {**module.quad_params, "k_h": 0.0, "kp_att": 310.0, "kd_att": 57.0}
    return {**c, "Izz": min(c["Izz"], 0.98 * (c["Ixx"] + c["Iyy"]))}


def hover_speed(c: Table) -> float:
    """Sum of the four rotor speeds at hover [rad/s]."""
    return 4.0 * math.sqrt(c["mass"] * 9.81 / (4.0 * c["k_eta"]))


def as_built(c: Table) -> Table:
    """The published drag as effects: of the hubs at the rotor speeds of hover, and its damping of body rates."""
    speed, arm = hover_speed(c), float(np.linalg.norm(c["rotor_pos"]["r1"]))
    tilt = speed * c["k_z"] * arm**2 / 2.0
    return {
        "linear_drag": {"x": speed * c["k_d"], "y": speed * c["k_d"], "z": speed * c["k_z"]},
        "rate_damping": {"x": tilt, "y": tilt, "z": speed * c["k_d"] * arm**2},
    }


def published(platform: str, effects: Table) -> Vehicle:
    """The vehicle file of a drone."""
    c = constants(platform)
    x, y = np.abs(c["rotor_pos"]["r1"][:2]).tolist()
    full = c["k_eta"] * c["rotor_speed_max"] ** 2
    return Vehicle(
        "drone", c["mass"], (c["Ixx"], c["Iyy"], c["Izz"]), arm=(x, y), thrust_curve=(0.0, 0.0, full / SUPPLY**2),
        rotor_constant=c["k_eta"], torque_per_thrust=c["k_m"] / c["k_eta"], motor_time_constant=c["tau_m"],
        thrust_max=full, effects=effects,
    )  # fmt: skip


def foreign_case(name: str, kind: str, strength: dict[str, float], random: Random) -> Table:
    """A case in the form of `random_case`; "vehicle" is the text of the vehicle file."""
    from .draw import waypoints

    hidden = {n: (CATALOGUE.get(n) or ABROAD[n]) for n in strength}
    platform = str(random.choice(tuple(PLATFORMS)))
    vehicle = published(platform, {})
    tables = {n: h.draw(strength[n], random, vehicle) for n, h in hidden.items()}
    if "linear_drag" in tables:  # a hub's drag has no z
        tables["linear_drag"] = {a: v for a, v in tables["linear_drag"].items() if a != "z"}
        tables["linear_drag"]["y"] = tables["linear_drag"]["x"]
    if "battery_sag" in tables and "gain_per_volt" in tables["battery_sag"]:  # there is no battery
        tables["battery_sag"] = {"gain_per_second": rounded(-0.0008 * 7.5 ** strength["battery_sag"])}
    kind_of_air = str(random.choice(("none", "right", "free"), p=(0.4, 0.3, 0.3)))
    names = set(hidden)
    if names & conditions.WINDY:
        kind_of_air = "right"
    elif names & conditions.AIRY:
        kind_of_air = "none"
    built = as_built(constants(platform)) if kind_of_air != "none" else {}
    own = conditions.trim(random, conditions.OWN_TRIM, heavy=False) if random.random() < 0.5 else None
    filed = {**({"trim": own} if own is not None else {}), **(built if kind_of_air == "right" else {})}
    pair = conditions.styles(hidden, random, among=tuple(s for s in conditions.STYLES if s != "draught"))
    aside = [*built, "quadratic_drag", "velocity_moment"] if kind_of_air == "free" else []
    aside += ["rate_damping"] if "linear_drag" in names else []  # the drag of the hubs damps the yaw rate
    return {
        "case": name,
        "world": "foreign",
        "kind": kind,
        "platform": platform,
        "effects": {n: t for n, t in tables.items() if n in CATALOGUE},
        "hidden": {n: t for n, t in tables.items() if n not in CATALOGUE},
        "strength": {n: round(u, 4) for n, u in strength.items()},
        "air": kind_of_air,
        "aside": aside,
        "own": filed,
        "built": built,
        "conditions": surroundings(random, names),
        "vehicle": published(platform, filed).to_toml(),
        "flights": {
            flight: conditions.flight(style, waypoints(style, random), random, own)
            for flight, style in zip(FLIGHTS, pair)
        },
    }


def surroundings(random: Random, hidden: set[str]) -> Table:
    """Draw the properties that are not hidden: step, noise, gains (relative), log."""
    step = int(random.choice(STEPS, p=STEP_SHARES))
    speeds = bool(random.random() < 0.4) and not hidden & BEFORE_ROTORS
    moving = bool(random.random() < 0.7) or bool(hidden & {"velocity_scale"})
    return {
        "step": step,
        "noise": {
            "position": factor(random, POSE), "attitude": factor(random, TURN), "velocity": factor(random, SPEED),
            "body_rate": factor(random, GYRO), "specific_force": factor(random, FELT),
            "gyro_offset": 0.02 * DEGREE if "gyro_bias" in hidden else factor(random, conditions.OFFSET),
            "motor": factor(random, MOTOR_NOISE),
            "share": rounded(float(random.uniform(0.0, 1.0))), "time": rounded(float(random.uniform(0.03, 0.5))),
        },
        "gains": {
            n: rounded(1.0 + float(random.uniform(-0.3, 0.3))) for n in ("kp_pos", "kd_pos", "kp_att", "kd_att")
        },
        "log": {
            "period": int(random.choice(PERIODS[step], p=PERIOD_SHARES)),
            "onboard": moving and bool(random.random() < 0.5),
            "velocity": moving,
            "attitude": bool(random.random() < 0.92) or bool(hidden & conditions.POSED),
            "specific_force": bool(random.random() < 0.5) or "accelerometer_misalignment" in hidden,
            "rotor_speed": speeds or "rotor_sensor" in hidden,
            "voltage": bool(random.random() < 0.85) or bool(hidden & conditions.VOLTAGE),
            "loss": 0.0 if random.random() < 0.3 else rounded(float(random.uniform(0.0, conditions.LOSS))),
        },
    }  # fmt: skip


def changed(case: Table, flight: str) -> Table:
    """RotorPy's parameters of the true drone on the day of a flight, and "com" [m]: its centre of mass in the body."""
    c, effects = dict(constants(case["platform"])), case["effects"]
    speed, today = hover_speed(c), case["flights"][flight]["day"]
    if case["air"] == "none":
        c["k_d"] = c["k_z"] = 0.0
    scale = effects.get("thrust_scale", {}).get("scale", 1.0) * today.get("thrust", 1.0)
    torque = effects.get("torque_scale", {}).get("scale", 1.0)
    drag, square = effects.get("linear_drag", {}), effects.get("quadratic_drag", {})
    if drag:
        c["k_d"] = drag["x"] / speed
    c["c_Dx"], c["c_Dy"], c["c_Dz"] = (square.get(a, 0.0) for a in "xyz")
    c["k_flap"] = -effects.get("velocity_moment", {}).get("roll_per_vy", 0.0) / speed
    c["k_h"] = case["hidden"].get("translational_lift", {}).get("lift", 0.0)
    c["tau_m"] = effects.get("motor_lag", {}).get("time_constant", c["tau_m"]) * today.get("lag", 1.0)
    moments = {**{n: c[f"I{n}"] for n in ("xx", "yy", "zz", "xy", "xz", "yz")}, **effects.get("inertia", {})}
    moments.update(effects.get("inertia_products", {}))
    J = np.array([[moments["xx"], moments["xy"], moments["xz"]], [moments["xy"], moments["yy"], moments["yz"]],
                  [moments["xz"], moments["yz"], moments["zz"]]])  # fmt: skip
    com = np.array([effects.get("center_of_mass", {}).get(a, 0.0) for a in "xyz"])
    load = effects.get("payload", {"mass": 0.0})
    c["mass"], com, J = loaded(c["mass"], com, J, load["mass"], np.array([load.get(a, 0.0) for a in "xyz"]))
    c.update(Ixx=J[0, 0], Iyy=J[1, 1], Izz=J[2, 2], Ixy=J[0, 1], Ixz=J[0, 2], Iyz=J[1, 2])
    c["rotor_pos"] = {n: np.asarray(r) * torque - com for n, r in c["rotor_pos"].items()}
    c["k_eta"], c["k_m"] = c["k_eta"] * scale, c["k_m"] * scale * torque
    c["motor_noise_std"] = case["conditions"]["noise"]["motor"]
    return {**c, "com": com}


def loaded(mass: float, com: np.ndarray, J: np.ndarray, more: float, at: np.ndarray) -> tuple[float, np.ndarray, Any]:
    """Mass, centre and inertia (about it) of a body with a point mass `more` [kg] at `at` [m], by Steiner."""
    total = mass + more
    centre = (mass * com + more * at) / total
    J = J.copy()
    for m, r in ((mass, com - centre), (more, at - centre)):
        J += m * (r @ r * np.eye(3) - np.outer(r, r))
    return total, centre, J
