"""What an open-loop prediction learns from the flight before its start: how much of the model's turning to believe, and
the mean force that the model lacks.

A drone in stabilised flight hardly accelerates: a controller that answers to the air makes the recorded torque cancel
a torque that no model knows. Over some tenths of a second the model's net torque is therefore mostly error, and a body
rate that stays as it is the better prediction; in hard manoeuvres the model is. Which of them is a matter of record:
for every time ahead h and each axis, the change of the rate that came is regressed on the change that the model gave,
and on h itself (a steady torque that the model lacks),

    change that came = weight(h) * change by the model + offset(h) * h,

over the flight so far, never what comes after a start; what is older than `MEMORY` counts less. While little has been
seen, weight and offset are drawn towards 1 and 0, the model itself. The force, in body axes, is a battery or a day's
thrust, which no file knows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

LAGS = 10  # of them up to the horizon
MEMORY = 10.0  # s
WEIGHT_SD, OFFSET_SD = 1.0, 2.0  # 1, rad/s^2: before anything was seen
FORCE_SD, CORRELATED = 0.5, 0.1  # m/s^2 before anything was seen; s within which one moment is as wrong as the next
MOST = 2.0  # weight; of a model that is right it is 1
LEAST_TIME = 2.0  # s of flight before anything is said


@dataclass(frozen=True, eq=False)
class Weights:
    """Of n starts, at times ahead of them.

    Attributes:
        lags: (l,) s, evenly spaced from 0.
        weight: (n, l, 3) of the model's change of the body rate.
        added: (n, l, 3) rad/s beside it.
        force: (n, 3) m/s^2, specific force that the model lacks, body axes.
    """

    lags: NDArray
    weight: NDArray
    added: NDArray
    force: NDArray

    def changed(self, since: NDArray, gained: NDArray) -> NDArray:
        """(n, 3) rad/s: the change of the rate `since` (n,) s, where the model gives `gained` (n, 3) rad/s."""
        place = np.clip(since / self.lags[1], 0.0, len(self.lags) - 1.000001)
        low = place.astype(int)
        part = (place - low)[:, None]
        row = np.arange(since.size)
        weight, added = ((1.0 - part) * v[row, low] + part * v[row, low + 1] for v in (self.weight, self.added))
        changed: NDArray = weight * gained + added
        return changed

    def of(self, rows: slice | NDArray) -> "Weights":
        """Of some of the starts."""
        return Weights(self.lags, self.weight[rows], self.added[rows], self.force[rows])


@dataclass(frozen=True, eq=False)
class Turned:
    """What a flight did, and what the model says of it one step ahead.

    Attributes:
        time: (r,) s, increasing.
        rate: (r, 3) rad/s, recorded.
        gained: (r, 3) rad/s, what the model adds from a row to the next one, beginning with the recorded row.
        flying: (r,) bool: the step from a row to the next one counts.
        lacking: (r,) m/s^2, specific force that the model lacked in that step, body axes (r, 3).
    """

    time: NDArray
    rate: NDArray
    gained: NDArray
    flying: NDArray
    lacking: NDArray

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    def changes(self, lag: float) -> tuple[NDArray, NDArray, NDArray]:
        """End times (k,) s, changes that the model gave and that came (k, 3) rad/s, over `lag` s, in order."""
        seen = np.isfinite(self.rate).all(1)
        sound = self.flying & seen & np.isfinite(self.gained).all(1)
        steps = np.where(sound[:, None], self.gained, 0.0)
        model = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)[:-1]])
        broken = np.concatenate([[0], np.cumsum(~sound)[:-1]])
        end = np.searchsorted(self.time, self.time + lag - 0.5 * self.period)
        rows = np.flatnonzero(end < self.time.size)
        rows = rows[(broken[end[rows]] == broken[rows]) & sound[rows] & seen[end[rows]]]
        last = end[rows]
        return self.time[last], model[last] - model[rows], self.rate[last] - self.rate[rows]


def earned(turned: Turned, starts: NDArray, *, horizon: float) -> Weights:
    """The weights of starts (n,) s by the flight before them, for times ahead up to `horizon` s."""
    lags = np.linspace(0.0, horizon, LAGS + 1)
    weight, added = np.ones((starts.size, lags.size, 3)), np.zeros((starts.size, lags.size, 3))
    for k, lag in enumerate(lags[1:], 1):
        ends, x, y = turned.changes(float(lag))
        at = np.searchsorted(ends, starts, "right") - 1
        known = (at + 1) * turned.period > LEAST_TIME
        if not known.any():
            continue
        for axis in range(3):
            found = regressed(x[:, axis], y[:, axis], float(lag), turned.period)[at[known]]
            weight[known, k, axis] = np.clip(found[:, 0], 0.0, MOST)
            added[known, k, axis] = found[:, 1] * lag
    weight[:, 0] = weight[:, 1]
    return Weights(lags, weight, added, lacked(turned, starts))


def regressed(x: NDArray, y: NDArray, lag: float, period: float) -> NDArray:
    """(k, 2) weight and offset [rad/s^2] by the changes x, y (k,) up to each of them, with the priors above."""
    forget = np.exp(-period / MEMORY)
    rows = np.stack([x, np.full(x.size, lag)], 1)
    products = [rows[:, i] * rows[:, j] for i, j in ((0, 0), (0, 1), (1, 1))]
    wanted = [rows[:, 0] * y, rows[:, 1] * y, y * y, np.ones(x.size)]
    sums = lfilter([1.0], [1.0, -forget], np.stack(products + wanted, 1), axis=0)
    a = sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    b, yy, count = sums[:, 3:5], sums[:, 5], sums[:, 6]
    small = 1e-9 * np.eye(2) * np.maximum(np.trace(a, axis1=1, axis2=2), 1e-12)[:, None, None]
    free = np.linalg.solve(a + small, b[:, :, None])[:, :, 0]
    missed = np.maximum(yy - np.einsum("ki,ki->k", free, b), 1e-12) / count  # variance
    noise = missed * max(1.0, lag / period)  # windows that overlap say the same
    prior = np.diag([WEIGHT_SD**-2, OFFSET_SD**-2])
    information = a / noise[:, None, None] + prior
    solved: NDArray = np.linalg.solve(information, (b / noise[:, None] + prior @ [1.0, 0.0])[:, :, None])[:, :, 0]
    return solved


def lacked(turned: Turned, starts: NDArray) -> NDArray:
    """(n, 3) m/s^2: mean specific force that the model lacked before each start, drawn towards 0."""
    rows = np.flatnonzero(turned.flying & np.isfinite(turned.lacking).all(1))
    found = np.zeros((starts.size, 3))
    if not rows.size:
        return found
    value = turned.lacking[rows]
    forget = np.exp(-turned.period / MEMORY)
    count, total, squares = (
        lfilter([1.0], [1.0, -forget], v, axis=0) for v in (np.ones((rows.size, 1)), value, value**2)
    )
    spread = np.maximum(squares / count - (total / count) ** 2, 1e-12) * max(1.0, CORRELATED / turned.period)
    mean = total / (count + spread / FORCE_SD**2)
    at = np.searchsorted(turned.time[rows] + turned.period, starts + 1e-9, "right") - 1
    known = (at + 1) * turned.period > LEAST_TIME
    found[known] = mean[at[known]]
    return found
