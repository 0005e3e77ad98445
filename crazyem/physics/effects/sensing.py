"""attitude_misalignment, accelerometer_misalignment, gyro_bias, velocity_scale, rotor_sensor: errors of sensors."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Offset, Parameter, Situation
from crazyem.physics.effects.prior import Conditions, Limits, Prior, Sizes, alike, in_turn
from crazyem.physics.rotations import axes, quaternion_from_euler, rotation_vector_from_quaternion


def tilted_pose(situation: Situation, *, roll: float, pitch: float, yaw: float) -> Offset:
    """The measured attitude is R R_P, R_P = Rz(yaw) Ry(pitch) Rx(roll): axes of the pose frame in the body [rad]."""
    offset = _nothing(situation)
    offset.state[:, 6:9] = rotation_vector_from_quaternion(quaternion_from_euler(roll, pitch, yaw))
    return offset


def tilted_accelerometer(situation: Situation, *, roll: float, pitch: float, yaw: float) -> Offset:
    """The accelerometer measures R_A' f; R_A, formed as R_P, holds its axes in the body [rad]."""
    offset = _nothing(situation)
    offset.specific_force[:] = situation.specific_force @ axes(roll, pitch, yaw) - situation.specific_force
    return offset


def biased_gyro(situation: Situation, *, x: float, y: float, z: float) -> Offset:
    """The gyro measures w + bias [rad/s], body."""
    offset = _nothing(situation)
    offset.state[:, 9:12] = (x, y, z)
    return offset


def scaled_velocity(situation: Situation, *, x: float, y: float, z: float) -> Offset:
    """The estimated velocity is scale times velocity, world axes; position is right."""
    offset = _nothing(situation)
    offset.state[:, 3:6] = (np.array([x, y, z]) - 1) * situation.velocity
    return offset


def _nothing(situation: Situation) -> Offset:
    return Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)))


def _leaning(conditions: Conditions) -> Sizes:
    """rad. An attitude computed from the acceleration has the tilt of the accelerometer.

    An onboard attitude with a biased gyro has an error of the bias times the time constant of the correction by fixes:
    38 to 43 ms in roll and pitch of two simulated flights.
    """
    if "attitude" not in conditions.signals:
        return in_turn("roll pitch yaw", 0.02, 0.02, 2e-3) if conditions.inferred_attitude else {}
    return alike("roll pitch yaw", 0.05 * conditions.gyro_bias) if conditions.gyro_bias > 0.0 else {}


def apparent(speed: NDArray, error: float) -> NDArray:
    """Apparent relative error (3,) of velocities of (3,) m/s (rms) by an error of an estimate [m/s].

    Errors of position and velocity are correlated, so a drone at low speed seems to move faster than it does.
    """
    found: NDArray = error / np.maximum(speed, 0.01)
    return found


# m/s. Motion capture: its jitter. Onboard filters: maximum likelihood, together with 0.2 %, over 120 axes of 40
# simulated flights without a wrong scale, in random worlds (benchmarks/concealed, seed 22601).
VELOCITY_ERROR = {False: 3e-3, True: 1e-3}
# m/s. In hover, velocities of 36 simulated onboard filters differ from the true ones by 0.9 to 10.6 mm/s (rms).
MAX_VELOCITY_ERROR = 1e-2


def _usual_scale(conditions: Conditions) -> Sizes:
    """Relative; at best, 0.2 %."""
    if not {"velocity", "position"} <= conditions.signals:
        return {}
    return in_turn("x y z", *(2e-3 + apparent(conditions.speed, VELOCITY_ERROR[conditions.onboard])))


def _scale_limit(chosen: Mapping[str, Any], conditions: Conditions) -> Limits:
    """Relative: twice the largest apparent error, at least 0.035."""
    error = MAX_VELOCITY_ERROR if conditions.onboard else VELOCITY_ERROR[False]
    return in_turn("x y z", *np.maximum(2.0 * apparent(conditions.speed, error), 0.035))


_ANGLES = tuple(Parameter(name, "rad", 0.0, -np.pi, np.pi, 5e-3) for name in ("roll", "pitch", "yaw"))

ATTITUDE_MISALIGNMENT = Effect(
    "attitude_misalignment",
    _ANGLES,
    order=80,
    measured=tilted_pose,
    prior=Prior(alike("roll pitch yaw", 0.04), _leaning, detection_limit=alike("roll pitch yaw", 2e-3)),
    needs=("attitude",),
    separates="hover for 5 s at each of four headings: a tilted frame turns with the drone, wind stays in the world",
    steady_force=True,
)

ACCELEROMETER_MISALIGNMENT = Effect(
    "accelerometer_misalignment",
    _ANGLES,
    order=81,
    measured=tilted_accelerometer,
    # usual: apparent angles because of small errors of the model's force, beside the sensor's bias; a yaw hardly
    # changes the thrust along body z
    prior=Prior(alike("roll pitch yaw", 0.04), in_turn("roll pitch yaw", 1.5e-3, 1.5e-3, 0.03)),
    needs=("specific_force",),
    own_likelihood=True,
    separates="record the accelerometer for 10 s with the drone standing on a level floor, then turned by 180 degrees",
)

GYRO_BIAS = Effect(
    "gyro_bias",
    tuple(Parameter(axis, "rad/s", 0.0, -1.0, 1.0, 5e-3) for axis in "xyz"),
    order=82,
    measured=biased_gyro,
    # usual: mean rates by gyro and by motion capture differ by 0.16 deg/s (rms about x and y of eight slow and medium
    # flights of NanoBench, arXiv 2603.09908)
    prior=Prior(
        alike("x y z", 0.025),
        lambda conditions: alike("x y z", 2.8e-3) if "body_rate" in conditions.signals else {},
        each=lambda conditions: True,
        systematic=alike("x y z", 4e-4),  # the bias drifts
        detection_limit=alike("x y z", 3e-3),
    ),
    needs=("body_rate",),
    belongs_to="recording",  # it drifts with the temperature
    separates="record the gyro for 10 s with the drone at rest",
)

VELOCITY_SCALE = Effect(
    "velocity_scale",
    tuple(Parameter(axis, "", 1.0, 0.0, 3.0, 0.01) for axis in "xyz"),
    order=83,
    measured=scaled_velocity,
    prior=Prior(alike("x y z", 0.12), _usual_scale, detection_limit=_scale_limit),
    linear_range=0.01,
    needs=("velocity",),
    words="velocity scale of the onboard estimate",
    belongs_to="recording",  # in a vehicle file it makes predictions of other flights worse
    separates="log position from motion capture or beacons, and fly straight legs of known length",
    steady_force=True,
)


def recounted(thrust: NDArray, *, rotor: int, scale: float) -> NDArray:
    """The measured speed is scale times the true one, so the true thrust is the apparent one over scale squared."""
    true = thrust.copy()
    true[:, int(rotor) - 1] /= scale**2
    return true


ROTOR_SENSOR = Effect(
    "rotor_sensor",
    (
        Parameter("rotor", "", 1, 1, 4, 1, chosen=(1, 2, 3, 4), phrase="of rotor {}"),
        Parameter("scale", "", 1.0, 0.1, 3.0, 0.01),
    ),
    order=24,
    speed=recounted,
    prior=Prior(own={"scale": 0.05}),
    needs=("rotor_speed",),
    words="wrong speed sensor",
    separates="log the motor commands beside the speeds, or point an optical tachometer at each rotor in hover",
    spared={"motor_command": "log the motor commands beside the speeds, or "},
)
