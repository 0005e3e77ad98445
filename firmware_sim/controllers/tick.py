"""One millisecond of the whole drone: sense, estimate, control, drive the motors, move the body, publish.

`tick_step` is for a drone without effects; `tick_step_with_effects` has the same order. So a drone without effects
spends no time on running or compiling them.
"""

import math

import numpy as np

from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers.externalise import (
    log_baro,
    log_battery,
    log_control,
    log_estimate,
    log_inertial,
    log_rotor_speed,
    log_setpoint,
)
from firmware_sim.controllers.indi import indi_step
from firmware_sim.controllers.indi import reset as indi_reset
from firmware_sim.controllers.lee import lee_step
from firmware_sim.controllers.lee import reset as lee_reset
from firmware_sim.controllers.lqg import lqg_step
from firmware_sim.controllers.lqg import reset as lqg_reset
from firmware_sim.controllers.mellinger import mellinger_step
from firmware_sim.controllers.mellinger import reset as mellinger_reset
from firmware_sim.controllers.pid import pid_step
from firmware_sim.controllers.pid import reset as pid_reset
from firmware_sim.controllers.power_distribution import motors_step
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.sensing import delay_estimate, delay_sensors, restore_estimate, scale_velocity
from firmware_sim.plant.effects.step import hold_step, plant_step_with_effects
from firmware_sim.plant.onboard_estimate import estimate_step
from firmware_sim.plant.rigid_body import body_step
from firmware_sim.plant.rotors import battery_step, lag, wrench
from firmware_sim.plant.sensors import sensors_step

DT = 1e-3  # s
PID, MELLINGER, INDI, LEE, LQG = 1.0, 2.0, 3.0, 5.0, 6.0  # stabilizer.controller


@kernel
def control_step(setpoint, estimate, sensor, param, memory, log, tick):
    """Run the selected controller at its rate; a new selection starts with empty integrals."""
    which = param[pm.CONTROLLER]
    if memory[mem.RUNNING] != which:
        memory[mem.RUNNING] = which
        lee_reset(memory)
        lqg_reset(memory)
        mellinger_reset(memory)
        indi_reset(param, memory)
        pid_reset(estimate, memory)
    if tick % 2 == 0:
        if which == PID:
            pid_step(setpoint, estimate, sensor, param, memory, log, tick)
        elif which == MELLINGER:
            mellinger_step(setpoint, estimate, sensor, param, memory, log)
        elif which == INDI:
            indi_step(setpoint, estimate, sensor, param, memory, log, tick)
        elif which == LQG:
            lqg_step(setpoint, estimate, sensor, param, memory, log)
        else:
            lee_step(setpoint, estimate, sensor, param, memory, log)
    for i in range(mem.MEMORY_SIZE):  # a setpoint or gain that is not a number must not stay in the integrals
        if not math.isfinite(memory[i]):
            memory[i] = 0.0


@kernel
def integrates(truth, tick):
    """Whether the plant moves at the end of this tick: with an integration step of n ms at the end of every n-th."""
    return (tick + 1) % int(truth[at.INTEGRATION_STEP]) == 0


@kernel
def plant_step(truth, state, noise, dt):
    """Move rotors, battery and body on by dt under the present PWM."""
    mean, u, force, torque = np.empty(4), np.empty(4), np.zeros(3), np.zeros(3)
    lag(truth, state, dt, mean)
    wrench(truth, mean, 0, u)
    body_step(truth, state, u, force, torque, noise, dt)
    battery_step(truth, state, dt)


@kernel
def log_rest(truth, board, state, sensor, setpoint, param, memory, log, union_float, union_short, noise, tick):
    """Write all log variables but those of the estimate."""
    log_inertial(sensor, log)
    log_battery(sensor, log)
    log_baro(state, noise, tick, log)
    log_setpoint(setpoint, log)
    log_control(memory, param, log, union_float, union_short)
    if board[at.B_BRUSHLESS] > 0.0:
        log_rotor_speed(truth, board, state, noise, log)


@kernel
def tick_step(
    truth, board, state, sensor, estimate, P, setpoint, param, memory, log, union_float, union_short, noise, tick, flags
):
    """One millisecond. flags: bit 0 motors allowed by the supervisor, bit 1 armed, bit 2 flies."""
    sensors_step(truth, state, sensor, noise, tick)
    estimate_step(truth, state, sensor, estimate, P, param, noise, tick, (flags & 4) != 0)
    control_step(setpoint, estimate, sensor, param, memory, log, tick)
    motors_step(board, state, sensor, param, memory, log, (flags & 1) != 0, (flags & 2) != 0)
    if integrates(truth, tick):
        plant_step(truth, state, noise, DT * truth[at.INTEGRATION_STEP])
    log_estimate(sensor, estimate, P, log)
    log_rest(truth, board, state, sensor, setpoint, param, memory, log, union_float, union_short, noise, tick)


@kernel
def tick_step_with_effects(
    truth, board, state, sensor, estimate, P, setpoint, param, memory, log, union_float, union_short, noise, tick, flags
):
    """One millisecond. flags: bit 0 motors allowed by the supervisor, bit 1 armed, bit 2 flies."""
    sensors_step(truth, state, sensor, noise, tick)
    delay_sensors(truth, state, sensor, tick)
    estimate_step(truth, state, sensor, estimate, P, param, noise, tick, (flags & 4) != 0)
    scale_velocity(truth, sensor, estimate)
    control_step(setpoint, estimate, sensor, param, memory, log, tick)
    motors_step(board, state, sensor, param, memory, log, (flags & 1) != 0, (flags & 2) != 0)
    if integrates(truth, tick):
        plant_step_with_effects(truth, state, noise, DT * truth[at.INTEGRATION_STEP])
    else:
        hold_step(truth, state)
    delay_estimate(truth, sensor, estimate, tick)
    log_estimate(sensor, estimate, P, log)
    restore_estimate(sensor, estimate)
    log_rest(truth, board, state, sensor, setpoint, param, memory, log, union_float, union_short, noise, tick)
