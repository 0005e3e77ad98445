"""Draws the properties that are not hidden in a random world: sensors, log, controller, course, battery, days, air.

All are properties of the true drone. Those missing in its vehicle file are noise of every flight, or effects in the
list `aside` of the case, which are not judged in an answer. Ranges are from the issue and from recordings. Results are
plain tables, so that a case is one JSON document.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from .courses import MADE, size_of
from .sizes import DEGREE, Concealed, Random, between

Table = dict[str, Any]

BRUSHLESS = 0.3  # share of cf21bl if the effect is possible on both drones
FAVOURABLE = 0.75  # share of flights with a style that shows the effect well; the others have any style
FACTOR = (0.3, 3.0)  # of the noise of gyro, accelerometer and pose, around the simulator's
UNREST = (0.5, 2.0)  # the same for process noise
OFFSET = (0.05 * DEGREE, 0.3 * DEGREE)  # rad/s, sd of a flight's gyro offset on each axis
GAIN, EACH = 0.22, 0.08  # relative change of all gains of a loop, and of each: at most 30 % in total
LOSS = 0.05  # share of packets, at most
PERIODS, SHARES = (20, 10, 5, 4, 2), (0.2, 0.4, 0.2, 0.1, 0.1)  # ms: 50 to 500 Hz
STYLES = ("hover", "excite", "figure8", "fast", *MADE)
# Styles that show an effect as well as the style of the home world.
LIKE = {"figure8": ("helix", "oval"), "fast": ("star", "oval"), "excite": ("multisine", "vertical")}
# Of drones with a file of their own: sd of trim (m of torque over thrust) from drone to drone, and from day to day with
# the thrust (relative) and the lag, as on CrazyPAD's two drones (docs/results/diagnosis_real.md); heavy tails.
OWN_TRIM, DAY_TRIM, DAY_THRUST, DAY_LAG, DAY_FREEDOM = (1.0e-3, 1.0e-3, 3e-4), (5e-4, 5e-4, 1.6e-4), 0.02, 0.03, 5
DRAG, FLAPPING = (3e-3, 9e-3), (3e-6, 2e-5)  # N s/m, N m s/m of the true drone
DRAUGHT = (0.05, 0.25)  # m/s, sd
WINDY = {"wind", "gusts"}
AIRY = WINDY | {"linear_drag", "quadratic_drag", "velocity_moment", "velocity_scale", "rate_damping"}

# Effects that need a logged voltage; without this signal no flight shows them.
VOLTAGE = {"payload", "thrust_scale", "battery_sag", "thrust_curve", "suspended_load"}
ONBOARD = {"velocity_scale"}
POSED = {"attitude_misalignment", "magnetic_yaw", "accelerometer_misalignment"}
FELT = {"accelerometer_misalignment"}
SPEEDS = {"rotor_sensor"}

_AXES = ("x", "y", "z")
_PID = ("roll", "pitch", "yaw")
GAINS: dict[str, dict[str, tuple[str, ...]]] = {
    "pid": {
        "attitude": (*(f"pid_attitude.{a}_kp" for a in _PID), *(f"pid_rate.{a}_kp" for a in _PID)),
        "position": (*(f"posCtlPid.{a}Kp" for a in _AXES), *(f"velCtlPid.v{a}Kp" for a in _AXES)),
    },
    "mellinger": {
        "attitude": ("ctrlMel.kR_xy", "ctrlMel.kR_z", "ctrlMel.kw_xy", "ctrlMel.kw_z"),
        "position": ("ctrlMel.kp_xy", "ctrlMel.kd_xy", "ctrlMel.kp_z", "ctrlMel.kd_z"),
    },
    "lee": {
        "attitude": (*(f"ctrlLee.KR_{a}" for a in _AXES), *(f"ctrlLee.Kw_{a}" for a in _AXES)),
        "position": (*(f"ctrlLee.Kpos_P{a}" for a in _AXES), *(f"ctrlLee.Kpos_D{a}" for a in _AXES)),
    },
    "lqg": {
        "attitude": ("ctrlLqg.q_att", "ctrlLqg.q_rate", "ctrlLqg.q_yaw", "ctrlLqg.q_yawrate"),
        "position": ("ctrlLqg.q_pos", "ctrlLqg.q_vel"),
    },
}
NUMBER = {"pid": 1, "mellinger": 2, "lee": 5, "lqg": 6}  # stabilizer.controller
FITTING_THRUST = (
    132000.0 / 1.61
)  # ctrlMel.massThrust with the desired force on a cf21bl (docs/reference/firmware_sim.md)


def rounded(value: float) -> float:
    """A value with four digits, as in the files."""
    return float(f"{value:.4g}")


def factor(random: Random, ends: tuple[float, float]) -> float:
    """A log-uniform number between two ends."""
    return rounded(between(float(random.random()), ends))


def sensors(random: Random, hidden: Iterable[str]) -> Table:
    """Sections of the scenario: sensors, estimator, process noise, battery, integration step."""
    offset = 0.02 * DEGREE if "gyro_bias" in hidden else factor(random, OFFSET)  # small beside the hidden one
    return {
        "sensors": {
            "gyro_noise": rounded(2.44e-4 * factor(random, FACTOR)),
            "accelerometer_noise": rounded(1.86e-3 * factor(random, FACTOR)),
            "gyro_bias": offset,
        },
        "estimator": {
            "rate": float(random.choice((40.0, 100.0, 200.0))),
            "position_noise": rounded(1e-3 * factor(random, FACTOR)),
            "attitude_noise": rounded(5e-3 * factor(random, FACTOR)),
        },
        "noise": {
            "thrust": rounded(1e-3 * factor(random, UNREST)),
            "torque": rounded(5e-6 * factor(random, UNREST)),
        },
        "battery": {
            "resistance": rounded(float(random.uniform(0.06, 0.3))),
            "noise": rounded(3e-3 * factor(random, FACTOR)),
        },
        "integration": {"step": float(random.choice((1e-3, 2e-3, 4e-3), p=(0.5, 0.3, 0.2)))},
    }


def controller(random: Random, platform: str) -> Table:
    """Firmware parameters: which controller, its gains, the colour of the onboard filter."""
    name = str(random.choice(tuple(GAINS), p=(0.2, 0.2, 0.4, 0.2)))
    out: Table = {"stabilizer.controller": float(NUMBER[name])}
    if name == "mellinger" and platform == "cf21bl":
        out["ctrlMel.massThrust"] = rounded(FITTING_THRUST)
    relative = {}
    for names in GAINS[name].values():
        together = random.uniform(-GAIN, GAIN)
        relative.update({n: rounded(1.0 + float(together + random.uniform(-EACH, EACH))) for n in names})
    return {
        "controller": name,
        "parameters": out,
        "gains": relative,
        "filter": {
            "kalman.pNAcc_xy": rounded(0.5 * factor(random, FACTOR)),
            "kalman.pNAcc_z": rounded(1.0 * factor(random, FACTOR)),
            "locSrv.extPosStdDev": rounded(0.01 * factor(random, FACTOR)),
        },
    }


def log(random: Random, platform: str, hidden: Iterable[str]) -> Table:
    """Signals, rates and packets of the log and share of lost packets; signals that hidden effects need are logged."""
    names = set(hidden)
    onboard = bool(random.random() < 0.7) or bool(names & ONBOARD)
    state, command = (int(random.choice(PERIODS, p=SHARES)) for _ in range(2))
    out: Table = {
        "estimate": "kalman" if onboard else "none",
        "layout": str(random.choice(("compact", "floats", "mixed", "card"), p=(0.4, 0.2, 0.2, 0.2))),
        "period": state,
        "command_period": state if random.random() < 0.6 else command,
        "voltage": bool(random.random() < 0.85) or bool(names & VOLTAGE),
        "rotor_speed": platform == "cf21bl" and (bool(random.random() < 0.7) or bool(names & SPEEDS)),
        "attitude": bool(random.random() < 0.92) or bool(names & POSED),
        "accelerometer": bool(random.random() < 0.6) or bool(names & FELT),
        "loss": 0.0 if random.random() < 0.3 else rounded(float(random.uniform(0.0, LOSS))),
        "burst": rounded(float(random.uniform(1.0, 4.0))),
    }
    if not onboard:  # correlated errors of motion capture: markers, calibration
        out["drift"] = {
            "share": rounded(float(random.uniform(0.0, 1.0))),
            "time": rounded(float(random.uniform(0.05, 1.0))),
        }
    return out


def air(random: Random, hidden: Iterable[str]) -> tuple[str, Table]:
    """Drag and flapping of the true drone: ("none", {}), ("right", effects in the file), ("free", not in the file)."""
    names = set(hidden)
    kind = str(random.choice(("none", "right", "free"), p=(0.4, 0.3, 0.3)))
    drag, flapping = factor(random, DRAG), factor(random, FLAPPING)
    if kind == "none" or names & (AIRY - WINDY) or (kind == "free" and names & WINDY):
        return "none", {}
    return kind, {
        "linear_drag": {"x": drag, "y": rounded(drag * float(random.uniform(0.8, 1.2))), "z": rounded(0.5 * drag)},
        "velocity_moment": {"roll_per_vy": flapping, "pitch_per_vx": -flapping},
    }


def trim(random: Random, sds: Iterable[float], *, heavy: bool) -> Table:
    """A trim: normally distributed over drones, t-distributed over days (heavy)."""
    draws = random.standard_t(DAY_FREEDOM, 3) if heavy else random.standard_normal(3)
    return {a: rounded(float(sd * d)) for a, sd, d in zip("xyz", sds, draws)}


def day(random: Random, own: Table | None) -> Table:
    """Changes on the day of a flight: thrust and lag (relative), trim [m]; none for a drone without its own file."""
    charge = rounded(float(random.uniform(0.55, 1.0)))
    if own is None:
        return {"charge": charge}
    tails = random.standard_t(DAY_FREEDOM, 2)
    return {
        "charge": charge,
        "trim": trim(random, DAY_TRIM, heavy=True),
        "thrust": rounded(1.0 + DAY_THRUST * float(np.clip(tails[0], -4, 4))),
        "lag": rounded(1.0 + DAY_LAG * float(np.clip(tails[1], -4, 4))),
    }


def styles(hidden: dict[str, Concealed], random: Random, *, among: tuple[str, ...] = STYLES) -> tuple[str, str]:
    """Styles of the fitted and of the held-out flight: different ones if several show the effect."""
    suited = [set(h.trajectories).union(*(LIKE.get(s, ()) for s in h.trajectories)) for h in hidden.values()]
    if any("low" in s for s in suited):
        return "low", "low"
    possible = [s for s in among if s != "draught" or not AIRY & set(hidden)]
    good = [s for s in possible if all(s in fit for fit in suited)] or possible
    first = str(random.choice(good if hidden and random.random() < FAVOURABLE else possible))
    second = str(
        random.choice([s for s in (good if random.random() < FAVOURABLE else possible) if s != first] or possible)
    )
    return first, second


def flight(style: str, waypoints: Any, random: Random, own: Table | None) -> Table:
    """Properties of one flight: course, seed, day, draught."""
    out = {
        "style": style, "seed": int(random.integers(1, 2**31)), "waypoints": waypoints,
        "size": size_of(style, random), "day": day(random, own),
    }  # fmt: skip
    if style == "draught":
        out["gusts"] = {
            "standard_deviation": factor(random, DRAUGHT),
            "correlation_time": rounded(float(random.uniform(0.3, 2.0))),
        }
    return out
