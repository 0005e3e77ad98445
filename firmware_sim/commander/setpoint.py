"""The setpoint that the commander hands to the controllers: one flat float64 array, so that compiled code can read it.

Layout follows `setpoint_t` of the firmware (stabilizer_types.h); each constant below is an index into the array.
"""

import numpy as np

# Values of the mode entries.
DISABLE, ABSOLUTE, VELOCITY = 0.0, 1.0, 2.0

# Mode of each controlled quantity.
MODE_X, MODE_Y, MODE_Z, MODE_ROLL, MODE_PITCH, MODE_YAW, MODE_QUAT = range(7)
X, Y, Z = 7, 8, 9  # position, m, world
VX, VY, VZ = 10, 11, 12  # velocity, m/s, world (body if VELOCITY_BODY)
AX, AY, AZ = 13, 14, 15  # acceleration without gravity, m/s^2, world
JX, JY, JZ = 16, 17, 18  # jerk, m/s^3, world
ROLL, PITCH, YAW = 19, 20, 21  # attitude, deg (firmware's legacy pitch sign)
RATE_ROLL, RATE_PITCH, RATE_YAW = 22, 23, 24  # body rates, deg/s
QX, QY, QZ, QW = 25, 26, 27, 28  # attitude quaternion, body to world
THRUST = 29  # thrust in PWM units, legacy manual modes
VELOCITY_BODY = 30  # 1 if VX, VY are in the yaw-aligned body frame
SIZE = 31


def null_setpoint() -> np.ndarray:
    """The setpoint with everything disabled: motors off."""
    setpoint = np.zeros(SIZE)
    setpoint[QW] = 1.0
    return setpoint
