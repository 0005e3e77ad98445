"""The paper's own algorithm as printed (section X), with only those corrections without which it does not run.

It is here to be compared with, not to be used: the product's estimator is crazyem.estimation. What was corrected stands
in published_corrections.CORRECTIONS, with the reasons; everything else is kept, the isotropic Q0 and R0, the Jacobian
without the tilt (eq. 59) and the smoother that ignores it (eq. 95) included.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.paper.flight import Flight
from crazyem.paper.published_corrections import CORRECTIONS, Correction
from crazyem.paper.published_kernels import expectation, maximisation
from crazyem.paper.settings import Settings

__all__ = ["CORRECTIONS", "Correction", "PublishedFit", "PublishedOnline", "published_offline"]

# `clamp` refuses an inertia further than this from I0: ten times too stiff a rate loop still is stable
LARGEST_INERTIA_RATIO = 10.0

Angles = Literal["zero", "dead-reckoned"]


@dataclass(frozen=True)
class PublishedFit:
    """What the EM iterations of one flight gave.

    Attributes:
        theta: (n_iterations + 1, 4) mass kg, Ixx, Iyy, Izz kg m^2 after each EM iteration, the start first.
    """

    theta: NDArray


class _Workspace:
    """Arrays that the kernels fill, for windows of up to `rows` rows."""

    def __init__(self, rows: int, settings: Settings) -> None:
        self.settings = settings
        self.predicted = np.empty((rows, 12))
        self.filtered = np.empty((rows, 12))
        self.linear = np.empty((rows, 3))
        self.angular = np.empty((rows, 6, 6))
        self.smoothed = np.empty((rows, 12))
        inertia = np.array(settings.inertia_start)
        self.lowest = np.array([0.0, *inertia / LARGEST_INERTIA_RATIO])
        self.highest = np.array([np.inf, *inertia * LARGEST_INERTIA_RATIO])

    def iterate(
        self, observed: NDArray, wrench: NDArray, first: NDArray, theta: NDArray, *, sees_angles: bool, clamp: bool
    ) -> NDArray:
        """One EM iteration over a window; the smoothed states of the window stay in `smoothed`."""
        s, n = self.settings, len(observed)
        expectation(
            observed, wrench, first, theta, s.dt, s.filter_start, s.filter_process, s.filter_measurement, sees_angles,
            self.predicted, self.filtered, self.linear, self.angular, self.smoothed,
        )  # fmt: skip
        new = np.empty(4)
        maximisation(self.smoothed[:n], wrench, theta, s.dt, clamp, self.lowest, self.highest, new)
        return new


def _observed(flight: Flight, sensor: str, first: int) -> NDArray:
    """(n, 12) what the paper gives to the E-step from row `first` on: sensor A's filter, or readings."""
    if sensor == "A":
        return flight.estimate[first : flight.size]
    rows = flight.readings[first : flight.size, :12]
    if sensor == "C":
        rows = rows.copy()
        rows[:, 6:9] = 0.0
    return rows


def _check(sensor: str, angles: str) -> None:
    if sensor not in ("A", "B", "C"):
        raise UsageError(f"there is no sensor {sensor!r} in the paper: A, B or C")
    if angles not in ("zero", "dead-reckoned"):
        raise UsageError(f'angles that sensor C lacks are "zero" or "dead-reckoned", not {angles!r}')


def published_offline(
    flight: Flight, sensor: str, *, angles: Angles = "zero", iterations: int = 20, clamp: bool = False
) -> PublishedFit:
    """EM over all rows of a flight, from m0 and I0 (eq. 116, 117).

    Args:
        flight: flown, two rows at least.
        sensor: A (the states of the state filter are the observations), B (full state) or C (no angles).
        angles: how C's missing angles are taken: read as "zero", as the printed bias implies, or "dead-reckoned" from
            the start (their rows dropped from H).
        iterations: of EM.
        clamp: as in `PublishedOnline`; offline nothing needs it.

    Raises:
        UsageError: no such sensor or way to take the angles; fewer than two rows.
    """
    _check(sensor, angles)
    if flight.size < 2:
        raise UsageError("the flight has not been flown yet: EM needs two rows at least")
    s = flight.settings
    observed = np.ascontiguousarray(_observed(flight, sensor, 0))
    first = observed[0].copy()
    sees = sensor != "C" or angles == "zero"
    if not sees:
        first[6:9] = flight.estimate[0, 6:9]
    work = _Workspace(flight.size, s)
    theta = np.empty((iterations + 1, 4))
    theta[0] = (s.mass_start, *s.inertia_start)
    for i in range(iterations):
        theta[i + 1] = work.iterate(
            observed, flight.wrench[: flight.size], first, theta[i], sees_angles=sees, clamp=clamp
        )
    return PublishedFit(theta)


class PublishedOnline:
    """One EM iteration over the newest rows of a flight (800, XI-A2) at each call, parameters carried over.

    The paper does not say how many iterations an update takes. "200 iterations" until convergence (XI-C) are 800
    samples at 4 a time: one each.

    Args:
        settings: of the flight.
        sensor, angles: as in `published_offline`. Dead-reckoned angles go on from where the last window's filter saw
            the row that is now the first (its smoother, which ignores Phi, would carry them away).
        clamp: whether a mass that is not positive, or an inertia off I0 by a factor over `LARGEST_INERTIA_RATIO`,
            is refused and the last one kept. As printed it is not (False); some flights from m0 = 1 g then crash.

    Attributes:
        theta: (4,) mass kg, Ixx, Iyy, Izz kg m^2, newest.
    """

    def __init__(self, settings: Settings, sensor: str, *, angles: Angles = "zero", clamp: bool = False) -> None:
        _check(sensor, angles)
        self.sensor = sensor
        self.angles = angles
        self.clamp = clamp
        self.theta = np.array([settings.mass_start, *settings.inertia_start])
        self._work = _Workspace(settings.window, settings)
        self._first = 0  # row of the flight at which the last window began
        self._begun = False

    def update(self, flight: Flight) -> tuple[float, NDArray]:
        """Mass kg and inertia (3,) kg m^2 after one more iteration over the newest rows of the flight."""
        first = max(0, flight.size - self._work.settings.window)
        if flight.size - first >= 2:
            observed = np.ascontiguousarray(_observed(flight, self.sensor, first))
            start = observed[0].copy()
            sees = self.sensor != "C" or self.angles == "zero"
            if not sees:
                start[6:9] = self._work.filtered[first - self._first, 6:9] if self._begun else flight.estimate[0, 6:9]
            wrench = flight.wrench[first : flight.size]
            self.theta = self._work.iterate(observed, wrench, start, self.theta, sees_angles=sees, clamp=self.clamp)
            self._first, self._begun = first, True
        return float(self.theta[0]), self.theta[1:].copy()
