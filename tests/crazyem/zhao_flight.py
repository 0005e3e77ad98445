"""The paper's quadcopter (eq. 54 to 56) in closed loop, for tests of the inference: own arithmetic, compiled.

Explicit Euler steps of position, velocity, roll, pitch, yaw and body rate (eq. 56). The wrench is held over a step,
noise enters with thrust and torque only. The drone flies to waypoints that step. Its controller knows the true state
but for the rates, for which it has the logged ones with their noise, so that the torque answers to that noise. Nothing
of crazyem is imported but the type of a sample (in `samples`).
"""

from dataclasses import dataclass

import numpy as np
from synthetic import COLUMNS, matrix, turned

from crazyem.compiled import kernel

G = 9.81  # m/s^2
MASS, INERTIA = 0.18, np.array([2.5e-4, 3.1e-4, 2.0e-4])  # kg, kg m^2
DT = 0.005  # s
TRUE = np.array([MASS, *INERTIA])


@dataclass(frozen=True)
class Flight:
    """time (n,), y (n, 13) measured x y z w attitude included, force (n, 3) measured, wrench (n, 4), x (n, 13) true."""

    time: np.ndarray
    y: np.ndarray
    force: np.ndarray
    wrench: np.ndarray
    x: np.ndarray


@kernel
def _stepped(axes, w, dt):
    """Quaternion after roll, pitch and yaw have moved on by dt times their derivatives (eq. 47)."""
    roll, pitch, yaw = np.arctan2(axes[2, 1], axes[2, 2]), -np.arcsin(axes[2, 0]), np.arctan2(axes[1, 0], axes[0, 0])
    sideways = np.sin(roll) * w[1] + np.cos(roll) * w[2]
    a = 0.5 * (roll + dt * (w[0] + np.tan(pitch) * sideways))
    b = 0.5 * (pitch + dt * (np.cos(roll) * w[1] - np.sin(roll) * w[2]))
    c = 0.5 * (yaw + dt * sideways / np.cos(pitch))
    return np.array([
        np.sin(a) * np.cos(b) * np.cos(c) - np.cos(a) * np.sin(b) * np.sin(c),
        np.cos(a) * np.sin(b) * np.cos(c) + np.sin(a) * np.cos(b) * np.sin(c),
        np.cos(a) * np.cos(b) * np.sin(c) - np.sin(a) * np.sin(b) * np.cos(c),
        np.cos(a) * np.cos(b) * np.cos(c) + np.sin(a) * np.sin(b) * np.sin(c),
    ])  # fmt: skip


@kernel
def _fly(n, dt, mass, inertia, s_force, s_torque, sensor, goals, leg, noise, errors):
    p, v, w = goals[0].copy(), np.zeros(3), np.zeros(3)
    q = np.array([0.0, 0.0, 0.0, 1.0])
    x, y, force, wrench = np.empty((n, 13)), np.empty((n, 13)), np.full((n, 3), np.nan), np.empty((n, 4))
    up = np.array([0.0, 0.0, G])
    for k in range(n):
        x[k, 0:3], x[k, 3:6], x[k, 6:10], x[k, 10:13] = p, v, q, w
        y[k, 0:3] = p + sensor[0] * errors[k, 0:3]
        y[k, 3:6] = v + sensor[1] * errors[k, 3:6]
        y[k, 6:10] = turned(q, sensor[2] * errors[k, 6:9])
        y[k, 10:13] = w + sensor[3] * errors[k, 9:12]
        axes = matrix(q)
        away = goals[(k // leg) % len(goals)] - p
        wanted = up - 3.0 * v
        for i in range(3):
            wanted[i] += min(4.0, max(-4.0, 4.0 * away[i]))
        thrust = mass * np.sum(wanted * axes[:, 2])
        axis = wanted / np.sqrt(np.sum(wanted**2))
        wrong = np.zeros(3)
        for i in range(3):
            wrong[0] += axes[i, 1] * axis[i]
            wrong[1] += axes[i, 0] * axis[i]
        wrong[0] = -wrong[0]
        wrong[2] = 0.6 * np.sin(3.0 * k * dt) - 2 * q[2] * np.sign(q[3])
        torque = inertia * 20.0 * (20.0 * wrong - y[k, 10:13])
        wrench[k, 0], wrench[k, 1:] = thrust, torque
        if k == n - 1:
            break
        specific = (thrust + s_force * noise[k, 0] / np.sqrt(dt)) / mass
        acting = torque + s_torque * noise[k, 1:] / np.sqrt(dt)
        force[k + 1] = sensor[4] * errors[k, 12:15]
        force[k + 1, 2] += specific
        spin = inertia * w
        gyro = np.array(
            [w[1] * spin[2] - w[2] * spin[1], w[2] * spin[0] - w[0] * spin[2], w[0] * spin[1] - w[1] * spin[0]]
        )
        p = p + dt * v
        v = v + dt * (axes[:, 2] * specific - up)
        q = _stepped(axes, w, dt)
        w = w + dt * (acting - gyro) / inertia
    return x, y, force, wrench


def fly(*, seed: int, seconds: float = 4.0, force: float = 5e-4, torque: float = 2e-5,
        sensor: tuple[float, ...] = (7.07e-3, 7.07e-3, 7.07e-3, 7.07e-2, 7.07e-2)) -> Flight:  # fmt: skip
    """One flight; intensities in N sqrt(s) and N m sqrt(s); sensor sds of position, velocity, attitude, rate, force."""
    rng = np.random.default_rng([seed, 4])
    n = round(seconds / DT)
    goals = rng.uniform(-1.5, 1.5, (max(2, n // 200), 3)) + np.array([0.0, 0.0, 3.0])
    x, y, f, wrench = _fly(
        n, DT, MASS, INERTIA, force, torque, np.array(sensor), goals, 200, rng.normal(size=(n, 4)),
        rng.normal(size=(n, 15)),
    )  # fmt: skip
    return Flight(np.arange(n) * DT, y, f, wrench, x)


def samples(flight: Flight, signals: tuple[str, ...] = ("position", "body_rate")) -> list:
    """The log as samples: those signals at every stamp (specific_force among them if wanted), then the wrench."""
    from crazyem.signals.sample import Sample

    out = []
    for k, t in enumerate(flight.time.tolist()):
        for name in signals:
            value = flight.force[k] if name == "specific_force" else flight.y[k, COLUMNS[name]]
            if not np.isnan(value).any():
                out.append(Sample(name, t, tuple(value.tolist())))
        out.append(Sample("wrench_command", t, tuple(flight.wrench[k].tolist())))
    return out
