"""Rotors with effects: commands, lag, thrust and reaction in their order, instead of rotors.lag and rotors.wrench."""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.command import delayed, remember
from firmware_sim.plant.effects.rotor_inertia import angular_momentum
from firmware_sim.plant.effects.thrust import acting_thrust, acting_wrench, goal_thrust
from firmware_sim.plant.rotors import wrench


@kernel
def drive(truth, state, dt, mean, u):
    """Advance the rotors by dt (one tick); u = [F, Mx, My, Mz], torque about the centre of mass, over the step."""
    remember(truth, state)
    before = angular_momentum(truth, state, at.ROTOR)
    lag_delayed(truth, state, dt, mean)
    thrust = np.empty(4)
    acting_thrust(truth, state, mean, 0, origin_height(truth, state), thrust)
    acting_wrench(truth, thrust, u)
    if truth[at.ROTOR_INERTIA] > 0.0:
        after = angular_momentum(truth, state, at.ROTOR)
        u[3] -= (after - before) / dt
        state[at.SPIN] = 0.5 * (before + after)
    age(state)


@kernel
def age(state):
    """One millisecond more since the feet left the floor."""
    if state[at.AIRBORNE] > 0.0 or state[at.FEET] == 0.0:
        state[at.AIRBORNE] += 1.0


@kernel
def lag_delayed(truth, state, dt, mean):
    """Like rotors.lag, for goals with effects and a command that may change within the step."""
    tau = truth[at.MOTOR_TAU]
    late = truth[at.INPUT_DELAY] - math.floor(truth[at.INPUT_DELAY])  # share of the step that sees the older command
    for i in range(4):
        f, impulse = state[at.ROTOR + i], 0.0
        for part in range(2):
            h = dt * (late if part == 0 else 1.0 - late)
            if h <= 0.0:
                continue
            goal = goal_thrust(truth, state, delayed(truth, state, i, part))
            keep = math.exp(-h / tau) if tau > 0.0 else 0.0
            impulse += goal * h + (f - goal) * (1.0 - keep) * tau
            f = goal + (f - goal) * keep
        state[at.ROTOR + i] = f
        mean[i] = impulse / dt


@kernel
def origin_height(truth, state):
    """Height [m, world] of the geometric origin."""
    q = at.QUAT
    w, x, y, z = state[q], state[q + 1], state[q + 2], state[q + 3]
    c = at.COM
    up = 2 * (x * z - w * y) * truth[c] + 2 * (y * z + w * x) * truth[c + 1] + (1 - 2 * (x * x + y * y)) * truth[c + 2]
    return state[at.POS + 2] - up


@kernel
def present_wrench(truth, state, u):
    """u = [F, Mx, My, Mz] of the rotors' present thrusts, torque about the centre of mass, without spin-up reaction."""
    if truth[at.EFFECT_ROTORS] > 0.0:
        thrust = np.empty(4)
        acting_thrust(truth, state, state, at.ROTOR, origin_height(truth, state), thrust)
        acting_wrench(truth, thrust, u)
    else:
        wrench(truth, state, at.ROTOR, u)
