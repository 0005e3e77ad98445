"""Constants of the compiled plant (layout.py) from the effects of a scenario, neutral ones included."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.catalogue import EFFECTS, HIDDEN, Effect, Values
from firmware_sim.plant.rigid_body import GRAVITY

LOAD_FRICTION = 0.1  # 1/s, drag of the suspended load over its mass
WIND_DRAG = 0.007  # N s/m: 0.92e-6 N s/m per rad/s of rotor speed (Foerster 2015), 7500 rad/s in sum at hover
FULL_COMMAND = 65535.0
_STREAM_DELAYS = {
    "pose": at.DELAY_POSE,
    "gyro": at.DELAY_GYRO,
    "accelerometer": at.DELAY_ACC,
    "state": at.DELAY_STATE,
}


def fill_effects(
    c: np.ndarray, effects: Mapping[str, Values], hidden: Mapping[str, Values], bare_mass: float, com: np.ndarray
) -> None:
    """Set the constants of all effects in c; bare_mass [kg]: without payload; com [m]: of the loaded body.

    c already contains motor_lag and the mass properties of effects/body.py.
    """
    fx = {name: effects.get(name, neutral(effect)) for name, effect in EFFECTS.items()}
    c[at.COM : at.COM + 3] = com
    _rotors(c, fx, hidden, bare_mass)
    _motion(c, fx, hidden)
    _sensing(c, fx, hidden)


def neutral(effect: Effect) -> Values:
    """The values of an absent effect."""
    values: Values = {p.name: 0.0 if p.required else p.default for p in effect.parameters}
    return {**values, "streams": ()} if effect.streams else values


def rotation(angles: Values) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll): the axes of a frame turned by these angles, as columns in the old frame."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angles[k]), math.sin(angles[k])) for k in ("roll", "pitch", "yaw"))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _rotors(c: np.ndarray, fx: dict[str, Values], hidden: Mapping[str, Values], bare_mass: float) -> None:
    sticky, vibration = _hidden(hidden, "sticky_rotor"), _hidden(hidden, "vibration")
    fault = fx["rotor_fault"]
    c[at.INPUT_DELAY] = 1000.0 * fx["input_delay"]["delay"]
    c[at.THRUST_SCALE] = fx["thrust_scale"]["scale"]
    c[at.FAULT_ROTOR], c[at.FAULT_SCALE] = fault["rotor"], fault["scale"]
    c[at.FAULT_ONSET] = 1000.0 * fault["onset_time"]
    c[at.SAG_PER_VOLT] = fx["battery_sag"]["gain_per_volt"]
    c[at.SAG_PER_SECOND] = fx["battery_sag"]["gain_per_second"]
    c[at.SLOPE_ERROR] = fx["thrust_curve"]["slope_error"]
    c[at.HOVER_THRUST] = 0.25 * bare_mass * GRAVITY
    c[at.GROUND_STRENGTH], c[at.GROUND_HEIGHT] = fx["ground_effect"]["strength"], fx["ground_effect"]["height"]
    c[at.TORQUE_SCALE] = fx["torque_scale"]["scale"]
    c[at.ROTOR_INERTIA] = fx["rotor_inertia"]["inertia"]
    c[at.TRIM : at.TRIM + 3] = [fx["trim"][axis] for axis in "xyz"]
    c[at.STICKY_ROTOR], c[at.STICKY_BAND] = sticky["rotor"], FULL_COMMAND * sticky["deadband"]
    c[at.VIBRATION_ROTOR], c[at.VIBRATION_TORQUE] = vibration["rotor"], vibration["torque"]
    c[at.VIBRATION_RATIO] = vibration["ratio"]
    zero = (at.INPUT_DELAY, at.SAG_PER_VOLT, at.SAG_PER_SECOND, at.SLOPE_ERROR, at.GROUND_STRENGTH, at.ROTOR_INERTIA)
    one = (at.THRUST_SCALE, at.FAULT_SCALE, at.TORQUE_SCALE)
    odd = any(c[i] != 0.0 for i in (*zero, *range(at.COM, at.COM + 3), at.STICKY_BAND, at.VIBRATION_TORQUE))
    odd |= any(c[at.TRIM : at.TRIM + 3] != 0.0)
    c[at.EFFECT_ROTORS] = float(odd or any(c[i] != 1.0 for i in one))


def _motion(c: np.ndarray, fx: dict[str, Values], hidden: Mapping[str, Values]) -> None:
    cable, load = _hidden(hidden, "cable_spring"), fx["suspended_load"]
    for name, place in (
        ("linear_drag", at.LINEAR_DRAG),
        ("quadratic_drag", at.QUADRATIC_DRAG),
        ("rate_damping", at.RATE_DAMPING),
        ("wind", at.WIND),
    ):
        c[place : place + 3] = [fx[name][axis] for axis in "xyz"]
    c[at.ROLL_PER_VY] = fx["velocity_moment"]["roll_per_vy"]
    c[at.PITCH_PER_VX] = fx["velocity_moment"]["pitch_per_vx"]
    c[at.GUST_SD], c[at.GUST_TIME] = fx["gusts"]["standard_deviation"], fx["gusts"]["correlation_time"]
    drag = np.any(c[at.LINEAR_DRAG : at.LINEAR_DRAG + 6] != 0.0)
    c[at.WIND_DRAG] = 0.0 if drag else WIND_DRAG
    c[at.LOAD_MASS], c[at.LOAD_LENGTH], c[at.LOAD_FRICTION] = load["mass"], load["length"], LOAD_FRICTION
    c[at.STANDING_MASS] = c[at.MASS] + load["mass"]
    c[at.CABLE_STIFFNESS], c[at.CABLE_LENGTH] = cable["stiffness"], cable["length"]
    c[at.CABLE_POINT : at.CABLE_POINT + 3] = [cable[axis] for axis in "xyz"]
    used = (*range(at.COM, at.COM + 3), *range(at.LINEAR_DRAG, at.GUST_SD + 1), at.LOAD_MASS, at.CABLE_STIFFNESS)
    moved = any(c[i] != 0.0 for i in (*used, at.ROTOR_INERTIA, at.VIBRATION_TORQUE))
    c[at.EFFECT_BODY] = float(moved or any(v != 0.0 for v in fx["accelerometer_misalignment"].values()))


def _sensing(c: np.ndarray, fx: dict[str, Values], hidden: Mapping[str, Values]) -> None:
    yaw, delay = _hidden(hidden, "magnetic_yaw"), fx["measurement_delay"]
    c[at.POSE_TURN : at.POSE_TURN + 4] = quaternion(fx["attitude_misalignment"])
    c[at.ACC_TURN : at.ACC_TURN + 9] = rotation(fx["accelerometer_misalignment"]).T.ravel()
    c[at.VELOCITY_SCALE : at.VELOCITY_SCALE + 3] = [fx["velocity_scale"][axis] for axis in "xyz"]
    for stream in delay["streams"]:
        c[_STREAM_DELAYS[stream]] = 1000.0 * delay["delay"]
    c[at.RPM_SCALE : at.RPM_SCALE + 4] = 1.0
    if fx["rotor_sensor"]["rotor"]:
        c[at.RPM_SCALE + int(fx["rotor_sensor"]["rotor"]) - 1] = fx["rotor_sensor"]["scale"]
    c[at.YAW_AMPLITUDE], c[at.YAW_WAVELENGTH] = yaw["amplitude"], yaw["wavelength"]
    turned = any(v != 0.0 for v in fx["attitude_misalignment"].values())
    odd = any(c[i] != 0.0 for i in (*_STREAM_DELAYS.values(), *range(at.COM, at.COM + 3), at.YAW_AMPLITUDE))
    scaled = any(c[at.VELOCITY_SCALE + i] != 1.0 for i in range(3))
    c[at.EFFECT_SENSING] = float(turned or odd or scaled)


def quaternion(angles: Values) -> tuple[float, float, float, float]:
    """The same rotation as `rotation`, w x y z."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(0.5 * angles[k]), math.sin(0.5 * angles[k])) for k in ("roll", "pitch", "yaw")
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _hidden(hidden: Mapping[str, Values], name: str) -> dict[str, Any]:
    return hidden.get(name, neutral(HIDDEN[name]))
