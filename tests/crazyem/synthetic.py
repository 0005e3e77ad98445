"""A small flight simulator for tests of the estimator, independent of the package: own arithmetic, compiled.

A rigid body under thrust and torque with first-order lag, white disturbances in force and torque (integrated at 1 kHz
sub-steps), and a hovering controller that acts every 2 ms on the same noisy rate and attitude that are logged. The
dither makes inertia visible. Nothing of crazyem is imported here but the type of a sample (in `samples`).

Attitude is kept as a quaternion (x, y, z, w), advanced by the exact turn of the mean rate of a sub-step.
"""

from dataclasses import dataclass

import numpy as np

from crazyem.compiled import kernel

G = 9.81  # m/s^2
# rad/s of the dither, three sines each about x, y and z; out of step with each other
DITHER = 2 * np.pi * np.array([[2.1, 3.3, 4.7], [2.5, 3.9, 5.3], [1.9, 2.9, 4.3]])


@dataclass(frozen=True)
class Truth:
    """What is true of a synthetic drone, SI.

    Attributes:
        mass: kg.
        inertia: (Ixx, Iyy, Izz) kg m^2, or those and (Ixy, Ixz, Iyz).
        lag: first-order time constant of thrust and torque [s].
        force_noise, torque_noise: intensities [N sqrt(s)], [N m sqrt(s)].
        sensor: standard deviations of position [m], velocity [m/s], attitude [rad], body rate [rad/s].
        dither: amplitude of the torque dither, of the whole sum in rms terms [N m].
        heave: relative amplitude of the thrust dither.
        fade: the torque dither fades in for so long [s]; with 0 the log begins amid a manoeuvre.
        attitude_gain, rate_gain: of the controller [1/s^2], [1/s].
    """

    mass: float = 0.036
    inertia: tuple[float, ...] = (2.0e-5, 2.1e-5, 3.6e-5)
    lag: float = 0.06
    force_noise: float = 1e-3
    torque_noise: float = 5e-6
    sensor: tuple[float, float, float, float] = (1e-3, 1e-2, 3e-3, 2e-3)
    dither: float = 2e-4
    heave: float = 0.05
    fade: float = 0.5
    attitude_gain: float = 350.0
    rate_gain: float = 57.0

    @property
    def matrix(self) -> np.ndarray:
        """Inertia matrix (3, 3) [kg m^2]."""
        xx, yy, zz, xy, xz, yz = (*self.inertia, 0.0, 0.0, 0.0)[:6]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class Flight:
    """A logged flight: `time` (n,), measurements `y` (n, 13), commands `wrench` (n, 4), true states `x` (n, 13)."""

    time: np.ndarray
    y: np.ndarray
    wrench: np.ndarray
    x: np.ndarray
    fine_time: np.ndarray  # (n * sub,) every sub-step
    fine_wrench: np.ndarray  # (n * sub, 4) command in force
    fine_y: np.ndarray  # (n * sub, 13) measurements with the same noise level at every sub-step
    fine_acting: np.ndarray  # (n * sub, 4) force and torque after the lag, before the disturbance


@kernel
def turned(q, phi):
    """q * exp(phi), normalised."""
    angle = np.sqrt(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
    s = 0.5 if angle < 1e-12 else np.sin(angle / 2) / angle
    x, y, z, w = s * phi[0], s * phi[1], s * phi[2], np.cos(angle / 2)
    out = np.empty(4)
    out[0] = q[3] * x + q[0] * w + q[1] * z - q[2] * y
    out[1] = q[3] * y - q[0] * z + q[1] * w + q[2] * x
    out[2] = q[3] * z + q[0] * y - q[1] * x + q[2] * w
    out[3] = q[3] * w - q[0] * x - q[1] * y - q[2] * z
    return out / np.sqrt(np.sum(out**2))


@kernel
def matrix(q):
    x, y, z, w = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


@kernel
def _fly(n, dt, control_every, mass, inertia, lag, scale, sensor, dither, heave, fade, gains, phases, noise, errors):
    """n sub-steps; noise (n, 4) and errors (n, 12) are standard normal. States, measurements, commands, acting."""
    inverse = np.linalg.inv(inertia)
    p, v, w = np.zeros(3), np.zeros(3), np.zeros(3)
    q = np.array([0.0, 0.0, 0.0, 1.0])
    command = np.array([mass * G, 0.0, 0.0, 0.0])
    acting = command.copy()
    x, y = np.empty((n, 13)), np.empty((n, 13))
    commands, actings = np.empty((n, 4)), np.empty((n, 4))
    decay = np.exp(-dt / lag) if lag > 0 else 0.0
    up = np.array([0.0, 0.0, G])
    for k in range(n):
        t = k * dt
        x[k, 0:3], x[k, 3:6], x[k, 6:10], x[k, 10:13] = p, v, q, w
        y[k, 0:3] = p + sensor[0] * errors[k, 0:3]
        y[k, 3:6] = v + sensor[1] * errors[k, 3:6]
        y[k, 6:10] = turned(q, sensor[2] * errors[k, 6:9])
        y[k, 10:13] = w + sensor[3] * errors[k, 9:12]
        if k % control_every == 0:
            seen, rate = matrix(y[k, 6:10]), y[k, 10:13]
            wanted = up - 7.0 * p - 4.0 * v
            axis = wanted / np.sqrt(np.sum(wanted**2))
            wrong = seen.T @ np.cross(seen[:, 2].copy(), axis)
            wrong[2] = -2 * y[k, 8] * np.sign(y[k, 9])
            torque = inertia @ (gains[0] * wrong - gains[1] * rate)
            command[0] = mass * np.dot(wanted, seen[:, 2].copy()) * (1 + heave * np.sin(2 * np.pi * 0.7 * t))
            shaken = dither * min(1.0, t / fade) if fade > 0 else dither
            for i in range(3):
                command[1 + i] = torque[i]
                for j in range(3):
                    command[1 + i] += shaken * np.sqrt(2 / 3) * np.sin(DITHER[i, j] * t + phases[i, j])
        commands[k] = command
        acting = command + (acting - command) * decay
        actings[k] = acting
        force = acting[0] + scale[0] * noise[k, 0] / np.sqrt(dt)
        torque = acting[1:] + scale[1] * noise[k, 1:] / np.sqrt(dt)
        a = matrix(q)[:, 2] * force / mass - up
        alpha = inverse @ (torque - np.cross(w, inertia @ w))
        p = p + dt * v + 0.5 * dt * dt * a
        v = v + dt * a
        q = turned(q, dt * (w + 0.5 * dt * alpha))
        w = w + dt * alpha
    return x, y, commands, actings


def fly(truth: Truth = Truth(), *, seed: int = 0, duration: float = 8.0, rate: int = 100, sub: int = 10,
        control_every: int = 2) -> Flight:  # fmt: skip
    """Fly `duration` s, logged at `rate` Hz, `sub` sub-steps per logged sample; control every so many of them."""
    rng = np.random.default_rng(seed)
    n = round(duration * rate) * sub + 1
    dt = 1.0 / (rate * sub)
    x, y, commands, acting = _fly(
        n, dt, control_every, truth.mass, truth.matrix, truth.lag, np.array([truth.force_noise, truth.torque_noise]),
        np.array(truth.sensor), truth.dither, truth.heave, truth.fade, np.array([truth.attitude_gain, truth.rate_gain]),
        rng.uniform(0, 2 * np.pi, (3, 3)), rng.normal(size=(n, 4)), rng.normal(size=(n, 12)),
    )  # fmt: skip
    fine = np.arange(n) * dt
    return Flight(fine[::sub], y[::sub], commands[::sub], x[::sub], fine, commands, y, acting)


COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}


def samples(flight: Flight, *, signal: str = "wrench_command", input_shift: float = 0.0) -> list:
    """The log as samples in the order of their stamps; inputs may be stamped (not acting) a little later."""
    from crazyem.signals.sample import Sample

    events = [
        (t + input_shift, 0, Sample(signal, t + input_shift, tuple(u))) for t, u in zip(flight.time, flight.wrench)
    ]
    for t, y in zip(flight.time, flight.y):
        events += [(t, 1, Sample(name, t, tuple(y[columns]))) for name, columns in COLUMNS.items()]
    return [sample for _, _, sample in sorted(events, key=lambda e: e[:2])]
