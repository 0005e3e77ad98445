"""Consistent recordings in closed form: a smooth flight whose pose, rates, forces and rotors agree, to plant faults in.

>>> recording = made_flight(seconds=20.0, seed=1)
>>> recording.signals["body_rate"].value.shape
(4000, 3)
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.sample import SIGNALS
from crazyem.vehicle import GRAVITY, Vehicle, load_vehicle

Array = NDArray[np.float64]
ROTOR_CONSTANT = 3.0e-8  # N/(rad/s)^2

# Standard deviation of the noise of each quantity at `noise=1`, in its own unit (rad for attitudes).
NOISE: dict[str, float] = {
    "position": 5e-4, "velocity": 1e-2, "attitude": 2e-3, "body_rate": 2e-2, "specific_force": 0.15,
    "motor_command": 2e-3, "rotor_speed": 3.0, "voltage": 5e-3, "acceleration": 0.1, "euler": 2e-3,
}  # fmt: skip

# stream -> (rate in Hz, quantities sampled together)
STREAMS: dict[str, tuple[float, tuple[str, ...]]] = {
    "state": (100.0, ("position", "velocity", "attitude")),
    "imu": (200.0, ("body_rate", "specific_force")),
    "motor": (100.0, ("motor_command", "voltage", "flying")),
}
# further streams to ask for by name
MORE: dict[str, tuple[float, tuple[str, ...]]] = {
    "mocap": (100.0, ("position@mocap", "attitude@mocap")),
    "onboard": (100.0, ("position@onboard", "velocity@onboard", "attitude@onboard", "euler@onboard")),
    "accelerations": (100.0, ("acceleration",)),
    "angles": (100.0, ("euler",)),
    "rpm": (100.0, ("rotor_speed",)),
}


@dataclass(frozen=True)
class Motion:
    """Take-off, a path of sines in x, y, z and yaw, landing; every quantity is exact at any time.

    Attributes:
        seconds: length of the recording; 1 s on the ground before and after, 2 s of climb and descent.
        seed: of amplitudes, frequencies and phases.
        size: rms of the horizontal path in m; 0 hovers.
        frequency: about which the path oscillates [Hz].
        yaw: amplitude of the yaw oscillation [rad].
        turn: steady yaw rate [rad/s].
        height: of the flight [m].
        drag: linear, of mass [1/s].
        mass: kg.
    """

    seconds: float = 20.0
    seed: int = 0
    size: float = 0.5
    frequency: float = 0.3
    yaw: float = 0.6
    turn: float = 0.0
    height: float = 1.0
    drag: float = 0.2
    mass: float = 0.036

    def _path(self, t: Array) -> tuple[Array, Array, Array]:
        """Position, velocity, acceleration, each (n, 3)."""
        p, v, a = self._path_at(np.ascontiguousarray(t).tobytes())
        return p.copy(), v.copy(), a.copy()

    @lru_cache(maxsize=4)  # noqa: B019  # the signals of a stream share their stamps
    def _path_at(self, stamps: bytes) -> tuple[Array, Array, Array]:
        t = np.frombuffer(stamps)
        rng = np.random.default_rng(self.seed)
        shape = np.zeros((3, t.size, 3))
        for axis, scale in enumerate((1.0, 1.0, 0.35)):
            for factor in (0.7, 1.0, 1.7):
                w = 2.0 * np.pi * self.frequency * factor * rng.uniform(0.85, 1.15)
                amplitude, phase = scale * self.size / factor**2 * rng.uniform(0.6, 1.0), rng.uniform(0, 2 * np.pi)
                sine = np.sin(w * t + phase)
                shape[0, :, axis] += amplitude * sine
                shape[1, :, axis] += amplitude * w * np.cos(w * t + phase)
                shape[2, :, axis] -= amplitude * w**2 * sine
        shape[0, :, 2] += self.height + 0.5 * self.size
        e, de, dde = self._airborne(t)
        return shape[0] * e, shape[1] * e + shape[0] * de, shape[2] * e + 2.0 * shape[1] * de + shape[0] * dde

    def _airborne(self, t: Array) -> tuple[Array, Array, Array]:
        """0 on the ground, 1 in flight, smooth to the fourth derivative; with its two derivatives, each (n, 1)."""

        def step(u: Array) -> tuple[Array, Array, Array]:
            u = np.clip(u, 0.0, 1.0)
            return (
                u**5 * (126 + u * (-420 + u * (540 + u * (-315 + 70 * u)))),
                630 * u**4 * (1 - u) ** 4,
                2520 * u**3 * (1 - u) ** 3 * (1 - 2 * u),
            )

        climb = min(3.0, 0.15 * self.seconds)
        start = min(1.0, 0.05 * self.seconds)
        up, down = step((t - start) / climb), step((self.seconds - start - t) / climb)
        value = up[0] * down[0]
        first = (up[1] * down[0] - up[0] * down[1]) / climb
        second = (up[2] * down[0] - 2 * up[1] * down[1] + up[0] * down[2]) / climb**2
        return value[:, None], first[:, None], second[:, None]

    def position(self, t: Array) -> Array:
        """(n, 3) m, world."""
        return self._path(t)[0]

    def velocity(self, t: Array) -> Array:
        """(n, 3) m/s, world."""
        return self._path(t)[1]

    def acceleration(self, t: Array) -> Array:
        """(n, 3) m/s^2, world, gravity removed."""
        return self._path(t)[2]

    def attitude(self, t: Array) -> Rotation:
        """Body FLU to world: thrust along body z, heading as told."""
        _, v, a = self._path(t)
        up = a + np.array([0.0, 0.0, GRAVITY]) + self.drag * v
        z = up / np.linalg.norm(up, axis=1, keepdims=True)
        heading = self.yaw * np.sin(2.0 * np.pi * 0.13 * t + self.seed) * self._airborne(t)[0][:, 0] + self.turn * t
        left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros_like(t)])
        x = np.cross(left, z)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2))

    def body_rate(self, t: Array) -> Array:
        """(n, 3) rad/s, body: central difference of the exact attitude, good to 1e-6 of it."""
        h = 1e-3
        return (self.attitude(t - h).inv() * self.attitude(t + h)).as_rotvec() / (2.0 * h)

    def specific_force(self, t: Array) -> Array:
        """(n, 3) m/s^2, body: what an ideal accelerometer at the centre of mass shows."""
        return self.attitude(t).inv().apply(self.acceleration(t) + np.array([0.0, 0.0, GRAVITY]))

    def voltage(self, t: Array) -> Array:
        """(n,) V."""
        return 4.05 - 0.4 * t / max(self.seconds, 60.0)

    def thrust(self, t: Array) -> Array:
        """(n,) N, all rotors together; 0 on the ground."""
        _, v, a = self._path(t)
        force = self.mass * np.linalg.norm(a + np.array([0.0, 0.0, GRAVITY]) + self.drag * v, axis=1)
        return np.where(self._airborne(t)[0][:, 0] > 1e-6, force, 0.0)

    def quantity(self, name: str, t: Array, vehicle: Vehicle) -> Array:
        """Exact values (n, c) of a vocabulary signal at times t (n,)."""
        if name in ("position", "velocity", "acceleration", "body_rate", "specific_force"):
            return np.asarray(getattr(self, name)(t), float)
        if name == "attitude":
            return self.attitude(t).as_quat()
        if name == "euler":
            return self.attitude(t).as_euler("ZYX")[:, ::-1]
        if name == "voltage":
            return self.voltage(t)[:, None]
        if name == "flying":
            return (self.thrust(t) > 0.0).astype(float)[:, None]
        rotor = self.thrust(t) / 4.0
        if name == "rotor_speed":
            return np.tile(np.sqrt(rotor / ROTOR_CONSTANT)[:, None], 4)
        if name == "motor_command":
            volts = np.linspace(0.0, 5.0, 5001)
            curve = np.polynomial.polynomial.polyval(volts, vehicle.thrust_curve)
            duty = np.where(rotor > 0.0, np.interp(rotor, curve, volts), 0.0) / self.voltage(t)
            return np.tile(duty[:, None], 4)
        raise KeyError(name)


def made_flight(
    motion: Motion | None = None,
    *,
    seconds: float = 20.0,
    seed: int = 0,
    noise: float = 1.0,
    jitter: float = 0.0,
    more: Iterable[str] = (),
    rates: Mapping[str, float] | None = None,
    lags: Mapping[str, float] | None = None,
    gaps: Mapping[str, Iterable[tuple[float, float]]] | None = None,
    tilt: ArrayLike = (0.0, 0.0, 0.0),
    bias: ArrayLike = (0.0, 0.0, 0.0),
    loss: float = 0.0,
    vehicle: str = "cf2",
    without: Iterable[str] = (),
) -> Recording:
    """A recording whose streams agree with each other.

    Args:
        motion: the flight; by default `Motion(seconds, seed)`.
        seconds, seed: of the default motion; the seed is that of the noise, too.
        noise: factor on `NOISE`.
        jitter: standard deviation of the time between samples, in periods (stamps stay true).
        more: keys of `MORE`, streams to add.
        rates: stream -> Hz, instead of the usual.
        lags: stream -> s by which its stamps are late.
        gaps: stream -> (start, end) stretches in s without samples.
        tilt: rotation vector [rad] that turns the true world into the world of position, velocity, attitude of
            every stream (not of what the accelerometer measures).
        bias: of the accelerometer [m/s^2], body.
        loss: share of records lost at random, in all streams.
        vehicle: preset for the rotors.
        without: streams to leave out.
    """
    motion = motion or Motion(seconds=seconds, seed=seed)
    rng = np.random.default_rng(seed + 1000)
    drone = load_vehicle(vehicle)
    world = Rotation.from_rotvec(np.asarray(tilt, float))
    chosen = {name: entry for name, entry in STREAMS.items() if name not in set(without)}
    chosen |= {name: MORE[name] for name in more}
    signals: dict[str, SignalArray] = {}
    for stream, (usual, names) in chosen.items():
        rate = (rates or {}).get(stream, usual)
        true_time = np.arange(round(motion.seconds * rate)) / rate
        if jitter:
            true_time = np.sort(true_time + rng.normal(0.0, jitter / rate, true_time.size))
        keep = rng.random(true_time.size) >= loss
        for start, end in (gaps or {}).get(stream, ()):
            keep &= ~((true_time >= start) & (true_time < end))
        true_time = true_time[keep]
        for name in names:
            quantity = name.split("@")[0]
            value = motion.quantity(quantity, true_time, drone)
            value = _noisy(_turned(value, quantity, world), quantity, noise, rng)
            if quantity == "specific_force":
                value = value + np.asarray(bias, float)
            time = true_time + (lags or {}).get(stream, 0.0)
            signals[name] = array_of(quantity, time, value, stream=stream, place=len(signals))
    return Recording("made_flight", "made", signals)


def array_of(quantity: str, time: ArrayLike, value: ArrayLike, *, stream: str = "made", place: int = 0) -> SignalArray:
    """A signal of the vocabulary from (n,) times [s] and (n, c) values; `place` keeps orders of signals apart."""
    time = np.asarray(time, float)
    value = np.asarray(value, float)
    value = value.reshape(time.size, SIGNALS[quantity][0])
    _, unit, frame = SIGNALS[quantity]
    return SignalArray(
        time, value, np.arange(time.size, dtype=np.int64) * 64 + place, np.full(time.size, np.nan),
        ~np.isfinite(value).all(axis=1), quantity=quantity, unit=unit, frame=frame, clock="firmware", stream=stream,
        source=(quantity,),
    )  # fmt: skip


def changed(
    recording: Recording, name: str, *, value: ArrayLike | None = None, time: ArrayLike | None = None
) -> Recording:
    """The recording with other values (n, c) or stamps (n,) of one signal: for planting faults."""
    old = recording.signals[name]
    new = replace(
        old,
        value=old.value if value is None else np.asarray(value, float),
        time=old.time if time is None else np.asarray(time, float),
    )
    return replace(recording, signals={**recording.signals, name: new})


def without(recording: Recording, *names: str) -> Recording:
    """The recording less some signals."""
    return replace(recording, signals={k: v for k, v in recording.signals.items() if k not in names})


def _turned(value: Array, quantity: str, world: Rotation) -> Array:
    if quantity in ("position", "velocity", "acceleration"):
        return world.apply(value)
    if quantity == "attitude":
        return (world * Rotation.from_quat(value)).as_quat()
    if quantity == "euler":
        return (world * Rotation.from_euler("ZYX", value[:, ::-1])).as_euler("ZYX")[:, ::-1]
    return value


def _noisy(value: Array, quantity: str, noise: float, rng: np.random.Generator) -> Array:
    sd = noise * NOISE.get(quantity, 0.0)
    if sd == 0.0:
        return value
    if quantity == "attitude":
        turned = Rotation.from_quat(value) * Rotation.from_rotvec(rng.normal(0.0, sd, (len(value), 3)))
        return turned.as_quat()
    dirty = value + rng.normal(0.0, sd, value.shape)
    return np.where(value == 0.0, 0.0, dirty) if quantity in ("motor_command", "rotor_speed") else dirty
