"""Information of a flight's commands: prewhitened regressions of acceleration on commanded force and torque.

The acceleration over a step between two samples is compared with the mean thrust and torque over this step, after
rotor lag and delay. An autoregression whitens the residual (generalised least squares). So the standard deviations are
those of an efficient estimator under the noise of this flight (the Cramer-Rao bound of the linearised model). They are
widened for the remaining correlation (Newey and West 1987). Noise in sampled commands is counted as in
crazyem.estimation.inflation: commands of a 500 Hz loop, logged slower, are partly noise that never acted. Priors of
lag, delay and offsets are those of the estimator; the parameter whose error is computed has no prior.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.kinematics import turn
from crazyem.doctor.regression import AUTOREGRESSION_ORDER, Fit, autoregression, filtered, long_run, widened
from crazyem.physics.lag import CAUSAL, LINEAR, fit_predictor, hold_predictor, lagged_means
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import Array
from crazyem.recordings.thrust import Inputs
from crazyem.vehicle import GRAVITY, Vehicle

FINEST_STEP = 4e-3  # s; faster streams are averaged into steps of 5 ms
AVERAGED_STEP = 5e-3
LONGEST_STEP = 0.05  # s; a longer gap between two samples separates two stretches
MOST_STEPS = 6_000  # of more steps a sample of blocks is used, and the information is scaled
BLOCK_STEPS = 1_000
DELAY, DELAY_SD = 3.5e-3, 2e-3  # s, prior of the estimator for commands
SPEED_DELAY_SD = 10e-3  # s, the same for measured rotor speeds
LAG_SD = 0.7  # of the logarithm
INERTIA_SD = 0.5
TRIM_SD = 0.05  # shift of the centre of mass over the arm: prior of the torque offsets
_THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])
# largest move in one iteration: logarithms of inertia and lag, delay [ms]; offsets are not limited
_LONGEST_MOVE = np.array([0.4, 0.4, 0.4, 0.4, 5.0, np.inf, np.inf, np.inf])


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Steps between samples: stretches of nodes without gaps; `share` is their share of the flight."""

    nodes: tuple[Array, ...]  # (k,) s each
    values: tuple[Array, ...]  # (k, c) each
    period: float  # s
    share: float

    @property
    def count(self) -> int:
        return sum(t.size - 1 for t in self.nodes)


def steps_of(time: Array, value: Array, air: Airtime) -> Steps | None:
    """Stretches of samples (n, c) in the air, thinned to steps of at least 4 ms by averaging; None with too few."""
    inside = air.covers(time)
    time, value = time[inside], value[inside]
    if time.size < 4 * AUTOREGRESSION_ORDER:
        return None
    time, value = thinned(time, value)
    # a row equal to the one before was not measured (a slower stream on a faster grid)
    keep = np.append(True, (np.diff(time) > 0.0) & (value[1:] != value[:-1]).any(axis=1))
    time, value = time[keep], value[keep]
    period = float(np.median(np.diff(time))) if time.size > 1 else math.nan
    cuts = np.flatnonzero(np.diff(time) > max(LONGEST_STEP, 3.5 * period)) + 1
    pieces = [p for p in zip(np.split(time, cuts), np.split(value, cuts)) if p[0].size > 3 * AUTOREGRESSION_ORDER]
    total = sum(t.size for t, _ in pieces)
    if total > MOST_STEPS:
        pieces = _sampled(pieces, total)
    if not pieces:
        return None
    nodes, values = zip(*pieces)
    return Steps(nodes, values, period, sum(t.size for t in nodes) / total)


def lagged(
    inputs: Inputs, steps: Steps, *, tau: float, delay: float, predictor: Array | None = None
) -> list[tuple[Array, Array, Array]]:
    """For each stretch, means of the wrench over its steps (k, 4) and their derivatives by tau and delay [1/s]."""
    mode = CAUSAL if inputs.lagged else LINEAR
    if predictor is None:
        predictor = predictor_of(inputs, steps)
    result = []
    for nodes in steps.nodes:
        begin = int(np.searchsorted(inputs.time, nodes[0] - delay - 10.0 * max(tau, 0.02), "right")) - 1
        first = max(begin, 0)
        last = int(np.searchsorted(inputs.time, nodes[-1] + 0.1, "right"))
        times = np.ascontiguousarray(inputs.time[first:last])
        commands = np.ascontiguousarray(inputs.wrench[first:last])
        mean, by_tau, by_delay = (np.full((nodes.size, 4), np.nan) for _ in range(3))
        if times.size >= 2:
            state = np.append(np.tile(commands[0], 3), times[0])
            lagged_means(
                times, commands, 0, times.size, predictor, nodes, 0, nodes.size, mode, tau, delay, state, mean, by_tau,
                by_delay,
            )  # fmt: skip
        late = np.searchsorted(times, nodes, "right")
        far = nodes - times[np.maximum(late - 1, 0)] > 0.1 if times.size else np.ones(nodes.size, bool)
        mean[far | (nodes < inputs.time[0] + 0.2)] = np.nan
        result.append((mean[1:], by_tau[1:], by_delay[1:]))
    return result


def predictor_of(inputs: Inputs, steps: Steps) -> Array:
    """Predictor of the next command from those before it, in these stretches: see crazyem.physics.lag."""
    if not inputs.lagged:
        return hold_predictor()
    return fit_predictor(inputs.wrench[np.concatenate([_indices(inputs, nodes) for nodes in steps.nodes])])


def delay_sd(inputs: Inputs) -> float:
    """Standard deviation [s] of the prior of the delay."""
    return DELAY_SD if inputs.lagged else SPEED_DELAY_SD


def offset_sd(vehicle: Vehicle) -> float:
    """Standard deviation [N m] of the prior of the torque offsets."""
    return max(TRIM_SD * vehicle.mass * GRAVITY * max(vehicle.arm), 1e-9)


def rotation_fit(inputs: Inputs, steps: Steps, vehicle: Vehicle) -> Fit | None:
    """`rotation_fit_once`, widened by the scatter of quarters of the flight.

    A wrong model (aerodynamic torque, a lag that varies) gives another inertia in every quarter.
    """
    fit = rotation_fit_once(inputs, steps, vehicle)
    return fit and widened(fit, [rotation_fit_once(inputs, part, vehicle) for part in quarters(steps)])


def quarters(steps: Steps) -> list[Steps]:
    """The flight in four parts with equal numbers of samples."""
    edges = np.quantile(np.concatenate(steps.nodes), [0.0, 0.25, 0.5, 0.75, 1.0])
    parts = []
    for low, high in pairwise(edges):
        inside = [(t >= low) & (t <= high) for t in steps.nodes]
        long = [i for i, rows in enumerate(inside) if rows.sum() > 3 * AUTOREGRESSION_ORDER]
        if long:
            nodes, values = zip(*((steps.nodes[i][inside[i]], steps.values[i][inside[i]]) for i in long))
            parts.append(Steps(nodes, values, steps.period, steps.share))
    return parts


def rotation_fit_once(inputs: Inputs, steps: Steps, vehicle: Vehicle) -> Fit | None:
    """Joint fit of log Ixx, log Iyy, log Izz, log tau, delay [ms] and torque offsets [N m]: 8 parameters.

    Args:
        inputs: the wrench.
        steps: of the body rate (k, 3) [rad/s].
        vehicle: nominal inertia (start, and scale of the gyroscopic term), lag and arm.

    Returns: None with too few steps.
    """
    nominal = np.array(vehicle.inertia)
    unit = offset_sd(vehicle)
    timed = inputs.lagged
    centre = np.array([*np.log(nominal), math.log(max(vehicle.motor_time_constant, 1e-4)), 0.0, 0.0, 0.0, 0.0])
    centre[4] = DELAY * 1e3 if timed else 0.0
    prior = np.array([INERTIA_SD] * 3 + [LAG_SD if timed else 0.1, 1e3 * delay_sd(inputs), unit, unit, unit]) ** -2.0
    theta = centre.copy()
    response = [_angular_acceleration(t, w, nominal) for t, w in zip(steps.nodes, steps.values)]
    predictor = predictor_of(inputs, steps)
    for _ in range(8):
        tau, delay = (math.exp(theta[3]) if timed else 0.0), theta[4] * 1e-3
        rows = lagged(inputs, steps, tau=tau, delay=delay, predictor=predictor)
        system = _RotationSystem(response, rows, theta, tau)
        if system.count < 10 * AUTOREGRESSION_ORDER:
            return None
        step = np.linalg.solve(system.matrix + np.diag(prior), system.score + prior * (centre - theta))
        theta = theta + np.clip(step, -_LONGEST_MOVE, _LONGEST_MOVE)
        theta[4] = min(max(theta[4], -20.0), 40.0)
        if np.all(np.abs(step[:4]) < 1e-3):
            break
    noise = _command_noise_score(inputs, steps, system, theta, timed=timed)
    sd, bias = np.zeros(8), np.zeros(8)
    share = steps.share
    for i in range(8):
        own = prior.copy()
        own[i] = 0.0
        covariance = np.linalg.pinv(system.matrix / share + np.diag(own), hermitian=True)
        sd[i] = math.sqrt(max(covariance[i, i], 0.0)) * system.inflation(np.asarray(covariance[:, i], float))
        # the larger of the biases with all other parameters known and with all other parameters free
        together = abs(float(covariance[i] @ noise)) / share
        bias[i] = max(together, min(float(noise[i] / max(system.matrix[i, i], 1e-300)), 1.0) if noise[i] > 0.0 else 0.0)
    return Fit(theta, sd, bias)


def rates_of_attitude(time: Array, attitude: Array) -> tuple[Array, Array]:
    """Mean body rates (n - 1, 3) [rad/s] between attitudes (n, 4), at the middle of each step."""
    span = np.diff(time)
    good = (span > 0.0) & (span < LONGEST_STEP)
    rate = turn(attitude[:-1][good], attitude[1:][good]) / span[good, None]
    return 0.5 * (time[:-1] + time[1:])[good], rate


class _RotationSystem:
    """Normal equations of the rotation at one parameter point, whitened for each axis."""

    def __init__(self, response: list[Array], rows: list[tuple[Array, Array, Array]], theta: Array, tau: float) -> None:
        self.matrix, self.score, self.count = np.zeros((8, 8)), np.zeros(8), 0
        self.weights: list[Array] = []
        self.variance: list[float] = []
        self.rate_variance: list[float] = []
        self.terms: list[Array] = []
        for axis in range(3):
            inverse = math.exp(-theta[axis])
            left, jacobian = [], []
            for y, (mean, by_tau, by_delay) in zip(response, rows):
                torque = mean[:, 1 + axis] + theta[5 + axis]
                left.append(y[:, axis] - inverse * torque)
                columns = np.zeros((torque.size, 8))
                columns[:, axis] = -inverse * torque
                columns[:, 3] = inverse * by_tau[:, 1 + axis] * tau
                columns[:, 4] = inverse * by_delay[:, 1 + axis] * 1e-3
                columns[:, 5 + axis] = inverse
                jacobian.append(columns)
            weights = autoregression(left)
            z, f = (np.concatenate([filtered(weights, part) for part in parts]) for parts in (left, jacobian))
            good = np.isfinite(z) & np.isfinite(f).all(axis=1)
            z, f = z[good], f[good]
            variance = float(np.mean(z**2)) if z.size else math.inf
            self.weights.append(weights)
            self.variance.append(variance)
            self.rate_variance.append(_first_covariance(left))
            if z.size:
                self.matrix += f.T @ f / variance
                self.score += f.T @ z / variance
                self.terms.append(f * (z / variance)[:, None])
            self.count = max(self.count, z.size)

    def inflation(self, weights: Array) -> float:
        """Factor by which the remaining correlation of the scores widens the error of `weights @ score`; at least 1."""
        scaled = [terms @ weights[:, None] for terms in self.terms]
        plain = sum(float(np.sum(s**2)) for s in scaled)
        wide = sum(float(long_run(s)[0]) for s in scaled)
        return math.sqrt(max(wide / plain, 1.0)) if plain > 0.0 else 1.0


def _command_noise_score(inputs: Inputs, steps: Steps, system: _RotationSystem, theta: Array, *, timed: bool) -> Array:
    """(8,) contribution of noise in the command samples to the score, from simulated noise of the same variance."""
    score = np.zeros(8)
    if not timed:
        return score
    tau, delay = math.exp(theta[3]), theta[4] * 1e-3
    nodes = np.concatenate(steps.nodes)
    rates = np.concatenate(steps.values)
    inside = np.concatenate([_indices(inputs, t) for t in steps.nodes])
    if inside.size < 20:
        return score
    near = np.clip(np.searchsorted(nodes, inputs.time[inside]), 1, nodes.size - 1)
    near -= inputs.time[inside] - nodes[near - 1] < nodes[near] - inputs.time[inside]
    rng = np.random.default_rng(0)
    noise = np.zeros_like(inputs.wrench)
    for axis in range(3):
        rate_variance = system.rate_variance[axis] * steps.period**2
        white = _white_variance(inputs.wrench[inside, 1 + axis], rates[near, axis], rate_variance)
        noise[inside, 1 + axis] = math.sqrt(white) * rng.standard_normal(inside.size)
    for mean, by_tau, by_delay in lagged(replace(inputs, wrench=noise), steps, tau=tau, delay=delay):
        for axis in range(3):
            inverse = math.exp(-theta[axis])
            m, by_log_tau, by_ms = (
                filtered(system.weights[axis], inverse * part[:, 1 + axis])
                for part in (mean, by_tau * tau, by_delay * 1e-3)
            )
            score[axis] += np.nansum(m * m) / system.variance[axis]
            score[3] -= np.nansum(m * by_log_tau) / system.variance[axis]
            score[4] -= np.nansum(m * by_ms) / system.variance[axis]
    return score


def _white_variance(command: Array, rate: Array, rate_variance: float) -> float:
    """Variance of white noise in command samples (n,), computed as in crazyem.estimation.inflation."""
    du, dw = np.convolve(command, _THIRD_DIFFERENCE, "valid"), np.convolve(rate, _THIRD_DIFFERENCE, "valid")
    power = float(dw @ dw)
    gain = float(du @ dw) / power if power > 0.0 else 0.0
    return gain**2 * rate_variance + float(np.mean((du - gain * dw) ** 2)) / 20.0


def _angular_acceleration(time: Array, rate: Array, inertia: Array) -> Array:
    """(k, 3) rad/s^2 over each step, less the gyroscopic part of the nominal inertia."""
    middle = 0.5 * (rate[1:] + rate[:-1])
    gyroscopic = np.cross(middle, middle * inertia) / inertia
    return np.diff(rate, axis=0) / np.diff(time)[:, None] + gyroscopic


def _first_covariance(parts: list[Array]) -> float:
    """Variance of the measurement noise over the squared step: minus the covariance of neighbouring residuals."""
    pairs = np.concatenate([p[1:] * p[:-1] for p in parts]) if parts else np.zeros(0)
    pairs = pairs[np.isfinite(pairs)]
    return max(-float(pairs.mean()), 0.0) if pairs.size else 0.0


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """A stream (n,), (n, c): unchanged, or if it is faster as means over bins of 5 ms that are at least half full."""
    if time.size < 2 or np.median(np.diff(time)) >= FINEST_STEP:
        return time, value
    bins = np.floor((time - time[0]) / AVERAGED_STEP).astype(np.int64)
    starts = np.flatnonzero(np.append(True, np.diff(bins) > 0))
    counts = np.diff(np.append(starts, time.size))
    good = counts >= 0.5 * float(np.median(counts))
    return (
        (np.add.reduceat(time, starts) / counts)[good],
        (np.add.reduceat(value, starts, axis=0) / counts[:, None])[good],
    )


def _sampled(pieces: list[tuple[Array, Array]], total: int) -> list[tuple[Array, Array]]:
    """Blocks of BLOCK_STEPS samples, evenly spread over the flight, of about MOST_STEPS in all."""
    blocks = [
        (t[i : i + BLOCK_STEPS], v[i : i + BLOCK_STEPS])
        for t, v in pieces
        for i in range(0, t.size, BLOCK_STEPS)
        if t[i : i + BLOCK_STEPS].size > 3 * AUTOREGRESSION_ORDER
    ]
    wanted = np.linspace(0, len(blocks) - 1, min(len(blocks), max(MOST_STEPS // BLOCK_STEPS, 1))).round().astype(int)
    return [blocks[i] for i in np.unique(wanted)]


def _indices(inputs: Inputs, nodes: Array) -> NDArray[np.int64]:
    return np.arange(np.searchsorted(inputs.time, nodes[0]), np.searchsorted(inputs.time, nodes[-1], "right"))
