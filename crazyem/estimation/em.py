"""Expectation maximisation over a window of the tape: full passes, incremental passes, scoring, and the uncertainty.

A full pass filters and smooths the whole window with the present parameters. An incremental pass filters the new
samples and smooths only the newest ones. Older samples keep the expectations from earlier parameters; these are
physical quantities (accelerations, rates). This is incremental EM in the sense of Neal and Hinton. Near the maximum EM
is slow, so Fisher-scoring steps on the likelihood of the innovations replace it."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation import kernels
from crazyem.estimation.inflation import (
    innovation_noise,
    long_run,
    steady_gain,
    variance_with_bias,
    white_variance,
)
from crazyem.estimation.inputs import InputHistory
from crazyem.estimation.model import Noise, Parameters, Setup
from crazyem.estimation.mstep import maximise
from crazyem.estimation.tape import START_VARIANCE, Tape

CONVERGED_DECREMENT = 0.02  # standard deviations; converged when the next scoring step is shorter
# standard deviations; if a noise scale has a longer scoring step, its information is computed exactly
INEXACT_SCALE_SD = 1.0


@dataclass(frozen=True)
class Information:
    """Fisher information at a point, in logarithms of theta (units of the linear parameters).

    Attributes:
        matrix: (9, 9) information of the data; only rows and columns of free parameters are used.
        covariance: (9, 9) of the logarithms, prior included, widened where innovations are correlated in time.
        step: (9,) scoring step of the logarithms.
        decrement: length of that step in standard deviations.
        inflation: (9,) factor on each standard deviation for correlation in time.
        bias: (9,) possible bias of the parameters because commands are known only at their stamps, in the same
            coordinates; the covariance contains its square.
        noise_sd: (11,) standard deviations of the logarithms of the noise scales, zero where known.
        noise_step: (11,) scoring step of these logarithms.
        shift: (9,) correction of the reported values (`in_step.py`); None: no correction.
        open_sd: (9,) additional standard deviation because of unknown torques; not part of the covariance.
    """

    matrix: NDArray
    covariance: NDArray
    step: NDArray
    decrement: float
    inflation: NDArray
    bias: NDArray
    noise_sd: NDArray
    noise_step: NDArray
    shift: NDArray | None = None
    open_sd: NDArray | None = None

    @cached_property
    def sd(self) -> NDArray:
        """(9,) standard deviations from the covariance."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def noise_length(self) -> float:
        """The longest scoring step of a noise scale, in its standard deviations."""
        return float(np.max(np.abs(self.noise_step) / np.where(self.noise_sd > 0, self.noise_sd, np.inf)))


class WindowEM:
    """Passes of EM and scoring over a tape; holds the present parameters, all other results are on the tape."""

    def __init__(self, setup: Setup, tape: Tape, inputs: InputHistory) -> None:
        self.setup = setup
        self.tape = tape
        self.inputs = inputs
        self.parameters = setup.start
        self._sums = np.zeros(kernels.SIZE)
        self._squares = np.ones(4)
        self._damping = np.ones(11)  # factor on the steps of noise scales: smaller where steps change their sign;
        self._step_before = np.zeros(11)  # both are kept from one update to the next

    # E-step -------------------------------------------------------------------------------------------------

    def forward(self, first: int, last: int, *, restart: bool) -> float:
        """Filter rows first..last-1; with restart the tape holds the prior at `first`. Returns the log-likelihood."""
        t, p = self.tape, self.parameters
        return kernels.forward(
            first, last, restart, t.time, t.kind, t.y, t.force, t.thrust, t.torque, p.theta[0], p.inertia, p.inverse,
            p.noise.q, p.noise.r, p.noise.measurement[4] ** 2, self.setup.lead, START_VARIANCE, t.xp, t.pp, t.xf, t.pf,
            t.gain, t.s, t.e, t.blocks, t.middle, t.loglik,
        )  # fmt: skip

    def backward(self, first: int, last: int) -> None:
        """Smooth rows first..last-1 and fill their statistics."""
        t, p = self.tape, self.parameters
        kernels.backward(
            first, last, t.time, t.kind, t.usable, t.force, t.thrust, t.torque, t.thrust_tau, t.torque_tau,
            t.thrust_delay, t.torque_delay, p.theta[4], p.theta[5], p.theta[6:9], p.theta[0], p.inertia,
            p.inverse, p.noise.q, p.noise.r, p.noise.measurement[4] ** 2, self.setup.lead, t.xf, t.pf, t.gain, t.s,
            t.e, t.blocks, t.middle, t.stats, t.moments,
        )  # fmt: skip

    def full_pass(self, first: int, last: int) -> None:
        """Filter and smooth the window with the present parameters.

        The position at the start of the window is unknown. A filter that took it from older rows could keep an error
        for ever: a large error looks like a large noise of position, which gives the position no weight.
        """
        prior = self.tape.pp[first]
        prior[:3], prior[:, :3] = 0.0, 0.0
        prior[:3, :3] = np.diag(START_VARIANCE[:3])
        self.refill_inputs(first, last)
        self.forward(first, last, restart=True)
        self.backward(first, last)

    def refill_inputs(self, first: int, last: int) -> None:
        """Recompute the mean inputs of the window with the present time constant and delay."""
        self.inputs.refill(self.tape, first, last, self.parameters.theta)

    # M-step -------------------------------------------------------------------------------------------------

    def maximise(self, first: int, last: int, *, iterations: int = 30) -> Parameters:
        """Parameters and noise that maximise the expected log-likelihood given the statistics of the window."""
        kernels.total(first + 1, last, self.tape.stats, self._sums)
        prior = self.setup.prior
        theta = self.parameters.theta.copy()
        if self._sums[kernels.COUNT] >= 3:
            maximise(
                theta, self.setup.unit, self._sums, self.setup.free, prior.centre, prior.precision,
                self.setup.known_squares, iterations, self._squares,
            )  # fmt: skip
            # the lag is linearised, so one step changes it by a quarter at most
            before = self.parameters.theta[4]
            theta[4] = min(1.25 * before, max(0.8 * before, theta[4]))
        return Parameters(theta, self._noise(theta), self.parameters.inertia_products)

    def _noise(self, theta: NDArray) -> Noise:
        """Noise scales of the M-step: mean squares, combined with the weak prior."""
        sums, prior = self._sums, self.setup.prior
        n = sums[kernels.COUNT]
        if n < 3:
            return self.parameters.noise
        squares = np.empty(11)
        squares[:2] = sums[kernels.IMPULSE : kernels.IMPULSE + 2] / n
        squares[2:6] = self._squares / theta[:4] ** 2 / n
        seen = np.maximum(sums[kernels.MEASURED : kernels.MEASURED + 5], 1e-9)
        squares[6:] = sums[kernels.RESIDUAL : kernels.RESIDUAL + 5] / seen
        # weight of the prior: the curvature of the log-likelihood in log s is 2 n
        weight = 1.0 / (1.0 + 2 * np.concatenate([np.full(6, n), seen]) * prior.noise_sd**2)
        logs = 0.5 * np.log(np.maximum(squares, 1e-300)) * (1 - weight) + prior.noise.logs * weight
        logs = np.where(weight > 0.5, prior.noise.logs, logs)
        return self.setup.noise_at(theta, np.maximum(logs, prior.floor))

    def noise_terms(self, first: int, last: int) -> NDArray:
        """Terms (n, 11) by row of the score of the logarithms of the noise scales; the window must be smoothed.

        Fisher's identity: the score of the likelihood is the expected score of the complete data.
        """
        noise, rows = self.parameters.noise, self.tape.stats[first:last]
        counts = rows[:, kernels.COUNT : kernels.COUNT + 1]
        return np.concatenate(
            [
                (rows[:, kernels.IMPULSE : kernels.IMPULSE + 6] + rows[:, kernels.BRIDGE : kernels.BRIDGE + 6])
                / noise.q
                - counts,
                rows[:, kernels.RESIDUAL : kernels.RESIDUAL + 5] / np.square(noise.measurement)
                - rows[:, kernels.MEASURED : kernels.MEASURED + 5],
            ],
            axis=1,
        )

    def noise_information(self, first: int, last: int) -> NDArray:
        """Expected information (11, 11) of the logarithms of the noise scales; the window must have been filtered."""
        t, p = self.tape, self.parameters
        return kernels.noise_information(
            first, last, t.time, t.kind, t.usable, t.force, t.torque, p.inertia, p.inverse, p.noise.q, p.noise.r,
            p.noise.measurement[4] ** 2, self.setup.lead, t.xf, t.gain, t.s, t.blocks, t.middle,
        )  # fmt: skip

    def _noise_step(self, first: int, last: int, of_noise: NDArray | None) -> tuple[NDArray, NDArray]:
        """Scoring step (11,) of the logarithms of the noise scales, and their standard deviations (11,).

        Without `of_noise` (11, 11), the information is diagonal: the larger of the sum over single steps and the
        long-run variance of the score's terms. This is cheap, and steps overshoot little.
        """
        noise, setup = self.parameters.noise, self.setup
        prior = setup.prior
        terms = self.noise_terms(first, last)
        score = terms.sum(0) + (prior.noise.logs - noise.logs) / prior.noise_sd**2
        if of_noise is None:
            own = 2 * self.tape.stats[first:last, kernels.IMPULSE_SEEN : kernels.SIZE].sum(0)
            variance = 1.0 / (np.maximum(own, long_run(terms - terms.mean(0))) + prior.noise_sd**-2)
            step = score * variance
        else:
            covariance = np.linalg.inv(of_noise + np.eye(11) / prior.noise_sd**2)
            variance = np.diag(covariance)
            step = covariance @ score
        step = np.maximum(noise.logs + np.clip(step, -1.5, 1.5), prior.floor) - noise.logs
        return np.where(setup.known_scales, 0.0, step), np.where(setup.known_scales, 0.0, np.sqrt(variance))

    # passes -------------------------------------------------------------------------------------------------

    def incremental(self, first: int, fresh: int, last: int, *, lookback: int) -> None:
        """Filter and smooth the new rows fresh..last-1 and `lookback` rows before them, then maximise.

        The older of these rows are filtered again. Otherwise filter and smoother would use different parameters, and
        the difference would appear in the accelerations.
        """
        theta, tape = self.parameters.theta, self.tape
        self.inputs.advance(tape, fresh, last, theta)
        begin = max(first, fresh - lookback - 1)
        tape.spread_inputs(begin + 1, fresh, theta[6:9])
        kept = tape.stats[begin].copy()  # the smoother clears its first row
        self.forward(min(begin + 1, fresh), last, restart=False)
        self.backward(begin, last)
        tape.stats[begin] = kept
        self.parameters = self.maximise(first, last, iterations=3)

    def sensitivities(self, first: int, last: int) -> NDArray:
        """Information (9, 9) of theta from the means of the innovations; writes score rows; window must be filtered."""
        return kernels.sensitivities(*self._filtered(first, last), self.tape.score)

    def torque_sensitivities(self, first: int, last: int, shapes: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """For torques shapes (last, 3, K): information theta-sizes (9, K) and sizes (K, K), score of the sizes (K,)."""
        return kernels.torque_sensitivities(*self._filtered(first, last), shapes)

    def _filtered(self, first: int, last: int) -> tuple:
        """The filtered window, as both kernels of sensitivities take it."""
        t, p, setup = self.tape, self.parameters, self.setup
        return (
            first, last, t.time, t.kind, t.usable, t.force, t.thrust, t.torque, t.thrust_tau, t.torque_tau,
            t.thrust_delay, t.torque_delay, p.theta, setup.unit, p.inertia, p.inverse, p.noise.q,
            p.noise.measurement[4] ** 2, setup.lead, t.xf, t.gain, t.s, t.e, t.blocks, t.middle,
        )  # fmt: skip

    def information(self, first: int, last: int, *, of_noise: NDArray | None = None) -> Information:
        """Score and information at the present parameters; the window must have been filtered and smoothed with them.

        `of_noise` (11, 11) is the information on the noise scales (`noise_information`); None: an approximation.
        """
        t, p, setup = self.tape, self.parameters, self.setup
        matrix = self.sensitivities(first, last)
        noise_step, noise_sd = self._noise_step(first, last, of_noise)
        free = np.flatnonzero(setup.free)
        precision = setup.prior.precision
        score = t.score[first:last].sum(0)
        if setup.carried.any():  # known scales depend on mass and inertia, so they carry information on both
            matrix += self._carried_information(first, last, of_noise)
            score += setup.carried.T @ self.noise_terms(first, last).sum(0)
        score = (score - precision * offset(p.theta, setup.prior.centre, setup.unit))[free]
        posterior = matrix[np.ix_(free, free)] + np.diag(precision[free])
        covariance = np.linalg.inv(posterior)
        step = np.zeros(9)
        step[free] = covariance @ score
        decrement = float(np.sqrt(max(score @ step[free], 0.0)))
        widened, inflation = _widen(covariance, t.score[first:last, free])
        full, factors = np.zeros((9, 9)), np.ones(9)
        full[np.ix_(free, free)] = widened
        factors[free] = inflation
        bias = np.zeros(9)
        if setup.free[4]:
            # squares are added: the parts are not known well enough to let them cancel
            bias[free] = np.sqrt(covariance**2 @ self.command_noise_score(first, last)[free] ** 2)
        np.fill_diagonal(full, variance_with_bias(np.diag(full), bias))
        return Information(matrix, full, step, decrement, factors, bias, noise_sd, noise_step)

    def _carried_information(self, first: int, last: int, of_noise: NDArray | None) -> NDArray:
        """Information (9, 9) on theta from the size of known process noise, with the unknown scales as nuisances."""
        setup = self.setup
        if of_noise is None:
            of_noise = np.diag(2 * self.tape.stats[first:last, kernels.IMPULSE_SEEN : kernels.SIZE].sum(0))
        unknown = np.flatnonzero(~setup.known_scales)
        among = of_noise[np.ix_(unknown, unknown)] + np.eye(len(unknown)) / setup.prior.noise_sd**2
        cross = of_noise[unknown] @ setup.carried
        return setup.carried.T @ of_noise @ setup.carried - cross.T @ np.linalg.solve(among, cross)

    def command_noise_score(self, first: int, last: int) -> NDArray:
        """(9,) mean of the score because of noise in the command samples (`inflation.py`).

        The innovation of a step contains minus the torque of the noise. Its derivatives by log I, log tau and delay
        contain the same noise, so their product has a mean that is not zero.
        """
        tape, p, unit = self.tape, self.parameters, self.setup.unit
        score = np.zeros(9)
        nodes = tape.time[first:last]
        stamps, wrenches = self.inputs.between(nodes[0], nodes[-1])
        if len(stamps) < 20 or len(nodes) < 20:
            return score
        nearest = np.clip(np.searchsorted(nodes, stamps), 1, len(nodes) - 1)
        nearest -= stamps - nodes[nearest - 1] < nodes[nearest] - stamps
        rates = tape.y[first:last][nearest, 10:13]
        period = float(np.median(np.diff(stamps)))
        rate_variance = float(p.noise.measurement[3] ** 2)
        steps = int(np.count_nonzero(tape.usable[first + 1 : last]))
        dt = float(np.median(np.diff(nodes)))
        for axis in range(3):
            white = white_variance(wrenches[:, 1 + axis], rates[:, axis], rate_variance=rate_variance)
            gain, variance = steady_gain(p.noise.impulse[3 + axis] ** 2 * dt, rate_variance)
            m2, m_tau, m_delay = innovation_noise(period=period, tau=float(p.theta[4]), gain=gain)
            weight = steps * white * dt**2 / (p.theta[1 + axis] ** 2 * variance)
            score[1 + axis] += weight * m2
            score[4] -= weight * m_tau * p.theta[4]
            score[5] -= weight * m_delay * unit[5]
        return score

    def converge(self, first: int, last: int, *, passes: int, tolerance: float = CONVERGED_DECREMENT) -> Information:
        """Full passes until the next step is shorter than `tolerance` standard deviations, at most `passes`.

        The steps are EM far from the maximum and scoring near it. At the end the tape is filtered and smoothed with the
        parameters to which the returned information belongs.
        """
        for count in range(passes):
            self.full_pass(first, last)
            info = self.information(first, last)
            if info.noise_length > INEXACT_SCALE_SD:  # the diagonal approximation is too large for look-alike scales
                info = self.information(first, last, of_noise=self.noise_information(first, last))
            noise_step = info.noise_step
            longer = np.minimum(1.3 * self._damping, 1.0)
            self._damping = np.where(noise_step * self._step_before < 0, 0.5 * self._damping, longer)
            self._step_before = noise_step
            if max(info.decrement, info.noise_length) < tolerance or count == passes - 1:
                break
            after = self.maximise(first, last)
            em_step = np.max(np.abs(offset(after.theta, self.parameters.theta, self.setup.unit)[:4]))
            if info.decrement < 10.0 and em_step < 0.1:
                theta = displaced(self.parameters.theta, np.clip(info.step, -0.2, 0.2), self.setup.unit)
                noise = self.setup.noise_at(theta, self.parameters.noise.logs + self._damping * noise_step)
                self.parameters = Parameters(theta, noise, after.inertia_products)
            else:
                self.parameters = after
        return info


def offset(theta: NDArray, origin: NDArray, unit: NDArray) -> NDArray:
    """Difference of theta and origin (9,): logarithms of the ratios, linear parameters in their units."""
    far: NDArray = (theta - origin) / unit
    for i in range(kernels.DELAY):
        a, b = float(theta[i]), float(origin[i])
        far[i] = math.log(a / b) if a > 0 and b > 0 else 0.0
    return far


def displaced(theta: NDArray, step: NDArray, unit: NDArray) -> NDArray:
    """Inverse of `offset`: theta moved by a step (9,) in the coordinates of `offset`."""
    with np.errstate(over="ignore"):  # an unbounded interval
        moved = theta * np.exp(step)
    moved[kernels.DELAY :] = (theta + unit * step)[kernels.DELAY :]
    return moved


def _widen(covariance: NDArray, score: NDArray) -> tuple[NDArray, NDArray]:
    """Covariance widened for scores that are correlated in time (Newey and West 1987), never narrowed; and the factors.

    Real disturbances are not white, and onboard estimates have memory, so the plain covariance is too small.
    """
    scaled = score @ covariance
    scaled = scaled - scaled.mean(0)
    plain = np.sum(scaled**2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(plain > 0, long_run(scaled) / plain, 1.0)
    inflation = np.sqrt(np.maximum(ratio, 1.0))
    return covariance * np.outer(inflation, inflation), inflation
