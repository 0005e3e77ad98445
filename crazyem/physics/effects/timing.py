"""sampled_commands, motor_lag, input_delay, measurement_delay: when commands act, and of when measurements tell.

sampled_commands: a logged command stands for all that its loop sent until the next one. A loop at 500 Hz, logged at
100 Hz, shows every fifth command. What is smooth in them acts as logged. What is new in a command, beyond what the ones
before it led to expect, is in part noise of the loop: it acts for 2 ms and not for 10. So the torque that acts is the
expected one and a share of what is new, as in a Kalman filter of constant gain

    u = expected + (1 - share) (logged - expected),

with one share for roll and pitch (tilt) and one for yaw (turn). The thrust of all rotors together is smooth.
With all of it, torques look too weak (errors in the variables; Fuller, Measurement Error Models, 1987, ch. 1).
It belongs to the log and not to the drone.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Offset, Parameter, Situation, stretches
from crazyem.physics.effects.onboard_estimate import attitude_error
from crazyem.physics.effects.prior import Conditions, Limits, Prior, Sizes
from crazyem.physics.lag import PREDICTION_ORDER, fit_predictor
from crazyem.physics.rotations import rotation_between
from crazyem.physics.rotors import PITCH_SIGN, ROLL_SIGN, YAW_SIGN

# Columns: all together, about x, about y, about z; orthonormal
MODES = 0.5 * np.stack([np.ones(4), ROLL_SIGN, PITCH_SIGN, YAW_SIGN], axis=1)
LOOP = 2e-3  # s between commands of the loop (500 Hz, crazyflie-firmware stabilizer.c)


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


def _unlogged(conditions: Conditions) -> Sizes:
    """Shares of a log that is slower than the loop: all from 0, of commands that are smooth, to most of what is new."""
    slower = conditions.period > 1.5 * LOOP and not conditions.measured_speeds
    return {"tilt": 0.4, "turn": 0.4} if slower and conditions.shows_rotation else {}


SAMPLED_COMMANDS = Effect(
    "sampled_commands",
    (Parameter("tilt", "", 0.0, 0.0, 1.0, 0.05), Parameter("turn", "", 0.0, 0.0, 1.0, 0.05)),
    order=21,
    commanded=shrunk,
    prior=Prior(usual=_unlogged),
    needs=("motor_command",),
    words="commands between samples",
    belongs_to="recording",
    separates="log motor commands at 500 Hz",
)


def slow(lag: float, delay: float, *, time_constant: float) -> tuple[float, float]:
    """Replace the first-order lag of thrust [s]."""
    return time_constant, delay


def late(lag: float, before: float, *, delay: float) -> tuple[float, float]:
    """The command of t acts at t + delay, before the lag [s]."""
    return lag, before + delay


def _clock(conditions: Conditions) -> Sizes:
    """s between a stamp and its effect; stamps of measured speeds come by another way."""
    stamps = 5e-3 if conditions.measured_speeds else 2e-3
    return {"delay": math.hypot(stamps, conditions.unlogged_share * conditions.period)}


# s: the lag of rotors in the calm flights of real drones, 24 to 105 ms in 26 flights for a file's 50, whether anything
# was wrong with them or not, so a file to which one of them was fitted does not know it.
DAILY_LAG_SD = 0.025


def _lag(conditions: Conditions) -> Sizes:
    """s: with nothing hidden and torques as free, 51 to 55 ms instead of 50 in ten flights; or as from day to day."""
    if conditions.measured_speeds or conditions.lag <= 0.0:
        return {}
    if conditions.individual_file:
        return {"time_constant": DAILY_LAG_SD}
    return {"time_constant": 2e-3} if conditions.shows_rotation else {}


MOTOR_LAG = Effect(
    "motor_lag",
    (Parameter("time_constant", "s", math.nan, 0.0, 1.0, 2e-3),),
    order=22,
    own=lambda vehicle: {"time_constant": vehicle.motor_time_constant},
    constants={"time_constant": "lag"},
    about=("lag",),
    timing=slow,
    prior=Prior(own={"time_constant": 0.015}, usual=_lag, detection_limit={"time_constant": 7.5e-3}),
    needs=("motor_command",),
    separates="log rotor speeds; or log motor commands and gyro at 500 Hz or more, and step roll and pitch hard",
    spared={"rotor_speed": "log rotor speeds; or "},
    needs_torques=True,
    twins=("torque_scale",),  # a longer lag with more torque is nearly the same as neither
    # a heavier drone with as much more thrust has more torque and nothing else: beside a lag that is the same again
    never_beside=(frozenset({"payload", "thrust_scale"}),),
)

INPUT_DELAY = Effect(
    "input_delay",
    (Parameter("delay", "s", 0.0, 0.0, 0.1, 1e-3),),
    order=23,
    timing=late,
    prior=Prior(own={"delay": 8e-3}, usual=_clock, signed=True, detection_limit={"delay": 4e-3}),
    same_as={"measurement_delay": {"streams": ("state", "gyro")}},  # of all that is measured
    belongs_to="day",
    needs=("motor_command", "rotor_speed"),
    separates="log motor commands and gyro at 500 Hz or more, and step roll and pitch hard",
    needs_torques=True,
)


SHOWN = {  # which of position, velocity, attitude, rate, specific force a stream shows
    "state": ("position", "velocity", "attitude"),
    "pose": ("position", "attitude"),
    "gyro": ("body_rate",),
    "accelerometer": ("specific_force",),
}


def shown_late(situation: Situation, *, delay: float, streams: str | Sequence[str]) -> Offset:
    """What was `delay` [s] ago, less what is now, for the streams "state", "pose", "gyro", "accelerometer".

    Interpolates between rows, which are one path broken where a step is 0 or longer than 0.1 s. Before the first row of
    a stretch the drone moved and turned as in that row. An attitude that was made on board of a late gyro is off where
    the drone turns fast (`onboard_estimate.py`). Of a filter's rates differences over some ms are half the noise
    of the gyro, that of the very sample which is to be explained; `Situation.turned` has none.
    """
    offset = Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)))
    if delay == 0.0 or not situation.size:
        return offset
    names = [streams] if isinstance(streams, str) else streams
    shown = {quantity for name in names for quantity in SHOWN[name]}
    row, part, before = _looked_up(situation, delay)
    path = situation.integrated or situation
    if "position" in shown:
        offset.state[:, 0:3] = _past(path.position, row, part) - path.position
        offset.state[:, 0:3] -= before * situation.velocity.take(row, axis=0)
    if "velocity" in shown:
        offset.state[:, 3:6] = _past(path.velocity, row, part) - path.velocity
    if "attitude" in shown:
        offset.state[:, 6:9] = _past_attitude(path.rotation, row, part)
        offset.state[:, 6:9] -= before * situation.body_rate.take(row, axis=0)
    if "body_rate" in shown:
        offset.state[:, 9:12] = _past(path.body_rate, row, part) - path.body_rate
        offset.state[:, 6:9] += attitude_error(situation, offset.state[:, 9:12], delay=delay)
    if "specific_force" in shown:
        offset.specific_force[:] = _past(situation.specific_force, row, part) - situation.specific_force
    return offset


def _looked_up(situation: Situation, delay: float) -> tuple[NDArray, NDArray, NDArray]:
    """For each moment: the last row before t - delay, the part of the way to the next, and s before the first row."""
    gap, broken = stretches(situation)
    clock = np.cumsum(np.where(broken, 1.0, gap))  # stretches further apart than any delay
    first = np.maximum.accumulate(np.where(broken, np.arange(situation.size), 0))
    wanted = clock - delay
    row = np.maximum(np.searchsorted(clock, wanted, "right") - 1, first)
    before = np.maximum(clock[first] - wanted, 0.0)
    following = np.minimum(row + 1, situation.size - 1)
    length = clock[following] - clock[row]
    part = np.where((length > 0) & (before == 0.0), (wanted - clock[row]) / np.where(length > 0, length, 1.0), 0.0)
    return row, np.clip(part, 0.0, 1.0)[:, None], before[:, None]


def _past(values: NDArray, row: NDArray, part: NDArray) -> NDArray:
    shown = values.take(row, axis=0)
    return shown + part * (values.take(np.minimum(row + 1, len(values) - 1), axis=0) - shown)


def _past_attitude(rotation: NDArray, row: NDArray, part: NDArray) -> NDArray:
    """(n, 3) rad: rotation from the attitude now to the one shown, body axes; between rows along the chord."""
    shown = _past(rotation.reshape(-1, 9), row, part).reshape(-1, 3, 3)
    return rotation_between(rotation, shown)


def _delay_limit(chosen: Mapping[str, Any], conditions: Conditions) -> Limits:
    """s. Where no gyro was late, rates were 1.2 ms later than usual at most in 51 simulated flights. Velocities of a
    filter on board are 0.7 to 5.7 ms late anyway, in ten flights of five filters. Filters of gyros differ by 3 ms
    (`RATE_LAGS`), which shows where the attitude is not made of them."""
    least = 2e-3 if chosen.get("streams") == ("gyro",) else 6e-3
    return {"delay": least if conditions.onboard else 3e-3}


MEASUREMENT_DELAY = Effect(
    "measurement_delay",
    (
        Parameter("delay", "s", 0.0, 0.0, 0.1, 1e-3),
        Parameter(
            "streams",
            "",
            ("state",),
            0,
            0,
            0,
            chosen=(("state",), ("gyro",), ("accelerometer",)),
            among=tuple(SHOWN),
            phrase="of the {}",
            spoken={"state": "state estimate"},
        ),
    ),
    order=84,
    measured=shown_late,
    # systematic: how fast fixes draw an attitude back that is made of a late gyro is roughly known
    # (`onboard_estimate.py`); usual: see `onboard_filter`
    prior=Prior(own={"delay": 0.012}, systematic={"delay": 1.5e-3}, detection_limit=_delay_limit),
    needs=("position", "velocity", "attitude", "body_rate", "specific_force"),
    belongs_to="recording",
    separates="log the gyro and the pose at 100 Hz or more, and turn and stop sharply several times",
)
