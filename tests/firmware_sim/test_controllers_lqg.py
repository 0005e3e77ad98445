"""The LQG's gains against python-control and the algebraic solution; what it believes scales what it does."""

import numpy as np
import pytest

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import lqg, parameters, variables
from firmware_sim.controllers.lee import lee_step
from firmware_sim.controllers.lqg import lqg_step
from firmware_sim.plant import layout as at

DEFAULTS = parameters.defaults("cf2")
WEIGHTS = {name: DEFAULTS[f"ctrlLqg.{name}"] for name in parameters.LQG_WEIGHTS}


def test_gains_are_those_of_python_control() -> None:
    import control

    tau = WEIGHTS["tau"]
    A = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / tau]])
    system = control.c2d(control.ss(A, [[0], [0], [1 / tau]], np.eye(3), np.zeros((3, 1))), lqg.DT)
    gains = lqg.design(**WEIGHTS)
    assert gains is not None
    for start, q, q_rate, r in ((2, "q_att", "q_rate", "r_ang"), (5, "q_yaw", "q_yawrate", "r_yaw")):
        K, _, poles = control.dlqr(system, np.diag([WEIGHTS[q], WEIGHTS[q_rate], 0.0]), [[WEIGHTS[r]]])
        assert gains[start : start + 3] == pytest.approx(np.asarray(K)[0], rel=1e-6)
        assert np.abs(poles).max() < 1.0


def test_position_gains_approach_the_continuous_closed_form() -> None:
    gains = lqg.design(**WEIGHTS)
    assert gains is not None
    kp = np.sqrt(WEIGHTS["q_pos"] / WEIGHTS["r_acc"])  # double integrator: k1 = sqrt(q1/r), k2 = sqrt(q2/r + 2 k1)
    assert gains[:2] == pytest.approx([kp, np.sqrt(WEIGHTS["q_vel"] / WEIGHTS["r_acc"] + 2 * kp)], rel=0.02)


@pytest.mark.parametrize("bad", [{"tau": 0.0}, {"r_acc": -1.0}, {"q_pos": float("nan")}, {"r_ang": 0.0}])
def test_senseless_weights_have_no_gains(bad: dict) -> None:
    assert lqg.design(**(WEIGHTS | bad)) is None


def one_step(step, changes: dict) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Force and torque of one controller step for a tilted, turning, displaced drone."""
    param = np.array([(DEFAULTS | changes)[name] for name in parameters.PARAMETER_NAMES])
    memory, log = np.zeros(mem.MEMORY_SIZE), np.zeros(len(variables.ALL_VARIABLES))
    memory[mem.LQG_GAIN_POS : mem.LQG_GAIN_POS + 8] = lqg.design(**WEIGHTS)
    setpoint, estimate, sensor = sp.null_setpoint(), np.zeros(at.ESTIMATE_SIZE), np.zeros(at.SENSOR_SIZE)
    setpoint[sp.MODE_X : sp.MODE_Z + 1] = setpoint[sp.MODE_YAW] = sp.ABSOLUTE
    setpoint[sp.X : sp.X + 3] = 0.1, -0.2, 0.3
    estimate[at.E_QUAT : at.E_QUAT + 4] = np.array([1.0, 0.05, -0.02, 0.1]) / np.linalg.norm([1.0, 0.05, -0.02, 0.1])
    sensor[at.GYRO : at.GYRO + 3] = 0.5, -0.3, 0.8
    step(setpoint, estimate, sensor, param, memory, log)
    return memory[mem.WRENCH : mem.WRENCH + 4].copy()


def test_thrust_and_torque_scale_with_the_beliefs() -> None:
    nominal = one_step(lqg_step, {})
    J = {f"ctrlLqg.J_{a}": 3.0 * DEFAULTS[f"ctrlLqg.J_{a}"] for a in "xyz"}
    assert one_step(lqg_step, {"ctrlLqg.mass": 0.058}) == pytest.approx(nominal * [2, 1, 1, 1], rel=1e-9)
    assert one_step(lqg_step, J) == pytest.approx(nominal * [1, 3, 3, 3], rel=1e-9)


def test_lee_takes_mass_and_hardly_inertia() -> None:
    nominal = one_step(lee_step, {})
    assert one_step(lee_step, {"ctrlLee.mass": 0.058})[0] == pytest.approx(2 * nominal[0])
    w, J = np.array([0.5, -0.3, 0.8]), np.array([DEFAULTS[f"ctrlLee.J_{a}"] for a in "xyz"])
    ten = one_step(lee_step, {f"ctrlLee.J_{a}": 10 * DEFAULTS[f"ctrlLee.J_{a}"] for a in "xyz"})
    assert ten[1:] - nominal[1:] == pytest.approx(9 * np.cross(w, J * w), rel=1e-6)


def test_lee_is_the_published_law() -> None:
    q = np.array([1.0, 0.05, -0.02, 0.1]) / np.linalg.norm([1.0, 0.05, -0.02, 0.1])
    v, w = q[1:], np.array([0.5, -0.3, 0.8])
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    R = np.eye(3) + 2 * q[0] * K + 2 * K @ K
    force = 7.0 * np.array([0.1, -0.2, 0.3]) + [0, 0, 9.81]
    z = force / np.linalg.norm(force)
    y = np.cross(z, [1, 0, 0]) / np.linalg.norm(np.cross(z, [1, 0, 0]))
    D = np.column_stack([np.cross(y, z), y, z])
    E = 0.5 * (D.T @ R - R.T @ D)
    eR = np.array([E[2, 1], E[0, 2], E[1, 0]])
    J = np.array([DEFAULTS[f"ctrlLee.J_{a}"] for a in "xyz"])
    torque = -np.array([0.007, 0.007, 0.008]) * eR - np.array([0.00115, 0.00115, 0.002]) * w - 0.03 * 0.002 * eR
    assert one_step(lee_step, {}) == pytest.approx([0.029 * force @ R[:, 2], *(torque + np.cross(w, J * w))], rel=1e-9)
