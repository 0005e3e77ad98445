"""Controller 2, Mellinger's as in controller_mellinger.c, at 500 Hz, in the firmware's PWM units (legacy mixer).

F_des = mass (a_d + g e3) + kp e_p + kd e_v + ki int e_p;  thrust = massThrust F_des . R e3
M = -kR vee(D'R - R'D) + kw e_w + ki_m int + kd_omega d(e_w)/dt, pitch inverted for the mixer. The mixer's scale is
65535 = THRUST_MAX a motor, so ctrlMel.mass is only a mass if massThrust fits the platform.
It controls positions and, with the setpoint's thrust, attitudes. Any other setpoint (velocities, levelling out after
a timeout) is a hover at the setpoint's height: level, with the present yaw, without feedforward.
"""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.attitude import align, desired_yaw, from_angles, rotation_error
from firmware_sim.controllers.power_distribution import to_int
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import matrix, roll_pitch_yaw
from firmware_sim.plant.rigid_body import GRAVITY

DT = 0.002  # s
LIMIT = 32000.0  # PWM units of roll, pitch and yaw


@kernel
def reset(memory):
    """Forget the integrals."""
    for i in range(3):
        memory[mem.MEL_I_POS + i] = 0.0
        memory[mem.MEL_I_ATT + i] = 0.0


@kernel
def clamp(value, limit):
    """value within +-|limit|."""
    return min(max(value, -abs(limit)), abs(limit))


@kernel
def mellinger_step(setpoint, estimate, sensor, param, memory, log):
    """One controller step: writes memory[LEGACY] and the ctrlMel.* variables."""
    memory[mem.MODE] = mem.LEGACY_MODE
    R, D = np.empty((3, 3)), np.empty((3, 3))
    force, eR, M = np.zeros(3), np.empty(3), np.empty(3)
    matrix(estimate, at.E_QUAT, R)
    yaw = desired_yaw(setpoint, estimate, DT)
    thrust = setpoint[sp.THRUST]
    place = setpoint[sp.MODE_X] == sp.ABSOLUTE
    tilt = setpoint[sp.MODE_ROLL] == sp.ABSOLUTE and setpoint[sp.MODE_PITCH] == sp.ABSOLUTE
    mass = param[pm.MEL_MASS]
    for i in range(3):
        g = pm.MEL_Z if i == 2 else pm.MEL_XY  # kp, kd, ki, range
        e_pos = setpoint[sp.X + i] - estimate[at.E_POS + i]
        e_vel = setpoint[sp.VX + i] - estimate[at.E_VEL + i]
        held = clamp(memory[mem.MEL_I_POS + i] + DT * e_pos, param[g + 3])
        memory[mem.MEL_I_POS + i] = held
        if place or i == 2:
            force[i] = param[g] * e_pos + param[g + 1] * e_vel + param[g + 2] * held
        if place:
            force[i] += mass * setpoint[sp.AX + i]
    force[2] += mass * GRAVITY
    if not place and tilt and setpoint[sp.MODE_Z] == sp.DISABLE:
        from_angles(math.radians(setpoint[sp.ROLL]), -math.radians(setpoint[sp.PITCH]), yaw, D)
    else:
        if not place:
            _, _, yaw = roll_pitch_yaw(estimate, at.E_QUAT)
        align(force, yaw, D)
    if setpoint[sp.MODE_Z] != sp.DISABLE:
        thrust = param[pm.MEL_MASS_THRUST] * (force[0] * R[0, 2] + force[1] * R[1, 2] + force[2] * R[2, 2])
    rotation_error(D, R, eR)
    for i in range(3):
        kR, kw, ki = param[pm.MEL_KR + i // 2], param[pm.MEL_KW + i // 2], param[pm.MEL_KI_M + i // 2]
        rate = sensor[at.GYRO + i]
        error = math.radians(setpoint[sp.RATE_ROLL + i]) - rate
        change = (error - memory[mem.MEL_PREV + i]) / DT if i < 2 else 0.0
        memory[mem.MEL_PREV + i] = error
        held = clamp(memory[mem.MEL_I_ATT + i] - 2.0 * DT * eR[i], param[pm.MEL_RANGE_M + i // 2])
        memory[mem.MEL_I_ATT + i] = held
        M[i] = -2.0 * kR * eR[i] + kw * error + ki * held + param[pm.MEL_KD_OMEGA] * change
        log[lv.MEL + 4 + i] = -rate if i == 1 else rate
        log[lv.MEL + 8 + i] = D[i, 2]
    out = mem.LEGACY
    memory[out] = thrust
    memory[out + 1] = to_int(clamp(M[0], LIMIT))  # control_t has 16-bit integers
    memory[out + 2] = to_int(clamp(-M[1], LIMIT))
    memory[out + 3] = to_int(clamp(-M[2], LIMIT))
    if not thrust > 0.0:
        for i in range(4):
            memory[out + i] = 0.0
        reset(memory)
    for i in range(4):
        log[lv.MEL + i] = memory[out + i]
    for i in range(3):
        log[lv.MEL + 11 + i] = memory[mem.MEL_I_POS + i]
    log[lv.MEL + 7] = sensor[at.ACCEL + 2] / GRAVITY
