"""The product's estimator on the paper's flights: the same `OnlineEstimator` as in flight, fed with samples.

The estimator gets only information that a user has: thrust and torque are the inputs, the way the simulator steps
(explicitly by eq. 56, unless it takes smaller steps than it samples), and whether there is an accelerometer. Noise and
parameters stay unknown: the paper's cold start (eq. 116, 117) replaces the vehicle file's constants, with a wide prior.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.estimation.model import KnownNoise
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.result import Estimate
from crazyem.paper.flight import Flight
from crazyem.paper.published_values import PARAMETERS
from crazyem.paper.settings import Settings
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle

NO_UPDATE = 10**9  # samples between updates when only the last one is wanted


@dataclass(frozen=True)
class Fit:
    """The estimate from one part of a flight.

    Attributes:
        value: (4,) mass kg, Ixx, Iyy, Izz kg m^2.
        sd: (4,) standard deviations, same units.
        ci95: (4, 2) 95 % intervals.
        converged: whether the score test was passed.
        passes: number of full passes.
        history: (passes + 1, 4) value before each pass and at the end.
        seconds: wall-clock time without handing over the samples.
    """

    value: NDArray
    sd: NDArray
    ci95: NDArray
    converged: bool
    passes: int
    history: NDArray
    seconds: float


def known_noise(settings: Settings) -> KnownNoise:
    """The intensities of the simulation's process noise, for an estimator that knows h (all else stays unknown)."""
    return KnownNoise(force=settings.force_noise, torque=settings.torque_noise, lateral_force=0.0)


def estimator_for(
    settings: Settings, sensor: str, *, known: KnownNoise | None = None, accelerometer: bool = True
) -> OnlineEstimator:
    """A new estimator for flights with these settings.

    Args:
        settings: only window, update interval, start values and the way of stepping are used.
        sensor: A, B or C; A has an accelerometer.
        known: noise that the estimator knows.
        accelerometer: whether to use the accelerometer of sensor A.

    Raises: UsageError: no such sensor, or a value that the estimator refuses.
    """
    if sensor not in {"A", "B", "C"}:
        raise UsageError(f"unknown sensor '{sensor}' (known: A, B, C)")
    mass, inertia = settings.mass_start, settings.inertia_start
    vehicle = replace(load_vehicle("zhao"), mass=mass, inertia=inertia)  # replaces the true values of the preset
    return OnlineEstimator(
        vehicle,
        window=settings.window,
        every=settings.every,
        input_signal="wrench_command",
        mass=mass,
        inertia=inertia,
        integration="euler" if settings.substeps == 1 else "midpoint",
        accelerometer=sensor == "A" and accelerometer,
        known_noise=known,
    )


def product_offline(
    flight: Flight,
    sensor: str,
    first: int = 0,
    last: int | None = None,
    *,
    known: KnownNoise | None = None,
    accelerometer: bool = True,
) -> Fit:
    """One converged estimate from rows first..last-1 as a single window.

    Args:
        flight: only its samples and settings (with the values to start from) are used.
        sensor, known, accelerometer: as for `estimator_for`.
        first, last: rows; last defaults to all rows flown.

    Raises: UsageError: no such sensor, or too few rows.
    """
    last = flight.size if last is None else last
    if not 0 <= first < last <= flight.size:
        raise UsageError(f"rows {first} to {last} are not in a flight of {flight.size} rows")
    settings = replace(flight.settings, window=last - first, every=NO_UPDATE)
    estimator = estimator_for(settings, sensor, known=known, accelerometer=accelerometer)
    for sample in flight.samples(sensor, first, last):
        estimator.feed(sample)
    begin = time.perf_counter()
    estimate = estimator.finish()
    seconds = time.perf_counter() - begin
    trace = np.array([theta[:4] for theta in estimator.trace]).reshape(-1, 4)  # empty for a window of few samples
    said = [estimate[name] for name in PARAMETERS]
    return Fit(
        value=np.array([p.value for p in said]),
        sd=np.array([p.sd for p in said]),
        ci95=np.array([p.ci95 for p in said]),
        converged=estimate.converged,
        passes=max(len(trace) - 1, 0),
        history=trace,
        seconds=seconds,
    )


class ProductOnline:
    """The estimator in the loop: it gets the new rows after every piece of flight and returns mass and inertia.

    The estimator uses a row when the next row and its wrench are known: of a flight of n rows, the first n - 2. After a
    first piece of 5 rows, every piece of 4 rows therefore ends with an update.

    Attributes:
        estimate: the latest, None before the first.
        estimator: the product's estimator.
    """

    def __init__(self, settings: Settings, sensor: str, *, accelerometer: bool = True) -> None:
        """Args: as for `estimator_for`."""
        self.estimator = estimator_for(settings, sensor, accelerometer=accelerometer)
        self.estimate: Estimate | None = None
        self._sensor = sensor
        self._mass = settings.mass_start
        self._inertia = np.array(settings.inertia_start)
        self._rows = 0

    @property
    def update_seconds(self) -> list[float]:
        """Wall-clock time of each update of the estimator [s]."""
        return self.estimator.update_seconds

    def update(self, flight: Flight) -> tuple[float, NDArray]:
        """Hand over the rows since the last call; returns mass [kg] and inertia (3,) [kg m^2] for the controller.

        Before the first estimate these are the start values.
        """
        if 0 < self._rows < flight.size:  # the wrench of the newest row of the last call is known now
            k = self._rows - 1
            self._feed(Sample("wrench_command", k * flight.settings.dt, tuple(flight.wrench[k].tolist())))
        for sample in flight.samples(self._sensor, self._rows, flight.size):
            self._feed(sample)
        self._rows = flight.size
        return self._mass, self._inertia

    def _feed(self, sample: Sample) -> None:
        estimate = self.estimator.feed(sample)
        if estimate is None:
            return
        self.estimate = estimate
        mass, *inertia = (estimate[name].value for name in PARAMETERS)
        self._mass, self._inertia = mass, np.array(inertia)
