"""onboard_filter: what filters on board do to what is logged.

A gyro is low-passed before it is logged (crazyflie-firmware, sensors_bmi088_bmp3xx.c: second order at 80 Hz, 2.8 ms),
and so are the accelerations that carry an onboard estimate of velocity from one fix of the pose to the next; attitude
and position, which the fixes show, are later by less, but from one fix to the next an attitude is the sum of a late
gyro. So rates are behind the attitude, velocities behind the position;
and an attitude made on board of that gyro is off where the drone turns fast (`fused_attitude.py`).
It belongs to the log and not to the drone: no vehicle file needs it, and diagnosis leaves it free
(`crazyem/diagnosis/fitting/nuisances.py`).
"""

import numpy as np

from crazyem.physics.effects.effect import Effect, Offset, Parameter, Situation
from crazyem.physics.effects.fused_attitude import attitude_error
from crazyem.physics.effects.prior import Prior
from crazyem.vehicle import GRAVITY


def filtered(situation: Situation, *, rate_lag: float, velocity_lag: float, attitude_lag: float) -> Offset:
    """The gyro shows w - rate_lag dw/dt, the estimate of velocity v - velocity_lag dv/dt, the attitude that of
    attitude_lag before; lags in s."""
    offset = Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)))
    acceleration = np.einsum("nij,nj->ni", situation.rotation, situation.specific_force)
    acceleration[:, 2] -= GRAVITY
    offset.state[:, 3:6] = -velocity_lag * acceleration
    offset.state[:, 9:12] = -rate_lag * situation.angular_acceleration
    offset.state[:, 6:9] = attitude_error(situation, offset.state[:, 9:12], delay=max(rate_lag, 0.0))
    offset.state[:, 6:9] -= attitude_lag * situation.body_rate
    return offset


ONBOARD_FILTER = Effect(
    "onboard_filter",
    (
        Parameter("rate_lag", "s", 0.0, -0.02, 0.02, 1e-3),
        Parameter("velocity_lag", "s", 0.0, -0.02, 0.02, 1e-3),
        Parameter("attitude_lag", "s", 0.0, -0.02, 0.02, 1e-3, needs=("attitude",)),
    ),
    order=85,
    measured=filtered,
    # usual: 0.0 to 2.4 and 0.0 to 1.6 ms in 80 flights with nothing hidden (`fitting/nuisances.py`); attitudes 1.3 to
    # 4.2 ms late in three more
    prior=Prior(usual={"rate_lag": 1.3e-3, "velocity_lag": 7e-4, "attitude_lag": 2.5e-3}),
    needs=("velocity", "body_rate"),
    words="filters on board",
    belongs_to="recording",
    separates="log the pose of motion capture beside the onboard estimate",
)
