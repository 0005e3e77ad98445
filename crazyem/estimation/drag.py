"""Drag over mass along body x and y, by regression of the specific force on the drone's speed.

In flight an accelerometer along x or y shows no gravity and no thrust, only drag: s = c - d v, with v the speed along
this axis, d drag over mass [1/s], and a constant c (mounting, steady wind at one heading). The onboard filter takes d
as its parameter kalman.dragB_*. The speed is distance over time, over the same quarter of a second as s. The velocity
of the onboard filter has an error in proportion to the drag that the filter does not know; its position hardly has one.
d is the least-squares slope. Its standard deviation takes whole seconds as clusters (Liang, Zeger 1986), because the
residuals within a second are not independent.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.result import ParameterEstimate
from crazyem.signals.sample import Sample

SPAN = 0.25  # s over which speed and force are averaged
SPANS = 4  # spans in a cluster: these are taken as dependent
KEPT = 30  # clusters (seconds) in the regression
FEWEST = 6  # clusters needed for an estimate
FEWEST_SAMPLES = 10  # least number of accelerometer samples in a span
RANGE = 0.3  # m/s, least standard deviation of speed along an axis; below, other specific forces hide the drag
HALF_WIDTH = 0.3  # largest 95 % half width over the value
# Systematic error, relative: along a curve, distance over time is not the speed. In figures 8 of the simulated firmware
# d comes out 1 to 3 % too low.
SYSTEMATIC = 0.02
NAMES = ("drag_x", "drag_y")
UNIT = "1/s"


class DragRegression:
    """Regression of specific force on speed, fed with position, attitude and specific_force in order of arrival."""

    def __init__(self) -> None:
        self._start: tuple[float, tuple[float, ...]] | None = None  # of the span: s, position
        self._attitude: list[tuple[float, ...]] = []
        self._force: list[tuple[float, ...]] = []
        self._seconds: deque[NDArray] = deque(maxlen=KEPT)  # (2, 5): n, sum v, vv, s, vs of x and y
        self._sums, self._count = np.zeros((2, 5)), 0

    def feed(self, sample: Sample, *, airborne: bool) -> None:
        """Take one sample; samples on the ground are not used."""
        if not airborne or not all(map(math.isfinite, sample.value)):
            self._start = None
        elif sample.signal == "attitude":
            self._attitude.append(sample.value)
        elif sample.signal == "specific_force":
            self._force.append(sample.value)
        elif sample.signal == "position":
            self._position(sample.time, sample.value)

    def _position(self, time: float, position: tuple[float, ...]) -> None:
        if self._start is not None:
            lasted = time - self._start[0]
            if 0.0 <= lasted < SPAN:
                return
            if SPAN <= lasted < 1.5 * SPAN and len(self._force) >= FEWEST_SAMPLES and self._attitude:
                moved = [(b - a) / lasted for a, b in zip(self._start[1], position)]
                self._add(_body(self._attitude[len(self._attitude) // 2], moved))
        self._start = (time, position)
        self._attitude.clear()
        self._force.clear()

    def _add(self, velocity: tuple[float, float]) -> None:
        for axis, v in enumerate(velocity):
            s = sum(f[axis] for f in self._force) / len(self._force)
            self._sums[axis] += (1.0, v, v * v, s, v * s)
        self._count += 1
        if self._count == SPANS:
            self._seconds.append(self._sums)
            self._sums, self._count = np.zeros((2, 5)), 0

    def estimates(self) -> dict[str, ParameterEstimate]:
        """The estimates drag_x, drag_y [1/s]."""
        sums = np.array(self._seconds) if self._seconds else np.zeros((0, 2, 5))
        return {name: _estimate(sums[:, axis]) for axis, name in enumerate(NAMES)}


def _body(q: tuple[float, ...], v: list[float]) -> tuple[float, float]:
    """Components along body x and y of a world vector; q = x, y, z, w, body to world."""
    x, y, z, w = q
    return (
        (1 - 2 * (y * y + z * z)) * v[0] + 2 * (x * y + w * z) * v[1] + 2 * (x * z - w * y) * v[2],
        2 * (x * y - w * z) * v[0] + (1 - 2 * (x * x + z * z)) * v[1] + 2 * (y * z + w * x) * v[2],
    )


def _estimate(sums: NDArray) -> ParameterEstimate:
    """Estimate of one axis from sums (seconds, 5), see `DragRegression`."""
    count = len(sums)
    if count < FEWEST:
        return _unknown("too few samples in the air")
    n, v, vv, s, vs = sums.sum(axis=0)
    information = np.array([[n, v], [v, vv]])
    spread = math.sqrt(max(vv / n - (v / n) ** 2, 0.0))
    if spread < RANGE:
        return _unknown(f"speeds of {spread:.2f} m/s rms are too small: {RANGE:g} m/s or more show drag")
    inverse = np.linalg.inv(information)
    beta = inverse @ (s, vs)  # s = beta_0 + beta_1 v
    scores = np.stack([
        sums[:, 3] - beta[0] * sums[:, 0] - beta[1] * sums[:, 1],
        sums[:, 4] - beta[0] * sums[:, 1] - beta[1] * sums[:, 2],
    ])  # fmt: skip
    covariance = inverse @ (scores @ scores.T) @ inverse * count / (count - 2)
    value = -float(beta[1])
    sd = math.hypot(math.sqrt(covariance[1, 1]), SYSTEMATIC * value)
    low, high = value - 1.96 * sd, value + 1.96 * sd
    reason = ""
    if low <= 0.0:
        reason = "no drag is seen: its interval holds 0"
    elif 1.96 * sd > HALF_WIDTH * value:
        reason = f"uncertain by {100 * 1.96 * sd / value:.0f} %"
    return ParameterEstimate(value, sd, (low, high), UNIT, not reason, reason)


def _unknown(reason: str) -> ParameterEstimate:
    return ParameterEstimate(math.nan, math.inf, (-math.inf, math.inf), UNIT, False, reason)
