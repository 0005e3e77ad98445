"""Closed-loop flights by Runge and Kutta with a chosen effect, noise and a controller that answers to what it measures.

Shares no line with the code that diagnoses: the oracle of `test_diagnosis_end_to_end.py`. Compiled, for speed alone.
"""

from dataclasses import dataclass

import numpy as np
from made_flight import array_of
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from crazyem.compiled import kernel as compiled
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

Array = NDArray[np.float64]
G = 9.81
PER_VOLT = 0.04  # N of one rotor
DRONE = Vehicle(
    "made", 0.035, (2.0e-5, 2.2e-5, 3.5e-5), arm=(0.033, 0.033), thrust_curve=(0.0, PER_VOLT), torque_per_thrust=0.006,
    motor_time_constant=0.04, thrust_max=0.16,
)  # fmt: skip
SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]], float)  # roll, pitch, yaw of rotors 1 to 4
CONTROL, LOG = 0.002, 0.01  # s between commands, between logged rows


@dataclass(frozen=True)
class Hidden:
    """What the drone has and its vehicle file does not; neutral by default.

    Attributes:
        thrust: (4,) factors on the rotors' thrusts, from `onset` [s] on.
        torque: factor on the rotors' torques.
        drag: (3,) N s/m, body axes.
        rope: N, along world x where x is beyond 0.1 m: nothing of the catalogue does that.
        load: kg and m of a weight on a string that swings little: a plane pendulum, its weight, and no more.
        breeze: (3,) N, world, constant.
        twist: m, torque about body z over the thrust of all rotors, which are not upright.
        cable: N/m and m: stiffness and length of a slack cable to a point of the floor, (0.5, -0.7, 0).
    """

    thrust: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    onset: float = 0.0
    torque: float = 1.0
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rope: float = 0.0
    load: tuple[float, float] = (0.0, 1.0)
    breeze: tuple[float, float, float] = (0.0, 0.0, 0.0)
    twist: float = 0.0
    cable: tuple[float, float] = (0.0, 0.4)


def wanted(seed: int, time: Array) -> tuple[Array, Array, Array, Array]:
    """Position, velocity, acceleration (n, 3) [m, s] and yaw (n,) [rad] that the controller is asked for."""
    rng = np.random.default_rng(1000 + seed)
    size = rng.uniform(0.2, 0.4, (2, 3)) * [1, 1, 0.5]
    pulse, phase = 2 * np.pi * rng.uniform(0.15, 0.45, (2, 3)), rng.uniform(0, 6, (2, 3))
    angle = pulse * time[:, None, None] + phase
    p = (size * np.sin(angle)).sum(1) + np.array([0, 0, 1.2])
    v = (size * pulse * np.cos(angle)).sum(1)
    return p, v, -(size * pulse**2 * np.sin(angle)).sum(1), 0.8 * np.sin(2.2 * time)


@compiled
def cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@compiled
def turned(r, by):
    """Rotation matrix turned on by a rotation vector on the right (Rodrigues)."""
    angle = np.sqrt(np.sum(by * by))
    a = 1.0 if angle < 1e-9 else np.sin(angle) / angle
    b = 0.5 if angle < 1e-9 else (1 - np.cos(angle)) / angle**2
    k = np.array([[0.0, -by[2], by[1]], [by[2], 0.0, -by[0]], [-by[1], by[0], 0.0]])
    return r @ (np.eye(3) + a * k + b * (k @ k))


@compiled
def loop(goal, goal_v, goal_a, yaw, noise, kicks, sway, weak, onset, scale, drag, rope, load, breeze, twist, cable,
         mass, inertia, levers, signs, unmix, lag, most, h, rows):  # fmt: skip
    p, v, r, w = goal[0].copy(), goal_v[0].copy(), np.eye(3), np.zeros(3)
    f, integral = np.full(4, mass * G / 4), np.zeros(3)
    sa, sb = np.zeros((4, 3)), np.zeros((4, 3))
    aside, slide, stiff = np.zeros(3), np.zeros(3), G / load[1]
    for k in range(len(goal)):
        p_s, v_s, w_s = p + noise[k, :3], v + noise[k, 3:6], w + noise[k, 9:]
        r_s = turned(r, noise[k, 6:9])
        integral = np.minimum(np.maximum(integral + h * (goal[k] - p_s), -1.0), 1.0)
        pull = 6 * (goal[k] - p_s) + 4 * (goal_v[k] - v_s) + 3 * integral + goal_a[k]
        pull[2] += G
        up = pull / np.sqrt(np.sum(pull * pull))
        side = cross(up, np.array([np.cos(yaw[k]), np.sin(yaw[k]), 0.0]))
        side /= np.sqrt(np.sum(side * side))
        aim = np.zeros((3, 3))
        aim[:, 0], aim[:, 1], aim[:, 2] = cross(side, up), side, up
        e = r_s.T @ aim
        error = 0.5 * np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]])
        asked = np.zeros(4)
        asked[0] = mass * np.sum(pull * r_s[:, 2])
        asked[1:] = inertia * (150 * error - 18 * w_s)
        command = np.minimum(np.maximum(unmix @ asked, 0.0), most)
        rows[k, :3], rows[k, 3:6], rows[k, 6:15], rows[k, 15:18] = p_s, v_s, r_s.copy().reshape(9), w_s
        rows[k, 18:] = command
        for i in range(4):
            part = (0.0, 0.5, 0.5, 1.0)[i]
            real = command + (f - command) * np.exp(-part * h / lag)
            if k * h + part * h >= onset:
                real = real * weak
            at = turned(r, part * h * w)
            v_at, w_at = v, w
            if i:
                at = turned(r, part * h * (w + 0.5 * part * h * sb[i - 1]))
                v_at, w_at = v + part * h * sa[i - 1], w + part * h * sb[i - 1]
            body = -drag * (at.T @ v_at)
            body[2] += real.sum()
            world = at @ body
            if p[0] > 0.1:
                world[0] += rope
            world += load[0] * stiff * aside + breeze
            away = p - np.array([0.5, -0.7, 0.0])
            far = np.sqrt(np.sum(away * away))
            if far > cable[1]:
                world -= cable[0] * (1.0 - cable[1] / far) * away
            world[2] -= load[0] * G
            sa[i] = world / mass
            sa[i, 2] -= G
            torque = scale * levers * (signs @ real)
            torque[2] += twist * real.sum()
            sb[i] = (torque - cross(w_at, inertia * w_at)) / inertia + sway[k]
        moved = -stiff * aside - sa[0] - 0.1 * (v + slide)  # the same drag over mass as the catalogue's
        moved[2] = 0.0
        slide = slide + h * moved
        aside = aside + h * slide
        p = p + h * v + h * h / 6 * (sa[0] + sa[1] + sa[2])
        r = turned(r, h * w + h * h / 6 * (sb[0] + sb[1] + sb[2]))
        v = v + h / 6 * (sa[0] + 2 * sa[1] + 2 * sa[2] + sa[3]) + kicks[k, :3]
        w = w + h / 6 * (sb[0] + 2 * sb[1] + 2 * sb[2] + sb[3]) + kicks[k, 3:]
        f = command + (f - command) * np.exp(-h / lag)


def fly(
    hidden: Hidden | None = None,
    *,
    seed: int = 0,
    seconds: float = 20.0,
    rate_noise: float = 0.02,
    shake: float = 0.3,
    sway: float = 0.0,
    vibration: float = 0.0,
    sticking: float = 0.0,
    hop: float = 0.0,
    vehicle: Vehicle = DRONE,
) -> Recording:
    """A recording at 100 Hz of a controller that runs at 500 Hz.

    Args:
        rate_noise: rad/s, standard deviation of each sample of the gyro.
        shake: rad/s^2 sqrt(s), intensity of random angular impulses.
        sway: rad/s^2, standard deviation of random angular accelerations with a memory of 0.5 s.
        vibration: rad/s^2, amplitude of an angular acceleration about roll and pitch at 6 Hz, a little unsteady.
        sticking: N, standard deviation of random thrusts of rotor 4 with a memory of 0.05 s.
        hop: m, by which the height asked for is higher in every second span of 2 s: thrust sets in at once.
    """
    hidden = hidden or Hidden()
    rng = np.random.default_rng(seed)
    levers = np.array([*vehicle.arm[::-1], vehicle.torque_per_thrust])
    unmix = np.linalg.inv(np.vstack([np.ones(4), levers[:, None] * SIGNS]))
    steps = int(seconds / CONTROL)
    time = CONTROL * np.arange(steps)
    noise = rng.normal(size=(steps, 12)) * np.repeat([1e-3, 1e-2, 3e-3, rate_noise], 3)
    kicks = rng.normal(size=(steps, 6)) * np.repeat([0.05, shake], 3) * np.sqrt(CONTROL)
    wander, keep = np.zeros((steps, 3)), np.exp(-CONTROL / 0.5)
    if sway > 0:
        wander = lfilter([sway * np.sqrt(1 - keep**2)], [1, -keep], rng.normal(size=(steps, 3)), axis=0)
    if vibration > 0:
        phase = 2 * np.pi * 6.0 * time + 3.0 * np.sin(0.7 * time)
        wander[:, :2] += vibration * np.stack([np.cos(phase), np.sin(phase)], 1)
    if sticking > 0:
        keep = np.exp(-CONTROL / 0.05)
        thrust = lfilter([sticking * np.sqrt(1 - keep**2)], [1, -keep], rng.normal(size=steps))
        wander = wander + thrust[:, None] * levers * SIGNS[:, 3] / np.array(vehicle.inertia)
    rows = np.zeros((steps, 22))
    position, *motion = wanted(seed, time)
    position[:, 2] += hop * (np.floor(time / 2.0) % 2)
    loop(
        position, *motion, noise, kicks, wander, np.array(hidden.thrust), hidden.onset, hidden.torque,
        np.array(hidden.drag), hidden.rope, np.array(hidden.load), np.array(hidden.breeze), hidden.twist,
        np.array(hidden.cable), vehicle.mass, np.array(vehicle.inertia), levers, SIGNS, np.ascontiguousarray(unmix),
        vehicle.motor_time_constant, vehicle.thrust_max, CONTROL, rows,
    )  # fmt: skip
    every = round(LOG / CONTROL)
    return recorded(time[::every], rows[::every])


def recorded(time: Array, rows: Array) -> Recording:
    """The rows as named signals; the battery falls by 0.4 V in 20 s, and commands make up for it."""
    volts = 4.2 - 0.02 * time[:, None]
    columns = {
        "position": rows[:, :3], "velocity": rows[:, 3:6],
        "attitude": Rotation.from_matrix(rows[:, 6:15].reshape(-1, 3, 3)).as_quat(), "body_rate": rows[:, 15:18],
        "motor_command": rows[:, 18:] / PER_VOLT / volts, "voltage": volts, "flying": np.ones((len(time), 1)),
    }  # fmt: skip
    signals = {n: array_of(n, time, v, place=i) for i, (n, v) in enumerate(columns.items())}
    return Recording("made.csv", "made", signals)
