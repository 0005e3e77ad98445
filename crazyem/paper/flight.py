"""A simulated flight of the paper: plant, sensors A, B, C, filter and controller in closed loop, advanced in pieces.

Row k of every array belongs to t = k dt. The acceleration reading in row k belongs to the step from k - 1 to k; the
wrench in row k is held from k to k + 1. All random numbers are drawn in advance from the seed, so a flight does not
depend on the size of the pieces, and all sensors of one seed have the same noise.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.control.lqg import control, position_gains
from crazyem.control.trajectories import smooth_step
from crazyem.errors import UsageError
from crazyem.paper.plant import filter_step, step, thrust_axis
from crazyem.paper.settings import Settings
from crazyem.physics.rotations import quaternion_from_euler
from crazyem.signals.sample import Sample
from crazyem.vehicle import GRAVITY

LIFTED_HEIGHT = 0.1  # m, measured height at which the reference starts (7 standard deviations of the position sensor)
THRUST_RAMP = 2.0  # N/s, increase of thrust before lift-off from a floor
# s, time constant of the transition from the rising drone to the reference, which begins at rest on the floor
MERGE_SECONDS = 0.5


@compiled
def _advance(
    first, last, dt, truth_mass, truth_inertia, mass, inertia, gains, limit, reference, ground, lift_off, handover,
    substeps, noise, sensor_noise, sensor_sd, q, r, truth, estimate, covariance, wrench, readings, contact,
):  # fmt: skip
    """Fly steps first..last-1; returns the row of lift-off, -1 before lift-off."""
    scratch = np.empty(12)
    axis = np.empty(3)
    mean = np.empty(3)
    goal = np.empty(9)
    up = np.zeros(9)  # goal before lift-off: stay above the start; the thrust ramp determines the height
    up[:2] = truth[0, :2]
    h = dt / substeps
    for k in range(first, last):
        # the controller acts on the estimate at k
        lifted = readings[k, 2] > LIFTED_HEIGHT
        if ground and lift_off < 0 and lifted and not np.isnan(mass):
            lift_off = k
            handover[0] = estimate[k, :3] - truth[0, :3]
            handover[1] = estimate[k, 3:6]
        if ground and lift_off < 0:
            up[2], up[5] = estimate[k, 2], estimate[k, 5]
            control(estimate[k], up, 0.0, gains, limit, 1.0, inertia, wrench[k])
            wrench[k, 0] = wrench[k - 1, 0] if lifted else THRUST_RAMP * k * dt
        else:
            goal[:] = reference[k - lift_off if ground else k]
            if ground:
                _lead(handover, (k - lift_off) * dt, goal)
            control(estimate[k], goal, 0.0, gains, limit, mass, inertia, wrench[k])
        truth[k + 1] = truth[k]
        mean[:] = 0.0
        for s in range(substeps):
            touches = step(
                truth[k + 1], wrench[k], noise[k * substeps + s], h, truth_mass, truth_inertia, ground, scratch
            )
            contact[k + 1] = touches
            mean += scratch[3:6] / substeps
        # sensors: position, velocity, angles, rate at k + 1; acceleration of the step; the same as specific force
        for i in range(12):
            readings[k + 1, i] = truth[k + 1, i] + sensor_sd[i] * sensor_noise[k + 1, i]
        for i in range(3):
            readings[k + 1, 12 + i] = mean[i] + sensor_sd[12 + i] * sensor_noise[k + 1, 12 + i]
        _specific_force(truth[k], readings[k + 1], axis)
        estimate[k + 1] = estimate[k]
        filter_step(
            estimate[k + 1], covariance, readings[k + 1, 12:15], readings[k + 1, 0:3], readings[k + 1, 9:12], dt, q, r
        )
    return lift_off


@compiled
def _lead(handover, t, goal):
    """Add the offset and velocity at take-off to goal (9,), decayed (critically damped) over t s since take-off."""
    for i in range(3):
        d = handover[0, i]
        b = handover[1, i] + d / MERGE_SECONDS
        here = (d + b * t) * np.exp(-t / MERGE_SECONDS)
        slope = b * np.exp(-t / MERGE_SECONDS)
        goal[i] += here
        goal[3 + i] += slope - here / MERGE_SECONDS
        goal[6 + i] += here / MERGE_SECONDS**2 - 2.0 * slope / MERGE_SECONDS


@compiled
def _specific_force(x, reading, axis):
    """Reading of a body-fixed accelerometer: acceleration minus gravity in body axes, noise included."""
    total = np.empty(3)
    for i in range(3):
        total[i] = reading[12 + i]
    total[2] += GRAVITY
    sr, cr = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    sy, cy = np.sin(x[8]), np.cos(x[8])
    thrust_axis(x[6:9], axis)
    reading[15] = cp * cy * total[0] + cp * sy * total[1] - sp * total[2]
    reading[16] = (sr * sp * cy - cr * sy) * total[0] + (sr * sp * sy + cr * cy) * total[1] + sr * cp * total[2]
    reading[17] = axis[0] * total[0] + axis[1] * total[1] + axis[2] * total[2]


class Flight:
    """One flight from one seed.

    Args:
        settings: of the simulation.
        seed: of all noise.
        ground: whether z = 0 is a floor. The drone then starts on the floor. Thrust ramps up until the measured height
            shows lift-off; the controller keeps the drone upright above the start. Thrust then stays constant until a
            mass estimate exists. Then the reference begins, with a smooth transition from the drone's motion.

    Attributes:
        size: rows flown so far (the last step ends at row size - 1).
        truth: (n + 1, 12) position m, velocity m/s, roll pitch yaw rad, body rate rad/s.
        estimate: (n + 1, 12) the same, estimated by the controller's filter (sensor A).
        wrench: (n + 1, 4) thrust N, torque N m commanded from each row on.
        readings: (n + 1, 18) position, velocity, angles, rate, acceleration (world), specific force (body), with noise.
        reference: (n + 1, 9) desired position, velocity, acceleration.
        contact: (n + 1,) whether the drone stood on the floor in the previous step.
        lift_off: row where the reference began, -1 before.
    """

    def __init__(self, settings: Settings, seed: int, *, ground: bool = False) -> None:
        self.settings = settings
        self.ground = ground
        n = settings.steps
        rng = np.random.default_rng([seed, 5506])
        noise = rng.normal(size=(n * settings.substeps, 4))
        held = settings.dt / settings.substeps
        self._noise = noise * np.array([settings.force_noise, *[settings.torque_noise] * 3]) / np.sqrt(held)
        self._sensor_noise = rng.normal(size=(n + 1, 15))
        self._sensor_sd = np.repeat(
            [settings.position_sd, settings.velocity_sd, settings.attitude_sd, settings.body_rate_sd,
             settings.acceleration_sd], 3
        )  # fmt: skip
        gains = position_gains(
            dt=settings.dt, position_weight=settings.position_weight, velocity_weight=settings.velocity_weight
        )
        self._gains = np.array([*gains, settings.angle_gain, settings.rate_gain])
        self.reference = reference(settings)
        self.truth = np.zeros((n + 1, 12))
        self.truth[0, :3] = settings.start
        self.estimate = self.truth.copy()
        self._covariance = settings.filter_start * np.eye(12)
        self.wrench = np.zeros((n + 1, 4))
        self.readings = np.zeros((n + 1, 18))
        self.readings[0, :12] = self.truth[0] + self._sensor_sd[:12] * self._sensor_noise[0, :12]
        self.readings[0, 12:] = np.nan
        self.contact = np.zeros(n + 1, np.bool_)
        self.lift_off = -1
        self._handover = np.zeros((2, 3))
        self.size = 1

    @property
    def time(self) -> NDArray:
        """(n + 1,) s."""
        return np.arange(len(self.truth)) * self.settings.dt

    @property
    def crashed(self) -> bool:
        """Whether the drone is upside down, fell far below the start, or has a state that is not finite."""
        x = self.truth[: self.size]
        return bool(
            not np.all(np.isfinite(x))
            or np.any(np.abs(x[:, 6:8]) > np.pi / 2)
            or np.any(x[:, 2] < min(self.settings.start[2], 0.0) - 1.0)
        )

    def advance(self, steps: int, *, mass: float | None, inertia: tuple[float, float, float] | NDArray) -> None:
        """Fly `steps` steps (fewer at the end); the controller uses mass kg and inertia (3,) kg m^2.

        A mass of None means unknown; this is possible only before lift-off from a floor.

        Raises: UsageError: no mass is known and there is no floor, or the reference has begun.
        """
        s = self.settings
        if mass is None and (not self.ground or self.lift_off >= 0):
            raise UsageError("a drone in the air cannot wait for its mass to be known")
        last = min(self.size - 1 + steps, s.steps)
        self.lift_off = _advance(
            self.size - 1, last, s.dt, s.mass, np.array(s.inertia),
            np.nan if mass is None else float(mass), np.array(inertia, float), self._gains, s.acceleration_limit,
            self.reference, self.ground, self.lift_off, self._handover, s.substeps, self._noise,
            self._sensor_noise, self._sensor_sd, s.filter_process, s.filter_measurement, self.truth, self.estimate,
            self._covariance, self.wrench, self.readings, self.contact,
        )  # fmt: skip
        self.size = last + 1

    def samples(self, sensor: str, first: int = 0, last: int | None = None) -> Iterator[Sample]:
        """Readings of a sensor in rows first..last-1 as samples for the estimator; inputs follow the measurements.

        Args:
            sensor: A (position, specific force, body rate), B (full state) or C (position, velocity, body rate).
        """
        last = self.size if last is None else last
        dt, readings = self.settings.dt, self.readings
        for k in range(first, last):
            t = k * dt
            row = readings[k].tolist()
            yield Sample("position", t, tuple(row[0:3]))
            if sensor in "BC":
                yield Sample("velocity", t, tuple(row[3:6]))
            if sensor == "B":
                yield Sample("attitude", t, tuple(quaternion_from_euler(*row[6:9]).tolist()))
            yield Sample("body_rate", t, tuple(row[9:12]))
            if sensor == "A" and k:
                yield Sample("specific_force", t, tuple(row[15:18]))
            if k + 1 < self.size:  # the wrench of the newest row is not known yet
                yield Sample("wrench_command", t, tuple(self.wrench[k].tolist()))


def reference(settings: Settings) -> NDArray:
    """(n + 1, 9) desired position m, velocity m/s, acceleration m/s^2: waypoints at equal times, steps or smoothed."""
    n = settings.steps
    out = np.zeros((n + 1, 9))
    points = np.array([settings.start, *settings.waypoints])
    share = n / len(settings.waypoints)
    for k in range(n + 1):
        leg = min(int(k / share), len(settings.waypoints) - 1)
        if not settings.smooth:
            out[k, :3] = points[leg + 1]
            continue
        duration = share * settings.dt
        p, v, a, _ = smooth_step((k - leg * share) / share)
        way = points[leg + 1] - points[leg]
        out[k] = np.concatenate([points[leg] + p * way, v / duration * way, a / duration**2 * way])
    return out


def fly(settings: Settings, seed: int) -> Flight:
    """A whole flight with the true parameters in the controller (the paper's offline simulation)."""
    flight = Flight(settings, seed)
    flight.advance(settings.steps, mass=settings.mass, inertia=settings.inertia)
    return flight
