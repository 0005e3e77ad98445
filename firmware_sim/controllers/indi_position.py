"""INDI's outer loop, as in position_controller_indi.c: position -> velocity -> acceleration -> steps of tilt, thrust.

G [roll, pitch, T] = acceleration error, where G is the derivative of the thrust's acceleration by roll and pitch (at
hover) and by thrust. K_THR [m/s^2 a unit] is a constant of the firmware: another mass gives another loop gain. Axes:
x forward, y right, z down. Velocity and acceleration of a position setpoint are ignored; velocities are in world axes.
Both loops filter by filter.h, init_butterworth_2_low_pass, direct form I.
"""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.rigid_body import GRAVITY

QUALITY = 0.7071  # of the filter; as in the source, not 1/sqrt(2)


@kernel
def design(memory, o, cutoff, rate):
    """Coefficients a1, a2, b0 into memory[o:o+3]; cutoff and rate in Hz. b1 = 2 b0, b2 = b0."""
    k = math.tan(math.pi * cutoff / rate)
    poly = k * k + k / QUALITY + 1.0
    memory[o] = 2.0 * (k * k - 1.0) / poly
    memory[o + 1] = (k * k - k / QUALITY + 1.0) / poly
    memory[o + 2] = k * k / poly


@kernel
def butterworth(memory, c, o, value):
    """One step: coefficients memory[c:c+3], the last two inputs and outputs in memory[o:o+4]. Returns the output."""
    a1, a2, b0 = memory[c], memory[c + 1], memory[c + 2]
    out = b0 * (value + 2.0 * memory[o] + memory[o + 1]) - a1 * memory[o + 2] - a2 * memory[o + 3]
    memory[o + 1], memory[o] = memory[o], value
    memory[o + 3], memory[o + 2] = memory[o + 2], out
    return out


K_THR = 0.00024730  # m/s^2 a unit of thrust
ACT_DYN = 0.03149  # rotor lag of the thrust, a step; independent of ctrlINDI.act_dyn_*
MAX_THRUST = 60000.0


@kernel
def axes(f, M, G):
    """M (3x3): body to world of the angles f (roll, pitch, yaw, rad); G (3x3): the effect of roll, pitch and thrust."""
    c0, s0, c1, s1, c2, s2 = (
        math.cos(f[0]), math.sin(f[0]), math.cos(f[1]), math.sin(f[1]), math.cos(f[2]), math.sin(f[2])
    )  # fmt: skip
    M[0, 0], M[0, 1], M[0, 2] = c1 * c2, s0 * s1 * c2 - c0 * s2, c0 * s1 * c2 + s0 * s2
    M[1, 0], M[1, 1], M[1, 2] = c1 * s2, s0 * s1 * s2 + c0 * c2, c0 * s1 * s2 - s0 * c2
    M[2, 0], M[2, 1], M[2, 2] = -s1, s0 * c1, c0 * c1
    for i in range(3):
        G[i, 0] = GRAVITY * M[i, 1]  # d(M e3)/d(roll) = -M e2
        G[i, 2] = M[i, 2]
    G[0, 1], G[1, 1], G[2, 1] = -GRAVITY * c0 * c1 * c2, -GRAVITY * c0 * c1 * s2, GRAVITY * c0 * s1


@kernel
def solve(G, e, out):
    """out = G^-1 e by cofactors (not finite if the thrust is horizontal)."""
    det = 0.0
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        out[j] = 0.0
        for i in range(3):
            k, m = (i + 1) % 3, (i + 2) % 3
            cofactor = G[k, a] * G[m, b] - G[k, b] * G[m, a]
            out[j] += cofactor * e[i]
            if j == 0:
                det += G[i, 0] * cofactor
    for j in range(3):
        out[j] /= det


@kernel
def indi_position_step(setpoint, estimate, sensor, angle, param, memory, log):
    """One step (500 Hz): INDI_TILTS [rad], INDI_LIFT [PWM units] and posCtrlIndi.*. angle: roll, pitch, yaw, rad."""
    M, G = np.empty((3, 3)), np.empty((3, 3))
    error, f, acc, turned, gain = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    o = lv.INDI_POS
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        velocity = sign * estimate[at.E_VEL + i]
        goal = sign * setpoint[sp.VX + i]
        if setpoint[sp.MODE_X + i] == sp.ABSOLUTE:
            place = sign * setpoint[sp.X + i]
            goal = param[pm.INDI_XI + i] * (place - sign * estimate[at.E_POS + i])
            log[o + i] = place
        error[i] = param[pm.INDI_XI + 3 + i] * (goal - velocity)
        sensed = sign * sensor[at.ACCEL + i]
        acc[i] = butterworth(memory, mem.INDI_PLACE, mem.INDI_ACC + 4 * i, sensed)
        f[i] = butterworth(memory, mem.INDI_PLACE, mem.INDI_ANGLE + 4 * i, angle[i])
        log[o + 3 + i], log[o + 6 + i], log[o + 9 + i], log[o + 12 + i] = velocity, goal, angle[i], f[i]
        log[o + 15 + i], log[o + 18 + i], log[o + 21 + i] = error[i], sensed, acc[i]
    axes(f, M, G)
    for i in range(3):
        turned[i] = M[i, 0] * acc[0] + M[i, 1] * acc[1] + M[i, 2] * acc[2]
        if i == 2:
            turned[i] += GRAVITY
        error[i] -= turned[i]
        log[o + 24 + i], log[o + 27 + i] = turned[i], error[i]
    solve(G, error, gain)
    passed = butterworth(memory, mem.INDI_PLACE, mem.INDI_LIFTED, memory[mem.INDI_LIFT])
    memory[mem.INDI_LIFT_ACT] += ACT_DYN * (passed - memory[mem.INDI_LIFT_ACT])
    more = -gain[2] / K_THR
    memory[mem.INDI_LIFT] = min(max(more + memory[mem.INDI_LIFT_ACT], 0.0), MAX_THRUST)
    limit = math.radians(param[pm.INDI_TILT_LIMIT])
    for i in range(2):
        memory[mem.INDI_TILTS + i] = min(max(f[i] + gain[i], -limit), limit)
        log[o + 30 + i] = gain[i]
        log[o + 36 + i] = memory[mem.INDI_TILTS + i]
    log[o + 32], log[o + 33], log[o + 34] = more, memory[mem.INDI_LIFT_ACT], passed
    log[o + 35] = memory[mem.INDI_LIFT]
