"""The two implementations of one page, docs: firmware_sim_effects.md: what the simulated drone does, the host predicts.

The simulator's plant flies under changing motor commands with each effect; along its path, millisecond by millisecond,
the host's model must give the same accelerations. The two packages share no line; here alone they meet.
"""

from dataclasses import replace

import numpy as np
import pytest
from effects_cases import CF2, still
from scipy.spatial.transform import Rotation, Slerp

from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effects, Situation
from crazyem.physics.motion import RotorInput, measured, motion, rotor_thrust
from crazyem.vehicle import Vehicle
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.catalogue import EFFECTS
from firmware_sim.plant.effects.motion import origin
from firmware_sim.plant.effects.sensing import fix_pose
from firmware_sim.plant.effects.step import plant_step_with_effects, set_accelerometer
from firmware_sim.scenario import parse_scenario

N, SETTLED = 900, 700  # ms flown; from when on the host's lag has forgotten its start
VOLT = 4.2
VEHICLE: Vehicle = replace(
    CF2, mass=0.03, inertia=(2e-5, 1.5e-5, 3e-5), inertia_products=(1e-6, -5e-7, 8e-7), arm=(0.03, 0.03),
    torque_per_thrust=0.006, thrust_curve=(0.0, 0.03), rotor_constant=2e-8, motor_time_constant=0.03, thrust_max=1.0,
)  # fmt: skip
SCENARIO = {
    "vehicle": {
        "mass": 0.03, "inertia": [2e-5, 1.5e-5, 3e-5, 1e-6, -5e-7, 8e-7], "arm": 0.03, "torque_per_thrust": 0.006,
        "thrust_curve": [0.0, 0.03], "thrust_max": 1.0, "motor_time_constant": 0.03, "rotor_constant": 2e-8,
    },
    "noise": {"thrust": 0.0, "torque": 0.0},
    "battery": {"resistance": 0.0, "power_coefficient": 0.0, "electronics_power": 0.0},
    "ground": {"height": -4.0},
    "start": {"velocity": [0.4, -0.3, 0.2], "yaw": 0.7},
}  # fmt: skip


def command() -> np.ndarray:
    """(N, 4) PWM, held a millisecond each: about hover, every rotor at its own pace."""
    t = 0.001 * np.arange(N)
    base = 0.03 * 9.81 / 4 / (0.03 * VOLT) * 65535
    waves = np.sin(np.multiply.outer(t, [40.0, 47.0, 55.0, 62.0]) + np.arange(4))
    return base * (1 + 0.15 * waves)


def flown(effects: Effects) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity of O, attitude matrices and body rate, (N + 1, ...), of the plant."""
    scenario = parse_scenario(SCENARIO | {"effects": {k: dict(v) for k, v in effects.items()}}, "test")
    truth, state = scenario.truth(), scenario.start_state()
    still = np.zeros(at.NOISE_WIDTH)
    p, v, q, rate = np.empty((N + 1, 3)), np.empty((N + 1, 3)), np.empty((N + 1, 4)), np.empty((N + 1, 3))
    pwm = command()
    for k in range(N + 1):
        origin(truth, state, p[k], v[k])
        q[k] = state[at.QUAT : at.QUAT + 4]
        rate[k] = state[at.OMEGA : at.OMEGA + 3]
        if k < N:
            state[at.PWM : at.PWM + 4] = pwm[k]
            plant_step_with_effects(truth, state, still, 0.001)
    return p, v, Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix(), rate  # w comes first there


def predicted(path, effects: Effects) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations of O (world) and of the body rate (body) that the host has for every millisecond of a path."""
    p, v, rotation, rate = path
    time = 0.001 * np.arange(N + 1)
    thrust = 0.03 * command() / 65535 * VOLT
    inputs = RotorInput(time[:-1], thrust, np.full(N, VOLT), time[:-1], measured=False, aged=False)
    mean, change = rotor_thrust(inputs, time[1:], vehicle=VEHICLE, effects=effects)
    middle = Slerp(time, Rotation.from_matrix(rotation))(time[:-1] + 0.0005).as_matrix()
    none = np.zeros((N, 3))
    situation = Situation(
        time=time[1:], flown=time[1:], step=np.full(N, 0.001), position=(p[1:] + p[:-1]) / 2,
        height=(p[1:] + p[:-1])[:, 2] / 2 + 4.0, velocity=(v[1:] + v[:-1]) / 2, rotation=middle,
        body_rate=(rate[1:] + rate[:-1]) / 2, specific_force=none, angular_acceleration=none, thrust=mean,
        thrust_rate=change, voltage=np.full(N, VOLT), rotor_constant=2e-8, air=none,
    )  # fmt: skip
    found = motion(situation, vehicle=VEHICLE, effects=effects)
    world = np.einsum("nij,nj->ni", middle, found.specific_force) - [0, 0, 9.81]
    return world[SETTLED:], found.angular_acceleration[SETTLED:]


OF_A_DIAGNOSIS = ("force_by_place", "sampled_commands")
CASES: dict[str, Effects] = {
    "none": {},
    "payload": {"payload": {"mass": 0.004, "x": 0.003, "y": -0.004, "z": -0.02}},
    "center_of_mass": {"center_of_mass": {"x": 0.0006, "y": -0.0004, "z": -0.01}},
    "payload on a shifted body": {
        "center_of_mass": {"x": -0.001, "z": 0.01},
        "payload": {"mass": 0.004, "x": 0.01, "z": -0.02},
    },
    "inertia": {"inertia": {"xx": 2.5e-5, "zz": 2.5e-5}},
    "inertia_products": {"inertia_products": {"xy": -2e-6, "yz": 3e-6}},
    "thrust_scale": {"thrust_scale": {"scale": 1.1}},
    "rotor_fault": {"rotor_fault": {"rotor": 2, "scale": 0.97, "onset_time": 0.75}},
    "torque_scale": {"torque_scale": {"scale": 1.3}},
    "trim": {"trim": {"x": 0.0003, "y": -0.0002, "z": 0.0004}},
    "trim of torques scaled": {"trim": {"x": 0.0003, "z": 0.0004}, "torque_scale": {"scale": 1.2}},
    "motor_lag": {"motor_lag": {"time_constant": 0.06}},
    "input_delay": {"input_delay": {"delay": 0.0125}},
    "thrust_curve": {"thrust_curve": {"slope_error": 0.4}},
    "battery_sag in volts": {"battery_sag": {"gain_per_volt": 0.2}},
    "battery_sag in time": {"battery_sag": {"gain_per_second": -0.05}},
    "ground_effect": {"ground_effect": {"strength": 0.3, "height": 4.0}},
    "rotor_inertia": {"rotor_inertia": {"inertia": 1e-7}},
    "rotor_inertia of a fault": {"rotor_inertia": {"inertia": 1e-7}, "rotor_fault": {"rotor": 1, "scale": 0.97}},
    "linear_drag": {"linear_drag": {"x": 0.02, "y": 0.03, "z": 0.04}},
    "quadratic_drag": {"quadratic_drag": {"x": 0.02, "y": 0.03, "z": 0.04}},
    "velocity_moment": {"velocity_moment": {"roll_per_vy": 2e-5, "pitch_per_vx": -3e-5}},
    "rate_damping": {"rate_damping": {"x": 2e-5, "y": 3e-5, "z": 4e-5}},
    "wind": {"wind": {"x": 3.0, "y": -2.0, "z": 1.0}},
    "wind on drag": {"wind": {"x": 3.0, "y": -2.0, "z": 1.0}, "quadratic_drag": {"x": 0.01, "y": 0.01, "z": 0.01}},
    "suspended_load": {"suspended_load": {"mass": 0.006, "length": 0.2}},
    "load and payload": {
        "suspended_load": {"mass": 0.006, "length": 0.2},
        "payload": {"mass": 0.004, "x": 0.004, "z": -0.02},
        "linear_drag": {"x": 0.02, "y": 0.03, "z": 0.04},
    },
}


@pytest.mark.parametrize("case", CASES)
def test_host_and_simulated_drone_agree(case: str) -> None:
    effects = CASES[case]
    path = flown(effects)
    linear, angular = predicted(path, effects)
    flew = np.diff(path[1], axis=0)[SETTLED:] / 0.001, np.diff(path[3], axis=0)[SETTLED:] / 0.001
    assert np.abs(path[3]).max() < 60  # the flight is a flight
    np.testing.assert_allclose(linear, flew[0], atol=1e-3)
    np.testing.assert_allclose(angular, flew[1], atol=5e-3)
    if effects:  # and the agreement means something: without the effect there is none
        plain = predicted(path, {})
        assert np.abs(plain[0] - flew[0]).max() > 0.03 or np.abs(plain[1] - flew[1]).max() > 0.5


@pytest.mark.parametrize("angles", [(0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, -0.3), (0.4, -0.6, 2.0)])
def test_host_and_simulated_sensors_are_turned_alike(angles: tuple[float, float, float]) -> None:
    turn = dict(zip(("roll", "pitch", "yaw"), angles, strict=True))
    effects: Effects = {"attitude_misalignment": turn, "accelerometer_misalignment": turn}
    scenario = parse_scenario({"effects": effects}, "test")
    truth, state = scenario.truth(), scenario.start_state()
    body = Rotation.from_rotvec([0.5, -0.4, 1.0])
    state[at.QUAT : at.QUAT + 4] = np.roll(body.as_quat(), 1)
    position, seen = np.empty(3), np.empty(4)
    fix_pose(truth, state, np.zeros(at.SENSOR_SIZE), 0, position, seen)
    force = np.array([1.0, -2.0, 9.0])
    set_accelerometer(truth, state, np.eye(3), force)
    situation = still(rotation=body.as_matrix(), specific_force=force)
    shown = measured(situation, vehicle=VEHICLE, effects=effects)
    attitude = body * Rotation.from_rotvec(shown.state[0, 6:9])
    assert (attitude.inv() * Rotation.from_quat(np.roll(seen, -1))).magnitude() < 1e-7
    np.testing.assert_allclose(force + shown.specific_force[0], state[at.ACC : at.ACC + 3], atol=1e-12)


def test_every_effect_that_moves_the_drone_is_compared() -> None:
    compared = {name for effects in CASES.values() for name in effects}
    moving = {name for name, e in CATALOGUE.items() if e.measured is None and e.speed is None}
    assert compared == moving - {"gusts", *OF_A_DIAGNOSIS}  # no mean motion; never part of a vehicle


def test_the_simulator_flies_whatever_a_fit_may_find():
    """A fitted vehicle must not be refused by the simulator that is to fly like the drone: its bounds hold ours."""
    narrower = [
        (name, ours.name)
        for name, effect in CATALOGUE.items()
        if name not in (*OF_A_DIAGNOSIS, "onboard_filter")  # no fit puts them into a vehicle
        for ours in effect.parameters
        for theirs in EFFECTS[name].parameters
        if theirs.name == ours.name != "onset_time" and not theirs.low <= ours.low <= ours.high <= theirs.high
    ]
    assert narrower == []
