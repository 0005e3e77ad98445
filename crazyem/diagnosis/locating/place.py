"""A force that depends on place, as a generic rival of the named ones: a constant and a slope by x, y, z for each axis.

A cable, a fan, a wall's draught: none of them is in the catalogue, but wind, ground effect or gusts take their part of
it. Such a force is the same on the next flight, while the force of gusts correlates with place by chance only; so it
must hold on flights that it was not fitted to.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Column, Model, Point
from crazyem.diagnosis.fitting.situation import initial_path
from crazyem.diagnosis.locating.locate import AXES, Finding
from crazyem.physics.rotations import rotation_matrix
from crazyem.vehicle import GRAVITY, Vehicle

NATS = 25.0  # that it must gain on the flights fitted and on those held out
SMALLEST = 0.01  # of the weight, standard deviation along the flight
WEAK = 1e-4  # (m/s^2)^-2, precision of the prior


@dataclass(frozen=True)
class Place:
    """A force that depends on place: nats on the flights fitted and held out; what it is as a finding."""

    nats: float
    held_out: float
    finding: Finding

    @property
    def pushed(self) -> bool:
        """Whether the drone is pushed away from where it is: a loop that gives way to gusts flies like that, on every
        flight; what is tied to a place pulls back."""
        return self.finding.axis == self.finding.variable and self.finding.effect_size > 0.0


def depends_on_place(data: Data, apart: Data | None, point: Point) -> Place | None:
    """Whether a force that depends on place is left beside a model; None if not, or where positions are unknown."""
    if "position" not in data.signals:
        return None
    centre = np.median(np.concatenate([_path(m)[:, :3] for m in data.models]), axis=0)
    gram = _gram(data, point, centre)
    prior = np.full(gram.size, WEAK)
    solution = gram.solve(range(gram.size), precision=prior)
    dispersion = max(1.0, solution.dispersion)
    theta, held = solution.theta, solution.held_out
    if apart is not None:
        b, a = _gram(apart, point, centre).total(range(gram.size))
        held = float(b @ theta - 0.5 * theta @ a @ theta)
    gained = solution.gain / dispersion - gram.size
    if min(gained, held / dispersion) < NATS:
        return None
    covariance = solution.covariance
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(3, 4)[:, 1:]
    mass = point.vehicle.mass
    finding = slope_finding(data, mass * theta.reshape(3, 4)[:, 1:], mass * errors, float(gained), point.vehicle)
    return None if finding is None else Place(float(gained), float(held), finding)


def left_by_place(data: Data, point: Point) -> float:
    """Nats that a force by place would gain beside a model, beyond its parameters, in the linear approximation."""
    gram = _gram(data, point, np.median(np.concatenate([_path(m)[:, :3] for m in data.models]), axis=0))
    solution = gram.solve(range(gram.size), precision=np.full(gram.size, WEAK))
    return float(solution.gain / max(1.0, solution.dispersion) - gram.size)


def slope_finding(data: Data, slopes: NDArray, errors: NDArray, nats: float, vehicle: Vehicle) -> Finding | None:
    """The strongest slope of a force by place, (3, 3) N/m with its standard deviations, as a finding; None where it
    moves the force by less than counts along these flights."""
    spread = np.concatenate([_path(m)[:, :3] for m in data.models]).std(axis=0)
    sizes = slopes * spread
    i, j = np.unravel_index(int(np.argmax(np.abs(sizes))), sizes.shape)
    if abs(sizes[i, j]) < SMALLEST * vehicle.mass * GRAVITY:
        return None
    begin, end = (float(t) for t in data.flights[0].time[[0, -1]])
    size, sd, chance = float(sizes[i, j]), float(errors[i, j] * spread[j]), float(np.exp(-min(nats, 700.0)))
    return Finding("force", AXES[i], f"{AXES[j]} position", AXES[j], (begin, end), size, sd, "N", nats, chance)


def _path(model: Model) -> NDArray:
    """Filtered, or as measured where the model left the range of numbers."""
    return initial_path(model.flight) if model.shown is None else model.shown


def _gram(data: Data, point: Point, centre: NDArray) -> Gram:
    score, information, flight = [], [], []
    for k, model in enumerate(data.models):
        if model.shown is None:
            model.sweep(point)
        path = _path(model)
        axes = rotation_matrix(path[:, 6:10])  # row i: world axis i in the body
        by = np.column_stack([np.ones(len(path)), path[:, :3] - centre])
        columns = []
        for i in range(3):
            for j in range(4):
                acting = np.zeros((len(path), 6))
                acting[:, :3] = axes[:, i] * by[:, j : j + 1]
                columns.append(Column(f"place{i}{j}", acting=acting))
        swept = model.sweep(point, columns)
        score.append(swept.score)
        information.append(swept.information)
        flight.append(np.full(len(swept.score), k))
    return Gram(np.concatenate(score), np.concatenate(information), np.concatenate(flight))
