"""Controller 6 (out of tree): flatness reference and LQR on the onboard estimate, after Zhao, section IX, at 500 Hz.

t = a_d + g e3 + K_v e_v + K_p e_p;  F = m t . R e3 (eq. 11 and 83 joined: equal when the attitude follows, and without
the 1/(cos cos) of eq. 83); wanted attitude from t and yaw (flatness);
M = J u + w x J w (eq. 84), u = K [angle error, rate error, -angular acceleration]. m and J are parameters (ctrlLqg.*):
thrust and torque scale with them; the angular acceleration is modelled by rotors with lag ctrlLqg.tau.

The gains are those of discrete linear-quadratic regulators from the weights in ctrlLqg.*. Position, one axis:
x = [p, v], u = acceleration. Attitude, one axis: x = [angle, rate, angular acceleration] with the rotor lag tau between
the commanded and the actual angular acceleration. Cost: sum of q x^2 and r u^2. The onboard filter supplies the state
(certainty equivalence; eq. 79-84). Default weights: 1 m/s^2 is worth about 0.14 m; 30 rad/s^2 about 0.1 rad.
python-control gives the same gains (a test compares), but its import takes 0.8 s at every start.
"""

import math

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.attitude import (
    align,
    angles,
    desired_rate,
    desired_yaw,
    from_angles,
    position_error,
    rotation_error,
)
from firmware_sim.controllers.lee import DT, MANUAL_THRUST
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import matrix
from firmware_sim.plant.rigid_body import GRAVITY


def design(
    *,
    tau: float,
    q_pos: float,
    q_vel: float,
    r_acc: float,
    q_att: float,
    q_rate: float,
    r_ang: float,
    q_yaw: float,
    q_yawrate: float,
    r_yaw: float,
) -> np.ndarray | None:
    """[K_p 1/s^2, K_v 1/s, roll and pitch: K 1/s^2, 1/s, -, yaw: K 1/s^2, 1/s, -] (8), or None for invalid weights.

    tau: rotor lag in s; q_*: weights of the state (>= 0, those of position and angles > 0); r_*: of the input (> 0).
    """
    positive = (tau, q_pos, r_acc, q_att, r_ang, q_yaw, r_yaw)
    if not all(np.isfinite([*positive, q_vel, q_rate, q_yawrate])) or min(positive) <= 0.0:
        return None
    integrator = np.array([[0.0, 1.0], [0.0, 0.0]])
    rotor = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau]])
    try:
        gains = np.concatenate(
            [
                regulator(integrator, np.array([0.0, 1.0]), np.array([q_pos, q_vel]), r_acc),
                regulator(rotor, np.array([0.0, 0.0, 1.0 / tau]), np.array([q_att, q_rate, 0.0]), r_ang),
                regulator(rotor, np.array([0.0, 0.0, 1.0 / tau]), np.array([q_yaw, q_yawrate, 0.0]), r_yaw),
            ]
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    return gains if np.all(np.isfinite(gains)) else None


def regulator(A: np.ndarray, b: np.ndarray, q: np.ndarray, r: float) -> np.ndarray:
    """Gain K (n) of u = -K x for dx = A x + b u held over DT, cost diag(q), r."""
    n = len(b)
    M = expm(DT * np.block([[A, b[:, None]], [np.zeros((1, n + 1))]]))
    Ad, Bd = M[:n, :n], M[:n, n:]
    P = solve_discrete_are(Ad, Bd, np.diag(q), np.array([[r]]))
    return np.linalg.solve(r + Bd.T @ P @ Bd, Bd.T @ P @ Ad)[0]


@kernel
def reset(memory):
    """Set the modelled angular acceleration of the rotors to zero."""
    for i in range(3):
        memory[mem.LQG_ALPHA + i] = 0.0


@kernel
def lqg_step(setpoint, estimate, sensor, param, memory, log):
    """One controller step: writes memory[WRENCH] and the ctrlLqg.* variables."""
    memory[mem.MODE] = mem.FORCE_TORQUE_MODE
    out = mem.WRENCH
    R, D = np.empty((3, 3)), np.empty((3, 3))
    t, eR, wr, Jw, u = np.zeros(3), np.empty(3), np.zeros(3), np.empty(3), np.empty(3)
    matrix(estimate, at.E_QUAT, R)
    yaw = desired_yaw(setpoint, estimate, DT)
    mass = param[pm.LQG_MASS]
    if setpoint[sp.MODE_X] + setpoint[sp.MODE_Y] + setpoint[sp.MODE_Z] > 0.0:
        for i in range(3):
            e_pos, e_vel = position_error(setpoint, estimate, i, yaw)
            t[i] = setpoint[sp.AX + i] + memory[mem.LQG_GAIN_POS] * e_pos + memory[mem.LQG_GAIN_POS + 1] * e_vel
        limit = abs(param[pm.LQG_ACC_LIMIT])
        size = math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        if size > limit:
            for i in range(3):
                t[i] *= limit / size
        for i in range(3):
            log[lv.LQG_ACC + i] = t[i]
        t[2] += GRAVITY
        thrust = max(mass * (t[0] * R[0, 2] + t[1] * R[1, 2] + t[2] * R[2, 2]), 0.0)
        align(t, yaw, D)
    else:
        if setpoint[sp.THRUST] < 1000.0:
            for i in range(4):
                memory[out + i] = 0.0
                log[lv.LQG_OUT + i] = 0.0
            reset(memory)
            return
        thrust = setpoint[sp.THRUST] / 65535.0 * MANUAL_THRUST
        from_angles(math.radians(setpoint[sp.ROLL]), -math.radians(setpoint[sp.PITCH]), yaw, D)
    memory[out] = thrust
    rotation_error(D, R, eR)
    desired_rate(setpoint, mass, thrust, R, D, wr)
    keep = math.exp(-DT / max(param[pm.LQG_TAU], 1e-4))
    for i in range(3):
        K = mem.LQG_GAIN_YAW if i == 2 else mem.LQG_GAIN_ATT
        alpha = memory[mem.LQG_ALPHA + i]
        u[i] = -memory[K] * eR[i] - memory[K + 1] * (sensor[at.GYRO + i] - wr[i]) - memory[K + 2] * alpha
        memory[mem.LQG_ALPHA + i] = u[i] + (alpha - u[i]) * keep
        Jw[i] = param[pm.LQG_J + i] * sensor[at.GYRO + i]
        log[lv.LQG_ACC + 3 + i] = u[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        gyroscopic = sensor[at.GYRO + j] * Jw[k] - sensor[at.GYRO + k] * Jw[j]
        memory[out + 1 + i] = param[pm.LQG_J + i] * u[i] + gyroscopic
    for i in range(4):
        log[lv.LQG_OUT + i] = memory[out + i]
    roll, pitch, heading = angles(D)
    log[lv.LQG_RPYD], log[lv.LQG_RPYD + 1], log[lv.LQG_RPYD + 2] = roll, pitch, heading
