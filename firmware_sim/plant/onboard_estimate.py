"""The onboard state estimate: an error-state Kalman filter on position, velocity and attitude, tuned by `kalman.*`.

Inputs as of the firmware's filter: gyro and accelerometer at 1 kHz (filtered, so late by a few ms), averaged between
predictions; position fixes (and attitude fixes) weighted by locSrv.extPosStdDev and locSrv.extQuatStdDev. State and
covariance are predicted 100 times a second (PREDICT_RATE of estimator_kalman.c) with the process noise of
kalman_core.c. Between predictions the state is constant, so controllers and log get a state up to 10 ms old: its error
grows with speed and is correlated in time, as on a real drone.
Error state: position (world, m), velocity (world, m/s), attitude (body, rad).
"""

import math

import numpy as np

from firmware_sim.controllers import parameters as pm
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.motion import origin
from firmware_sim.plant.effects.sensing import fix_pose
from firmware_sim.plant.quaternion import matrix, turn
from firmware_sim.plant.rigid_body import GRAVITY


@kernel
def estimate_step(truth, state, sensor, estimate, P, param, noise, tick, flying):
    """One millisecond: add up the sensors, predict when due, and use the fixes that are due."""
    if estimate[at.E_RESET] > 0.0 or not healthy(estimate, P):
        estimate[at.E_RESET] = 0.0
        reset_filter(truth, state, estimate, P)
    accumulate(sensor, estimate)
    if tick >= estimate[at.E_DUE]:
        estimate[at.E_DUE] = tick + truth[at.PREDICT_PERIOD]
        if noise[at.N_SLIP] > truth[at.PREDICT_SLIP]:
            estimate[at.E_DUE] += 1.0  # as the firmware: counted from this prediction, so a delay stays
        dt = 1e-3 * estimate[at.E_COUNT]
        integrate(estimate, dt, flying)
        if flying:
            drag(estimate, param, dt)
        predict(estimate, P, param, dt, flying)
    kind = truth[at.FIX_KIND]
    if kind > 0.0 and (tick - int(truth[at.FIX_PHASE])) % int(truth[at.FIX_PERIOD]) == 0:
        p, q = np.empty(3), np.empty(4)
        fix_pose(truth, state, sensor, tick, p, q)
        sd = param[pm.EXT_POS_SD]
        for i in range(3):
            fix = p[i] + truth[at.FIX_POSITION] * noise[at.N_FIX_POSITION + i]
            scalar_update(estimate, P, i, fix - estimate[at.E_POS + i], sd * sd)
        if kind > 1.0:
            s = truth[at.FIX_ATTITUDE]
            a = at.N_FIX_ATTITUDE
            turn(q, 0, s * noise[a], s * noise[a + 1], s * noise[a + 2])
            attitude_update(estimate, P, q, 0, param[pm.EXT_QUAT_SD])
    if estimate[at.E_EXT] > 0.0:
        sd = param[pm.EXT_POS_SD]
        for i in range(3):
            scalar_update(estimate, P, i, estimate[at.E_EXT_POS + i] - estimate[at.E_POS + i], sd * sd)
        if estimate[at.E_EXT] > 1.0:
            attitude_update(estimate, P, estimate, at.E_EXT_QUAT, param[pm.EXT_QUAT_SD])
        estimate[at.E_EXT] = 0.0
    bound(estimate, param)


@kernel
def healthy(estimate, P):
    """False if the filter holds a value that is not a number, from a parameter; the filter then restarts."""
    total = 0.0
    for i in range(9):
        total += P[i, i]
    for i in range(at.E_QUAT + 4):
        total += estimate[i]
    for i in range(at.E_SUM, at.E_DUE):
        total += estimate[i]
    return math.isfinite(total)


@kernel
def reset_filter(truth, state, estimate, P):
    """Start at the true position and attitude (the user places the drone level) with a small covariance."""
    if truth[at.EFFECT_SENSING] > 0.0:
        origin(truth, state, estimate[at.E_POS : at.E_POS + 3], estimate[at.E_VEL : at.E_VEL + 3])
    else:
        for i in range(3):
            estimate[at.E_POS + i] = state[at.POS + i]
    for i in range(3):
        estimate[at.E_VEL + i] = 0.0
    for i in range(4):
        estimate[at.E_QUAT + i] = state[at.QUAT + i]
    for i in range(at.E_SUM, at.E_DUE):
        estimate[i] = 0.0
    for i in range(9):
        for j in range(9):
            P[i, j] = 0.0
        P[i, i] = 1e-4


@kernel
def accumulate(sensor, estimate):
    """Gyro and accelerometer of this millisecond, for the mean that the next prediction uses."""
    for i in range(3):
        estimate[at.E_SUM + i] += sensor[at.GYRO + i]
        estimate[at.E_SUM + 3 + i] += sensor[at.ACCEL + i]
    estimate[at.E_COUNT] += 1.0


@kernel
def integrate(estimate, dt, flying):
    """Strapdown integration over dt of the filtered gyro and accelerometer, by their mean since the last prediction.

    In the air it uses only the accelerometer's z (kalman_core.c, predictDt), so it does not see a drag along x and y.
    """
    R = np.empty((3, 3))
    matrix(estimate, at.E_QUAT, R)
    a, g = at.E_ACC, at.E_GYRO
    for i in range(3):
        estimate[g + i] = estimate[at.E_SUM + i] / estimate[at.E_COUNT]
        estimate[a + i] = estimate[at.E_SUM + 3 + i] / estimate[at.E_COUNT]
        estimate[at.E_SUM + i] = 0.0
        estimate[at.E_SUM + 3 + i] = 0.0
    estimate[at.E_COUNT] = 0.0
    if flying:
        estimate[a] = 0.0
        estimate[a + 1] = 0.0
    for i in range(3):
        acc = R[i, 0] * estimate[a] + R[i, 1] * estimate[a + 1] + R[i, 2] * estimate[a + 2]
        if i == 2:
            acc -= GRAVITY
        estimate[at.E_POS + i] += dt * estimate[at.E_VEL + i] + 0.5 * dt * dt * acc
        estimate[at.E_VEL + i] += dt * acc
    turn(estimate, at.E_QUAT, dt * estimate[g], dt * estimate[g + 1], dt * estimate[g + 2])


@kernel
def drag(estimate, param, dt):
    """The filter's model of drag, kalman.dragB_*: acceleration -dragB v of the centre of pressure, body axes.

    dragB [1/s] is drag over mass (the firmware's own text says N s/m); the centre of pressure lies at kalman.cop_* [m].
    The firmware uses it in flight only.
    """
    if param[pm.DRAG] == 0.0 and param[pm.DRAG + 1] == 0.0 and param[pm.DRAG + 2] == 0.0:
        return
    R, w, r = np.empty((3, 3)), np.empty(3), np.empty(3)
    matrix(estimate, at.E_QUAT, R)
    for i in range(3):
        w[i], r[i] = estimate[at.E_GYRO + i], param[pm.COP + i]
    acc = np.empty(3)
    for i in range(3):
        speed = w[(i + 1) % 3] * r[(i + 2) % 3] - w[(i + 2) % 3] * r[(i + 1) % 3]
        for k in range(3):
            speed += R[k, i] * estimate[at.E_VEL + k]
        acc[i] = -param[pm.DRAG + i] * speed
    for i in range(3):
        estimate[at.E_VEL + i] += dt * (R[i, 0] * acc[0] + R[i, 1] * acc[1] + R[i, 2] * acc[2])


@kernel
def predict(estimate, P, param, dt, flying):
    """P <- A P A' + Q with A = [[I, dt I, 0], [0, I - dt R dragB R', -dt R [a]x], [0, 0, I - dt [w]x]].

    dragB counts in the air only.
    """
    R, A = np.empty((3, 3)), np.zeros((9, 9))
    matrix(estimate, at.E_QUAT, R)
    ax, ay, az = estimate[at.E_ACC], estimate[at.E_ACC + 1], estimate[at.E_ACC + 2]
    wx, wy, wz = estimate[at.E_GYRO], estimate[at.E_GYRO + 1], estimate[at.E_GYRO + 2]
    for i in range(9):
        A[i, i] = 1.0
    for i in range(3):
        A[i, 3 + i] = dt
        for j in range(3 if flying else 0):
            for k in range(3):
                A[3 + i, 3 + j] -= dt * R[i, k] * param[pm.DRAG + k] * R[j, k]
        A[3 + i, 6] = -dt * (R[i, 1] * az - R[i, 2] * ay)
        A[3 + i, 7] = -dt * (R[i, 2] * ax - R[i, 0] * az)
        A[3 + i, 8] = -dt * (R[i, 0] * ay - R[i, 1] * ax)
    A[6, 7], A[6, 8] = dt * wz, -dt * wy
    A[7, 6], A[7, 8] = -dt * wz, dt * wx
    A[8, 6], A[8, 7] = dt * wy, -dt * wx
    B = np.zeros((9, 9))
    for i in range(9):
        for k in range(9):
            if A[i, k] != 0.0:
                for j in range(9):
                    B[i, j] += A[i, k] * P[k, j]
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for k in range(9):
                s += B[i, k] * A[j, k]
            P[i, j] = s
            P[j, i] = s
    for i in range(3):
        acc = param[pm.PN_ACC_Z] if i == 2 else param[pm.PN_ACC_XY]
        gyro = param[pm.MN_GYRO_YAW] if i == 2 else param[pm.MN_GYRO_RP]
        P[i, i] += (acc * dt * dt + param[pm.PN_VEL] * dt + param[pm.PN_POS]) ** 2
        P[3 + i, 3 + i] += (acc * dt + param[pm.PN_VEL]) ** 2
        P[6 + i, 6 + i] += (gyro * dt + param[pm.PN_ATT]) ** 2


@kernel
def scalar_update(estimate, P, index, innovation, variance):
    """Kalman update with a direct measurement of one error state."""
    s = P[index, index] + variance
    if not (s > 0.0) or not math.isfinite(innovation):
        return
    K = np.empty(9)
    row = np.empty(9)
    for i in range(9):
        K[i] = P[i, index] / s
        row[i] = P[index, i]
    for i in range(9):
        for j in range(9):
            P[i, j] -= K[i] * row[j]
    for i in range(9):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean
        P[i, i] = min(max(P[i, i], 1e-12), 100.0)
    for i in range(6):
        estimate[i] += K[i] * innovation
    turn(estimate, at.E_QUAT, K[6] * innovation, K[7] * innovation, K[8] * innovation)


@kernel
def attitude_update(estimate, P, q, o, sd):
    """Update with an attitude q[o:o+4] (w first) as three measurements of the attitude error."""
    for i in range(3):
        a = at.E_QUAT
        w, x, y, z = estimate[a], estimate[a + 1], estimate[a + 2], estimate[a + 3]
        dw = w * q[o] + x * q[o + 1] + y * q[o + 2] + z * q[o + 3]
        d0 = w * q[o + 1] - x * q[o] - y * q[o + 3] + z * q[o + 2]
        d1 = w * q[o + 2] + x * q[o + 3] - y * q[o] - z * q[o + 1]
        d2 = w * q[o + 3] - x * q[o + 2] + y * q[o + 1] - z * q[o]
        error = d0 if i == 0 else (d1 if i == 1 else d2)
        scalar_update(estimate, P, 6 + i, math.copysign(2.0, dw) * error, sd * sd)


@kernel
def bound(estimate, param):
    """Keep position and velocity within kalman.maxPos and kalman.maxVel (kalman_supervisor.c resets; we clip)."""
    for i in range(3):
        limit = max(abs(param[pm.MAX_POS]), 1e-3)
        estimate[at.E_POS + i] = min(max(estimate[at.E_POS + i], -limit), limit)
        limit = max(abs(param[pm.MAX_VEL]), 1e-3)
        estimate[at.E_VEL + i] = min(max(estimate[at.E_VEL + i], -limit), limit)
