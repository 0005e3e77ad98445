"""sampled_commands, motor_lag, input_delay, measurement_delay: timing of commands and measurements.

sampled_commands: a logged command stands for all commands of the control loop until the next logged one. A loop at
500 Hz, logged at 100 Hz, shows every fifth command. The smooth part of the commands acts as logged. The innovation of a
command (logged less expected from earlier commands) is partly noise of the loop: it acts for 2 ms and not for 10 ms. So
the torque that acts contains only a part of the innovation, as in a Kalman filter of constant gain:

    u = expected + (1 - share) (logged - expected),

with one share for roll and pitch (tilt) and one for yaw (turn). The total thrust of the rotors is smooth. With the
whole innovation, torques look too weak (errors in the variables; Fuller, Measurement Error Models, 1987, ch. 1). The
effect belongs to the log and not to the drone.
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

# Columns: total thrust, torque about x, y, z; orthonormal
MODES = 0.5 * np.stack([np.ones(4), ROLL_SIGN, PITCH_SIGN, YAW_SIGN], axis=1)
LOOP = 2e-3  # s between commands of the loop (500 Hz, crazyflie-firmware stabilizer.c)


def shrunk(thrust: NDArray, *, tilt: float, turn: float, **_: Any) -> NDArray:
    """Settled thrusts (m, 4) [N] less shares of the innovations of their torques: tilt about x and y, turn about z."""
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
    """Shares, for logs slower than the loop: from 0 (smooth commands) to most of the innovation (noise)."""
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
    """Add a delay before the lag [s]: a command of time t acts at t + delay."""
    return lag, before + delay


def _clock(conditions: Conditions) -> Sizes:
    """s, error of the time between a stamp and its effect; measured speeds have stamps of their own."""
    stamps = 5e-3 if conditions.measured_speeds else 2e-3
    return {"delay": math.hypot(stamps, conditions.unlogged_share * conditions.period)}


# s: without hidden effects and with free torques, 51 to 55 ms instead of 50 in ten flights
LAG_SD = 2e-3


def _lag(conditions: Conditions) -> Sizes:
    """s: `LAG_SD`, and the error by commands between the logged ones, which change torques by `unlogged_share`.

    At the frequency 1 / lag, a relative change of the lag changes the torque half as much, so the factor is two. In 53
    calm flights of two real drones with shares of 0.3 to 1, the estimated lag is 14 to 200 ms instead of 50.
    """
    if conditions.measured_speeds or conditions.lag <= 0.0:
        return {}
    return {"time_constant": math.hypot(LAG_SD, 2.0 * conditions.lag * conditions.unlogged_share)}


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
    twins=("torque_scale",),  # a longer lag with more torque has nearly the same signals as neither
    # payload and thrust_scale by the same factor together look like torque_scale, a twin
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


SHOWN = {  # stream -> its measured quantities
    "state": ("position", "velocity", "attitude"),
    "pose": ("position", "attitude"),
    "gyro": ("body_rate",),
    "accelerometer": ("specific_force",),
}


def shown_late(situation: Situation, *, delay: float, streams: str | Sequence[str]) -> Offset:
    """Values of `delay` [s] ago less present values, for the streams "state", "pose", "gyro", "accelerometer".

    Values are interpolated between rows; a step of 0 or of more than 0.1 s is a break. Before the first row of a
    stretch, the drone is assumed to move and turn as in this row. An onboard attitude from a delayed gyro has an error
    where the drone turns fast (`onboard_estimate.py`). Differences of a filter's rates over some ms are half noise of
    the gyro, and the noise of the same sample that is to be explained; `Situation.integrated` has none.
    """
    tilt = np.zeros((situation.size, 3))
    offset = Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)), tilt)
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
        tilt += attitude_error(situation, offset.state[:, 9:12], delay=delay)
        offset.state[:, 6:9] += tilt
    if "specific_force" in shown:
        offset.specific_force[:] = _past(situation.specific_force, row, part) - situation.specific_force
    return offset


def _looked_up(situation: Situation, delay: float) -> tuple[NDArray, NDArray, NDArray]:
    """For each moment: the last row before t - delay, the fraction of the step to the next, s before the first row."""
    gap, broken = stretches(situation)
    clock = np.cumsum(np.where(broken, 1.0, gap))  # 1 s between stretches, more than any delay
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
    """(n, 3) rad, body axes: rotation from the present to the shown attitude; rotation matrices are interpolated."""
    shown = _past(rotation.reshape(-1, 9), row, part).reshape(-1, 3, 3)
    return rotation_between(rotation, shown)


def _delay_limit(chosen: Mapping[str, Any], conditions: Conditions) -> Limits:
    """s. In 51 simulated flights without a delayed gyro, rates are at most 1.2 ms later than usual. Velocities of
    onboard filters have a delay of 0.7 to 5.7 ms, in ten flights of five filters. The filters of gyros differ by 3 ms
    (`RATE_LAGS`), which matters where the attitude does not come from the gyro."""
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
    # systematic: the time constant of the correction of onboard attitudes is only roughly known
    # (`onboard_estimate.py`); usual: see `onboard_filter`
    prior=Prior(own={"delay": 0.012}, systematic={"delay": 1.5e-3}, detection_limit=_delay_limit),
    needs=("position", "velocity", "attitude", "body_rate", "specific_force"),
    belongs_to="recording",
    separates="log the gyro and the pose at 100 Hz or more, and turn and stop sharply several times",
)
