"""The setpoint of the controllers, and the priorities of its sources (crazyflie-firmware commander.c).

It is one flat float64 array, so that compiled code can read it. Its layout follows `setpoint_t` of the firmware
(stabilizer_types.h); each constant below is an index into the array.

Any low-level setpoint locks the high-level commander out until the client notifies that its stream has stopped. cflib
sends a zero setpoint when it closes a link, so the next client's take-off has no effect before such a notice. A
client's setpoint also stops the planner: a notice in flight with no command after it stops the motors.
"""

from collections.abc import Callable

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


NO_SETPOINT, HIGH_LEVEL, CRTP = 0, 1, 2  # priorities of the sources of setpoints (commander.c)


class Arbiter:
    """Keeps the newest setpoint among those of the highest priority, with its time stamp for the watchdogs.

    low_level is called when a setpoint from a client takes over; relaxed when a client gives the drone back.
    """

    def __init__(self, low_level: Callable[[], None], relaxed: Callable[[], None]):
        self.setpoint = null_setpoint()
        self.stamp = 0  # tick [ms] the setpoint arrived
        self._priority = NO_SETPOINT
        self._low_level, self._relaxed = low_level, relaxed

    @property
    def disabled(self) -> bool:
        """True until the first setpoint of any kind."""
        return self._priority == NO_SETPOINT

    def offer(self, setpoint: np.ndarray, priority: int, tick: int) -> bool:
        """Take the setpoint if its priority is at least the current one; returns whether it was taken."""
        if priority < self._priority:
            return False
        self.setpoint, self.stamp, self._priority = setpoint, tick, priority
        if priority > HIGH_LEVEL:
            self._low_level()
        return True

    def relax(self) -> None:
        """The client's stream of setpoints has ended: the high-level commander may command again."""
        self._relaxed()
        self._priority = HIGH_LEVEL
