"""INDI's loops from a position setpoint to the drone's position: setpoints for a trajectory, and the expected response.

INDI uses only position and heading of a position setpoint. Its outer loop (position_controller_indi.c) commands the
acceleration K_dxi (K_xi (setpoint - p) - v), its inner loop the yaw rate ref_err_r (heading - yaw). A setpoint ahead of
the reference by (v + a/K_dxi)/K_xi gives the reference's acceleration for a drone on the reference. A heading ahead by
its rate over ref_err_r does the same for yaw.

The attitude loop makes the commanded acceleration with the gains ref_err and ref_rate (controller_indi.c):

    a'' = ref_rate (ref_err (commanded - a) - a')

The response leaves out the rotors' lag, the tilt limit and the other dynamics of the vertical loop. Its gains are those
at boot.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from crazyem.control.trajectories import Reference

ATTITUDE_GAIN, RATE_GAIN = 5.0, 24.0  # 1/s, ctrlINDI.ref_err_p and ref_rate_p at boot
GAP = 0.5  # s without a measurement after which the response starts again

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class IndiGains:
    """INDI's gains in the firmware, 1/s: of position, velocity and heading. Defaults: the values at boot."""

    place: tuple[float, float, float] = (1.0, 1.0, 1.0)
    velocity: tuple[float, float, float] = (5.0, 5.0, 5.0)
    heading: float = 5.0

    @classmethod
    def of(cls, values: Mapping[str, float]) -> "IndiGains":
        """Gains from parameter values; see `PARAMETERS`. The boot value replaces a gain that is not positive."""
        plain = cls()

        def positive(name: str, otherwise: float) -> float:
            return values[name] if values.get(name, 0.0) > 0.0 else otherwise

        place = [positive(f"posCtrlIndi.K_xi_{a}", g) for a, g in zip(_AXES, plain.place)]
        velocity = [positive(f"posCtrlIndi.K_dxi_{a}", g) for a, g in zip(_AXES, plain.velocity)]
        return cls(
            (place[0], place[1], place[2]),
            (velocity[0], velocity[1], velocity[2]),
            positive("ctrlINDI.ref_err_r", plain.heading),
        )


PARAMETERS = (
    *(f"posCtrlIndi.{gain}_{a}" for gain in ("K_xi", "K_dxi") for a in _AXES),
    "ctrlINDI.ref_err_r",
)


def place_ahead(r: Reference, gains: IndiGains) -> tuple[float, float, float, float]:
    """Setpoint x, y, z [m, world] and heading [rad] for INDI to follow a reference; see the module."""
    x, y, z = (
        p + (v + a / k_v) / k_p
        for p, v, a, k_p, k_v in zip(r.position, r.velocity, r.acceleration, gains.place, gains.velocity)
    )
    return x, y, z, r.yaw + r.yaw_rate / gains.heading


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
