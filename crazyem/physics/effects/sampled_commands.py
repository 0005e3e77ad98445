"""sampled_commands: a logged command stands for all that its loop sent until the next one.

A loop at 500 Hz, logged at 100 Hz, shows every fifth command. What is smooth in them acts as logged. What is new in a
command, beyond what the ones before it led to expect, is in part noise of the loop: it acts for 2 ms and not for 10.
So the torque that acts is the expected one and a share of what is new, as in a Kalman filter of constant gain

    u = expected + (1 - share) (logged - expected),

with one share for roll and pitch (tilt) and one for yaw (turn). The thrust of all rotors together is smooth.

With all of it, torques look too weak (errors in the variables; Fuller, Measurement Error Models, 1987, ch. 1).
It belongs to the log and not to the drone: `diagnose --method posterior` leaves it free for each recording.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Parameter
from crazyem.physics.effects.prior import Prior
from crazyem.physics.lag import PREDICTION_ORDER, fit_predictor
from crazyem.physics.rotors import PITCH_SIGN, ROLL_SIGN, YAW_SIGN

# Columns: all together, about x, about y, about z; orthonormal
MODES = 0.5 * np.stack([np.ones(4), ROLL_SIGN, PITCH_SIGN, YAW_SIGN], axis=1)


def shrunk(thrust: NDArray, *, tilt: float, turn: float, **_: Any) -> NDArray:
    """Settled thrusts (m, 4) [N] less a share of the innovations of their torques about x and y, and about z."""
    if not (tilt or turn) or len(thrust) <= PREDICTION_ORDER:
        return thrust
    modes = thrust @ MODES
    weights = fit_predictor(np.ascontiguousarray(modes))
    rows = len(modes) - PREDICTION_ORDER
    expected = np.tile(weights[:, PREDICTION_ORDER], (rows, 1))
    for j in range(PREDICTION_ORDER):
        expected += weights[:, j] * modes[PREDICTION_ORDER - 1 - j :][:rows]
    modes[PREDICTION_ORDER:] -= np.array([0.0, tilt, tilt, turn]) * (modes[PREDICTION_ORDER:] - expected)
    return modes @ MODES.T


SAMPLED_COMMANDS = Effect(
    "sampled_commands",
    (Parameter("tilt", "", 0.0, 0.0, 1.0, 0.05), Parameter("turn", "", 0.0, 0.0, 1.0, 0.05)),
    order=21,
    commanded=shrunk,
    prior=Prior(usual={"tilt": 0.4, "turn": 0.4}),
    needs=("motor_command",),
    words="commands between samples",
    belongs_to="recording",
    separates="log motor commands at 500 Hz",
)
