"""Where physics is evaluated along a flight: path of the drone, thrusts of its rotors, situation at each row."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import Flight
from crazyem.physics.effects.effect import Effects, Situation
from crazyem.physics.motion import rotor_thrust
from crazyem.physics.rotations import rotation_matrix
from crazyem.vehicle import Vehicle


def initial_path(flight: Flight) -> NDArray:
    """(n, 19) states to begin with: what was measured, interpolated where it was not."""
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


def thrust_of(flight: Flight, vehicle: Vehicle, effects: Effects) -> tuple[NDArray, NDArray]:
    """Mean thrust of each rotor over the steps, and its rate: (n, 4) N, (n, 4) N/s."""
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
        rotor_constant=_rotor_constant(vehicle), air=np.zeros((n, 3)), fused=flight.attitude is not None,
    )  # fmt: skip


def with_rotors(situation: Situation, vehicle: Vehicle, thrusts: tuple[NDArray, NDArray]) -> Situation:
    """The situation with other rotors' thrusts, and rates of them."""
    thrust, rate = thrusts
    return replace(situation, thrust=thrust, thrust_rate=rate, rotor_constant=_rotor_constant(vehicle))


def _rotor_constant(vehicle: Vehicle) -> float:
    return float("nan") if vehicle.rotor_constant is None else vehicle.rotor_constant


def causal_middle(filtered: NDArray, predicted: NDArray, starts: NDArray) -> NDArray:
    """(n, 19) states in the middle of each step: filtered at its begin, predicted to its end."""
    middle = predicted.copy()
    before = filtered[:-1]
    inside = ~starts[1:]
    sign = np.sign(np.sum(before[:, 6:10] * predicted[1:, 6:10], axis=1, keepdims=True))
    mean = 0.5 * (before + predicted[1:])
    mean[:, 6:10] = before[:, 6:10] * np.where(sign == 0, 1.0, sign) + predicted[1:, 6:10]
    mean[:, 6:10] /= np.linalg.norm(mean[:, 6:10], axis=1, keepdims=True)
    middle[1:][inside] = mean[inside]
    return middle
