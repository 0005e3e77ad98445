"""Where INDI takes a drone whose parameters are right: the response of its position to position setpoints.

INDI's outer loop commands the acceleration K_dxi (K_xi (setpoint - p) - v) (position_controller_indi.c). Its attitude
loop makes this acceleration with the gains ref_err and ref_rate (controller_indi.c):

    a'' = ref_rate (ref_err (commanded - a) - a')

The rotors' lag, the tilt limit and the vertical loop's other dynamics are left out. Gains: those at boot.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from crazyem.control.command_units import IndiGains

ATTITUDE_GAIN, RATE_GAIN = 5.0, 24.0  # 1/s, ctrlINDI.ref_err_p and ref_rate_p at boot
GAP = 0.5  # s without a measurement after which the response starts again


@lru_cache(maxsize=256)
def transition(milliseconds: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """F (4, 4) and g (4,): (p, v, a, a') becomes F (p, v, a, a') + g setpoint after this time."""
    place, speed = IndiGains().place[0], IndiGains().velocity[0]
    drive = RATE_GAIN * ATTITUDE_GAIN
    system = np.zeros((5, 5))
    system[0, 1] = system[1, 2] = system[2, 3] = 1.0
    system[3] = (-drive * speed * place, -drive * speed, -drive, -RATE_GAIN, drive * speed * place)
    step = expm(1e-3 * milliseconds * system)
    return step[:4, :4], step[:4, 4]


class IndiResponse:
    """Expected position of a drone under INDI, from the setpoints of its log."""

    def __init__(self) -> None:
        self._time = -np.inf
        self._state = np.zeros((3, 4))
        self._setpoint: tuple[float, ...] = ()

    def expected(
        self, time: float, setpoint: tuple[float, ...], position: tuple[float, ...], velocity: tuple[float, ...]
    ) -> tuple[float, ...]:
        """Expected position [m, world] at `time` [s]; the measured one after a start, a gap or an invalid setpoint.

        Args:
            setpoint: logged last [m, world]; holds from now on. position, velocity: measured [m, m/s, world].
        """
        elapsed = round(1e3 * (time - self._time)) if time - self._time < GAP else -1
        if elapsed < 0 or not np.isfinite(self._setpoint).all():
            self._state = np.column_stack([position, velocity, np.zeros((3, 2))])
        else:
            F, g = transition(elapsed)
            self._state = self._state @ F.T + np.outer(self._setpoint, g)
        self._time, self._setpoint = time, setpoint
        return tuple(self._state[:, 0])
