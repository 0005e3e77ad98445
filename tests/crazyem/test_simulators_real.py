"""Real simulators, fed our files: 0.5 s open loop from a hundred starts, against crazyem's own prediction, within 2 %.

crazyflow, rotorpy, MuJoCo and PyBullet are run where they are installed (extra `bench`). Gazebo, PX4 SIH and l2f are
not run: their published equations are integrated here, with the numbers read from the file by this test.
"""

import importlib.util
import json
import math
import os
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.physics.rotors import wrench
from crazyem.simulators.convert import HORIZON, STEP, Conversion, Reference, convert, flown, reference_flight
from crazyem.vehicle import Vehicle

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # of other people's simulators
]
Array = NDArray[np.float64]
WITHIN = 0.02
SUB = 5  # steps of a simulator per command of 10 ms
RPM = 60.0 / (2.0 * math.pi)
DRONE = Vehicle(
    "drone", 0.034, (1.7e-5, 1.8e-5, 3.0e-5), inertia_products=(4e-7, -3e-7, 2e-7), arm=(0.0325, 0.0325),
    rotor_constant=2.2e-8, torque_per_thrust=0.006, motor_time_constant=0.04, thrust_max=0.2,
    effects={"linear_drag": {"x": 0.012, "y": 0.012, "z": 0.012}},
)  # fmt: skip
State = tuple[Array, Array, Array, Array, Array]  # position, velocity, attitude x y z w, rate, rotors: all (n, ...)


def case(form: str, **changes: Any) -> tuple[Conversion, Vehicle, Reference, Array]:
    """A file, the vehicle that it says, the reference flight, and (n, k, 4) thrusts commanded after each start [N]."""
    vehicle = replace(DRONE, **changes)
    suffix = ".json" if form == "rotorpy" else ""
    made = convert(vehicle, form, suffix=suffix, costs=False)
    reference = reference_flight(vehicle)
    rows = np.searchsorted(reference.inputs.rotor.time, reference.times[:, :-1] + 1e-6) - 1
    return made, made.held, reference, reference.inputs.rotor.thrust[rows]


def at_start(reference: Reference, lag: float) -> Array:
    """(n, 4) thrusts of the rotors at each start, by the exact answer of a first-order lag to held commands."""
    rotor = reference.inputs.rotor
    if lag <= 0.0:
        return rotor.thrust[np.searchsorted(rotor.time, reference.times[:, 0] + 1e-6) - 1]
    share, now, found = math.exp(-STEP / lag), rotor.thrust[0], []
    for command in rotor.thrust:
        found.append(now)
        now = command + (now - command) * share
    return np.array(found)[np.searchsorted(rotor.time, reference.times[:, 0] + 1e-6) - 1]


def compare(reference: Reference, held: Vehicle, theirs: Array) -> dict[str, float]:
    """Distance from crazyem's prediction over the motion, by quantity; theirs (n, 13)."""
    ours, start = flown(reference, held)[:, -1], reference.state
    assert reference.times[0, -1] - reference.times[0, 0] == pytest.approx(HORIZON)
    drift = start[:, 0:3] + HORIZON * start[:, 3:6]  # what any model knows of the position

    def size(values: Array) -> float:
        return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))

    def turn(a: Array, b: Array) -> float:
        return size((Rotation.from_quat(a).inv() * Rotation.from_quat(b)).as_rotvec())

    return {
        "position": size(theirs[:, :3] - ours[:, :3]) / size(ours[:, :3] - drift),
        "velocity": size(theirs[:, 3:6] - ours[:, 3:6]) / size(ours[:, 3:6] - start[:, 3:6]),
        "attitude": turn(ours[:, 6:10], theirs[:, 6:10]) / turn(start[:, 6:10], ours[:, 6:10]),
        "body_rate": size(theirs[:, 10:] - ours[:, 10:]) / size(ours[:, 10:] - start[:, 10:]),
    }


def within(shares: dict[str, float]) -> None:
    assert max(shares.values()) < WITHIN, {q: round(v, 4) for q, v in shares.items()}


def integrated(
    reference: Reference, derivative: Callable[[State, Array], State], rotors: Array, commands: Array
) -> Array:
    """(n, 13) after the commands, by the classical Runge-Kutta method."""
    s = reference.state
    state: State = (s[:, :3], s[:, 3:6], s[:, 6:10], s[:, 10:13], rotors)
    h = STEP / SUB

    def moved(d: State, by: float) -> State:
        q = Rotation.from_quat(state[2]) * Rotation.from_rotvec(by * d[2])
        return (state[0] + by * d[0], state[1] + by * d[1], q.as_quat(), state[3] + by * d[3], state[4] + by * d[4])

    for k in range(commands.shape[1]):
        for _ in range(SUB):
            a = derivative(state, commands[:, k])
            b = derivative(moved(a, h / 2), commands[:, k])
            c = derivative(moved(b, h / 2), commands[:, k])
            d = derivative(moved(c, h), commands[:, k])
            mean = tuple((w + 2 * x + 2 * y + z) / 6 for w, x, y, z in zip(a, b, c, d, strict=True))
            state = moved(mean, h)  # type: ignore[arg-type]
    return np.concatenate(state[:4], axis=1)


def rigid(state: State, force: Array, torque: Array, mass: float, inertia: Array, rotors: Array) -> State:
    """Newton and Euler: force in the body frame without gravity, torque about the centre of mass."""
    _, v, q, w, _ = state
    acceleration = Rotation.from_quat(q).apply(force) / mass - np.array([0.0, 0.0, 9.81])
    turning = np.linalg.solve(inertia, (torque - np.cross(w, w @ inertia.T)).T).T
    return v, acceleration, w, turning, rotors


def test_rotorpy() -> None:
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor", reason="rotorpy is not installed (extra bench)")
    made, held, reference, commands = case("rotorpy")
    parameters = json.loads(made.text)
    parameters["rotor_pos"] = {k: np.array(v) for k, v in parameters["rotor_pos"].items()}
    parameters["rotor_directions"] = np.array(parameters["rotor_directions"])
    simulator = multirotor.Multirotor(parameters)
    order = [3, 0, 1, 2]  # rotorpy's r1 is front left, ours 1 front right
    kf = parameters["k_eta"]
    begin, speeds = np.sqrt(at_start(reference, DRONE.motor_time_constant) / kf), np.sqrt(commands / kf)
    ends = []
    for n in range(0, len(reference.state), 5):  # twenty starts: its integrator takes its time
        s = reference.state[n]
        state = {
            "x": s[:3], "v": s[3:6], "q": s[6:10], "w": s[10:], "wind": np.zeros(3), "rotor_speeds": begin[n][order],
        }  # fmt: skip
        for command in speeds[n]:
            state = simulator.step(state, {"cmd_motor_speeds": command[order]}, STEP)
        ends.append(np.concatenate([state["x"], state["v"], state["q"], state["w"]]))
    rows = slice(0, None, 5)
    some = replace(reference, state=reference.state[rows], times=reference.times[rows])
    within(compare(some, held, np.array(ends)))


def test_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (extra bench)")
    centre = {"center_of_mass": {"x": 0.001, "y": -0.0005, "z": -0.004}}
    made, held, reference, commands = case("mujoco", motor_time_constant=0.0, effects=centre)
    assert held.effects["center_of_mass"] == pytest.approx(centre["center_of_mass"])
    model = mujoco.MjModel.from_xml_string(made.text)
    data = mujoco.MjData(model)
    ends = []
    for s, thrusts in zip(reference.state, commands, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = [*s[:3], s[9], *s[6:9]]
        data.qvel[:] = s[[3, 4, 5, 10, 11, 12]]
        for thrust in thrusts:
            data.ctrl[:] = wrench(thrust, arm=DRONE.arm, torque_per_thrust=DRONE.torque_per_thrust)
            for _ in range(SUB):
                mujoco.mj_step(model, data)
        q = data.qpos
        ends.append([*q[:3], *data.qvel[:3], *q[4:7], q[3], *data.qvel[3:6]])
    within(compare(reference, held, np.array(ends)))


def test_gym_pybullet_drones(tmp_path: Path) -> None:
    """PyBullet with forces and torques as gym-pybullet-drones applies them (BaseAviary: _physics, _drag)."""
    bullet = pytest.importorskip("pybullet", reason="pybullet is not installed (extra bench)")
    made, held, reference, commands = case("gym-pybullet-drones", motor_time_constant=0.0)
    path = tmp_path / "cf2x.urdf"
    path.write_text(made.text)
    properties = ET.fromstring(made.text).find("properties")
    assert properties is not None
    kf, km, drag_xy, drag_z = (float(properties.attrib[k]) for k in ("kf", "km", "drag_coeff_xy", "drag_coeff_z"))
    client = bullet.connect(bullet.DIRECT)
    try:
        bullet.setGravity(0, 0, -9.81)
        bullet.setTimeStep(STEP / SUB)
        drone = bullet.loadURDF(str(path), flags=bullet.URDF_USE_INERTIA_FROM_FILE)
        for link in range(-1, bullet.getNumJoints(drone)):
            bullet.changeDynamics(drone, link, linearDamping=0, angularDamping=0)
        ends = []
        for s, thrusts in zip(reference.state, commands, strict=True):
            turn = Rotation.from_quat(s[6:10])
            bullet.resetBasePositionAndOrientation(drone, s[:3], s[6:10])
            bullet.resetBaseVelocity(drone, s[3:6], turn.apply(s[10:]))
            for rpm in np.sqrt(thrusts / kf):
                for _ in range(SUB):
                    for k in range(4):
                        bullet.applyExternalForce(drone, k, [0, 0, kf * rpm[k] ** 2], [0, 0, 0], bullet.LINK_FRAME)
                    yaw = km * (-(rpm[0] ** 2) + rpm[1] ** 2 - rpm[2] ** 2 + rpm[3] ** 2)
                    bullet.applyExternalTorque(drone, 4, [0, 0, yaw], bullet.LINK_FRAME)
                    velocity = np.array(bullet.getBaseVelocity(drone)[0])
                    body = Rotation.from_quat(bullet.getBasePositionAndOrientation(drone)[1])
                    drag = (
                        -np.array([drag_xy, drag_xy, drag_z])
                        * np.sum(2 * np.pi * rpm / 60)
                        * body.inv().apply(velocity)
                    )
                    bullet.applyExternalForce(drone, 4, drag, [0, 0, 0], bullet.LINK_FRAME)
                    bullet.stepSimulation()
            position, attitude = bullet.getBasePositionAndOrientation(drone)
            velocity, rate = bullet.getBaseVelocity(drone)
            ends.append([*position, *velocity, *attitude, *Rotation.from_quat(attitude).inv().apply(rate)])
    finally:
        bullet.disconnect(client)
    within(compare(reference, held, np.array(ends)))


def test_crazyflow() -> None:
    """crazyflow's first-principles dynamics, by the Runge-Kutta method that it has as well."""
    if importlib.util.find_spec("crazyflow") is None:
        pytest.skip("crazyflow is not installed (extra bench)")
    if "SCIPY_ARRAY_API" not in os.environ:  # crazyflow asks for this before anybody imports scipy
        words = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-m", "slow", f"{__file__}::test_crazyflow"]
        run = subprocess.run(
            words, env={**os.environ, "SCIPY_ARRAY_API": "1"}, capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stdout
        return
    module = importlib.import_module("crazyflow.dynamics.first_principles.dynamics")
    made, held, reference, commands = case("crazyflow")
    table = tomllib.loads(made.text)["drone"]
    parameters = {k: np.array(v) for k, v in table.items() if k not in ("thrust_min", "thrust_max")}
    parameters["J_inv"] = np.linalg.inv(parameters["J"])
    kf = parameters["rpm2thrust"][2]

    def derivative(state: State, command: Array) -> State:
        x, v, q, w, rotors = state
        _, _, acceleration, turning, rates = module.dynamics(
            x, q, v, w, np.sqrt(command / kf), rotors, gravity_vec=np.array([0.0, 0.0, -9.81]), **parameters
        )
        return v, acceleration, w, turning, rates

    begin = np.sqrt(at_start(reference, DRONE.motor_time_constant) / kf)
    within(compare(reference, held, integrated(reference, derivative, begin, commands)))


CORNERS = np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])  # front right, and then clockwise
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])


def rotor_wrench(thrust: Array, places: Array, ratio: float) -> tuple[Array, Array]:
    force = np.zeros((len(thrust), 3))
    force[:, 2] = thrust.sum(1)
    return force, np.stack([thrust @ places[:, 1], -thrust @ places[:, 0], ratio * thrust @ SPIN], axis=1)


def matrix_of(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> Array:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_px4_sih_by_its_formula() -> None:
    """simulator_sih/sih.cpp: linear thrust with a first-order lag, one drag, one damping; here in FLU."""
    made, held, reference, commands = case("px4-sih")
    p = {m[1]: float(m[2]) for m in re.finditer(r"param set-default (\w+) (\S+)", made.text)}
    inertia = matrix_of(*(p[f"SIH_I{a}"] for a in ("XX", "YY", "ZZ", "XY", "XZ", "YZ")))
    flip = np.diag([1.0, -1.0, -1.0])  # FRD to FLU
    inertia = flip @ inertia @ flip
    places = CORNERS * [p["SIH_L_PITCH"], p["SIH_L_ROLL"]]

    def derivative(state: State, command: Array) -> State:
        _, v, q, w, u = state
        force, torque = rotor_wrench(p["SIH_T_MAX"] * u, places, p["SIH_Q_MAX"] / p["SIH_T_MAX"])
        force = force - p["SIH_KDV"] * Rotation.from_quat(q).inv().apply(v)
        du = (command / p["SIH_T_MAX"] - u) / p["SIH_T_TAU"]
        return rigid(state, force, torque - p["SIH_KDW"] * w, p["SIH_MASS"], inertia, du)

    begin = at_start(reference, DRONE.motor_time_constant) / p["SIH_T_MAX"]
    within(compare(reference, held, integrated(reference, derivative, begin, commands)))


def test_gazebo_by_its_formula() -> None:
    """MulticopterMotorModel: thrust by squared speed, drag by rotor speed across the rotor's axis, lag of the speed."""
    made, held, reference, commands = case("gazebo", effects={"linear_drag": {"x": 0.012, "y": 0.012, "z": 0.0}})
    root = ET.fromstring(made.text)
    body = root.find(".//link[@name='body']/inertial")
    motor = root.find(".//plugin")
    assert body is not None
    assert motor is not None
    mass = sum(float(m.text or 0) for m in root.iter("mass"))
    moments = body.find("inertia")
    assert moments is not None
    inertia = matrix_of(*(float(moments.findtext(f"i{a}") or 0) for a in ("xx", "yy", "zz", "xy", "xz", "yz")))
    poses = [[float(x) for x in (link.findtext("pose") or "").split()[:2]] for link in root.iter("link")][1:]
    for x, y in poses:  # propellers of a milligram
        inertia += 1e-6 * np.array([[y * y, -x * y, 0], [-x * y, x * x, 0], [0, 0, x * x + y * y]])
    kf, ratio, up, drag = (
        float(motor.findtext(k) or 0)
        for k in ("motorConstant", "momentConstant", "timeConstantUp", "rotorDragCoefficient")
    )

    def derivative(state: State, command: Array) -> State:
        _, v, q, _, speed = state
        force, torque = rotor_wrench(kf * speed**2, np.array(poses), ratio)
        across = Rotation.from_quat(q).inv().apply(v) * [1.0, 1.0, 0.0]
        force = force - drag * speed.sum(1)[:, None] * across
        return rigid(state, force, torque, mass, inertia, (np.sqrt(command / kf) - speed) / up)

    begin = np.sqrt(at_start(reference, DRONE.motor_time_constant) / kf)
    within(compare(reference, held, integrated(reference, derivative, begin, commands)))


def test_l2f_by_its_formula() -> None:
    """rl_tools' multirotor dynamics: rotors answer in the normalised command, thrust is a polynomial in it."""
    made, held, reference, commands = case("l2f", effects={})
    p = json.loads(made.text)["dynamics"]
    law, places = np.array(p["rotor_thrust_coefficients"][0]), np.array(p["rotor_positions"])
    inertia, ratio = np.array(p["J"]), p["rotor_torque_constants"][0]
    assert np.allclose(np.array(p["J_inv"]) @ inertia, np.eye(3), atol=1e-9)

    def derivative(state: State, command: Array) -> State:
        u = state[4]
        force, torque = rotor_wrench(law[0] + law[1] * u + law[2] * u**2, places, ratio)
        du = (np.sqrt(command / law[2]) - u) / p["rotor_time_constants_rising"][0]
        return rigid(state, force, torque, p["mass"], inertia, du)

    begin = np.sqrt(at_start(reference, DRONE.motor_time_constant) / law[2])
    within(compare(reference, held, integrated(reference, derivative, begin, commands)))
