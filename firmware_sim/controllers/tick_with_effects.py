"""One millisecond of a drone with effects: the order of tick.py, with plant and sensing of plant/effects/."""

from firmware_sim.controllers.externalise import (
    log_baro,
    log_battery,
    log_control,
    log_estimate,
    log_inertial,
    log_rotor_speed,
    log_setpoint,
)
from firmware_sim.controllers.power_distribution import motors_step
from firmware_sim.controllers.tick import DT, control_step, moves
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.sensing import be_honest, claim_velocity, go_back, sense_late
from firmware_sim.plant.effects.step import hold_still, plant_step_with_effects
from firmware_sim.plant.onboard_estimate import estimate_step
from firmware_sim.plant.sensors import sensors_step


@kernel
def tick_step_with_effects(
    truth, board, state, sensor, estimate, P, setpoint, param, memory, log, union_float, union_short, noise, tick, flags
):
    """One millisecond. flags: bit 0 motors allowed by the supervisor, bit 1 armed, bit 2 flies."""
    sensors_step(truth, state, sensor, noise, tick)
    sense_late(truth, state, sensor, tick)
    estimate_step(truth, state, sensor, estimate, P, param, noise, tick, (flags & 4) != 0)
    claim_velocity(truth, sensor, estimate)
    control_step(setpoint, estimate, sensor, param, memory, log, tick)
    motors_step(board, state, sensor, param, memory, log, (flags & 1) != 0, (flags & 2) != 0)
    if moves(truth, tick):
        plant_step_with_effects(truth, state, noise, DT * truth[at.INTEGRATION_STEP])
    else:
        hold_still(truth, state)
    go_back(truth, sensor, estimate, tick)
    log_estimate(sensor, estimate, P, log)
    be_honest(sensor, estimate)
    log_inertial(sensor, log)
    log_battery(sensor, log)
    log_baro(state, noise, tick, log)
    log_setpoint(setpoint, log)
    log_control(memory, param, log, union_float, union_short)
    if board[at.B_BRUSHLESS] > 0.0:
        log_rotor_speed(truth, board, state, noise, log)
