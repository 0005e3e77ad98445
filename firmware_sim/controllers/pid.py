"""Controller 1, the default cascaded PID: position and velocity at 100 Hz, attitude and rate at 500 Hz.

controller_pid.c, position_controller_pid.c, attitude_pid_controller.c and pid.c; degrees, legacy pitch (nose up
positive), output in PWM units for the legacy mixer. It uses neither mass nor inertia.
"""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.attitude import desired_yaw
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import roll_pitch_yaw
from firmware_sim.plant.rigid_body import GRAVITY
from firmware_sim.plant.sensors import low_pass

# The twelve regulators, each with four memories (integral, previous measurement, derivative filter) and four gains.
ATTITUDE, RATE, POSITION, VELOCITY = 0, 3, 6, 9
INTEGRAL_LIMIT = np.array([20.0, 20.0, 360.0, 33.3, 33.3, 166.7] + [5000.0] * 6)
SLOW, FAST = 0.01, 0.002  # s
OVERHEAD = 1.1  # output limits over the nominal ones


@kernel
def wrap(angle):
    """Angle in degrees to -180..180."""
    return angle - 360.0 * math.floor((angle + 180.0) / 360.0)


@kernel
def regulate(k, desired, measured, dt, limit, circular, cutoff, param, memory, log):
    """One update of regulator k. limit of the output and cutoff [Hz] of the derivative: 0 for none; circular: deg."""
    m, g = mem.PID_STATE + 4 * k, pm.PID_GAINS + 4 * k
    error, change = desired - measured, measured - memory[m + 1]
    if circular:
        error, change = wrap(error), wrap(change)
    memory[m + 1] = measured
    slope = -change / dt
    if cutoff > 0.0:
        slope = low_pass(memory, m + 2, slope, min(cutoff * dt * 1000.0, 450.0))
    memory[m] = min(max(memory[m] + error * dt, -INTEGRAL_LIMIT[k]), INTEGRAL_LIMIT[k])
    parts = (param[g] * error, param[g + 1] * memory[m], param[g + 2] * slope, param[g + 3] * desired)
    total = 0.0
    for i in range(4):
        log[lv.PID_PARTS + 4 * k + i] = parts[i]
        total += parts[i]
    if limit > 0.0:
        total = min(max(total, -limit), limit)
    return total


@kernel
def reset(estimate, memory):
    """Clear integrals and hold the present heading."""
    clear_integrals(estimate, memory)
    memory[mem.PID_ATTITUDE + 2] = angles(estimate)[2]


@kernel
def clear_integrals(estimate, memory):
    """Clear integrals; derivatives start from the present measurement. The heading to hold stays."""
    roll, pitch, yaw = angles(estimate)
    measured = (roll, pitch, yaw, 0.0, 0.0, 0.0)
    for k in range(12):
        m = mem.PID_STATE + 4 * k
        memory[m] = memory[m + 1] = memory[m + 2] = memory[m + 3] = 0.0
        if k < 6:
            memory[m + 1] = measured[k]
    memory[mem.PID_ATTITUDE], memory[mem.PID_ATTITUDE + 1] = roll, pitch


@kernel
def angles(estimate):
    """Roll, pitch (legacy sign) and yaw in degrees of the estimate."""
    roll, pitch, yaw = roll_pitch_yaw(estimate, at.E_QUAT)
    return math.degrees(roll), -math.degrees(pitch), math.degrees(yaw)


@kernel
def pid_step(setpoint, estimate, sensor, param, memory, log, tick):
    """One controller step (500 Hz): writes memory[LEGACY] and controller.*, pid_*.*, posCtl.*."""
    memory[mem.MODE] = mem.LEGACY_MODE
    changed = False
    for i in range(7):
        changed = changed or memory[mem.PID_MODES + i] != setpoint[i]
        memory[mem.PID_MODES + i] = setpoint[i]
    if changed:
        clear_integrals(estimate, memory)
    a = mem.PID_ATTITUDE
    roll, pitch, yaw = angles(estimate)
    if setpoint[sp.MODE_YAW] == sp.VELOCITY:
        goal = wrap(memory[a + 2] + setpoint[sp.RATE_YAW] * FAST)
        lead = abs(param[pm.PID_YAW_LEAD])
        if lead > 0.0:
            goal = yaw + min(max(wrap(goal - yaw), -lead), lead)
        memory[a + 2] = wrap(goal)
    elif setpoint[sp.MODE_YAW] == sp.ABSOLUTE or setpoint[sp.MODE_QUAT] == sp.ABSOLUTE:
        memory[a + 2] = wrap(math.degrees(desired_yaw(setpoint, estimate, FAST)))
    if tick % 10 == 0:
        position_step(setpoint, estimate, math.radians(yaw), param, memory, log)
    if setpoint[sp.MODE_Z] == sp.DISABLE:
        memory[mem.PID_THRUST] = setpoint[sp.THRUST]
    if setpoint[sp.MODE_X] == sp.DISABLE or setpoint[sp.MODE_Y] == sp.DISABLE:
        memory[a], memory[a + 1] = setpoint[sp.ROLL], setpoint[sp.PITCH]
    attitude_step(setpoint, (roll, pitch, yaw), sensor, param, memory, log)
    out = mem.LEGACY
    memory[out] = memory[mem.PID_THRUST]
    if memory[out] == 0.0:
        for i in range(4):
            memory[out + i] = 0.0
        reset(estimate, memory)
    for i in range(4):
        log[lv.PID + i] = memory[out + i]
    for i in range(3):
        rate = sensor[at.GYRO + i]
        log[lv.PID + 4 + i] = -rate if i == 1 else rate
        log[lv.PID + 9 + i] = memory[a + i]
    log[lv.PID + 7] = sensor[at.ACCEL + 2] / GRAVITY
    log[lv.PID + 8] = memory[mem.PID_THRUST]


@kernel
def position_step(setpoint, estimate, yaw, param, memory, log):
    """Position and velocity loops (100 Hz) in the yaw-aligned frame: wanted roll, pitch [deg] and thrust."""
    c, s = math.cos(yaw), math.sin(yaw)
    where, speed, goal = np.empty(3), np.empty(3), np.empty(3)
    v = np.empty(3)
    for source, out in ((at.E_POS, where), (at.E_VEL, speed)):
        out[0] = c * estimate[source] + s * estimate[source + 1]
        out[1] = c * estimate[source + 1] - s * estimate[source]
        out[2] = estimate[source + 2]
    goal[0] = c * setpoint[sp.X] + s * setpoint[sp.Y]
    goal[1] = c * setpoint[sp.Y] - s * setpoint[sp.X]
    goal[2] = setpoint[sp.Z]
    v[0], v[1], v[2] = setpoint[sp.VX], setpoint[sp.VY], setpoint[sp.VZ]
    if not setpoint[sp.VELOCITY_BODY] > 0.0:
        v[0], v[1] = c * setpoint[sp.VX] + s * setpoint[sp.VY], c * setpoint[sp.VY] - s * setpoint[sp.VX]
    for i in range(3):
        limit = abs(param[pm.PID_VEL_MAX + i])
        if i == 2:
            limit = max(limit, 0.5)
        if setpoint[sp.MODE_X + i] == sp.ABSOLUTE:
            v[i] = regulate(POSITION + i, goal[i], where[i], SLOW, OVERHEAD * limit, False, 20.0, param, memory, log)
        log[lv.PID_TARGETS + i] = v[i]
        log[lv.PID_TARGETS + 3 + i] = goal[i]
        if i < 2:
            log[lv.PID_TARGETS + 6 + i] = speed[i]
            log[lv.PID_TARGETS + 8 + i] = where[i]
    r_max, p_max = abs(param[pm.PID_R_LIMIT]), abs(param[pm.PID_R_LIMIT + 1])
    pitch = -regulate(VELOCITY, v[0], speed[0], SLOW, OVERHEAD * p_max, False, 20.0, param, memory, log)
    roll = -regulate(VELOCITY + 1, v[1], speed[1], SLOW, OVERHEAD * r_max, False, 20.0, param, memory, log)
    lift = regulate(VELOCITY + 2, v[2], speed[2], SLOW, 32.767, False, 20.0, param, memory, log)
    memory[mem.PID_ATTITUDE] = min(max(roll, -r_max), r_max)
    memory[mem.PID_ATTITUDE + 1] = min(max(pitch, -p_max), p_max)
    thrust = max(1000.0 * lift + param[pm.PID_THRUST_BASE], param[pm.PID_THRUST_BASE + 1])
    memory[mem.PID_THRUST] = min(max(thrust, 0.0), 65535.0)


@kernel
def attitude_step(setpoint, measured, sensor, param, memory, log):
    """Attitude and rate loops (500 Hz): roll, pitch, yaw for the mixer, truncated to 16 bits as the firmware does."""
    for i in range(3):
        rate = math.degrees(sensor[at.GYRO + i])
        if i == 1:
            rate = -rate
        slow = param[pm.PID_ATT_FILTER + 1] if param[pm.PID_ATT_FILTER] > 0.0 else 0.0
        fast = param[pm.PID_RATE_FILTER + 1 + i] if param[pm.PID_RATE_FILTER] > 0.0 else 0.0
        wanted = regulate(
            ATTITUDE + i, memory[mem.PID_ATTITUDE + i], measured[i], FAST, 0.0, i == 2, slow, param, memory, log
        )
        if i < 2 and setpoint[sp.MODE_ROLL + i] == sp.VELOCITY:
            wanted = setpoint[sp.RATE_ROLL + i]
        log[lv.PID + 12 + i] = wanted
        output = regulate(RATE + i, wanted, rate, FAST, 0.0, False, fast, param, memory, log)
        if not math.isfinite(output):
            output = 0.0
        output = float(math.trunc(min(max(output, -32767.0), 32767.0)))
        memory[mem.LEGACY + 1 + i] = -output if i == 2 else output
