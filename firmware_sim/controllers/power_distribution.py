"""From the controller's output to motor commands at 1 kHz: mixing, battery compensation, capping and idle thrust.

As power_distribution_quadrotor.c and motors.c, with their integer truncations: motor.m* log the truncated values.
"""

import math

from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at

FULL = 65535.0
INT32 = 2147483647.0


@kernel
def to_int(value):
    """C's conversion of a float to int32: towards zero; not a number becomes 0."""
    if not math.isfinite(value):
        return 0.0
    return float(math.trunc(min(max(value, -INT32), INT32)))


@kernel
def mix(board, memory, i):
    """Uncapped request of motor i (0..3) on the linear scale 65535 = THRUST_MAX."""
    left = 1.0 if i >= 2 else -1.0  # side, as roll torque sees it
    back = 1.0 if i in (1, 2) else -1.0
    turn = 1.0 if i in (1, 3) else -1.0
    if memory[mem.MODE] == mem.FORCE_TORQUE_MODE:
        w, d = mem.WRENCH, 4.0 * board[at.B_ARM]
        yaw = memory[w + 3] / (4.0 * board[at.B_TORQUE_PER_THRUST])
        f = 0.25 * memory[w] + left * memory[w + 1] / d + back * memory[w + 2] / d + turn * yaw
        return to_int(max(f, 0.0) / board[at.B_THRUST_MAX] * FULL)
    g = mem.LEGACY
    roll, pitch = to_int(memory[g + 1] / 2.0), to_int(memory[g + 2] / 2.0)
    # m1 = T - r + p + y, m2 = T - r - p - y, m3 = T + r - p + y, m4 = T + r + p - y
    return to_int(memory[g] + left * roll - back * pitch - turn * memory[g + 3])


@kernel
def motor_volts(board, thrust):
    """Motor volts at which the firmware's cubic gives `thrust` [N]: Cardano's real root, the cubic being monotone."""
    c = at.B_CURVE
    a, b = board[c + 2] / board[c + 3], board[c + 1] / board[c + 3]
    e = (board[c] - thrust) / board[c + 3]
    p = b - a * a / 3.0
    q = 2.0 * a**3 / 27.0 - a * b / 3.0 + e
    root = math.sqrt(max(q * q / 4.0 + p**3 / 27.0, 0.0))
    return cube_root(-q / 2.0 + root) + cube_root(-q / 2.0 - root) - a / 3.0


@kernel
def cube_root(x):
    """The real cube root of either sign."""
    return math.copysign(abs(x) ** (1.0 / 3.0), x)


@kernel
def compensate(board, volts, request):
    """Battery compensation of one motor: thrust request -> PWM ratio for the filtered battery voltage."""
    thrust = request / FULL * board[at.B_THRUST_MAX]
    if volts < 2.0 or thrust < board[at.B_THRUST_MIN]:
        return 0.0
    return to_int(motor_volts(board, thrust) / volts * FULL)


@kernel
def motors_step(board, state, sensor, param, memory, log, allowed, armed):
    """Set the four PWM ratios from the controller's output, or from motorPowerSet if enabled."""
    sensor[at.VBAT_FILTERED] += 0.01 * (sensor[at.VBAT] - sensor[at.VBAT_FILTERED])
    highest = 0.0
    for i in range(4):
        request = compensate(board, sensor[at.VBAT_FILTERED], mix(board, memory, i))
        memory[mem.REQUEST + i] = request
        log[lv.MOTOR_REQ + i] = request
        highest = max(highest, request)
    excess = max(highest - FULL, 0.0)
    requires_arming = board[at.B_REQUIRE_ARMING] > 0.0
    idle = min(max(param[pm.IDLE_THRUST], 0.0), FULL) if requires_arming else 0.0
    manual = int(param[pm.POWER_SET])
    for i in range(4):
        pwm = max(memory[mem.REQUEST + i] - excess, idle)
        if manual > 0:
            pwm = min(max(param[pm.POWER_SET + (1 if manual > 1 else 1 + i)], 0.0), FULL)
            if manual == 3:
                pwm = min(max(compensate(board, sensor[at.VBAT_FILTERED], pwm), 0.0), FULL)
        if not allowed or param[pm.STOP] > 0.0 or (requires_arming and not armed):
            pwm = 0.0
        state[at.PWM + i] = pwm
        log[lv.MOTOR + i] = pwm
