"""The step of a body with effects: rigid_body.body_step with the forces of motion.py and a suspended load (six states).

Runge-Kutta of fourth order on x = [p, v, q, w (13), n, dn/dt (6)], then the process noise, which acts on the load, too.
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.air import gusts_step, vibration_step
from firmware_sim.plant.effects.drive import count_airborne_time, rotors_step, store_commands
from firmware_sim.plant.effects.motion import act, ambient_forces, origin, static_forces
from firmware_sim.plant.effects.suspended_load import add_string_force, normalise_string, rest_load, share_impulse
from firmware_sim.plant.quaternion import matrix, normalise
from firmware_sim.plant.rigid_body import GRAVITY, RATE_LIMIT, SPEED_LIMIT, body_step, is_resting, newton_euler
from firmware_sim.plant.rotors import battery_step, lag, wrench


@kernel
def plant_step_with_effects(truth, state, noise, dt):
    """One tick of rotors, battery and body under the present PWM; parts without effects run the plain step."""
    mean, u, force, torque = np.empty(4), np.empty(4), np.zeros(3), np.zeros(3)
    if truth[at.EFFECT_ROTORS] > 0.0:
        rotors_step(truth, state, dt, mean, u)
    else:
        lag(truth, state, dt, mean)
        wrench(truth, mean, 0, u)
    if truth[at.GUST_SD] > 0.0:
        gusts_step(truth, state, noise, dt)
    if truth[at.VIBRATION_TORQUE] > 0.0:
        vibration_step(truth, state, dt, torque)
    if truth[at.EFFECT_BODY] > 0.0:
        body_step_with_effects(truth, state, u, force, torque, noise, dt)
    else:
        body_step(truth, state, u, force, torque, noise, dt)
    battery_step(truth, state, dt)
    state[at.CLOCK] += 1.0


@kernel
def hold_step(truth, state):
    """A tick within a longer integration step: the plant does not move; commands and clocks go on."""
    if truth[at.EFFECT_ROTORS] > 0.0:
        store_commands(truth, state)
        count_airborne_time(state)
    state[at.CLOCK] += 1.0


@kernel
def body_step_with_effects(truth, state, u, force, torque, noise, dt):
    """Advance the body and its load by dt under u = [F, Mx, My, Mz] of the rotors, and set the specific force.

    force [N, world] and torque [N m, body]: held over the step, at the geometric origin, which is also where the
    accelerometer sits. Process noise only off the floor.
    """
    ambient, R, dv, dw = np.empty(4), np.empty((3, 3)), np.empty(3), np.empty(3)
    p, before, after = np.empty(3), np.empty(3), np.empty(3)
    ambient_forces(truth, state, ambient)
    if state[at.FEET] == 4.0:
        static_forces(truth, state, ambient, force, torque, dv, dw)
        if is_resting(truth, state, u, dv, dw):
            rest_on_floor(truth, state, R)
            return
    state[at.ASLEEP] = 0.0
    origin(truth, state, p, before)
    x = np.empty(19)
    states_of(state, x)
    state[at.FEET] = runge_kutta(truth, x, u, force, torque, ambient, R, dt)
    normalise(x, 6)
    matrix(x, 6, R)
    if state[at.FEET] == 0.0:
        add_process_noise(truth, x, R, noise, dt, dv, dw)
    for i in range(3):  # as in rigid_body.py
        x[3 + i] = min(max(x[3 + i], -SPEED_LIMIT), SPEED_LIMIT)
        x[10 + i] = min(max(x[10 + i], -RATE_LIMIT), RATE_LIMIT)
    normalise_string(x)
    set_states(x, state)
    origin(truth, state, p, after)
    for i in range(3):
        after[i] = (after[i] - before[i]) / dt
    after[2] += GRAVITY
    set_accelerometer(truth, state, R, after)


@kernel
def runge_kutta(truth, x, u, force, torque, ambient, R, dt):
    """Advance x by dt; returns the number of feet on the floor at the start of the step."""
    k, y, total = np.zeros(19), x.copy(), np.zeros(19)
    f, t, v = np.empty(3), np.empty(3), np.empty(3)
    feet = 0
    for stage in range(4):
        matrix(y, 6, R)
        touching = act(truth, y, u, force, torque, ambient, R, f, t, v)
        if truth[at.LOAD_MASS] > 0.0:
            add_string_force(truth, y, R, v, ambient, f, t, k)
        newton_euler(truth, y, y[10:13], f, t, k)
        if stage == 0:
            feet = touching
        weight = 1.0 if stage in (0, 3) else 2.0
        ahead = dt if stage == 2 else 0.5 * dt
        for i in range(19):
            total[i] += weight * k[i]
            y[i] = x[i] + ahead * k[i]
    for i in range(19):
        x[i] += dt / 6.0 * total[i]
    return feet


@kernel
def add_process_noise(truth, x, R, noise, dt, dv, dw):
    """Process noise of thrust and torque over dt; dv (3) and dw (3) are scratch."""
    root = math.sqrt(dt)
    push = truth[at.NOISE_THRUST] / truth[at.MASS] * root * noise[at.N_THRUST]
    V, s, n = at.INERTIA_INV, at.NOISE_TORQUE, at.N_TORQUE
    for i in range(3):
        dv[i] = R[i, 2] * push
        dw[i] = 0.0
        for j in range(3):
            dw[i] += truth[V + 3 * i + j] * truth[s + j] * root * noise[n + j]
    if truth[at.LOAD_MASS] > 0.0:
        share_impulse(truth, x, R, dv, dw)
    for i in range(3):
        x[3 + i] += dv[i]
        x[10 + i] += dw[i]


@kernel
def rest_on_floor(truth, state, R):
    """Set the state at rest: the drone stands on its feet, and its load hangs still."""
    matrix(state, at.QUAT, R)
    for i in range(3):
        state[at.VEL + i] = 0.0
        state[at.OMEGA + i] = 0.0
    set_accelerometer(truth, state, R, np.array([0.0, 0.0, GRAVITY]))
    state[at.ASLEEP] = 1.0
    rest_load(state)


@kernel
def set_accelerometer(truth, state, R, force):
    """Set the accelerometer, in its own axes, from a specific force [m/s^2, world]."""
    bx = R[0, 0] * force[0] + R[1, 0] * force[1] + R[2, 0] * force[2]
    by = R[0, 1] * force[0] + R[1, 1] * force[1] + R[2, 1] * force[2]
    bz = R[0, 2] * force[0] + R[1, 2] * force[1] + R[2, 2] * force[2]
    for i in range(3):
        row = at.ACC_TURN + 3 * i
        state[at.ACC + i] = truth[row] * bx + truth[row + 1] * by + truth[row + 2] * bz


@kernel
def states_of(state, x):
    """x = the 19 states that are integrated."""
    for i in range(13):
        x[i] = state[i]
    for i in range(6):
        x[13 + i] = state[at.LOAD + i]


@kernel
def set_states(x, state):
    """The opposite of `states_of`."""
    for i in range(13):
        state[i] = x[i]
    for i in range(6):
        state[at.LOAD + i] = x[13 + i]
