"""Flights integrated by an independent solver (scipy), as recordings: the oracle of open-loop prediction."""

from collections.abc import Callable

import numpy as np
from made_flight import array_of
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Array = NDArray[np.float64]
G = 9.81
DRONE = Vehicle(
    "made", 0.04, (2.0e-5, 2.2e-5, 3.5e-5), inertia_products=(1e-6, -2e-6, 5e-7), arm=(0.03, 0.035),
    rotor_constant=4e-8, torque_per_thrust=0.006,
)  # fmt: skip
SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]], float)  # roll, pitch, yaw of rotors 1 to 4
START = np.array([0.1, -0.2, 1.5, 0.3, 0.1, -0.2, 0.05, -0.1, 0.3, 0.9434, 0.4, -0.3, 0.6])


def matrix_of(vehicle: Vehicle) -> Array:
    (xx, yy, zz), (xy, xz, yz) = vehicle.inertia, vehicle.inertia_products
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def fly(
    thrust: Callable[[float], Array],
    times: Array,
    *,
    vehicle: Vehicle = DRONE,
    start: Array = START,
    force: Callable[[Array, Array], Array] | None = None,
) -> Array:
    """(n, 13) states at times under rotor thrusts (4,) N; force(velocity, rotation) is added, world [N]."""
    inertia = matrix_of(vehicle)
    levers = np.array([vehicle.arm[1], vehicle.arm[0], vehicle.torque_per_thrust])

    def slope(t: float, x: Array) -> Array:
        f = thrust(t)
        turn = Rotation.from_quat(x[6:10]).as_matrix()
        pull = turn[:, 2] * f.sum()
        if force is not None:
            pull = pull + force(x[3:6], turn)
        w = x[10:13]
        qx, qy, qz, qw = x[6:10]
        dq = 0.5 * np.array(
            [
                qw * w[0] + qy * w[2] - qz * w[1],
                qw * w[1] - qx * w[2] + qz * w[0],
                qw * w[2] + qx * w[1] - qy * w[0],
                -qx * w[0] - qy * w[1] - qz * w[2],
            ]
        )
        dw = np.linalg.solve(inertia, levers * (SIGNS @ f) - np.cross(w, inertia @ w))
        return np.concatenate([x[3:6], pull / vehicle.mass - [0, 0, G], dq, dw])

    begin = start.copy()
    begin[6:10] /= np.linalg.norm(begin[6:10])
    found = solve_ivp(slope, (times[0], times[-1]), begin, t_eval=times, rtol=1e-8, atol=1e-9, max_step=0.01)
    states = found.y.T
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    return states


def smooth_thrust(seed: int, vehicle: Vehicle = DRONE) -> Callable[[float], Array]:
    """Thrusts near hover that wander by some per cent, each rotor on its own."""
    rng = np.random.default_rng(seed)
    size, frequency, phase = rng.uniform(0, 0.015, (3, 4)), rng.uniform(0.3, 3, (3, 4)), rng.uniform(0, 6, (3, 4))

    def thrust(t: float) -> Array:
        return vehicle.mass * G / 4 * (1 + (size * np.sin(2 * np.pi * frequency * t + phase)).sum(0))

    return thrust


def recording_of(times: Array, states: Array, **inputs: tuple[Array, Array]) -> Recording:
    """A recording of (n, 13) states; further signals as name=(times, values)."""
    signals = {
        "position": array_of("position", times, states[:, 0:3]),
        "velocity": array_of("velocity", times, states[:, 3:6], place=1),
        "attitude": array_of("attitude", times, states[:, 6:10], place=2),
        "body_rate": array_of("body_rate", times, states[:, 10:13], place=3),
    }
    for place, (name, (when, value)) in enumerate(inputs.items()):
        signals[name] = array_of(name, when, value, place=4 + place)
    return Recording("made.csv", "made", signals)


def speeds(thrust: Callable[[float], Array], times: Array, vehicle: Vehicle = DRONE) -> Array:
    """(n, 4) rad/s that give these thrusts."""
    assert vehicle.rotor_constant is not None
    return np.sqrt(np.array([thrust(t) for t in times]) / vehicle.rotor_constant)
