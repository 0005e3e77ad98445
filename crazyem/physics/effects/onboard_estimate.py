"""onboard_filter, and the error of an onboard attitude because of a delayed gyro.

A gyro is low-passed before it is logged (crazyflie-firmware, sensors_bmi088_bmp3xx.c: second order at 80 Hz, 2.8 ms).
So are the accelerations that an onboard filter integrates to a velocity between two fixes of the pose. The fixes
correct attitude and position, so these have less delay, but between fixes the attitude is the integral of a delayed
gyro. So rates lag behind the attitude, and velocities behind the position. The effect belongs to the log and not to the
drone: it is in no vehicle file, and diagnosis has it as a nuisance (`crazyem/diagnosis/fitting/nuisances.py`).

The attitude integrates the gyro, and fixes of the pose correct it, so its error e [rad, body axes] follows

    e' = r - e / T,    r: measured less true body rate [rad/s].

T is the time constant of the firmware's Kalman filter with a pose at 100 Hz. In simulated flights, the error by a gyro
bias (bias times T) gives T = 0.038 to 0.043 s.
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
# s, mean and standard deviation of the time constant of `path_error`. Maximum likelihood over 88 simulated flights in
# random worlds (benchmarks/concealed, seeds 21601 and 22601) under the true model: 0.18 and 0.09.
LATERAL_SECONDS, LATERAL_SD = 0.2, 0.1
MEMORY_SECONDS = 3.0 * CORRECTION_SECONDS  # s; older errors of the gyro are 5 % of an attitude's error


@compiled
def _relaxed(gap, broken, drive, time, out):
    """Error e at every row, from means of r (n, 3) over the steps that end there; 0 where a stretch begins."""
    for k in range(len(gap)):
        if broken[k]:
            out[k] = 0.0
            continue
        left = np.exp(-gap[k] / time)
        for i in range(3):
            out[k, i] = left * out[k - 1, i] + time * (1.0 - left) * drive[k, i]


def disturbs_attitude(values: Mapping[str, Any]) -> bool:
    """Whether an effect with these values changes onboard attitudes."""
    return "gyro" in values.get("streams", ()) or bool(values.get("rate_lag", 0.0))


def attitude_error(situation: Situation, rate_error: NDArray, *, delay: float) -> NDArray:
    """Error (n, 3) [rad, body axes] of an onboard attitude because of a gyro's errors; 0 for other attitudes.

    rate_error: (n, 3) rad/s at the rows, of a gyro that is `delay` [s] late. Rates are linear between rows, so the
    error reaches its value at a row `delay` after the row before.
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
def path_step(p, v, drive, time, decay, cosine, sine):
    """Errors of position and velocity along an axis after a step, by a mean acceleration `drive` (`path_error`).

    decay, cosine and sine: exp(-x), cos(x), sin(x) of the step x in units of `time` [s].
    """
    last_p, last_v = 0.5 * time * time * drive, time * drive
    p, v = p - last_p, v - last_v
    return last_p + decay * (cosine * p + sine * (time * v - p)), last_v + decay * (
        cosine * v + sine * (v - 2.0 * p / time)
    )


@compiled
def path_errors(gap, broken, drive, time, position, velocity):
    """Errors of position and velocity (n, 3) at every row, from mean accelerations `drive` (n, 3) over the steps that
    end there; 0 where a stretch begins, row 0 as given (`path_error`)."""
    for k in range(1, len(gap)):
        if broken[k]:
            position[k] = 0.0
            velocity[k] = 0.0
            continue
        part = gap[k] / time
        left, cosine, sine = np.exp(-part), np.cos(part), np.sin(part)
        for i in range(3):
            position[k, i], velocity[k, i] = path_step(
                position[k - 1, i], velocity[k - 1, i], drive[k, i], time, left, cosine, sine
            )


def path_error(situation: Situation, time_constant: float) -> tuple[NDArray, NDArray]:
    """Errors p (n, 3) [m], v (n, 3) [m/s], world axes, of a filter that does not know the specific force f along body
    x and y, nor the error d [rad] of its attitude.

    p' = v - 2 p / T, v' = R (d x (0, 0, f_z) - (f_x, f_y, 0)) - 2 p / T^2, and 0 where a stretch begins. This is the
    steady Kalman filter with position fixes and accelerations as white noise: by its Riccati equation, the second gain
    is half of the first one squared. A constant force gives an error of v of T [s] times the force.
    """
    position, velocity = np.zeros((situation.size, 3)), np.zeros((situation.size, 3))
    if time_constant and situation.size:
        gap, broken = stretches(situation)
        force = situation.specific_force if situation.model_force is None else situation.model_force
        unknown = -force[:, :2]
        if situation.tilt is not None:
            unknown = unknown + force[:, 2:] * np.stack([situation.tilt[:, 1], -situation.tilt[:, 0]], axis=1)
        drive = np.einsum("nij,nj->ni", situation.rotation[:, :, :2], unknown)
        path_errors(gap, broken, np.ascontiguousarray(drive), time_constant, position, velocity)
    return position, velocity


def filtered(
    situation: Situation, *, rate_lag: float, velocity_lag: float, attitude_lag: float, lateral_time_constant: float
) -> Offset:
    """Errors of signals with lags [s]: gyro w - rate_lag dw/dt, velocity v - velocity_lag dv/dt, attitude at the time
    attitude_lag before.

    The filter does not know the specific force along body x and y (drag, wind); fixes correct its velocity with the
    time constant lateral_time_constant [s] (`path_error`). This error exists for onboard filters only.
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


def _estimated(conditions: Conditions) -> bool:
    """Whether an onboard filter estimates velocity and position."""
    return conditions.onboard and {"velocity", "position"} <= conditions.signals


def _lags(conditions: Conditions) -> Sizes:
    """s: lags of rates behind the attitude and of velocities behind the position, by filters of the firmware.

    In 80 flights without hidden effects these are 0.0 to 2.4 and 0.0 to 1.6 ms, most in fast flights. Velocities of
    onboard filters: `VELOCITY_LAG`. A filter that does not know the drag also has a lateral_time_constant
    (`LATERAL_SECONDS`); a filter that knows all forces does not have this error.
    """
    if not {"attitude", "position"} & conditions.signals:
        return {}
    made = _estimated(conditions)
    found = {"rate_lag": RATE_LAGS[conditions.onboard][1]} if "body_rate" in conditions.signals else {}
    found |= {"velocity_lag": VELOCITY_LAG[made][1]} if "velocity" in conditions.signals else {}
    return found | ({"lateral_time_constant": LATERAL_SD} if made and found else {})


# s, mean and standard deviation of a gyro's lag; key: whether the attitude comes from an onboard filter. A second-order
# low-pass filter of f Hz has a lag of sqrt(2) / (2 pi f): 2.8 ms for the Crazyflie's 80 Hz (sensors_bmi088_bmp3xx.c),
# 5.6 ms for the 40 Hz of PX4 (IMU_GYRO_CUTOFF), 0 in many simulators. An attitude from this gyro has a lag, too.
RATE_LAGS = {True: (1.2e-3, 0.7e-3), False: (2.8e-3, 1.5e-3)}
# s, mean and standard deviation of a velocity's lag; key: whether an onboard filter estimates velocity and position.
# Maximum likelihood over 91 simulated flights with onboard filters in random worlds (benchmarks/concealed, seeds 21601
# and 22601) under the true model. Motion capture: see `_lags`.
VELOCITY_LAG = {True: (2.1e-3, 1.6e-3), False: (0.6e-3, 0.7e-3)}


def _mean_lags(conditions: Conditions) -> Sizes:
    """s: means of the lags, see `_lags`."""
    return {
        "rate_lag": RATE_LAGS[conditions.onboard][0],
        "velocity_lag": VELOCITY_LAG[_estimated(conditions)][0],
        "lateral_time_constant": LATERAL_SECONDS,
    }


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
