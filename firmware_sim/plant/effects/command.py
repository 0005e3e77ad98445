"""What becomes of a command before the rotor: input_delay, and the hidden sticky_rotor.

input_delay: the command of t acts at t + delay, exactly, also between two milliseconds; the log shows it undelayed.
sticky_rotor: one rotor keeps its command until the wanted one is more than `deadband` (of full scale) away.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def remember(truth, state):
    """Put the commands of this millisecond (CLOCK) into the ring, the sticky rotor's as it follows them."""
    row = at.COMMANDS + 4 * (int(state[at.CLOCK]) % at.DELAY_ROWS)
    for i in range(4):
        pwm = state[at.PWM + i]
        if truth[at.STICKY_ROTOR] == i + 1:
            if abs(pwm - state[at.HELD]) > truth[at.STICKY_BAND] or pwm == 0.0:
                state[at.HELD] = pwm
            pwm = state[at.HELD]
        state[row + i] = pwm


@kernel
def delayed(truth, state, i, part):
    """Command of motor i in part 0 (the first delay - floor(delay) ms) or part 1 (the rest) of this millisecond."""
    back = math.floor(truth[at.INPUT_DELAY]) + (1 - part)
    row = (int(state[at.CLOCK]) - back) % at.DELAY_ROWS  # not yet written, so 0, before the first command acts
    return state[at.COMMANDS + 4 * row + i]
