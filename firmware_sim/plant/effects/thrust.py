"""Thrust of a rotor: thrust_scale, rotor_fault, thrust_curve, battery_sag, ground_effect, torque_scale, trim.

    goal   = clip(f + slope_error (f - f_hover), 0, thrust_max) (1 + gain_per_volt (V - 3.7 V))  before the lag
           = ...                                               (1 + gain_per_second t)           t since take-off
    thrust = lagged * thrust_scale * fault * (1 + strength exp(-z / height))                     after the lag

f: the thrust curve's value for the command; f_hover: a quarter of the vehicle's weight without payload; V: the voltage
at the battery's terminals; z: height of the geometric origin above the floor. What is before the lag moves the rotor's
speed, what is after it does not. A rotor's drag torque follows its thrust. torque_scale multiplies the three torques of
the rotors about the geometric origin; trim adds a torque that goes with their whole thrust. Ground effect: the
exponential form of issue 5's catalogue.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.rotors import steady_thrust, wrench

NOMINAL_VOLTS = 3.7  # V, where battery_sag is neutral: the nominal voltage of a lithium-polymer cell


@kernel
def goal_thrust(truth, state, pwm):
    """Thrust [N] that the lag of one rotor goes to under this command."""
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
