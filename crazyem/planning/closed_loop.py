"""Simulation of a drone and its controller along a manoeuvre: expected states and rotor commands.

The model is a rigid body with rotor lag under the firmware's Lee controller with its default gains (controller_lee.c).
The control loop matters: full-state setpoints contain no torque, so the loop decides which torque follows from a
planned acceleration. Differential flatness alone would give torques that no controller commands. Other controllers
follow the same path with other torques, so for them the expectation is approximate.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from crazyem.control.harmonics import Harmonics
from crazyem.estimation.model import Noise
from crazyem.physics.rotors import wrench
from crazyem.planning.kernel import fly_loop
from crazyem.vehicle import GRAVITY, Vehicle

PERIOD = 0.011  # s between samples of a session's log (crazyem/live/session.py, LOG_RATE)
STEPS = 5  # of the loop between two samples: 2.2 ms, near the firmware's 2 ms
# Default gains of controller_lee.c: attitude N m/rad and its integral N m/(rad s), rate N m s/rad, position 1/s^2,
# velocity 1/s
ATTITUDE_GAIN = np.array([0.007, 0.007, 0.008])
INTEGRAL_GAIN = np.array([0.03, 0.03, 0.03])
RATE_GAIN = np.array([0.00115, 0.00115, 0.002])
POSITION_GAIN, VELOCITY_GAIN = 7.0, 4.0
RECALL = 0.06  # s, correlation time of errors of onboard pose and velocity (`diagnosis/fitting/noise.py`, RECALL)


@dataclass(frozen=True)
class Flown:
    """A simulated flight.

    Attributes:
        time: (n,) s, every `PERIOD`.
        state: (n, 13) position m and velocity m/s (about the hover point), quaternion x y z w, body rate rad/s; true.
        measured: (n, 13) `state` with measurement noise.
        command: (n, 4) N of each rotor, as commanded.
        thrust: (n, 4) N of each rotor, after the lag.
    """

    time: NDArray[np.float64]
    state: NDArray[np.float64]
    measured: NDArray[np.float64]
    command: NDArray[np.float64]
    thrust: NDArray[np.float64]

    @property
    def tilt(self) -> NDArray[np.float64]:
        """(n,) rad, angle between body z and the vertical."""
        x, y = self.state[:, 6], self.state[:, 7]
        angle: NDArray[np.float64] = np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))
        return angle


def mixing(vehicle: Vehicle) -> NDArray[np.float64]:
    """Matrix (4, 4) from the thrust of each rotor [N] to F [N], Mx, My, Mz [N m]."""
    matrix: NDArray[np.float64] = wrench(np.eye(4), arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust).T
    return np.ascontiguousarray(matrix)


def fly(manoeuvre: Harmonics, vehicle: Vehicle, *, noise: Noise | None = None, seed: int = 0) -> Flown:
    """Simulate a manoeuvre.

    Args:
        noise: of process and sensors; None: no noise, so that the result is a smooth function of the manoeuvre.
        seed: of the noise.
    """
    n = round(manoeuvre.duration / PERIOD) + 1
    dt = PERIOD / STEPS
    steps = (n - 1) * STEPS + 1
    reference = manoeuvre.derivatives(np.arange(steps, dtype=float) * dt)
    wanted = np.concatenate([reference[0, :, :3], reference[1, :, :3], reference[2, :, :3],
                             reference[0, :, 3:], reference[1, :, 3:]], axis=1)  # fmt: skip
    pushes, errors = np.zeros((steps, 6)), np.zeros((steps, 12))
    if noise is not None:
        random = np.random.default_rng(seed)
        pushes = random.standard_normal((steps, 6)) * noise.impulse * dt**0.5
        errors = random.standard_normal((steps, 12))
        last = math.exp(-dt / RECALL)
        errors[:, :9] = lfilter([math.sqrt(1.0 - last**2)], [1.0, -last], errors[:, :9], axis=0)
        errors *= np.repeat(noise.measurement[:4], 3)
    matrix = mixing(vehicle)
    state, seen = np.zeros((steps, 13)), np.zeros((steps, 13))
    command, thrust = np.zeros((steps, 4)), np.zeros((steps, 4))
    most = vehicle.thrust_max if np.isfinite(vehicle.thrust_max) else vehicle.mass * GRAVITY
    gains = ATTITUDE_GAIN, INTEGRAL_GAIN, RATE_GAIN, POSITION_GAIN, VELOCITY_GAIN
    fly_loop(
        np.ascontiguousarray(wanted), dt, vehicle.mass, np.array(vehicle.inertia), vehicle.motor_time_constant, matrix,
        np.linalg.inv(matrix), most, *gains, pushes, errors, state, seen, command, thrust,
    )  # fmt: skip
    rows = slice(None, None, STEPS)
    return Flown(np.arange(n, dtype=float) * PERIOD, state[rows], seen[rows], command[rows], thrust[rows])
