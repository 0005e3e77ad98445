"""Rotors and battery cell: command and voltage to thrust, lag, four rotors to force and torque.

Motors: M1 front right, M2 back right, M3 back left, M4 front left (x forward, y left, z up).

The battery is one lithium-polymer cell: open-circuit voltage from the charge left, sag under the load. A rotor's
shaft power grows as thrust^1.5 (momentum theory); the coefficient lumps the motor's efficiency.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def steady_thrust(truth, pwm, volts):
    """Thrust in N that one rotor settles at: polynomial in motor volts (duty times battery volts), 0 for command 0."""
    if pwm <= 0.0:
        return 0.0
    v = pwm / 65535.0 * volts
    f = 0.0
    for i in range(5, -1, -1):
        f = f * v + truth[at.CURVE + i]
    return min(max(f, 0.0), truth[at.THRUST_MAX])


@kernel
def lag(truth, state, dt, mean):
    """Advance the four rotor thrusts by dt (exact for a held command); `mean` gets each one's average over the step.

    The rigid body is integrated with the average: the exact impulse, so the error of holding it is of second order.
    """
    tau = truth[at.MOTOR_TAU]
    for i in range(4):
        goal = steady_thrust(truth, state[at.PWM + i], state[at.VOLTS])
        f = state[at.ROTOR + i]
        if tau <= 0.0:
            state[at.ROTOR + i] = goal
            mean[i] = goal
        else:
            keep = math.exp(-dt / tau)
            state[at.ROTOR + i] = goal + (f - goal) * keep
            mean[i] = goal + (f - goal) * (1.0 - keep) * tau / dt


@kernel
def wrench(truth, f, o, out):
    """out = [F N, Mx, My, Mz N m] of the four thrusts f[o:o+4], about the geometric origin."""
    dx, dy, k = truth[at.ARM], truth[at.ARM_Y], truth[at.TORQUE_PER_THRUST]
    f1, f2, f3, f4 = f[o], f[o + 1], f[o + 2], f[o + 3]
    out[0] = f1 + f2 + f3 + f4
    out[1] = dy * (-f1 - f2 + f3 + f4)
    out[2] = dx * (-f1 + f2 + f3 - f4)
    out[3] = k * (-f1 + f2 - f3 + f4)


@kernel
def open_circuit(soc):
    """Open-circuit voltage in V for a state of charge 0..1: 3.0 V empty, 3.7 V at 20 %, 4.2 V full."""
    soc = min(max(soc, 0.0), 1.0)
    if soc < 0.2:
        return 3.0 + 0.7 * (soc / 0.2) ** 0.5
    return 3.7 + 0.5 * (soc - 0.2) / 0.8


@kernel
def battery_step(truth, state, dt):
    """Discharge by dt and set the terminal voltage for the present load. The voltage never drops below 0.5 V."""
    power = truth[at.ELECTRONICS_POWER]
    for i in range(4):
        power += truth[at.POWER_COEFFICIENT] * max(state[at.ROTOR + i], 0.0) ** 1.5
    current = power / max(state[at.VOLTS], 2.0)
    state[at.CHARGE] = max(state[at.CHARGE] - current * dt, 0.0)
    state[at.VOLTS] = max(open_circuit(state[at.CHARGE] / truth[at.CAPACITY]) - truth[at.RESISTANCE] * current, 0.5)
