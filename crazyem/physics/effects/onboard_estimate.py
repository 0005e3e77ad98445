"""onboard_filter, and the error of an attitude that is made on board of a late gyro.

A gyro is low-passed before it is logged (crazyflie-firmware, sensors_bmi088_bmp3xx.c: second order at 80 Hz, 2.8 ms),
and so are the accelerations that carry an onboard estimate of velocity from one fix of the pose to the next; attitude
and position, which the fixes show, are later by less, but from one fix to the next an attitude is the sum of a late
gyro. So rates are behind the attitude, velocities behind the position. It belongs to the log and not to the drone: no
vehicle file needs it, and diagnosis leaves it free (`crazyem/diagnosis/fitting/nuisances.py`).

The attitude integrates the gyro, and fixes of the pose draw it back, so its error e [rad, body axes] goes by

    e' = r - e / T,    r: what the gyro shows less the rate that was [rad/s].

T is that of the firmware's Kalman filter with a pose at 100 Hz; what a gyro's bias leads such attitudes to in simulated
flights, the bias times T, says 0.038 to 0.043 s.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.physics.effects.effect import Effect, Offset, Parameter, Situation, stretches
from crazyem.physics.effects.prior import Conditions, Prior, Sizes
from crazyem.vehicle import GRAVITY

CORRECTION_SECONDS = 0.04  # s, T above
MEMORY_SECONDS = 3.0 * CORRECTION_SECONDS  # s: what a gyro showed before is 5 % of an attitude's error


@compiled
def _relaxed(gap, broken, drive, time, out):
    """e at every row, from drives (n, 3) that are the means over the steps that end there; 0 where a stretch begins."""
    for k in range(len(gap)):
        if broken[k]:
            out[k] = 0.0
            continue
        left = np.exp(-gap[k] / time)
        for i in range(3):
            out[k, i] = left * out[k - 1, i] + time * (1.0 - left) * drive[k, i]


def disturbs_attitude(values: Mapping[str, Any]) -> bool:
    """Whether an effect with these values disturbs attitudes that are made on board."""
    return "gyro" in values.get("streams", ()) or bool(values.get("rate_lag", 0.0))


def attitude_error(situation: Situation, rate_error: NDArray, *, delay: float) -> NDArray:
    """(n, 3) rad, body axes: how far an attitude made on board is off by a gyro's errors; 0 where it is not made so.

    rate_error: (n, 3) rad/s at the rows, of a gyro that is `delay` [s] late. What it is at a row it has been since
    `delay` after the row before: rates go straight from row to row.
    """
    out = np.zeros((situation.size, 3))
    if not situation.fused or not situation.size:
        return out
    gap, broken = stretches(situation)
    before = np.roll(rate_error, 1, axis=0)
    before[broken] = 0.0
    share = np.clip(0.5 * delay / np.where(gap > 0.0, gap, np.inf), 0.0, 0.5)[:, None]
    drive = np.ascontiguousarray((1.0 - share) * rate_error + share * before, dtype=np.float64)
    _relaxed(gap, broken, drive, CORRECTION_SECONDS, out)
    return out


@compiled
def _path_errors(gap, broken, drive, time, position, velocity):
    """Errors (n, 3) at every row, by drives (n, 3) that are the means over the steps that end there; 0 where a stretch
    begins (`path_error`)."""
    for k in range(len(gap)):
        if broken[k]:
            position[k] = 0.0
            velocity[k] = 0.0
            continue
        part = gap[k] / time
        left, cosine, sine = np.exp(-part), np.cos(part), np.sin(part)
        for i in range(3):
            last_p, last_v = 0.5 * time * time * drive[k, i], time * drive[k, i]
            p, v = position[k - 1, i] - last_p, velocity[k - 1, i] - last_v
            position[k, i] = last_p + left * (cosine * p + sine * (time * v - p))
            velocity[k, i] = last_v + left * (cosine * v + sine * (v - 2.0 * p / time))


def path_error(situation: Situation, time_constant: float) -> tuple[NDArray, NDArray]:
    """(n, 3) m, (n, 3) m/s, world axes: errors p, v of a filter that does not know the specific force f along body x
    and y, nor that its attitude is turned by d [rad].

    p' = v - 2 p / T, v' = R (d x (0, 0, f_z) - (f_x, f_y, 0)) - 2 p / T^2, and 0 where a stretch begins. That is the
    steady Kalman filter of a position that is fixed and of accelerations that are white noise: its Riccati equation
    makes the second gain half of the first one squared. A constant force makes v off by T [s] times the force.
    """
    position, velocity = np.zeros((situation.size, 3)), np.zeros((situation.size, 3))
    if time_constant and situation.size:
        gap, broken = stretches(situation)
        force = situation.specific_force if situation.model_force is None else situation.model_force
        unknown = -force[:, :2]
        if situation.tilt is not None:
            unknown = unknown + force[:, 2:] * np.stack([situation.tilt[:, 1], -situation.tilt[:, 0]], axis=1)
        drive = np.einsum("nij,nj->ni", situation.rotation[:, :, :2], unknown)
        _path_errors(gap, broken, np.ascontiguousarray(drive), time_constant, position, velocity)
    return position, velocity


def filtered(
    situation: Situation, *, rate_lag: float, velocity_lag: float, attitude_lag: float, lateral_time_constant: float
) -> Offset:
    """The gyro shows w - rate_lag dw/dt, the estimate of velocity v - velocity_lag dv/dt, the attitude that of
    attitude_lag before; lags in s.

    The filter does not know the specific force along body x and y (drag, wind); fixes draw its velocity back within
    lateral_time_constant [s] (`path_error`). Nothing where it is not made so.
    """
    offset = Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)))
    acceleration = np.einsum("nij,nj->ni", situation.rotation, situation.specific_force)
    acceleration[:, 2] -= GRAVITY
    offset.state[:, 3:6] = -velocity_lag * acceleration
    if situation.fused:
        position, velocity = path_error(situation, lateral_time_constant)
        offset.state[:, :3] = position
        offset.state[:, 3:6] += velocity
    offset.state[:, 9:12] = -rate_lag * situation.angular_acceleration
    offset.state[:, 6:9] = attitude_error(situation, offset.state[:, 9:12], delay=max(rate_lag, 0.0))
    offset.state[:, 6:9] -= attitude_lag * situation.body_rate
    return offset


def _lags(conditions: Conditions) -> Sizes:
    """s: rates behind the attitude, velocities behind the position, by the filters of the firmware.

    In 80 flights with nothing hidden 0.0 to 2.4 and 0.0 to 1.6 ms, most in quick ones; of velocities that a filter on
    board makes 0.7 to 5.7 ms in ten simulated flights of five filters. Fixes draw a velocity back that is made without
    the drag: within 0.17 to 0.36 s in nine simulated flights, by the rate and the noise of the fixes. A filter that
    knows all forces has none of that error.
    """
    if not {"attitude", "position"} & conditions.signals:
        return {}
    made = conditions.onboard and {"velocity", "position"} <= conditions.signals
    found = {"rate_lag": RATE_LAGS[conditions.onboard][1]} if "body_rate" in conditions.signals else {}
    found |= {"velocity_lag": 2e-3 if made else 0.7e-3} if "velocity" in conditions.signals else {}
    return found | ({"lateral_time_constant": 0.2} if made and found else {})


# s, mean and standard deviation of a gyro's lag, by whether the attitude beside it is made on board. A second-order
# low-pass filter of f Hz is sqrt(2) / (2 pi f) late: 2.8 ms for the Crazyflie's 80 Hz (sensors_bmi088_bmp3xx.c), 5.6 ms
# for the 40 Hz of PX4 (IMU_GYRO_CUTOFF), nothing in many simulators. An attitude made of that gyro is late as well.
RATE_LAGS = {True: (1.2e-3, 0.7e-3), False: (2.8e-3, 1.5e-3)}


def _mean_lags(conditions: Conditions) -> Sizes:
    """s: see `_lags`."""
    return {"rate_lag": RATE_LAGS[conditions.onboard][0], "velocity_lag": 0.6e-3, "lateral_time_constant": 0.2}


ONBOARD_FILTER = Effect(
    "onboard_filter",
    (
        Parameter("rate_lag", "s", 0.0, -0.02, 0.02, 1e-3),
        Parameter("velocity_lag", "s", 0.0, -0.02, 0.02, 1e-3),
        Parameter("attitude_lag", "s", 0.0, -0.02, 0.02, 1e-3, needs=("attitude",)),
        Parameter("lateral_time_constant", "s", 0.0, 0.0, 1.0, 0.01, needs=("attitude",)),
    ),
    order=85,
    measured=filtered,
    uses_force=True,
    prior=Prior(usual=_lags, centre=_mean_lags),
    needs=("velocity", "body_rate"),
    words="filters on board",
    belongs_to="recording",
    separates="log the pose of motion capture beside the onboard estimate",
)
