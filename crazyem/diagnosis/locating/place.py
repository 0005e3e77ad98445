"""A force that depends on place, as a generic rival of named effects: a constant and a slope by x, y, z for each axis.

A cable, a fan or the draught of a wall is not in the catalogue; wind, ground effect or gusts explain a part of its
force. Such a force is the same on the next flight. The force of gusts correlates with place by chance only. So the
force must also gain on held-out flights.
"""

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Column, Model, Point
from crazyem.diagnosis.fitting.situation import initial_path
from crazyem.diagnosis.locating.locate import AXES, Finding
from crazyem.diagnosis.settings import LOCATION
from crazyem.physics.rotations import (
    rotation_matrix,
)
from crazyem.vehicle import GRAVITY, Vehicle


def pushes_away(force: Finding) -> bool:
    """Whether a force by place grows along its own axis, so that it pushes the drone away.

    A control loop that gives way to gusts looks like this on every flight. A cable pulls back.
    """
    return force.axis == force.variable and force.effect_size > 0.0


def depends_on_place(data: Data, apart: Data | None, point: Point) -> Finding | None:
    """The force by place that a model lacks; None if there is none, or without positions."""
    if "position" not in data.signals:
        return None
    centre = np.median(np.concatenate([_path(m)[:, :3] for m in data.models]), axis=0)
    gram = _gram(data, point, centre)
    prior = np.full(gram.size, LOCATION.prior_precision)
    solution = gram.solve(range(gram.size), precision=prior)
    dispersion = max(1.0, solution.dispersion)
    theta, held = solution.theta, solution.held_out
    if apart is not None:
        b, a = _gram(apart, point, centre).total(range(gram.size))
        held = float(b @ theta - 0.5 * theta @ a @ theta)
    gained = solution.gain / dispersion - gram.size
    if min(gained, held / dispersion) < LOCATION.min_structure:
        return None
    errors = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0)).reshape(3, 4)[:, 1:]
    mass = point.vehicle.mass
    return slope_finding(data, mass * theta.reshape(3, 4)[:, 1:], mass * errors, float(gained), point.vehicle)


def left_by_place(data: Data, point: Point) -> float:
    """Gain of a force by place beside a model, less its number of parameters, in the linear approximation [nats]."""
    gram = _gram(data, point, np.median(np.concatenate([_path(m)[:, :3] for m in data.models]), axis=0))
    solution = gram.solve(range(gram.size), precision=np.full(gram.size, LOCATION.prior_precision))
    return float(solution.gain / max(1.0, solution.dispersion) - gram.size)


def slope_finding(data: Data, slopes: NDArray, errors: NDArray, nats: float, vehicle: Vehicle) -> Finding | None:
    """The strongest slope of a force by place, (3, 3) N/m with standard deviations, as a finding; None if the force
    varies too little along these flights (`LOCATION.force`)."""
    spread = np.concatenate([_path(m)[:, :3] for m in data.models]).std(axis=0)
    sizes = slopes * spread
    i, j = np.unravel_index(int(np.argmax(np.abs(sizes))), sizes.shape)
    if abs(sizes[i, j]) < LOCATION.force * vehicle.mass * GRAVITY:
        return None
    begin, end = (float(t) for t in data.flights[0].time[[0, -1]])
    size, sd, chance = float(sizes[i, j]), float(errors[i, j] * spread[j]), float(np.exp(-min(nats, 700.0)))
    return Finding("force", AXES[i], f"{AXES[j]} position", AXES[j], (begin, end), size, sd, "N", nats, chance)


def _path(model: Model) -> NDArray:
    """The predicted path; the measured one if the model left the range of numbers."""
    return initial_path(model.flight) if model.rows_path is None else model.rows_path


def _gram(data: Data, point: Point, centre: NDArray) -> Gram:
    swept = []
    for model in data.models:
        if model.rows_path is None:
            model.sweep(point)
        path = _path(model)
        axes = rotation_matrix(path[:, 6:10])  # row i: world axis i in the body
        by = np.column_stack([np.ones(len(path)), path[:, :3] - centre])
        forces = [axes[:, i] * by[:, j : j + 1] for i in range(3) for j in range(4)]
        none = np.zeros((len(path), 3))
        swept.append(model.sweep(point, [Column("place", acting=np.hstack([f, none])) for f in forces]))
    return Gram.joined(swept)
