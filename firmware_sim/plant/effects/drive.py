"""Rotors with effects, in their order: input_delay and sticky_rotor, lag, thrust and torque effects, rotor_inertia.

They replace rotors.lag and rotors.wrench.

input_delay: the command of t acts at t + delay, exactly, also between two milliseconds; the log shows it undelayed.
sticky_rotor: one rotor keeps its command until the new one differs by more than `deadband` (of full scale).

    goal   = clip(f + slope_error (f - f_hover), 0, thrust_max) (1 + gain_per_volt (V - 3.7 V))  before the lag
           = ...                                               (1 + gain_per_second t)           t since take-off
    thrust = lagged * thrust_scale * fault * (1 + strength exp(-z / height))                     after the lag

f: the thrust curve's value for the command; f_hover: a quarter of the vehicle's weight without payload; V: the voltage
at the battery's terminals; z: height of the geometric origin above the floor. Effects before the lag change the
rotor's speed, effects after it do not. A rotor's drag torque is proportional to its thrust. torque_scale multiplies the
three torques of the rotors about the geometric origin; trim adds a torque proportional to their total thrust.

    J dw/dt = ... - w x (H e3) - dH/dt e3,   W_i = sqrt(f_i / rotor_constant)

I: of one rotor and propeller about its axis, kg m^2 (the body's J contains the rotors at rest). f_i: the lagged
thrust, without rotor_fault and other effects after the lag. M1 and M3 turn counter-clockwise seen from above. The
spin-up reaction is the exact change of H over each step. Source: Euler's equation of a gyrostat.
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.rotors import steady_thrust, wrench


@kernel
def angular_momentum(truth, f, o):
    """H [N m s] along body z of rotors with lagged thrusts f[o:o+4]."""
    total = 0.0
    for i in range(4):
        speed = math.sqrt(max(f[o + i], 0.0) / truth[at.ROTOR_CONSTANT])
        total += speed if i % 2 == 0 else -speed
    return truth[at.ROTOR_INERTIA] * total


NOMINAL_VOLTS = 3.7  # V, where battery_sag is neutral: the nominal voltage of a lithium-polymer cell


@kernel
def settled_thrust(truth, state, pwm):
    """Steady thrust [N] of one rotor under this command, the goal of its lag."""
    f = steady_thrust(truth, pwm, state[at.VOLTS])
    if pwm > 0.0 and truth[at.SLOPE_ERROR] != 0.0:
        f += truth[at.SLOPE_ERROR] * (f - truth[at.HOVER_THRUST])
        f = min(max(f, 0.0), truth[at.THRUST_MAX])
    f *= max(1.0 + truth[at.SAG_PER_VOLT] * (state[at.VOLTS] - NOMINAL_VOLTS), 0.0)
    return f * max(1.0 + truth[at.SAG_PER_SECOND] * 1e-3 * state[at.AIRBORNE], 0.0)


@kernel
def acting_thrust(truth, state, f, o, origin_height, out):
    """out[0:4] = thrust [N] of the rotors whose lagged thrusts are f[o:o+4]; origin_height in m, world."""
    factor = truth[at.THRUST_SCALE]
    if truth[at.GROUND_STRENGTH] != 0.0:
        z = max(origin_height - truth[at.FLOOR], 0.0)
        factor *= 1.0 + truth[at.GROUND_STRENGTH] * math.exp(-z / truth[at.GROUND_HEIGHT])
    for i in range(4):
        out[i] = factor * f[o + i]
        if truth[at.FAULT_ROTOR] == i + 1 and state[at.CLOCK] >= truth[at.FAULT_ONSET]:
            out[i] *= truth[at.FAULT_SCALE]


@kernel
def acting_wrench(truth, thrust, u):
    """u = [F, Mx, My, Mz] of four acting thrusts [N], torque about the centre of mass."""
    wrench(truth, thrust, 0, u)
    for i in range(1, 4):
        u[i] = u[i] * truth[at.TORQUE_SCALE] + truth[at.TRIM + i - 1] * u[0]
    u[1] -= truth[at.COM + 1] * u[0]
    u[2] += truth[at.COM] * u[0]


@kernel
def store_commands(truth, state):
    """Put the commands of this millisecond (CLOCK) into the ring; of the sticky rotor, the held one."""
    row = at.COMMANDS + 4 * (int(state[at.CLOCK]) % at.DELAY_ROWS)
    for i in range(4):
        pwm = state[at.PWM + i]
        if truth[at.STICKY_ROTOR] == i + 1:
            if abs(pwm - state[at.HELD]) > truth[at.STICKY_BAND] or pwm == 0.0:
                state[at.HELD] = pwm
            pwm = state[at.HELD]
        state[row + i] = pwm


@kernel
def delayed_command(truth, state, i, part):
    """Command of motor i in part 0 (the first delay - floor(delay) ms) or part 1 (the rest) of this millisecond."""
    back = math.floor(truth[at.INPUT_DELAY]) + (1 - part)
    row = (int(state[at.CLOCK]) - back) % at.DELAY_ROWS  # 0 (not yet written) before the first command acts
    return state[at.COMMANDS + 4 * row + i]


@kernel
def rotors_step(truth, state, dt, mean, u):
    """Advance the rotors by dt (one tick); u = [F, Mx, My, Mz], torque about the centre of mass, over the step."""
    store_commands(truth, state)
    before = angular_momentum(truth, state, at.ROTOR)
    lag_delayed(truth, state, dt, mean)
    thrust = np.empty(4)
    acting_thrust(truth, state, mean, 0, origin_height(truth, state), thrust)
    acting_wrench(truth, thrust, u)
    if truth[at.ROTOR_INERTIA] > 0.0:
        after = angular_momentum(truth, state, at.ROTOR)
        u[3] -= (after - before) / dt
        state[at.SPIN] = 0.5 * (before + after)
    count_airborne_time(state)


@kernel
def count_airborne_time(state):
    """Add one millisecond to the time since the feet left the floor."""
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
            goal = settled_thrust(truth, state, delayed_command(truth, state, i, part))
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
