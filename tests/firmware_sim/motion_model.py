"""Bodies with effects against a plain model written about the geometric origin and integrated by SciPy.

The plant works about the centre of mass with the tension solved for; the model here takes the 10 x 10 system of
linear, angular, pendulum and constraint equations about the origin, so that they share no algebra.
"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.motion import origin
from firmware_sim.plant.effects.step import plant_step_with_effects
from firmware_sim.scenario import Scenario, parse_scenario

STILL = np.zeros(at.NOISE_WIDTH)
G = np.array([0.0, 0.0, -9.81])
ARM, K = 0.03, 0.006
MASS, INERTIA = 0.03, [2e-5, 1.5e-5, 3e-5, 1e-6, -5e-7, 8e-7]
PWM = np.array([30000.0, 31000.0, 30500.0, 30600.0])
THRUST = 0.03 * PWM / 65535 * 4.2  # N, of a linear curve on a battery that never sags
PLAIN = {
    "vehicle": {
        "mass": MASS, "inertia": INERTIA, "arm": ARM, "torque_per_thrust": K, "thrust_curve": [0.0, 0.03],
        "thrust_max": 1.0, "motor_time_constant": 0.0, "rotor_constant": 2e-8,
    },
    "noise": {"thrust": 0.0, "torque": 0.0},
    "battery": {"resistance": 0.0, "power_coefficient": 0.0, "electronics_power": 0.0},
    "ground": {"height": -1000.0},
    "start": {"velocity": [0.4, -0.3, 0.2], "yaw": 0.7},
}  # fmt: skip
OMEGA = np.array([1.5, -2.0, 1.0])  # rad/s, at the start


def matrix(values: list[float]) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = (*values, 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def cross(c: np.ndarray) -> np.ndarray:
    return np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])


def about_origin(mass: float, J: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Inertia about the origin by the parallel-axis theorem in its cross-product form."""
    return J - mass * cross(c) @ cross(c)


class Model:
    """A rigid body with its origin at the rotors' middle, and a pendulum hooked there. SI, world z up."""

    def __init__(
        self,
        mass: float = MASS,
        J_origin: np.ndarray | None = None,
        c: tuple[float, ...] = (0, 0, 0),
        force: Callable | None = None,  # (p, v, w, R) -> force (world), torque (body), at the origin
        load: tuple[float, float] | None = None,  # mass, length
        friction: float = 0.0,
        air: tuple[float, ...] = (0, 0, 0),
        spin: Callable | None = None,  # t -> H, dH/dt along body z
        thrust: Callable | None = None,  # t -> four thrusts
    ):
        self.mass, self.c, self.load, self.force = mass, np.array(c, dtype=float), load, force
        self.J = matrix(INERTIA) if J_origin is None else J_origin
        self.friction, self.air, self.spin = friction, np.array(air), spin or (lambda t: (0.0, 0.0))
        self.thrust = thrust or (lambda t: THRUST)

    def accelerations(self, t: float, x: np.ndarray) -> np.ndarray:
        """[a (3, world), alpha (3, body), n'' (3), tension]."""
        p, v, w, n, swing = x[:3], x[3:6], x[10:13], x[13:16], x[16:19]
        R = Rotation.from_quat(x[6:10] / np.linalg.norm(x[6:10])).as_matrix()
        f = self.thrust(t)
        places = [(ARM, -ARM), (-ARM, -ARM), (-ARM, ARM), (ARM, ARM)]
        lift = np.array([0, 0, f.sum()])
        turn_ = np.array(
            [
                sum(y * v for (_, y), v in zip(places, f)),
                -sum(x * v for (x, _), v in zip(places, f)),
                K * (-f[0] + f[1] - f[2] + f[3]),
            ]
        )
        extra, moment = self.force(p, v, w, R) if self.force else (np.zeros(3), np.zeros(3))
        H, rate = self.spin(t)
        ez = np.array([0, 0, 1.0])
        A, b = np.zeros((10, 10)), np.zeros(10)
        A[:3, :3] = self.mass * np.eye(3)
        A[:3, 3:6] = -self.mass * R @ cross(self.c)
        b[:3] = R @ lift + extra + self.mass * G - self.mass * R @ np.cross(w, np.cross(w, self.c))
        A[3:6, :3] = self.mass * cross(self.c) @ R.T
        A[3:6, 3:6] = self.J
        gyro = np.cross(w, self.J @ w + H * ez) + rate * ez
        b[3:6] = turn_ + moment + np.cross(self.c, self.mass * R.T @ G) - gyro
        if self.load:
            ml, length = self.load
            A[:3, 9] = -n
            A[6:9, :3], A[6:9, 6:9], A[6:9, 9] = ml * np.eye(3), ml * length * np.eye(3), n
            b[6:9] = ml * G - ml * self.friction * (v + length * swing - self.air)
            A[9, 6:9], b[9] = n, -swing @ swing
        else:
            A[6:10, 6:10] = np.eye(4)
        return np.linalg.solve(A, b)

    def derivative(self, t: float, x: np.ndarray) -> np.ndarray:
        q, w = x[6:10], x[10:13]
        a = self.accelerations(t, x)
        dq = 0.5 * np.array([*(q[3] * w + np.cross(q[:3], w)), -q[:3] @ w])
        return np.concatenate([x[3:6], a[:3], dq, a[3:6], x[16:19], a[6:9]])

    def fly(self, x: np.ndarray, seconds: float) -> np.ndarray:
        return solve_ivp(self.derivative, (0, seconds), x, rtol=1e-10, atol=1e-12, method="DOP853").y[:, -1]


def plant(effects: dict, hidden: dict | None = None, **vehicle: float) -> tuple[np.ndarray, np.ndarray, Scenario]:
    """Constants and state of a drone in the air with the rotors at PWM and the rates of OMEGA."""
    table = PLAIN | {"effects": effects, "hidden": hidden or {}, "vehicle": PLAIN["vehicle"] | vehicle}
    scenario = parse_scenario(table, "test")
    truth, x = scenario.truth(), scenario.start_state()
    x[at.PWM : at.PWM + 4] = PWM
    x[at.OMEGA : at.OMEGA + 3] = OMEGA
    c = truth[at.COM : at.COM + 3]
    R = Rotation.from_euler("z", 0.7).as_matrix()
    x[at.VEL : at.VEL + 3] += R @ np.cross(OMEGA, c)  # the start's velocity is the origin's
    return truth, x, scenario


def advance(truth: np.ndarray, x: np.ndarray, milliseconds: int) -> None:
    """Let the plant move without noise."""
    for _ in range(milliseconds):
        plant_step_with_effects(truth, x, STILL, 1e-3)


def seen(truth: np.ndarray, x: np.ndarray) -> np.ndarray:
    """State of the plant in the model's order: origin's position and velocity, quaternion x y z w, rate, pendulum."""
    p, v = np.empty(3), np.empty(3)
    origin(truth, x, p, v)
    q = np.roll(x[at.QUAT : at.QUAT + 4], -1)
    return np.concatenate([p, v, q, x[at.OMEGA : at.OMEGA + 3], x[at.LOAD : at.LOAD + 6]])


def compare(model: Model, truth: np.ndarray, x: np.ndarray, seconds: float = 1.0, tolerance: float = 1e-6) -> None:
    start = seen(truth, x)
    advance(truth, x, round(1000 * seconds))
    end, expected = seen(truth, x), model.fly(start, seconds)
    if end[6:10] @ expected[6:10] < 0:
        expected[6:10] *= -1
    if not model.load:
        end, expected = end[:13], expected[:13]
    assert end == pytest.approx(expected, abs=tolerance)


C = (0.004, -0.003, 0.006)
