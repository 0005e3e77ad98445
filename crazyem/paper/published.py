"""The paper's algorithm as printed (section X), with only the corrections without which it does not run.

It serves for comparison only; the product's estimator is crazyem.estimation. published_values.CORRECTIONS lists the
corrections with reasons. Everything else is as printed, including the isotropic Q0 and R0, the Jacobian without the
tilt (eq. 59) and the smoother that ignores this Jacobian (eq. 95).

Kernels: filter (eq. 88-93), smoother (94-98), mass (107), inertia (appendix). With isotropic P0, Q0, R0 and the
Jacobian of eq. 59, the covariance couples neither position and velocity with angles and rates nor the axes of position,
and is equal for these axes. Three numbers and a 6 by 6 block therefore represent it.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.errors import UsageError
from crazyem.paper.flight import Flight
from crazyem.paper.plant import derivative, transition
from crazyem.paper.settings import Settings
from crazyem.vehicle import GRAVITY


@compiled
def _predict_angular(p, a, b, q, half):
    """Eq. 89 for angles and rates: p (6, 6) in place, both triangles; half (3, 6) is scratch.

    a (3, 3), b (3, 3): derivatives of the angles' rows in eq. 59 with respect to angles and rates.
    """
    for i in range(3):
        for j in range(6):
            total = a[i, 0] * p[0, j] + a[i, 1] * p[1, j]
            if i == 2:
                total += p[2, j]
            half[i, j] = total + b[i, 0] * p[3, j] + b[i, 1] * p[4, j] + b[i, 2] * p[5, j]
    for i in range(3):
        for j in range(i + 1):
            total = half[i, 0] * a[j, 0] + half[i, 1] * a[j, 1]
            if j == 2:
                total += half[i, 2]
            total += half[i, 3] * b[j, 0] + half[i, 4] * b[j, 1] + half[i, 5] * b[j, 2]
            p[i, j] = total
            p[j, i] = total
        for j in range(3, 6):
            p[i, j] = half[i, j]
            p[j, i] = half[i, j]
    for i in range(6):
        p[i, i] += q


@compiled
def _correct_angular(p, x, y, r, sees_angles, gain):
    """Eq. 91-93 for angles and rates, a scalar at a time (R is diagonal): p (6, 6) and x[6:12] in place."""
    for c in range(0 if sees_angles else 3, 6):
        s = 1.0 / (p[c, c] + r)
        innovation = (y[6 + c] - x[6 + c]) * s
        for i in range(6):
            gain[i] = p[i, c]
            x[6 + i] += gain[i] * innovation
        for i in range(6):
            scaled = gain[i] * s
            for j in range(i + 1):
                value = p[i, j] - scaled * gain[j]
                p[i, j] = value
                p[j, i] = value


@compiled
def _correct_linear(p, x, y, r):
    """Eq. 91-93 for position and velocity: p (3,) variances and covariance rr, rv, vv of each axis, in place."""
    rr, rv, vv = p[0], p[1], p[2]
    s = 1.0 / (rr + r)
    for i in range(3):
        innovation = (y[i] - x[i]) * s
        x[i] += rr * innovation
        x[3 + i] += rv * innovation
    vv -= rv * rv * s
    rv -= rv * rr * s
    rr -= rr * rr * s
    s = 1.0 / (vv + r)
    for i in range(3):
        innovation = (y[3 + i] - x[3 + i]) * s
        x[i] += rv * innovation
        x[3 + i] += vv * innovation
    p[0] = rr - rv * rv * s
    p[1] = rv - rv * vv * s
    p[2] = vv - vv * vv * s


@compiled
def _solve6(p, q, d, lower):
    """(p + q 1)^-1 d for a 6 by 6 block, in place of d; lower (6, 6) is scratch. Cholesky."""
    for j in range(6):
        total = p[j, j] + q
        for k in range(j):
            total -= lower[j, k] * lower[j, k]
        pivot = 1.0 / np.sqrt(total)
        lower[j, j] = pivot  # its inverse
        for i in range(j + 1, 6):
            total = p[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total * pivot
        total = d[j]
        for k in range(j):
            total -= lower[j, k] * d[k]
        d[j] = total * pivot
    for j in range(5, -1, -1):
        total = d[j]
        for k in range(j + 1, 6):
            total -= lower[k, j] * d[k]
        d[j] = total * lower[j, j]


@compiled
def expectation(
    observed, wrench, first, theta, dt, p0, q, r, sees_angles, predicted, filtered, linear, angular, smoothed
):
    """E-step: extended Kalman filter forwards, Rauch-Tung-Striebel backwards, as printed.

    Args:
        observed: (n, 12) observations, in frames and SI units of the state. H is the identity, without the rows of the
            angles unless `sees_angles`.
        wrench: (n, 4) thrust N and torque N m held from each row to the next; the last row is not used.
        first: (12,) mean of the state at the first row before its observation.
        theta: (4,) mass kg, inertia kg m^2.
        dt: s.
        p0, q, r: P0, Q0, R0 as printed, one number each.
        predicted, filtered, smoothed: (>= n, 12) are filled; linear (>= n, 3) and angular (>= n, 6, 6) with the
            covariance after each row (position-velocity per axis; angles and rates).

    The smoothed covariance (eq. 98) is left out, because neither eq. 107 nor the appendix uses it.
    """
    n = observed.shape[0]
    phi = np.empty((12, 12))
    a, b = phi[6:9, 6:9], phi[6:9, 9:12]
    half = np.empty((3, 6))
    gain = np.empty(6)
    rate = np.empty(12)
    x = first.copy()
    mass = theta[0]
    inertia = theta[1:]
    pl = np.array([p0, 0.0, p0])
    pa = p0 * np.eye(6)
    for k in range(n):
        if k:
            transition(x, dt, phi)
            derivative(x, wrench[k - 1, 0], wrench[k - 1, 1:], mass, inertia, rate)
            for i in range(12):
                x[i] += dt * rate[i]
            pl[0] += 2.0 * dt * pl[1] + dt * dt * pl[2] + q
            pl[1] += dt * pl[2]
            pl[2] += q
            _predict_angular(pa, a, b, q, half)
        predicted[k] = x
        _correct_linear(pl, x, observed[k], r)
        _correct_angular(pa, x, observed[k], r, sees_angles, gain)
        filtered[k] = x
        linear[k] = pl
        angular[k] = pa
    _smooth(n, q, predicted, filtered, linear, angular, smoothed)


@compiled
def _smooth(n, q, predicted, filtered, linear, angular, smoothed):
    """Eq. 94-97: means backwards with the gain P (P + Q)^-1."""
    lower = np.empty((6, 6))
    d = np.empty(6)
    smoothed[n - 1] = filtered[n - 1]
    for k in range(n - 2, -1, -1):
        rr, rv, vv = linear[k, 0], linear[k, 1], linear[k, 2]
        srr, svv = rr + q, vv + q
        det = 1.0 / (srr * svv - rv * rv)
        for i in range(3):
            dr = smoothed[k + 1, i] - predicted[k + 1, i]
            dv = smoothed[k + 1, 3 + i] - predicted[k + 1, 3 + i]
            er = (svv * dr - rv * dv) * det
            ev = (srr * dv - rv * dr) * det
            smoothed[k, i] = filtered[k, i] + rr * er + rv * ev
            smoothed[k, 3 + i] = filtered[k, 3 + i] + rv * er + vv * ev
        for i in range(6):
            d[i] = smoothed[k + 1, 6 + i] - predicted[k + 1, 6 + i]
        p = angular[k]
        _solve6(p, q, d, lower)
        for i in range(6):
            total = filtered[k, 6 + i]
            for j in range(6):
                total += p[i, j] * d[j]
            smoothed[k, 6 + i] = total


@compiled
def maximisation(x, wrench, theta, dt, clamp, lowest, highest, new):
    """M-step: mass (eq. 107 without its last dt) and inertia (appendix) from means, as printed without expectations.

    Args:
        x: (n, 12) smoothed states. wrench: (n, 4) thrust N, torque N m held from each row to the next.
        theta: (4,) the last parameters; the formula of each axis uses the inertia of the other axes from here.
        dt: s.
        clamp: keep the last value if the new one is not between lowest and highest, (4,) each.
        new: (4,) is filled: mass kg, inertia kg m^2.
    """
    top = np.zeros(4)
    low = np.zeros(4)
    for k in range(x.shape[0] - 1):
        force = wrench[k, 0] * np.cos(x[k, 6]) * np.cos(x[k, 7])
        top[0] += force * force * dt
        low[0] += force * (GRAVITY * dt + x[k + 1, 5] - x[k, 5])
        for i in range(3):
            j = (i + 1) % 3
            m = (i + 2) % 3
            torque = wrench[k, 1 + i] + (theta[1 + j] - theta[1 + m]) * x[k, 9 + j] * x[k, 9 + m]
            top[1 + i] += torque * torque * dt
            low[1 + i] += (x[k + 1, 9 + i] - x[k, 9 + i]) * torque
    for i in range(4):
        value = top[i] / low[i] if low[i] != 0.0 else np.nan
        if clamp and not (lowest[i] < value < highest[i]):
            value = theta[i]
        new[i] = value


# `clamp` refuses an inertia that differs from I0 by a larger factor: with a factor of ten the rate loop is still stable
LARGEST_INERTIA_RATIO = 10.0

Angles = Literal["zero", "dead-reckoned"]


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
    """(n, 12) observations for the E-step from row `first` on: for sensor A its filter's states, else readings."""
    if sensor == "A":
        return flight.estimate[first : flight.size]
    rows = flight.readings[first : flight.size, :12]
    if sensor == "C":
        rows = rows.copy()
        rows[:, 6:9] = 0.0
    return rows


def _check(sensor: str) -> None:
    if sensor not in ("A", "B", "C"):
        raise UsageError(f"there is no sensor {sensor!r} in the paper: A, B or C")


def published_offline(flight: Flight, sensor: str, *, angles: Angles = "zero", iterations: int = 20) -> NDArray:
    """EM over all rows of a flight, from m0 and I0 (eq. 116, 117).

    Args:
        flight: at least two rows.
        sensor: A (the states of the state filter are the observations), B (full state) or C (no angles).
        angles: treatment of C's missing angles: observed as "zero", as the printed bias implies, or "dead-reckoned"
            from the start (their rows dropped from H).
        iterations: number of EM iterations.

    Returns: (iterations + 1, 4) mass kg, Ixx, Iyy, Izz kg m^2 after each EM iteration, the start first.

    Raises: UsageError: no such sensor; fewer than two rows.
    """
    _check(sensor)
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
            observed, flight.wrench[: flight.size], first, theta[i], sees_angles=sees, clamp=False
        )
    return theta


class PublishedOnline:
    """One EM iteration over the newest rows of a flight (800, XI-A2) at each call, parameters carried over.

    The paper does not give the number of iterations per update. "200 iterations" until convergence (XI-C) for 800
    samples at 4 samples per update mean one iteration each.

    Args:
        settings: of the flight.
        sensor: A, B or C, whose missing angles are observed as zero.
        clamp: whether to refuse a mass that is not positive, or an inertia that differs from I0 by a factor over
            `LARGEST_INERTIA_RATIO`, and keep the last one. As printed: False; some flights from m0 = 1 g then crash.

    Attributes:
        theta: (4,) mass kg, Ixx, Iyy, Izz kg m^2, newest.
    """

    def __init__(self, settings: Settings, sensor: str, *, clamp: bool = False) -> None:
        _check(sensor)
        self.sensor = sensor
        self.clamp = clamp
        self.theta = np.array([settings.mass_start, *settings.inertia_start])
        self._work = _Workspace(settings.window, settings)

    def update(self, flight: Flight) -> tuple[float, NDArray]:
        """Mass kg and inertia (3,) kg m^2 after one more iteration over the newest rows of the flight."""
        first = max(0, flight.size - self._work.settings.window)
        if flight.size - first >= 2:
            observed = np.ascontiguousarray(_observed(flight, self.sensor, first))
            wrench = flight.wrench[first : flight.size]
            self.theta = self._work.iterate(
                observed, wrench, observed[0].copy(), self.theta, sees_angles=True, clamp=self.clamp
            )
        return float(self.theta[0]), self.theta[1:].copy()
