"""Controller 3, INDI (incremental nonlinear dynamic inversion), as in controller_indi.c, at 500 Hz, in PWM units.

    alpha_ref = ref_rate (ref_err (angle error) - rate);  du = (alpha_ref - d(rate_f)/dt) / g1;  u = u_f + du

rate_f and u_f pass the same low pass; u_f is the last u after the rotors' lag (act_dyn a step). g1 [rad/s^2 a unit] is
the control effectiveness: g1 too small is a loop gain too high. Yaw has g2, too: the part of the rotors' own inertia in
a step of the command (Smeur, Chu, de Croon 2016, eq. 36). Axes: x forward, y right, z down. The outer loop is in
indi_position.py. Errors of the firmware that are kept: a heading by rate mixes degrees and radians, so the heading goes
to 0 within two steps; r_pitch and r_yaw of the log are the roll rate; with outerLoopActive = 0 the position loop of PID
gives degrees where radians are read.
"""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.indi_position import butterworth, design, indi_position_step
from firmware_sim.controllers.pid import position_step, wrap
from firmware_sim.controllers.power_distribution import to_int
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import roll_pitch_yaw

RATE = 500.0  # Hz
POSITION_CUTOFF = 8.0  # Hz, POSITION_INDI_FILT_CUTOFF


@kernel
def reset(param, memory):
    """As controllerINDIInit: empty filters with their present cut-off, no command; the thrust is kept."""
    for i in range(mem.INDI_FILTERS, mem.INDI_FILTERS_END):
        memory[i] = 0.0
    design(memory, mem.INDI_TILT, param[pm.INDI_CUTOFF], RATE)
    design(memory, mem.INDI_TURN, param[pm.INDI_CUTOFF + 1], RATE)
    design(memory, mem.INDI_PLACE, POSITION_CUTOFF, RATE)
    for i in range(3):
        memory[mem.INDI_ACT + i] = 0.0
        memory[mem.INDI_U + i] = 0.0


@kernel
def indi_step(setpoint, estimate, sensor, param, memory, log, tick):
    """One controller step: writes memory[LEGACY] and the ctrlINDI.* and posCtrlIndi.* variables."""
    memory[mem.MODE] = mem.LEGACY_MODE
    angle, rate, wanted, slope = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    roll, pitch, yaw = roll_pitch_yaw(estimate, at.E_QUAT)
    angle[0], angle[1], angle[2] = roll, -pitch, -yaw
    rate[0], rate[1], rate[2] = sensor[at.GYRO], -sensor[at.GYRO + 1], -sensor[at.GYRO + 2]
    attitude_setpoint(setpoint, estimate, sensor, angle, param, memory, log, tick)
    for i in range(3):
        goal = param[pm.INDI_ERR + i] * (memory[mem.INDI_ATTITUDE + i] - angle[i])
        if i < 2 and setpoint[sp.MODE_ROLL + i] == sp.VELOCITY:
            goal = math.radians(setpoint[sp.RATE_ROLL + i])
        wanted[i] = param[pm.INDI_ERR + 3 + i] * (goal - rate[i])
        kind = mem.INDI_TURN if i == 2 else mem.INDI_TILT
        before = memory[mem.INDI_RATE + 4 * i + 2]
        slope[i] = (butterworth(memory, kind, mem.INDI_RATE + 4 * i, rate[i]) - before) * RATE
        passed = butterworth(memory, kind, mem.INDI_PASSED + 4 * i, memory[mem.INDI_ACT + i])
        if i < 2:
            du = (wanted[i] - slope[i]) / param[pm.INDI_G1 + i]
        else:
            g2 = param[pm.INDI_G1 + 3]
            du = (wanted[2] - slope[2] + g2 * memory[mem.INDI_DU + 2]) / (param[pm.INDI_G1 + 2] + g2)
        bound = param[pm.INDI_BOUND]
        u = min(max(passed + du, -bound), bound)
        memory[mem.INDI_DU + i] = du
        memory[mem.INDI_U + i] = u
        memory[mem.INDI_ACT + i] += param[pm.INDI_ACT_DYN + i] * (u - memory[mem.INDI_ACT + i])
    thrust = memory[mem.INDI_THRUST]
    if thrust < param[pm.INDI_THRESHOLD]:  # else the commands would grow without end on the floor
        for i in range(3):
            wanted[i] = 0.0
            memory[mem.INDI_ACT + i] = 0.0
            memory[mem.INDI_U + i] = 0.0
        if thrust == 0.0:
            memory[mem.INDI_ATTITUDE + 2] = -math.degrees(yaw)
    memory[mem.LEGACY] = thrust
    for i in range(3):
        memory[mem.LEGACY + 1 + i] = to_int(memory[mem.INDI_U + i])  # control_t has 16-bit integers
    log_indi(rate, wanted, slope, memory, log)


@kernel
def attitude_setpoint(setpoint, estimate, sensor, angle, param, memory, log, tick):
    """The wanted roll, pitch, yaw [rad] into INDI_ATTITUDE and the thrust into INDI_THRUST."""
    a = mem.INDI_ATTITUDE
    if setpoint[sp.MODE_YAW] == sp.VELOCITY:
        memory[a + 2] = math.radians(wrap(memory[a + 2] + setpoint[sp.RATE_YAW] / RATE))
    else:
        memory[a + 2] = -math.radians(wrap(setpoint[sp.YAW]))
    outer = param[pm.INDI_OUTER] > 0.0
    if not outer and tick % 10 == 0:
        position_step(setpoint, estimate, -angle[2], param, memory, log)
        memory[mem.INDI_THRUST] = memory[mem.PID_THRUST]
        memory[a], memory[a + 1] = memory[mem.PID_ATTITUDE], memory[mem.PID_ATTITUDE + 1]
    if outer:
        indi_position_step(setpoint, estimate, sensor, angle, param, memory, log)
    if setpoint[sp.MODE_Z] == sp.DISABLE:
        memory[mem.INDI_THRUST] = setpoint[sp.THRUST]
    elif outer:
        memory[mem.INDI_THRUST] = memory[mem.INDI_LIFT]
    for i in range(2):
        if setpoint[sp.MODE_X + i] == sp.DISABLE:
            memory[a + i] = math.radians(setpoint[sp.ROLL + i])
        elif outer:
            memory[a + i] = memory[mem.INDI_TILTS + i]


@kernel
def log_indi(rate, wanted, slope, memory, log):
    """ctrlINDI.*: commands [PWM units], rates [rad/s] and accelerations [rad/s^2] in x forward, y right, z down."""
    log[lv.INDI] = memory[mem.INDI_THRUST]
    for i in range(3):
        log[lv.INDI + 1 + i] = memory[mem.INDI_U + i]
        log[lv.INDI + 4 + i] = rate[0]
        log[lv.INDI + 7 + i] = memory[mem.INDI_ACT + i]
        log[lv.INDI + 10 + i] = memory[mem.INDI_DU + i]
        log[lv.INDI + 13 + i] = wanted[i]
        log[lv.INDI + 16 + i] = slope[i]
        log[lv.INDI + 19 + i] = memory[mem.INDI_PASSED + 4 * i + 2]
        log[lv.INDI + 22 + i] = memory[mem.INDI_RATE + 4 * i + 2]
        log[lv.INDI + 25 + i] = memory[mem.INDI_ATTITUDE + i]
