"""A heading error that depends on place (a magnet under the floor, bent markers), from attitude and gyro, no model.

Between two samples, the attitude should turn by the integral of the gyro. The difference is regressed on errors of a
biased, late, scaled or tilted gyro, and on the change of place. With a heading error psi(x, y, z), a sum of waves along
each axis, the rotation about the vertical is wrong by the difference of psi. The filter of the fit explains such an
attitude by a noisy gyro, so it does not find the error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.locating.locate import AXES, Finding
from crazyem.diagnosis.settings import LOCATION
from crazyem.physics.rotations import (
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    rotation_vector_from_quaternion,
)


@dataclass(frozen=True)
class _Turns:
    turned: NDArray  # (n,) rad, rotation about the vertical less that of the gyro
    usual: NDArray  # (n, 8) regressors of usual sensor errors
    after: NDArray  # (n, 3) m, place at the end of a window
    place: NDArray  # (n, 3) m, place at its start


def heading_by_place(data: Data, apart: Data | None) -> Finding | None:
    """The heading error as a finding, if it depends on place in the same way on all flights; else None.

    The roles of fitted and held-out flights may be exchanged, because the model does not keep this fit: fitted flights
    that hover do not show the error.
    """
    if not {"position", "attitude", "body_rate"} <= data.signals:
        return None
    fitted, others = _seen(data), None if apart is None else _seen(apart)
    if fitted is None or apart is None:
        return None if fitted is None else _finding(fitted, None, data)
    if others is None:
        return None
    return _finding(fitted, others, data) or _finding(others, fitted, apart)


def _seen(data: Data) -> _Turns | None:
    """The windows of all flights; None if there are none."""
    turns = [t for t in (_turns(f) for f in data.flights) if t is not None]
    return _Turns(*(np.concatenate([getattr(t, n) for t in turns]) for n in _Turns.__annotations__)) if turns else None


def _finding(every: _Turns, other: _Turns | None, data: Data) -> Finding | None:
    """The finding of some flights, if other flights confirm it. Without others, or if they hardly move, it is fitted to
    every other second and confirmed by the rest."""
    middle = np.median(every.place, axis=0)
    shapes = _shapes(every, middle)
    theta = _ridge_fit(shapes, every)
    x = _without(every.usual, shapes)
    determined = float(np.trace(np.linalg.solve(_ridge(x), x.T @ x)))  # number of terms
    gained = _nats(shapes, every, theta) - determined
    asked = None if other is None else _shapes(other, middle)
    # a hover has its own biases, which may cost a tenth of the gain of a moving flight
    if (
        other is not None
        and asked is not None
        and _expected(asked, other, theta) > max(2 * LOCATION.heading_held_out, LOCATION.heading_share * gained)
    ):
        held = _nats(asked, other, theta)
    else:
        second = (np.arange(len(shapes)) * LOCATION.heading_window).astype(int) % 2 == 0
        one, two = (_Turns(*(getattr(every, n)[s] for n in _Turns.__annotations__)) for s in (second, ~second))
        held = _nats(shapes[~second], two, _ridge_fit(shapes[second], one))
    waves = _waves(every.place - middle)
    error = waves @ theta
    if gained < LOCATION.heading_gain or held < LOCATION.heading_held_out or error.std() < LOCATION.min_heading:
        return None
    axis = int(np.argmax([(waves[:, k::3] @ theta[k::3]).std() for k in range(3)]))
    time = data.flights[0].time[[0, -1]]
    return Finding("attitude", "z", f"{AXES[axis]} position", AXES[axis], (float(time[0]), float(time[1])),
                   float(error.std()), float(error.std() / np.sqrt(2.0 * gained)), "rad", float(gained),
                   float(np.exp(-min(gained, 700.0))))  # fmt: skip


def _turns(flight: Flight) -> _Turns | None:
    """The windows of a flight; None if too few are without gaps."""
    known = np.isfinite(flight.y[:, [0, 6, 10]]).all(axis=1)
    rows = np.flatnonzero(known)
    if rows.size < LOCATION.min_windows:
        return None
    time, y = flight.time[rows], flight.y[rows]
    torn = np.cumsum(flight.gaps)[rows]
    rate = np.einsum("nij,nj->ni", rotation_matrix(y[:, 6:10]), y[:, 10:13])  # world
    angle = np.zeros_like(rate)
    angle[1:] = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None], axis=0)
    step = max(1, round(LOCATION.heading_window / float(np.median(np.diff(time)))))
    first = np.arange(0, time.size - step, step)
    last = first + step
    whole = (torn[first] == torn[last]) & (time[last] - time[first] < 2 * LOCATION.heading_window)
    first, last = first[whole], last[whole]
    if first.size < LOCATION.min_windows:
        return None
    turned = quaternion_product(y[last, 6:10], quaternion_conjugate(y[first, 6:10]))  # about world axes
    turn = rotation_vector_from_quaternion(turned)
    shown = angle[last] - angle[first]
    usual = np.column_stack([time[last] - time[first], shown, rate[last] - rate[first], shown[:, 2] ** 2])
    return _Turns(turn[:, 2] - shown[:, 2], usual, y[last, :3], y[first, :3])


def _waves(place: NDArray) -> NDArray:
    """(n, 30): sines and cosines of x, y, z, by waves."""
    angle = [2 * np.pi / wave * place for wave in LOCATION.wavelengths]
    return np.hstack([f(x) for x in angle for f in (np.sin, np.cos)])


def _shapes(turns: _Turns, middle: NDArray) -> NDArray:
    """Change of the waves over each window."""
    return _waves(turns.after - middle) - _waves(turns.place - middle)


def _without(usual: NDArray, columns: NDArray) -> NDArray:
    return columns - usual @ np.linalg.lstsq(usual, columns, rcond=None)[0]


def _ridge(x: NDArray) -> NDArray:
    size = x.shape[1]
    return x.T @ x + (LOCATION.ridge * np.trace(x.T @ x) / size + 1e-12) * np.eye(size)  # regular without motion


def _ridge_fit(shapes: NDArray, turns: _Turns) -> NDArray:
    x, y = _without(turns.usual, shapes), _without(turns.usual, turns.turned[:, None])[:, 0]
    return np.linalg.solve(_ridge(x), x.T @ y)


def _nats(shapes: NDArray, turns: _Turns, theta: NDArray) -> float:
    """Gain of log-likelihood by the terms, for windows with independent errors of one unknown size."""
    x, y = _without(turns.usual, shapes), _without(turns.usual, turns.turned[:, None])[:, 0]
    return 0.5 * y.size * float(np.log(np.sum(y**2) / max(np.sum((y - x @ theta) ** 2), 1e-300)))


def _expected(shapes: NDArray, turns: _Turns, theta: NDArray) -> float:
    """Expected gain [nats] if the terms are real."""
    x, y = _without(turns.usual, shapes), _without(turns.usual, turns.turned[:, None])[:, 0]
    return 0.5 * float(np.sum((x @ theta) ** 2) / max(np.mean((y - x @ theta) ** 2), 1e-300))
