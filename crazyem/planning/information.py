"""Expected information of a flight: the estimator's filter and sensitivities along a simulated flight.

The gains of a filter and the sensitivities of its innovations do not depend on the innovations. So a simulated flight
gives the information matrix before the real flight (Goodwin and Payne, Dynamic System Identification, ch. 6).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.control.harmonics import Harmonics
from crazyem.estimation.em import WindowEM
from crazyem.estimation.inputs import InputHistory
from crazyem.estimation.model import Noise, Parameters, Setup, setup_for
from crazyem.estimation.online import ATTITUDE_PERIOD
from crazyem.estimation.tape import BREAK, Tape
from crazyem.physics.lag import CAUSAL
from crazyem.planning.closed_loop import PERIOD, Flown, fly, mixing
from crazyem.vehicle import Vehicle


@dataclass(frozen=True)
class Expected:
    """Expected information after a flight.

    Attributes:
        information: (9, 9) of the data, in logarithms of theta (units of the linear parameters).
        precision: (9,) of the prior, 0 where a parameter is fixed.
        free: (9,) bool, parameters that are estimated.
    """

    information: NDArray[np.float64]
    precision: NDArray[np.float64]
    free: NDArray[np.float64]

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (9, 9) of the estimates, prior included; zero where a parameter is fixed."""
        index = np.flatnonzero(self.free)
        full = np.zeros_like(self.information)
        inner = self.information[np.ix_(index, index)] + np.diag(self.precision[index])
        full[np.ix_(index, index)] = np.linalg.inv(inner)
        return full

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations (9,), relative for mass, inertia and lag."""
        spread: NDArray[np.float64] = np.sqrt(np.diag(self.covariance))
        return spread


class Expectation:
    """Expected information of flights of one vehicle with given noise scales."""

    def __init__(self, vehicle: Vehicle, noise: Noise | None = None) -> None:
        self.vehicle = vehicle
        self.setup: Setup = setup_for(vehicle)
        self.noise = noise or self.setup.prior.noise
        self._mixing = mixing(vehicle)

    def of(self, flown: Flown, *, known: NDArray[np.float64] | None = None) -> Expected:
        """Expected information after a flight.

        Args:
            known: (9, 9) information from earlier flights, in the same coordinates.
        """
        em = self._filtered(flown)
        n = em.tape.size
        information = em.sensitivities(0, n)
        if known is not None:
            information = information + known
        precision = np.where(self.setup.free, self.setup.prior.precision, 0.0)
        return Expected(information, precision, self.setup.free)

    def reached(self, manoeuvre: Harmonics, *, seeds: int = 4) -> NDArray[np.float64]:
        """Expected standard deviations (9,) of the estimator after the flight: root mean square over noisy flights.

        They include correlated scores and noise in sampled commands (`estimation/inflation.py`).
        """
        squares = []
        for seed in range(seeds):
            em = self._filtered(fly(manoeuvre, self.vehicle, noise=self.noise, seed=seed))
            em.backward(0, em.tape.size)
            squares.append(em.information(0, em.tape.size).sd ** 2)
        spread: NDArray[np.float64] = np.sqrt(np.mean(squares, axis=0))
        return spread

    def _filtered(self, flown: Flown) -> WindowEM:
        """The window with the samples of a flight, filtered with the vehicle's parameters."""
        n = flown.time.size
        tape = Tape(n)
        tape.size = n
        tape.time[:], tape.force[:] = flown.time, np.nan
        tape.y[:] = flown.measured
        every = max(1, round(ATTITUDE_PERIOD / PERIOD))
        tape.y[np.arange(n) % every != 0, 6:10] = np.nan
        tape.kind[0] = BREAK
        tape.usable[1:] = True
        inputs = InputHistory(CAUSAL, capacity=n)
        inputs.times[:], inputs.wrenches[:] = flown.time, flown.command @ self._mixing.T
        inputs.size, inputs.newest, inputs.gap_end = n, float(flown.time[-1]), float(flown.time[0])
        em = WindowEM(self.setup, tape, inputs)
        start = self.setup.start
        em.parameters = Parameters(start.theta, self.noise, start.inertia_products)
        em.refill_inputs(0, n)
        em.forward(0, n, restart=True)
        return em
