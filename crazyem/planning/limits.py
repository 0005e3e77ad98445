"""Limits of a manoeuvre: box, tilt, body rates, thrust reserve of every rotor."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.control.harmonics import Harmonics
from crazyem.errors import UsageError
from crazyem.planning.closed_loop import Flown
from crazyem.vehicle import GRAVITY, Vehicle

SHARPNESS = 60  # power of the norm that approximates a maximum, so that an optimiser has derivatives
BOX_SHARE = 0.9  # share of the box that a plan uses; the rest is for wind and errors of the model
RESERVE = 0.1  # share of a rotor's largest thrust that a plan leaves free at each end


@dataclass(frozen=True)
class Limits:
    """Limits of a manoeuvre.

    Attributes:
        box: m, full widths along x, y (of the heading at the start) and z, about the hover point.
        tilt: rad, angle between body z and the vertical.
        rate: rad/s, of each body rate.
        voltage: V, of the battery in flight; it limits the thrust.
        reserve: share of a rotor's largest thrust that stays free at both ends.
    """

    box: tuple[float, float, float] = (1.0, 1.0, 0.6)
    tilt: float = math.radians(20.0)
    rate: float = 4.0
    voltage: float = 3.5
    reserve: float = RESERVE

    def __post_init__(self) -> None:
        ends = {"box": (*self.box,), "tilt": (self.tilt,), "rate": (self.rate,), "voltage": (self.voltage,)}
        for name, values in ends.items():
            if not all(0.0 < v < math.inf for v in values):
                raise UsageError(f"the limit of {name} must be positive.")

    def rotor_range(self, vehicle: Vehicle) -> tuple[float, float]:
        """Least and largest thrust of one rotor [N] in a plan.

        Raises:
            UsageError: the drone cannot hover within this range.
        """
        most = vehicle.thrust_max
        if vehicle.thrust_curve:
            most = min(most, float(np.polynomial.polynomial.polyval(self.voltage, vehicle.thrust_curve)))
        low, high = self.reserve * most, (1.0 - self.reserve) * most
        hover = vehicle.mass * GRAVITY / 4
        if not low < hover < high:
            raise UsageError(
                f"{vehicle.name} hovers with {hover:.3g} N a rotor, and at {self.voltage:g} V a rotor gives "
                f"{most:.3g} N: no reserve for a manoeuvre."
            )
        return low, high

    def used(self, manoeuvre: Harmonics, flown: Flown, vehicle: Vehicle) -> NDArray[np.float64]:
        """Smooth maxima (8,) of values over their limits: x, y, z, tilt, three rates, rotors; 1 is at the limit.

        Positions and tilts are those of the setpoints or of the drone, whichever are larger, because another controller
        may follow the setpoints more closely.
        """
        low, high = self.rotor_range(vehicle)
        hover = vehicle.mass * GRAVITY / 4
        setpoints, _, acceleration, _ = manoeuvre.derivatives(flown.time)[:, :, :3]
        tilt = np.arctan2(np.hypot(acceleration[:, 0], acceleration[:, 1]), GRAVITY + acceleration[:, 2])
        room = BOX_SHARE * np.array(self.box) / 2
        rows = [
            *np.concatenate([setpoints / room, flown.state[:, :3] / room]).T,
            np.concatenate([flown.tilt, tilt]) / self.tilt,
            *np.tile(flown.state[:, 10:13] / self.rate, (2, 1)).T,
        ]
        command = flown.command - hover
        share = np.where(command > 0, command / (high - hover), command / (low - hover))
        return np.array([*map(_largest, rows), _largest(share.ravel())])


def _largest(values: NDArray[np.float64]) -> float:
    """Smooth maximum of |values| (n,): between the largest value and n^(1/SHARPNESS) times this value."""
    most = float(np.abs(values).max())
    if most == 0.0:
        return 0.0
    return most * float(np.sum(np.abs(values / most) ** SHARPNESS) ** (1.0 / SHARPNESS))
