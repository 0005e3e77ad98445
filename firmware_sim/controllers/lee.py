"""Controller 5, Lee's geometric tracking controller as in controller_lee.c, at 500 Hz. Thrust in N, torque in N m.

F_d = a_d + g e3 + Kd e_v + Kp e_p + Ki int e_p;  thrust = mass F_d . R e3
M = -KR e_R - Kw (w - w_r) - KI int e_R + w x J w, with w_r from the setpoint's jerk and yaw rate.
It controls positions only. If one axis is under position control, all three are: a hover setpoint has velocities along
x and y and positions 0 there, so it pulls towards the origin. Without such an axis the thrust is the setpoint's, 0
unless manual. One difference: without a position, it follows the attitude setpoint (the firmware keeps an old one).
"""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.attitude import (
    align,
    angles,
    any_absolute,
    desired_rate,
    desired_yaw,
    from_angles,
    rotation_error,
)
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import matrix, roll_pitch_yaw
from firmware_sim.plant.rigid_body import GRAVITY

DT = 0.002  # s
MANUAL_THRUST = 0.07 * 9.81  # N at full stick (70 g, controller_lee.c)


@kernel
def reset(memory):
    """Forget both integrals."""
    for i in range(3):
        memory[mem.LEE_I_POS + i] = 0.0
        memory[mem.LEE_I_ATT + i] = 0.0


@kernel
def log_step(estimate, D, memory, log):
    """Write wrench, actual and desired roll, pitch and yaw into the ctrlLee.* variables."""
    for i in range(4):
        log[lv.LEE_OUT + i] = memory[mem.WRENCH + i]
    roll, pitch, heading = roll_pitch_yaw(estimate, at.E_QUAT)
    log[lv.LEE_RPY], log[lv.LEE_RPY + 1], log[lv.LEE_RPY + 2] = roll, pitch, heading
    roll, pitch, heading = angles(D)
    log[lv.LEE_RPY + 3], log[lv.LEE_RPY + 4], log[lv.LEE_RPY + 5] = roll, pitch, heading


@kernel
def lee_step(setpoint, estimate, sensor, param, memory, log):
    """One controller step: writes memory[WRENCH] and the ctrlLee.* variables."""
    memory[mem.MODE] = mem.FORCE_TORQUE_MODE
    out = mem.WRENCH
    R, D = np.empty((3, 3)), np.empty((3, 3))
    force, eR, w, wr = np.zeros(3), np.empty(3), np.empty(3), np.zeros(3)
    matrix(estimate, at.E_QUAT, R)
    yaw = desired_yaw(setpoint, estimate, DT)
    if any_absolute(setpoint):
        for i in range(3):
            limit = abs(param[pm.LEE_KP_LIMIT])
            e_pos = min(max(setpoint[sp.X + i] - estimate[at.E_POS + i], -limit), limit)
            limit = abs(param[pm.LEE_KD_LIMIT])
            e_vel = min(max(setpoint[sp.VX + i] - estimate[at.E_VEL + i], -limit), limit)
            limit = abs(param[pm.LEE_KPI_LIMIT])
            memory[mem.LEE_I_POS + i] = min(max(memory[mem.LEE_I_POS + i] + DT * e_pos, -limit), limit)
            force[i] = (
                setpoint[sp.AX + i]
                + param[pm.LEE_KD + i] * e_vel
                + param[pm.LEE_KP + i] * e_pos
                + param[pm.LEE_KPI + i] * memory[mem.LEE_I_POS + i]
            )
            log[lv.LEE_ERROR + i] = e_pos
            log[lv.LEE_ERROR + 3 + i] = e_vel
        force[2] += GRAVITY
        thrust = param[pm.LEE_MASS] * (force[0] * R[0, 2] + force[1] * R[1, 2] + force[2] * R[2, 2])
        if thrust < 0.01:
            reset(memory)
        if thrust <= 0.0:
            force[0], force[1], force[2] = 0.0, 0.0, 1.0
        align(force, yaw, D)
    else:
        if setpoint[sp.THRUST] < 1000.0:
            for i in range(4):
                memory[out + i] = 0.0
                log[lv.LEE_OUT + i] = 0.0
            reset(memory)
            return
        thrust = setpoint[sp.THRUST] / 65535.0 * MANUAL_THRUST
        from_angles(math.radians(setpoint[sp.ROLL]), -math.radians(setpoint[sp.PITCH]), yaw, D)
    memory[out] = thrust
    rotation_error(D, R, eR)
    desired_rate(setpoint, param[pm.LEE_MASS], thrust, R, D, wr)
    J = pm.LEE_J
    for i in range(3):
        w[i] = sensor[at.GYRO + i]
        memory[mem.LEE_I_ATT + i] += DT * eR[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        gyroscopic = w[j] * param[J + k] * w[k] - w[k] * param[J + j] * w[j]
        memory[out + 1 + i] = (
            -param[pm.LEE_KR + i] * eR[i]
            - param[pm.LEE_KW + i] * (w[i] - wr[i])
            - param[pm.LEE_KI + i] * memory[mem.LEE_I_ATT + i]
            + gyroscopic
        )
        log[lv.LEE_OMEGA + i] = w[i]
        log[lv.LEE_OMEGA + 3 + i] = wr[i]
    log_step(estimate, D, memory, log)
