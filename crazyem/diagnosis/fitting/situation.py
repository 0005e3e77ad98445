"""States at which the physics is evaluated along a flight: path, thrusts of the rotors, situation at each row; and
results of a pass of the filter: states in the middle of steps, corrections by measurements."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.diagnosis.flights.flight import COLUMNS, Flight
from crazyem.estimation.kernels.algebra import matrix
from crazyem.physics.effects.effect import Effects, Path, Situation
from crazyem.physics.motion import rotor_thrust
from crazyem.physics.rotations import quaternion_from_rotation_vector, rotation_matrix
from crazyem.vehicle import GRAVITY, Vehicle


def initial_path(flight: Flight) -> NDArray:
    """(n, 19) start states: the measurements, interpolated between."""
    path = np.zeros((flight.time.size, 19))
    path[:, 9] = 1.0
    for c in range(13):
        known = np.isfinite(flight.y[:, c])
        if known.any():
            path[:, c] = np.interp(flight.time, flight.time[known], flight.y[known, c])
    if not np.isfinite(flight.y[:, 3:6]).any() and np.isfinite(flight.y[:, 0:3]).any():
        path[:, 3:6] = np.gradient(path[:, 0:3], flight.time, axis=0)
    path[:, 6:10] /= np.linalg.norm(path[:, 6:10], axis=1, keepdims=True)
    return path


def unmeasured(flight: Flight) -> NDArray:
    """(n, 4) bool: whether position, velocity, attitude or body rate has no measurement since the filter's last start.

    A quantity that the flight never measures counts as unmeasured at the starts alone.
    """
    row = np.arange(flight.time.size)
    start = np.maximum.accumulate(np.where(flight.starts, row, 0))
    found = np.empty((row.size, 4), bool)
    for k, columns in enumerate(COLUMNS.values()):
        shown = np.isfinite(flight.y[:, columns.start])
        last = np.maximum.accumulate(np.where(shown, row, -1))
        found[:, k] = last < start if shown.any() else flight.starts
    return found


def with_interpolated_states(flight: Flight, *states: NDArray) -> list[NDArray]:
    """States (n, 19) of the filter; one without a measurement since its start is interpolated between measurements."""
    missing = np.repeat(unmeasured(flight), [c.stop - c.start for c in COLUMNS.values()], axis=1)
    if not missing.any():
        return list(states)
    path = initial_path(flight)[:, :13]
    return [np.hstack([np.where(missing, path, s[:, :13]), s[:, 13:]]) for s in states]


def thrust_of(flight: Flight, vehicle: Vehicle, effects: Effects) -> tuple[NDArray, NDArray]:
    """Mean thrust of each rotor over the steps and its derivative: (n, 4) N, (n, 4) N/s."""
    return rotor_thrust(
        flight.inputs, flight.time, vehicle=vehicle, effects=effects, breaks=np.flatnonzero(flight.gaps).tolist()
    )


def situation_of(flight: Flight, path: NDArray, vehicle: Vehicle, thrusts: tuple[NDArray, NDArray]) -> Situation:
    """The situation at the rows of a path (n, 19)."""
    thrust, rate = thrusts
    step = np.concatenate([[0.0], np.diff(flight.time)])
    step[flight.gaps] = 0.0
    n = flight.time.size
    return Situation(
        time=flight.time, flown=flight.flown, step=step, position=path[:, 0:3],
        height=np.maximum(path[:, 2] - flight.ground, 0.0), velocity=path[:, 3:6],
        rotation=rotation_matrix(path[:, 6:10]), body_rate=path[:, 10:13], specific_force=np.zeros((n, 3)),
        angular_acceleration=np.zeros((n, 3)), thrust=thrust, thrust_rate=rate, voltage=flight.voltage,
        rotor_constant=_rotor_constant(vehicle), air=np.zeros((n, 3)), fused=flight.fused,
    )  # fmt: skip


def integrated_path(situation: Situation, accelerations: NDArray) -> Path:
    """The path by integration of rates and accelerations, from row to row by the trapezoidal rule.

    Args:
        accelerations: (n, 6) specific force [m/s^2] and angular acceleration [rad/s^2], body axes, over the steps.
    """
    step = situation.step[:, None]
    before = np.maximum(np.arange(situation.size) - 1, 0)
    middle = 0.5 * (situation.rotation + situation.rotation[before])
    force = np.einsum("nij,nj->ni", middle, accelerations[:, :3]) - np.array([0.0, 0.0, GRAVITY])
    velocity = 0.5 * (situation.velocity + situation.velocity[before])
    rate = 0.5 * (situation.body_rate + situation.body_rate[before])
    rotation = np.empty((situation.size, 3, 3))
    _chained(rotation_matrix(quaternion_from_rotation_vector(rate * step)), rotation)
    return Path(
        position=np.cumsum(velocity * step, axis=0), velocity=np.cumsum(force * step, axis=0), rotation=rotation,
        body_rate=np.cumsum(accelerations[:, 3:] * step, axis=0),
    )  # fmt: skip


@compiled
def _chained(turns, out):
    """Products of rotations turns (n, 3, 3) up to each row, into out (n, 3, 3)."""
    out[0] = turns[0]
    for k in range(1, len(turns)):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for m in range(3):
                    total += out[k - 1, i, m] * turns[k, m, j]
                out[k, i, j] = total


def with_rotors(situation: Situation, vehicle: Vehicle, thrusts: tuple[NDArray, NDArray]) -> Situation:
    """The situation with other thrusts of the rotors and their derivatives."""
    thrust, rate = thrusts
    return replace(situation, thrust=thrust, thrust_rate=rate, rotor_constant=_rotor_constant(vehicle))


def _rotor_constant(vehicle: Vehicle) -> float:
    return float("nan") if vehicle.rotor_constant is None else vehicle.rotor_constant


def causal_middle(filtered: NDArray, predicted: NDArray, starts: NDArray) -> NDArray:
    """(n, 19) states in the middle of each step: the mean of the filtered state at its start and the predicted one at
    its end."""
    middle = predicted.copy()
    _middle(filtered, predicted, starts, middle)
    return middle


@compiled
def _middle(filtered, predicted, starts, middle):
    """Write the rows of `causal_middle` that are no start into middle (n, 19)."""
    for k in range(1, len(predicted)):
        if starts[k]:
            continue
        before, after, out = filtered[k - 1], predicted[k], middle[k]
        for i in range(19):
            out[i] = 0.5 * (before[i] + after[i])
        along = 0.0
        for i in range(6, 10):
            along += before[i] * after[i]
        sign = -1.0 if along < 0.0 else 1.0  # the same attitude has two quaternions
        size = 0.0
        for i in range(6, 10):
            out[i] = sign * before[i] + after[i]
            size += out[i] * out[i]
        size = np.sqrt(size)
        for i in range(6, 10):
            out[i] /= size


@compiled
def impulses(predicted, filtered, step, known, out):
    """Write into out (n, 6) the changes of velocity [m/s] and body rate [rad/s], body axes, in each known step by
    measurements and disturbances with memory; the other rows stay.

    predicted, filtered: (n, 19) states at the end of the steps; step: (n,) s; known: (n,) bool.
    """
    turn = np.empty((3, 3))
    for k in range(len(step)):
        if not known[k]:
            continue
        matrix(filtered[k, 6:10], turn)
        for i in range(3):
            seen = 0.0
            for j in range(3):
                seen += turn[j, i] * (filtered[k, 3 + j] - predicted[k, 3 + j])
            out[k, i] = seen + step[k] * filtered[k, 13 + i]
            out[k, 3 + i] = filtered[k, 10 + i] - predicted[k, 10 + i] + step[k] * filtered[k, 16 + i]
