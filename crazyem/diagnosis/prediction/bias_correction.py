"""Corrections of an open-loop prediction from the flight before its start: a weight of the rotation by the model, the
feedback of the control loop, and the mean specific force that the model lacks.

A drone in stabilised flight hardly accelerates: its controller answers to the air, so the recorded torque cancels a
torque that no model contains. Over some tenths of a second, the net torque of the model is then mostly error, and a
constant body rate is the better prediction. In hard manoeuvres the model is better. A regression decides between them,
for every time ahead h and each axis:

    recorded change of the rate = weight(h) * change by the model + offset(h) * h + feedback(h) . start,
    start = (angular acceleration that the model lacked in the last step, rate, and across the axis: tilt, velocity,
             velocity times the flow along the axis of the rotors, distance from the mean position so far).

The offset is a steady torque that the model lacks. The feedback is there because unknown torques depend on the motion,
and because the loop takes rates, tilts, velocities and positions back to its setpoints.

The regression uses the flight before the start only; data older than `PREDICTION.memory` count less. Earlier flights,
if given, count as if they had just been flown. A prior shrinks everything towards the model: weight 1, the rest 0. The
specific force, in body axes, is that of a battery or of the thrust of the day, which no file contains.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.diagnosis.settings import PREDICTION

LAGS = 10  # times ahead, up to the horizon


@dataclass(frozen=True, eq=False)
class Weights:
    """Corrections for n starts, at times ahead.

    Attributes:
        lags: (l,) s, times ahead, evenly spaced from 0.
        weight: (n, l, 3) of the change of the body rate by the model.
        added: (n, l, 3) rad/s, added change.
        force: (n, 3) m/s^2, specific force that the model lacks, body axes.
    """

    lags: NDArray
    weight: NDArray
    added: NDArray
    force: NDArray

    def changed(self, since: NDArray, gained: NDArray) -> NDArray:
        """(n, 3) rad/s, corrected change of the rate over `since` (n,) s, for a change `gained` (n, 3) by the model."""
        place = np.clip(since / self.lags[1], 0.0, len(self.lags) - 1.000001)
        low = place.astype(int)
        part = (place - low)[:, None]
        row = np.arange(since.size)
        weight, added = ((1.0 - part) * v[row, low] + part * v[row, low + 1] for v in (self.weight, self.added))
        changed: NDArray = weight * gained + added
        return changed

    def of(self, rows: slice | NDArray) -> "Weights":
        """The corrections of some starts."""
        return Weights(self.lags, self.weight[rows], self.added[rows], self.force[rows])


@dataclass(frozen=True, eq=False)
class Turned:
    """The rotation of a recorded flight, and predictions of the model one step ahead.

    Attributes:
        time: (r,) s, increasing.
        rate: (r, 3) rad/s, recorded.
        gained: (r, 3) rad/s, change by the model from a recorded row to the next one.
        start: (r, 3, f) regressors `start` of the module at a row for each axis; f as in `PREDICTION.feedback_sd`.
        flying: (r,) bool, whether the step from a row to the next one counts.
        lacking: (r, 3) m/s^2, specific force that the model lacks in this step, body axes.
    """

    time: NDArray
    rate: NDArray
    gained: NDArray
    start: NDArray
    flying: NDArray
    lacking: NDArray

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    def changes(self, lag: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """End times (k,) s, changes by the model and recorded ones (k, 3) rad/s over `lag` s, in order; and their first
        rows (k,)."""
        seen = np.isfinite(self.rate).all(1)
        sound = self.flying & seen & np.isfinite(self.gained).all(1) & np.isfinite(self.start).all((1, 2))
        steps = np.where(sound[:, None], self.gained, 0.0)
        model = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)[:-1]])
        broken = np.concatenate([[0], np.cumsum(~sound)[:-1]])
        end = np.searchsorted(self.time, self.time + lag - 0.5 * self.period)
        rows = np.flatnonzero(end < self.time.size)
        rows = rows[(broken[end[rows]] == broken[rows]) & sound[rows] & seen[end[rows]]]
        last = end[rows]
        return self.time[last], model[last] - model[rows], self.rate[last] - self.rate[rows], rows


def correction_weights(turned: Turned, starts: NDArray, *, horizon: float, before: NDArray | None = None) -> Weights:
    """The corrections of starts (n,) s by the flight before them, for times ahead up to `horizon` s.

    before: `moments` of earlier flights; None: no earlier flights.
    """
    lags = np.linspace(0.0, horizon, LAGS + 1)
    weight, added = np.ones((starts.size, lags.size, 3)), np.zeros((starts.size, lags.size, 3))
    here = turned.start[np.maximum(np.searchsorted(turned.time, starts + 1e-9, "right") - 1, 0)]
    for k, lag in enumerate(map(float, lags[1:]), 1):
        ends, explaining, came = _explained(turned, lag)
        at = np.searchsorted(ends, starts, "right") - 1
        known = (at + 1) * turned.period > (PREDICTION.min_rotation_time if before is None else -1.0)
        if not known.any():
            continue
        sd = np.array([PREDICTION.weight_sd, PREDICTION.offset_sd * lag, *(s * lag for s in PREDICTION.feedback_sd)])
        for axis in range(3):
            found = regression(
                explaining[:, axis], came[:, axis], sd, max(1.0, lag / turned.period), turned.period, at[known],
                before=None if before is None else before[k - 1, axis],
            )  # fmt: skip
            weight[known, k, axis] = np.clip(found[:, 0], 0.0, PREDICTION.max_weight)
            added[known, k, axis] = found[:, 1] + np.einsum("nf,nf->n", found[:, 2:], here[known, axis])
    weight[:, 0] = weight[:, 1]
    return Weights(lags, weight, added, mean_missing_force(turned, starts))


def moments(turned: Turned, *, horizon: float) -> NDArray:
    """(l, 3, p) mean products of the regression of a flight, by time ahead and axis, for later flights."""
    found = []
    for lag in np.linspace(0.0, horizon, LAGS + 1)[1:]:
        _, explaining, came = _explained(turned, float(lag))
        found.append([_products(explaining[:, axis], came[:, axis]).sum(0) / max(len(came), 1) for axis in range(3)])
    return np.array(found)


def _explained(turned: Turned, lag: float) -> tuple[NDArray, NDArray, NDArray]:
    """End times (k,) s, regressors (k, 3, c) of a change over `lag` s by axis, and the recorded change (k, 3)."""
    ends, x, y, rows = turned.changes(lag)
    return ends, np.concatenate([x[:, :, None], np.ones((rows.size, 3, 1)), turned.start[rows]], axis=2), y


def _products(x: NDArray, y: NDArray) -> NDArray:
    """(k, p) of x (k, c) and y (k,): the upper triangle of x x, then x y, y y and 1."""
    i, j = np.triu_indices(x.shape[1])
    return np.column_stack([x[:, i] * x[:, j], x * y[:, None], y * y, np.ones_like(y)])


def regression(
    x: NDArray, y: NDArray, sd: NDArray, alike: float, period: float, at: NDArray, *, before: NDArray | None = None
) -> NDArray:
    """(n, c) coefficients of y (k,) on the columns of x (k, c), from rows up to each of `at` (n,).

    Priors of standard deviations `sd` (c,) shrink them towards 1, 0, 0 ... Rows come every `period` s; `alike` rows
    count as one, because their windows overlap.

    before: mean products (p,) of earlier flights (see `moments`), as if just flown; a row of -1 uses them alone.
    """
    forget, c = np.exp(-period / PREDICTION.memory), x.shape[1]
    i, j = np.triu_indices(c)
    products = _products(x, y)
    earlier = np.zeros((1, products.shape[1])) if before is None else before[None] / (1.0 - forget)
    later, _ = lfilter([1.0], [1.0, -forget], products, axis=0, zi=forget * earlier)
    sums = np.concatenate([earlier, later])[at + 1]
    a = np.empty((at.size, c, c))
    a[:, i, j] = a[:, j, i] = sums[:, : i.size]
    b, yy, count = sums[:, i.size : i.size + c], sums[:, -2], sums[:, -1]
    size = np.sqrt(np.maximum(np.einsum("kii->ki", a), 1e-12))
    a, b = a / (size[:, :, None] * size[:, None, :]), b / size
    free = np.linalg.solve(a + 1e-9 * np.eye(c), b[:, :, None])[:, :, 0]
    missed = np.maximum(yy - np.einsum("ki,ki->k", free, b), 1e-12) / count  # variance
    noise = (missed * alike)[:, None]  # windows overlap
    prior = (size * sd) ** -2.0
    middle = np.concatenate([prior[:, :1] * size[:, :1], np.zeros((at.size, c - 1))], axis=1)
    information = a / noise[:, :, None] + prior[:, :, None] * np.eye(c)
    solved: NDArray = np.linalg.solve(information, (b / noise + middle)[:, :, None])[:, :, 0] / size
    return solved


def mean_missing_force(turned: Turned, starts: NDArray) -> NDArray:
    """(n, 3) m/s^2, mean specific force that the model lacked before each start, shrunk towards 0."""
    rows = np.flatnonzero(turned.flying & np.isfinite(turned.lacking).all(1))
    found = np.zeros((starts.size, 3))
    if not rows.size:
        return found
    value = turned.lacking[rows]
    forget = np.exp(-turned.period / PREDICTION.memory)
    count, total, squares = (
        lfilter([1.0], [1.0, -forget], v, axis=0) for v in (np.ones((rows.size, 1)), value, value**2)
    )
    spread = np.maximum(squares / count - (total / count) ** 2, 1e-12) * max(
        1.0, PREDICTION.force_memory / turned.period
    )
    mean = total / (count + spread / PREDICTION.force_sd**2)
    at = np.searchsorted(turned.time[rows] + turned.period, starts + 1e-9, "right") - 1
    known = (at + 1) * turned.period > PREDICTION.min_force_time
    found[known] = mean[at[known]]
    return found


def weighted_mean(value: NDArray, counting: NDArray, period: float) -> NDArray:
    """(r, k): mean of the counted rows (r, k) up to each row; before the first counted row, the row itself.

    Weights of older rows are smaller (`PREDICTION.memory`)."""
    counts = counting & np.isfinite(value).all(1)
    forget = np.exp(-period / PREDICTION.memory)
    count = lfilter([1.0], [1.0, -forget], counts.astype(float))
    total = lfilter([1.0], [1.0, -forget], np.where(counts[:, None], value, 0.0), axis=0)
    return np.where(count[:, None] > 0.0, total / np.maximum(count, 1e-300)[:, None], value)
