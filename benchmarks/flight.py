"""A synthetic flight for the benchmarks: known truth, seeded noise, the samples that a drone's log blocks would give.

It shares no code with the estimator or the simulated firmware: rigid body at 1 kHz (midpoint rule), first-order rotor
lag, white disturbance forces and torques, a controller at 500 Hz that holds its commands, logs at 100 Hz. The
controller flies a slow circle with a multisine on the torques, so that every parameter is identifiable.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import kernel
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle, load_vehicle

LOG_RATE = 100.0  # Hz
VOLTAGE = 3.9  # V, constant
ACTIVE = (1.5e-3, 5e-6)  # N sqrt(s), N m sqrt(s): disturbances of a typical indoor flight
SENSORS = (1e-3, 1e-2, 3.5e-3, 1.75e-3)  # m, m/s, rad, rad/s: noise of the onboard estimate and the gyro
EXCITATION = 1.5e-4  # N m, amplitude of the torque multisine per axis

# sign of each rotor's thrust in the torque about x, y, z: rotors 1 front right, 2 back right, 3 back left, 4 front left
MIXER = np.array([[1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [-1.0, 1.0, -1.0, 1.0]])


@dataclass(frozen=True)
class Flight:
    """The log of a flight and its truth.

    Attributes:
        vehicle: nominal constants, given to the estimator.
        time: (n,) s.
        measured: (n, 13) position [m], velocity [m/s] world; quaternion x y z w body to world; body rate [rad/s] FLU.
        command: (n, 4) duty of the rotors in force at the stamp, 0..1.
        mass: true mass [kg].
        inertia: (3,) true moments of inertia [kg m^2].
        time_constant: true rotor lag [s].
    """

    vehicle: Vehicle
    time: NDArray
    measured: NDArray
    command: NDArray
    mass: float
    inertia: NDArray
    time_constant: float

    def samples(self) -> Iterator[Sample]:
        """The samples in the order in which a link would deliver them."""
        for k, t in enumerate(self.time.tolist()):
            y = self.measured[k].tolist()
            yield Sample("voltage", t, (VOLTAGE,))
            yield Sample("flying", t, (1.0,))
            yield Sample("motor_command", t, tuple(self.command[k].tolist()))
            yield Sample("position", t, tuple(y[0:3]))
            yield Sample("velocity", t, tuple(y[3:6]))
            yield Sample("attitude", t, tuple(y[6:10]))
            yield Sample("body_rate", t, tuple(y[10:13]))


@kernel
def _fly(steps, every, seed, mass, inertia, lag, force_noise, torque_noise, mixing, unmixing, phases, excitation):
    """States (n, 13) and rotor thrusts in force (n, 4) at every `every`-th millisecond."""
    np.random.seed(seed)
    dt = 1e-3
    p = np.array([0.0, 0.0, 1.0])
    v = np.zeros(3)
    q = np.array([0.0, 0.0, 0.0, 1.0])
    w = np.zeros(3)
    weight = mass * 9.81
    rotors = np.full(4, weight / 4)
    lagged = np.array([weight, 0.0, 0.0, 0.0])
    logged = np.empty((steps // every, 13))
    thrusts = np.empty((steps // every, 4))
    wrench = np.empty(4)
    for step in range(steps):
        t = step * dt
        x, y, z, s = q[0], q[1], q[2], q[3]
        if step % 2 == 0:
            a = 2 * np.pi * t / 8.0
            ax = 3.0 * (0.4 * np.cos(a) - 0.4 - p[0]) - 3.0 * v[0]
            ay = 3.0 * (0.4 * np.sin(a) - p[1]) - 3.0 * v[1]
            az = 4.0 * (1.0 + 0.15 * np.sin(1.7 * a) - p[2]) - 4.0 * v[2]
            yaw = 2 * z * s
            roll = 2 * (s * x + y * z)
            pitch = 2 * (s * y - z * x)
            level_x = (ax * np.cos(yaw) + ay * np.sin(yaw)) / 9.81
            level_y = (ay * np.cos(yaw) - ax * np.sin(yaw)) / 9.81
            level_x = min(0.4, max(-0.4, level_x))
            level_y = min(0.4, max(-0.4, level_y))
            wrench[0] = mass * (9.81 + az) / max(0.7, 1 - 2 * (x * x + y * y))
            error = (-level_y - roll, level_x - pitch, -yaw)
            for i in range(3):
                gain = 60.0 if i < 2 else 15.0
                rate = 15.0 if i < 2 else 8.0
                dither = 0.0
                for m in range(6):
                    dither += np.sin(2 * np.pi * (1.3 + 1.1 * m + 0.35 * i) * t + phases[i, m])
                wrench[1 + i] = inertia[i] * (gain * error[i] - rate * w[i]) + excitation[i] * dither / 6**0.5
            for r in range(4):
                rotors[r] = 0.0
                for c in range(4):
                    rotors[r] += unmixing[r, c] * wrench[c]
                rotors[r] = min(0.16, max(0.01, rotors[r]))
        if step % every == 0:
            k = step // every
            logged[k, 0:3] = p
            logged[k, 3:6] = v
            logged[k, 6:10] = q
            logged[k, 10:13] = w
            thrusts[k] = rotors
        decay = np.exp(-dt / lag)
        for c in range(4):
            goal = 0.0
            for r in range(4):
                goal += mixing[c, r] * rotors[r]
            after = goal + (lagged[c] - goal) * decay
            wrench[c] = goal + (lagged[c] - goal) * (1 - decay) * lag / dt  # mean over the step
            lagged[c] = after
        force = wrench[0] + force_noise * np.random.randn() / dt**0.5
        side_x = 0.3 * force_noise * np.random.randn() / dt**0.5
        side_y = 0.3 * force_noise * np.random.randn() / dt**0.5
        # attitude in the middle of the step
        h = 0.25 * dt
        mx = x + h * (s * w[0] + y * w[2] - z * w[1])
        my = y + h * (s * w[1] + z * w[0] - x * w[2])
        mz = z + h * (s * w[2] + x * w[1] - y * w[0])
        ms = s - h * (x * w[0] + y * w[1] + z * w[2])
        acc_x = (
            2 * (mx * mz + my * ms) * force + (1 - 2 * (my * my + mz * mz)) * side_x + 2 * (mx * my - mz * ms) * side_y
        )
        acc_y = (
            2 * (my * mz - mx * ms) * force + 2 * (mx * my + mz * ms) * side_x + (1 - 2 * (mx * mx + mz * mz)) * side_y
        )
        acc_z = (
            (1 - 2 * (mx * mx + my * my)) * force + 2 * (mx * mz - my * ms) * side_x + 2 * (my * mz + mx * ms) * side_y
        )
        acc = np.array([acc_x / mass, acc_y / mass, acc_z / mass - 9.81])
        before = w.copy()
        for i in range(3):
            j = (i + 1) % 3
            k2 = (i + 2) % 3
            torque = wrench[1 + i] + torque_noise * np.random.randn() / dt**0.5
            w[i] += dt * (torque - (inertia[k2] - inertia[j]) * before[j] * before[k2]) / inertia[i]
        p += dt * (v + 0.5 * dt * acc)
        v += dt * acc
        h = 0.25 * dt
        w0, w1, w2 = before[0] + w[0], before[1] + w[1], before[2] + w[2]
        q[0] = x + h * (s * w0 + y * w2 - z * w1)
        q[1] = y + h * (s * w1 + z * w0 - x * w2)
        q[2] = z + h * (s * w2 + x * w1 - y * w0)
        q[3] = s - h * (x * w0 + y * w1 + z * w2)
        q /= np.sqrt(np.sum(q * q))
    return logged, thrusts


def _disturbed(attitude: NDArray, sd: float, rng: np.random.Generator) -> NDArray:
    """Quaternions (n, 4) turned by small random rotation vectors of standard deviation sd [rad] per axis."""
    d = 0.5 * sd * rng.standard_normal((len(attitude), 3))
    x, y, z, s = attitude.T
    a, b, c = d.T
    out = np.stack([x + s * a + y * c - z * b, y + s * b + z * a - x * c, z + s * c + x * b - y * a,
                    s - x * a - y * b - z * c], 1)  # fmt: skip
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def simulate(
    *,
    seed: int,
    seconds: float = 25.0,
    mass: float = 0.036,
    inertia: tuple[float, float, float] = (2.0e-5, 2.1e-5, 3.6e-5),
    time_constant: float = 0.06,
    disturbance: tuple[float, float] = ACTIVE,
) -> Flight:
    """Fly for some seconds in the air.

    Args:
        seed: of every random number; the same seed gives the same flight.
        seconds: length [s].
        mass: truth [kg]. inertia: truth, Ixx, Iyy, Izz [kg m^2]. time_constant: truth of the rotor lag [s].
        disturbance: intensity of force [N sqrt(s)] and torque [N m sqrt(s)] noise.

    Raises:
        RuntimeError: the drone left the range of its rotors or controller, and the flight is useless.
    """
    vehicle = load_vehicle("cf2")
    rng = np.random.default_rng(seed)
    scale = np.array([1.0, vehicle.arm[1], vehicle.arm[0], vehicle.torque_per_thrust])
    mixing = scale[:, None] * MIXER
    moments = np.array(inertia)
    states, thrusts = _fly(
        round(seconds * 1000), round(1000 / LOG_RATE), seed, mass, moments, time_constant, disturbance[0],
        disturbance[1], mixing, np.linalg.inv(mixing), rng.uniform(0, 2 * np.pi, (3, 6)),
        np.full(3, EXCITATION),
    )  # fmt: skip
    if not np.all(np.isfinite(states)) or np.max(np.abs(states[:, :3])) > 5.0:
        raise RuntimeError(f"the synthetic flight of seed {seed} left the room")
    n = len(states)
    measured = states.copy()
    measured[:, 0:3] += SENSORS[0] * rng.standard_normal((n, 3))
    measured[:, 3:6] += SENSORS[1] * rng.standard_normal((n, 3))
    measured[:, 6:10] = _disturbed(states[:, 6:10], SENSORS[2], rng)
    measured[:, 10:13] += SENSORS[3] * rng.standard_normal((n, 3))
    volts = np.linspace(1.0, VOLTAGE, 20001)
    curve = np.polynomial.polynomial.polyval(volts, vehicle.thrust_curve)
    command = np.interp(thrusts, curve, volts) / VOLTAGE
    if command.max() > 0.999 or command.min() * VOLTAGE <= 1.0001:
        raise RuntimeError(f"the synthetic flight of seed {seed} saturates its rotors")
    return Flight(vehicle, np.arange(n) / LOG_RATE, measured, command, mass, moments, time_constant)
