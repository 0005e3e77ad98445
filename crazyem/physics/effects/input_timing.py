"""motor_lag and input_delay: how long the rotors take to answer."""

import math

from crazyem.physics.effects.effect import Effect, Parameter
from crazyem.physics.effects.prior import Logged, Prior, Sizes


def slow(lag: float, delay: float, *, time_constant: float) -> tuple[float, float]:
    """Replace the first-order lag of thrust [s]."""
    return time_constant, delay


def late(lag: float, before: float, *, delay: float) -> tuple[float, float]:
    """The command of t acts at t + delay, before the lag [s]."""
    return lag, before + delay


def _clock(logged: Logged) -> Sizes:
    """Between a stamp and its effect; stamps of measured speeds come by another way (`fitting/nuisances.py`)."""
    return {"delay": 5e-3 if logged.measured else 2e-3 * logged.coarse}


MOTOR_LAG = Effect(
    "motor_lag",
    (Parameter("time_constant", "s", math.nan, 0.0, 1.0, 2e-3),),
    order=22,
    timing=slow,
    # usual: sixteen flights with nothing hidden came out 3.1 ms (rms) off (`fitting/nuisances.py`)
    prior=Prior(own={"time_constant": 0.015}, usual=lambda logged: {"time_constant": 3e-3 * logged.coarse}),
    needs=("motor_command",),
    separates="log rotor speeds; or log motor commands and gyro at 500 Hz or more, and step roll and pitch hard",
    spared={"rotor_speed": "log rotor speeds; or "},
)

INPUT_DELAY = Effect(
    "input_delay",
    (Parameter("delay", "s", 0.0, 0.0, 0.1, 1e-3),),
    order=23,
    timing=late,
    prior=Prior(own={"delay": 8e-3}, usual=_clock),
    needs=("motor_command", "rotor_speed"),
    separates="log motor commands and gyro at 500 Hz or more, and step roll and pitch hard",
)
