"""The Cramer-Rao bound of mass and inertia for a part of a paper flight, computed without the product's estimator.

A separate Kalman filter, in Euler angles and with the explicit Euler step of eq. 56, runs along the flight with the
true parameters. Central differences give the derivatives of the innovations e_k and their covariances S_k with respect
to the logarithms of all parameters (mass, inertia, noise scales). The information is

    I_ij = sum_k  de_k/di' S_k^-1 de_k/dj  +  1/2 tr(S_k^-1 dS_k/di S_k^-1 dS_k/dj)

(expected, given the flight; the first term is the information in the innovations, the second in their covariance).
Noise acts through thrust and torque only (rank 4, eq. 55). Unknown noise scales are parameters, too; the bound of mass
and inertia comes from the inverse of the whole matrix.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.errors import UsageError
from crazyem.paper.flight import Flight
from crazyem.paper.plant import derivative, thrust_axis
from crazyem.paper.published_values import PARAMETERS

PROCESS_NOISES = ("force", "torque_x", "torque_y", "torque_z")
SENSORS = ("position", "velocity", "attitude", "body_rate", "specific_force")
MEASURED = {
    "A": ("position", "body_rate", "specific_force"),
    "B": ("position", "velocity", "attitude", "body_rate"),
    "C": ("position", "velocity", "body_rate"),
}
# m, m/s, rad, rad/s around the true state at the start. Wide enough to add little information to half a second of data
# (a wider start raises the bound of mass by 0.5 % at most), narrow enough that the filter is linear. From 0.3 rad of
# attitude on, the start biases the score of mass by 0.3 of the bound (sensor A).
START_SD = np.repeat([0.05, 0.1, 0.03, 1.0], 3)
# Step in the logarithm of a parameter for central differences. Rounding changes the bound of sensor A by a relative
# 3e-7 between processors, with ten times shorter steps by 2e-5. The truncation error of this step is 2e-7.
DERIVATIVE_STEP = 1e-3
CHUNK_ROWS = 400  # rows per call, so that memory does not grow with the flight


@compiled
def _slopes(x, specific, inertia, a):
    """Jacobian of f at x (12,) into its blocks a (4, 3, 3): dv/dangles, dangles/dangles, dangles/drate, drate/drate.

    specific: m/s^2 along body z.
    """
    sr, cr = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    sy, cy = np.sin(x[8]), np.cos(x[8])
    tp = sp / cp
    wy, wz = x[10], x[11]
    a[:] = 0.0
    a[0, 0, 0] = specific * (-sr * sp * cy + cr * sy)
    a[0, 0, 1] = specific * cr * cp * cy
    a[0, 0, 2] = specific * (-cr * sp * sy + sr * cy)
    a[0, 1, 0] = specific * (-sr * sp * sy - cr * cy)
    a[0, 1, 1] = specific * cr * cp * sy
    a[0, 1, 2] = specific * (cr * sp * cy + sr * sy)
    a[0, 2, 0] = -specific * sr * cp
    a[0, 2, 1] = -specific * cr * sp
    a[1, 0, 0] = tp * (cr * wy - sr * wz)
    a[1, 0, 1] = (sr * wy + cr * wz) / cp**2
    a[1, 1, 0] = -sr * wy - cr * wz
    a[1, 2, 0] = (cr * wy - sr * wz) / cp
    a[1, 2, 1] = (sr * wy + cr * wz) * tp / cp
    a[2, 0, 0] = 1.0
    a[2, 0, 1] = sr * tp
    a[2, 0, 2] = cr * tp
    a[2, 1, 1] = cr
    a[2, 1, 2] = -sr
    a[2, 2, 1] = sr / cp
    a[2, 2, 2] = cr / cp
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        g = (inertia[k] - inertia[j]) / inertia[i]
        a[3, i, j] = -g * x[9 + k]
        a[3, i, k] = -g * x[9 + j]


@compiled
def _propagate(a, dt, p, out):
    """out = ((1 + dt A) p)', for A of `_slopes` and p (12, 12); applied twice, this predicts a covariance."""
    for m in range(12):
        for i in range(3):
            v = 0.0
            t = 0.0
            w = 0.0
            for j in range(3):
                v += a[0, i, j] * p[6 + j, m]
                t += a[1, i, j] * p[6 + j, m] + a[2, i, j] * p[9 + j, m]
                w += a[3, i, j] * p[9 + j, m]
            out[m, i] = p[i, m] + dt * p[3 + i, m]
            out[m, 3 + i] = p[3 + i, m] + dt * v
            out[m, 6 + i] = p[6 + i, m] + dt * t
            out[m, 9 + i] = p[9 + i, m] + dt * w


@compiled
def _update(y, x, p, sensor_sd, before, gain, error, row):
    """Update with the 12 state measurements of y; fill innovation and covariance. before, gain (12,) are scratch."""
    for i in range(12):
        before[i] = x[i]
        if np.isnan(y[i]):
            continue
        error[i] = y[i] - x[i]
        for j in range(12):
            if not np.isnan(y[j]):
                row[i, j] = p[i, j]
        row[i, i] += sensor_sd[i // 3] ** 2
    for i in range(12):  # scalar updates: same result as a joint update, without an inversion
        if np.isnan(y[i]):
            continue
        variance = p[i, i] + sensor_sd[i // 3] ** 2
        for j in range(12):
            gain[j] = p[i, j] / variance
        left = error[i] - (x[i] - before[i])
        for j in range(12):
            x[j] += gain[j] * left
            f = gain[j] * variance
            for m in range(12):
                p[j, m] -= f * gain[m]


@compiled
def innovations(begin, end, y, wrench, x, p, dt, mass, inertia, process, sensor_sd, e, s):
    """Run the filter over rows begin..end-1; fill the innovations and their covariances, given the rows before.

    Args:
        begin, end: rows; only row 0 has no step before it.
        y: (n, 15) position m, velocity m/s, angles rad, rate rad/s, mean specific force m/s^2 (body) over the previous
            step; NaN means not measured.
        wrench: (n, 4) N, N m held from each row on.
        x, p: (12,), (12, 12) state and covariance before row `begin`; on return, those after row end - 1.
        dt: s.
        mass, inertia: kg, (3,) kg m^2.
        process: (4,) intensities of thrust N sqrt(s) and torque N m sqrt(s).
        sensor_sd: (5,) standard deviations of the five groups of y.
        e, s: (end - begin, 15), (end - begin, 15, 15) are filled; the specific force is processed first, the other
            innovations are conditional on it. Entries without measurement are 0 with variance 1.
    """
    a = np.empty((4, 3, 3))
    tmp = np.empty((12, 12))
    axis = np.empty(3)
    slope = np.empty(12)
    gain = np.empty(12)
    before = np.empty(12)
    e[:] = 0.0
    s[:] = 0.0
    for k in range(begin, end):
        row = s[k - begin]
        error = e[k - begin]
        for i in range(15):
            row[i, i] = 1.0
        if k > 0:
            thrust = wrench[k - 1, 0]
            scatter = process[0] ** 2 / (dt * mass**2)  # variance of the step's specific force along body z
            for i in range(3):
                if np.isnan(y[k, 12 + i]):
                    continue
                row[12 + i, 12 + i] = sensor_sd[4] ** 2
                error[12 + i] = y[k, 12 + i]
                if i == 2:
                    # the accelerometer measures the disturbance of this step: condition the process noise on it
                    row[14, 14] += scatter
                    error[14] -= thrust / mass
                    share = scatter / row[14, 14]
                    thrust += mass * share * error[14]
                    scatter *= 1.0 - share
            thrust_axis(x[6:9], axis)
            _slopes(x, thrust / mass, inertia, a)
            derivative(x, thrust, wrench[k - 1, 1:], mass, inertia, slope)
            for i in range(12):
                x[i] += dt * slope[i]
            _propagate(a, dt, p, tmp)
            _propagate(a, dt, tmp, p)
            for i in range(3):
                for j in range(3):
                    p[3 + i, 3 + j] += dt * dt * scatter * axis[i] * axis[j]
                p[9 + i, 9 + i] += dt * (process[1 + i] / inertia[i]) ** 2
        _update(y[k], x, p, sensor_sd, before, gain, error, row)


@dataclass(frozen=True)
class Bound:
    """The Cramer-Rao bound of mass and inertia from one part of a flight.

    Attributes:
        names: (p) parameters; the logarithm of each is the coordinate. The first four are mass, Ixx, Iyy, Izz.
        information: (p, p) Fisher information of the logarithms, given this flight.
        score: (p,) gradient of the log-likelihood at the truth. Over flights its mean is 0 and its covariance the
            information.
    """

    names: tuple[str, ...]
    information: NDArray
    score: NDArray

    @property
    def covariance(self) -> NDArray:
        """(p, p) the bound on the covariance of the logarithms."""
        scale = np.sqrt(np.diag(self.information))
        return np.linalg.inv(self.information / np.outer(scale, scale)) / np.outer(scale, scale)

    @property
    def sd(self) -> NDArray:
        """(4,) smallest relative standard deviation of mass, Ixx, Iyy, Izz."""
        return np.sqrt(np.diag(self.covariance))[:4]

    @property
    def efficient(self) -> NDArray:
        """(4,) relative error of an efficient estimator on this part of the flight, to first order: I^-1 score.

        Its standard deviation over flights is `sd`. An estimator's error minus this error is avoidable.
        """
        return (self.covariance @ self.score)[:4]

    def under(self, noise: Literal["single", "known"]) -> "Bound":
        """The bound with more knowledge of the process noise, from a bound with all noise scales free.

        Args:
            noise: single (one factor for thrust and torques: their ratio is known) or known.
        """
        groups: list[tuple[str, tuple[str, ...]]] = [(name, (name,)) for name in PARAMETERS]
        if noise == "single":
            groups += [("noise", PROCESS_NOISES)]
        groups += [(name, (name,)) for name in self.names if name in SENSORS]
        tie = np.array([[float(name in members) for name in self.names] for _, members in groups])
        return Bound(tuple(name for name, _ in groups), tie @ self.information @ tie.T, tie @ self.score)


def observed(flight: Flight, sensor: str, first: int, last: int, *, accelerometer: bool = True) -> NDArray:
    """(last - first, 15) readings of sensor A, B or C in these rows, NaN for quantities that it does not measure.

    Raises: UsageError: no such sensor, or the flight has no such rows.
    """
    if sensor not in MEASURED:
        raise UsageError(f"unknown sensor '{sensor}' (known: {', '.join(MEASURED)})")
    if not 0 <= first < last <= flight.size:
        raise UsageError(f"rows {first} to {last} are not in a flight of {flight.size} rows")
    y = np.full((last - first, 15), np.nan)
    for group, name in enumerate(SENSORS):
        if name in MEASURED[sensor] and (accelerometer or name != "specific_force"):
            at = slice(3 * group, 3 * group + 3)
            source = slice(15, 18) if name == "specific_force" else at
            y[:, at] = flight.readings[first:last, source]
    y[0, 12:] = np.nan  # this belongs to the step before the first row
    return y


def _add(seen: NDArray, e: NDArray, cov: NDArray, information: NDArray, score: NDArray) -> None:
    """Add the contributions of some rows to the information (p, p) and the score (p,), in place.

    Args:
        seen: (m,) measured columns.
        e, cov: (2 p + 1, n, 15), (2 p + 1, n, 15, 15) at the truth, then a step up and a step down for each parameter.
    """
    step = DERIVATIVE_STEP
    e, cov = e[:, :, seen], cov[:, :, seen[:, None], seen]
    white = np.linalg.inv(np.linalg.cholesky(cov[0]))  # whitening matrix: the sums become plain products
    error = (white @ e[0, ..., None])[..., 0]
    slope = (white @ ((e[1::2] - e[2::2]) / (2.0 * step))[..., None])[..., 0]
    spread = white @ ((cov[1::2] - cov[2::2]) / (2.0 * step)) @ white.transpose(0, 2, 1)
    flat_slope, flat_spread = slope.reshape(len(score), -1), spread.reshape(len(score), -1)
    information += flat_slope @ flat_slope.T + 0.5 * flat_spread @ flat_spread.T
    size = np.eye(len(seen)) - error[:, :, None] * error[:, None, :]
    score -= flat_slope @ error.ravel() + 0.5 * flat_spread @ size.ravel()


def bound(flight: Flight, sensor: str, first: int = 0, last: int | None = None, *, accelerometer: bool = True) -> Bound:
    """Cramer-Rao bound of mass and inertia from rows first..last-1 of a flight.

    Args:
        flight: any; its true state is only the centre of the start, its true parameters are used throughout.
        sensor: A, B or C.
        first, last: rows; last defaults to all rows flown.
        accelerometer: whether sensor A also measures the specific force.

    Raises: UsageError: no such sensor or rows.
    """
    last = flight.size if last is None else last
    y = observed(flight, sensor, first, last, accelerometer=accelerometer)
    wrench = np.ascontiguousarray(flight.wrench[first:last])
    s = flight.settings
    sds = (s.position_sd, s.velocity_sd, s.attitude_sd, s.body_rate_sd, s.acceleration_sd)
    truth = np.array([s.mass, *s.inertia, s.force_noise, *[s.torque_noise] * 3, *sds])
    free = [*range(8)] + [8 + g for g in range(5) if not np.all(np.isnan(y[:, 3 * g]))]
    names = (*PARAMETERS, *PROCESS_NOISES, *SENSORS)

    seen = np.flatnonzero(~np.all(np.isnan(y), axis=0))
    points = [truth]
    for i in free:
        factor = np.exp(DERIVATIVE_STEP * (np.arange(len(truth)) == i))
        points += [truth * factor, truth / factor]
    runs = [(point, flight.truth[first].copy(), np.diag(np.square(START_SD))) for point in points]
    information, score = np.zeros((len(free), len(free))), np.zeros(len(free))
    for begin in range(0, len(y), CHUNK_ROWS):
        end = min(begin + CHUNK_ROWS, len(y))
        n = end - begin
        e, cov = np.empty((len(runs), n, 15)), np.empty((len(runs), n, 15, 15))
        for i, (v, x, p) in enumerate(runs):
            innovations(begin, end, y, wrench, x, p, s.dt, v[0], v[1:4], v[4:8], v[8:13], e[i], cov[i])
        _add(seen, e, cov, information, score)
    return Bound(tuple(names[i] for i in free), information, score)
