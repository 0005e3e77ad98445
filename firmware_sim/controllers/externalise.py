"""Write sensors, estimate, battery and setpoint into the log array, in the units and signs of the firmware's tables."""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import compress, matrix, roll_pitch_yaw
from firmware_sim.plant.rigid_body import GRAVITY
from firmware_sim.plant.rotors import open_circuit


@kernel
def log_estimate(sensor, estimate, P, log):
    """stateEstimate.*, stateEstimateZ.*, kalman.*, stabilizer attitude."""
    R = np.empty((3, 3))
    matrix(estimate, at.E_QUAT, R)
    q = at.E_QUAT
    for i in range(3):
        log[lv.EST + i] = estimate[at.E_POS + i]
        log[lv.EST + 3 + i] = estimate[at.E_VEL + i]
        acc, body = 0.0, 0.0
        for k in range(3):
            acc += R[i, k] * sensor[at.ACCEL + k] / GRAVITY
            body += R[k, i] * estimate[at.E_VEL + k]
        if i == 2:
            acc -= 1.0
        log[lv.EST + 6 + i] = acc
        log[lv.ESTZ + i] = math.trunc(1000.0 * estimate[at.E_POS + i])
        log[lv.ESTZ + 3 + i] = math.trunc(1000.0 * estimate[at.E_VEL + i])
        log[lv.ESTZ + 6 + i] = math.trunc(1000.0 * 9.81 * (acc + (1.0 if i == 2 else 0.0)))
        log[lv.ESTZ_RATE + i] = math.trunc(1000.0 * (-sensor[at.GYRO + 1] if i == 1 else sensor[at.GYRO + i]))
        log[lv.EST_Q + i] = estimate[q + 1 + i]
        log[lv.KALMAN + i] = estimate[at.E_POS + i]
        log[lv.KALMAN + 3 + i] = body
    log[lv.EST_Q + 3] = estimate[q]
    log[lv.ESTZ_QUAT] = compress(estimate[q], estimate[q + 1], estimate[q + 2], estimate[q + 3])
    roll, pitch, yaw = roll_pitch_yaw(estimate, q)
    for base in (lv.EST_RPY, lv.STABILIZER):
        log[base], log[base + 1], log[base + 2] = math.degrees(roll), -math.degrees(pitch), math.degrees(yaw)
    for i in range(9):
        log[lv.KALMAN + 9 + i] = P[i, i]
    for i in range(4):
        log[lv.KALMAN + 18 + i] = estimate[q + i]


@kernel
def log_inertial(sensor, log):
    """gyro.*, acc.*: without the delay of a delayed estimate."""
    for i in range(3):
        log[lv.GYRO + i] = math.degrees(sensor[at.GYRO + i])
        log[lv.ACC + i] = sensor[at.ACCEL + i] / GRAVITY


@kernel
def log_battery(sensor, log):
    """pm.*: the last voltage measured, its state (0 on battery, 3 low below 3.2 V) and the level in steps of 10 %."""
    volts = sensor[at.VBAT]
    log[lv.PM] = volts
    log[lv.PM + 1] = math.trunc(1000.0 * volts)
    log[lv.PM + 2] = 3.0 if volts < 3.2 else 0.0
    level = 0
    for step in range(1, 11):
        if volts >= open_circuit(0.1 * step) - 0.02:
            level = 10 * step
    log[lv.PM + 3] = level


# Barometer (BMP388 datasheet, 0.3 Pa rms at standard resolution, through the firmware's sampling at 50 Hz).
BARO_PERIOD = 20  # ms
BARO_NOISE = 0.025  # m
# The firmware's formula (sensors_bmi088_bmp3xx.c): asl = ((SEA_LEVEL / p)^POWER - 1) (T + 273.15) / LAPSE.
SEA_LEVEL, POWER, LAPSE = 1015.7, 0.1902630958, 0.0065  # mbar, -, K/m
TEMPERATURE = 25.0  # degC


@kernel
def log_baro(state, noise, tick, log):
    """baro.*: height above sea level (world height 0 is sea level), temperature and pressure."""
    if tick % BARO_PERIOD == 0:
        height = state[at.POS + 2] + BARO_NOISE * noise[at.N_BARO]
        log[lv.BARO] = height
        log[lv.BARO + 1] = TEMPERATURE
        log[lv.BARO + 2] = SEA_LEVEL * (1.0 + height * LAPSE / (TEMPERATURE + 273.15)) ** (-1.0 / POWER)


@kernel
def log_setpoint(setpoint, log):
    """ctrltarget.* and ctrltargetZ.* (ctrltarget.yaw is the yaw rate)."""
    for i in range(3):
        for k, source in enumerate((sp.X, sp.VX, sp.AX)):
            log[lv.TARGET + 3 * k + i] = setpoint[source + i]
            log[lv.TARGETZ + 3 * k + i] = math.trunc(1000.0 * setpoint[source + i])
    log[lv.TARGET + 9] = setpoint[sp.ROLL]
    log[lv.TARGET + 10] = setpoint[sp.PITCH]
    log[lv.TARGET + 11] = setpoint[sp.RATE_YAW]
    log[lv.TARGET + 12] = setpoint[sp.THRUST]
    for i in range(7):
        log[lv.TARGET + 13 + i] = setpoint[sp.MODE_X + i]


@kernel
def log_control(memory, param, log, union_float, union_short):
    """Values read from control_t's union: the PWM thrust in legacy mode, else torque y and half of torque x."""
    for i in range(6):
        log[lv.LEE_GAINS + i] = param[(pm.LEE_KR if i < 3 else pm.LEE_KW - 3) + i]
        log[lv.LEE_GAINS + 6 + i] = param[(pm.LEE_KP if i < 3 else pm.LEE_KD - 3) + i]
    if memory[mem.MODE] == mem.FORCE_TORQUE_MODE:
        log[lv.STABILIZER + 3] = memory[mem.WRENCH + 2]
        union_float[0] = memory[mem.WRENCH + 1]
        log[lv.PID_CTR_YAW] = union_short[0]
    else:
        log[lv.STABILIZER + 3] = memory[mem.LEGACY]
        log[lv.PID_CTR_YAW] = memory[mem.LEGACY + 3]


# Idling rotors are slower than by the thrust curve, extrapolated below the firmware's least thrust. Busetto's data
# (arXiv 2512.14450): 11 stretches at rest, duty 0.1526, 3.4 to 4.1 V, 0.47 to 0.64 of the least thrust by the curve.
IDLE_SPEED = 0.90  # share of the curve's speed; sd 0.006
IDLE_UP_TO = 0.64  # of the least thrust
RPM_UNREADABLE = 65535.0  # MOTORS_RPM_INVALID: no report yet, or one with a wrong checksum


@kernel
def log_rotor_speed(truth, board, state, noise, log):
    """motor.m*_rpm, mechanical, of speed controllers that report it: thrust = constant * (rad/s)^2, less at idle."""
    for i in range(4):
        if noise[at.N_RPM + i] > truth[at.RPM_INVALID]:
            log[lv.RPM + i] = RPM_UNREADABLE
            continue
        thrust = max(state[at.ROTOR + i], 0.0)
        share = min(max(thrust / board[at.B_THRUST_MIN], IDLE_UP_TO), 1.0)
        idle = IDLE_SPEED + (1.0 - IDLE_SPEED) * (share - IDLE_UP_TO) / (1.0 - IDLE_UP_TO)
        speed = idle * math.sqrt(thrust / truth[at.ROTOR_CONSTANT])
        log[lv.RPM + i] = min(math.trunc(truth[at.RPM_SCALE + i] * speed * 30.0 / math.pi), 65534.0)
