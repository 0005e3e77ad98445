"""Who commands the drone: setpoints with priorities (crazyflie-firmware commander.c).

Any low-level setpoint locks the high-level commander out until the client notifies that its stream has stopped. cflib
sends a zero setpoint when it closes a link, so the next client's take-off has no effect before such a notice. A
client's setpoint also stops the planner: a notice in flight with no command after it stops the motors.
"""

from collections.abc import Callable

import numpy as np

from firmware_sim.commander.setpoint import null_setpoint

DISABLE, HIGH_LEVEL, CRTP = 0, 1, 2


class Arbiter:
    """Keeps the newest setpoint among those of the highest priority, with its time stamp for the watchdogs.

    low_level is called when a setpoint from a client takes over; relaxed when a client gives the drone back.
    """

    def __init__(self, low_level: Callable[[], None], relaxed: Callable[[], None]):
        self.setpoint = null_setpoint()
        self.stamp = 0  # tick [ms] the setpoint arrived
        self._priority = DISABLE
        self._low_level, self._relaxed = low_level, relaxed

    @property
    def disabled(self) -> bool:
        """True until the first setpoint of any kind."""
        return self._priority == DISABLE

    def offer(self, setpoint: np.ndarray, priority: int, tick: int) -> bool:
        """Take the setpoint if its priority is at least the current one; tells whether it was taken."""
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
