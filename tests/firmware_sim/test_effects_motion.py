"""Bodies with effects, air, cables and rotors against the plain model of `motion_model.py`."""

import numpy as np
import pytest
from motion_model import INERTIA, MASS, THRUST, C, G, Model, about_origin, advance, compare, matrix, plant, seen
from scipy.spatial.transform import Rotation

from firmware_sim.plant import layout as at


def test_plain_body() -> None:
    truth, x, _ = plant({})
    assert truth[at.EFFECT_BODY] == truth[at.EFFECT_ROTORS] == truth[at.EFFECT_SENSING] == 0
    compare(Model(), truth, x)


def test_center_of_mass() -> None:
    truth, x, _ = plant({"center_of_mass": {"x": C[0], "y": C[1], "z": C[2]}})
    start = seen(truth, x)
    assert start[:6] == pytest.approx([0, 0, 0, 0.4, -0.3, 0.2])
    model = Model(J_origin=about_origin(MASS, matrix(INERTIA), np.array(C)), c=C)
    flown = x.copy()
    compare(model, truth, flown)
    # the accelerometer sits at the origin
    advance(truth, x, 1)
    end = seen(truth, x)
    R = Rotation.from_quat(end[6:10]).as_matrix()
    felt = R.T @ (model.accelerations(0.0, end)[:3] - G)
    assert x[at.ACC : at.ACC + 3] == pytest.approx(felt, abs=0.03)  # its mean over a millisecond of turning
    assert np.abs(felt[:2]).max() > 0.2


def test_payload_is_a_point_mass_on_a_body_of_point_masses() -> None:
    """The bare body as six point masses on its axes, the payload as a seventh; everything summed point by point."""
    xx, yy, zz = 2e-5, 1.5e-5, 3e-5
    reach = np.sqrt(1.5 / MASS * np.array([yy + zz - xx, xx + zz - yy, xx + yy - zz]))  # two of MASS/6 on each axis
    points = np.vstack([np.diag(reach), -np.diag(reach), [[0.02, 0.01, -0.03]]])
    masses = np.array([MASS / 6] * 6 + [0.008])
    points, masses = points[masses > 0], masses[masses > 0]
    total, c = masses.sum(), masses @ points / masses.sum()
    J_origin = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points))
    effects = {"payload": {"mass": 0.008, "x": 0.02, "y": 0.01, "z": -0.03}, "inertia": {"xx": xx, "yy": yy, "zz": zz}}
    effects["inertia_products"] = {"xy": 0.0, "xz": 0.0, "yz": 0.0}
    truth, x, scenario = plant(effects)
    body = scenario.body()
    assert (body.mass, *body.center_of_mass) == pytest.approx((total, *c), rel=1e-12)
    J = sum(m * ((p - c) @ (p - c) * np.eye(3) - np.outer(p - c, p - c)) for m, p in zip(masses, points))
    assert body.inertia == pytest.approx(J, rel=1e-9, abs=1e-15)
    compare(Model(mass=total, J_origin=J_origin, c=tuple(c)), truth, x)


def test_payload_and_center_of_mass_together() -> None:
    effects = {"payload": {"mass": 0.005, "z": -0.02}, "center_of_mass": {"x": 0.003, "y": 0.001, "z": 0.0}}
    truth, x, _ = plant(effects)
    c0, r = np.array([0.003, 0.001, 0]), np.array([0, 0, -0.02])
    J = about_origin(MASS, matrix(INERTIA), c0) + about_origin(0.005, np.zeros((3, 3)), r)
    compare(Model(mass=0.035, J_origin=J, c=tuple((MASS * c0 + 0.005 * r) / 0.035)), truth, x)


def test_inertia_elements_replace_the_vehicles() -> None:
    truth, x, _ = plant({"inertia": {"yy": 1.8e-5}, "inertia_products": {"xz": 2e-6}})
    compare(Model(J_origin=matrix([2e-5, 1.8e-5, 3e-5, 1e-6, 2e-6, 8e-7])), truth, x)


AIR = {
    "linear_drag": ({"x": 0.01, "y": 0.02, "z": 0.005}, lambda u, w: (-np.array([0.01, 0.02, 0.005]) * u, np.zeros(3))),
    "quadratic_drag": (
        {"x": 0.004, "y": 0.002, "z": 0.01},
        lambda u, w: (-np.array([0.004, 0.002, 0.01]) * np.linalg.norm(u) * u, np.zeros(3)),
    ),
    "velocity_moment": (
        {"roll_per_vy": 3e-5, "pitch_per_vx": -2e-5},
        lambda u, w: (np.zeros(3), np.array([3e-5 * u[1], -2e-5 * u[0], 0.0])),
    ),
    "rate_damping": (
        {"x": 1e-5, "y": 2e-5, "z": 5e-6},
        lambda u, w: (np.zeros(3), -np.array([1e-5, 2e-5, 5e-6]) * w),
    ),
}


@pytest.mark.parametrize("name", list(AIR))
@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (1.5, -2.0, 0.5)])
def test_air(name: str, wind: tuple[float, ...]) -> None:
    table, law = AIR[name]
    no_drag = name in ("velocity_moment", "rate_damping")

    def force(p, v, w, R):
        f, m = law(R.T @ (v - wind), w)
        return R @ f + 0.007 * np.array(wind) * no_drag, m

    effects = {name: table, "wind": dict(zip("xyz", wind))}
    truth, x, _ = plant(effects)
    compare(Model(force=force), truth, x)


def test_drag_acts_at_the_origin_of_a_body_whose_centre_is_elsewhere() -> None:
    truth, x, _ = plant(
        {"linear_drag": {"x": 0.03, "y": 0.03, "z": 0.03}, "center_of_mass": {"x": 0, "y": 0, "z": -0.01}}
    )
    c = np.array([0, 0, -0.01])
    model = Model(
        J_origin=about_origin(MASS, matrix(INERTIA), c), c=tuple(c), force=lambda p, v, w, R: (-0.03 * v, np.zeros(3))
    )
    compare(model, truth, x)


def test_cable_spring_pulls_when_taut_only() -> None:
    anchor = np.array([0.5, 0.2, -0.3])

    def force(p, v, w, R):
        d = anchor - p
        r = np.linalg.norm(d)
        return (0.4 * (r - 0.5) / r * d if r > 0.5 else np.zeros(3)), np.zeros(3)

    hidden = {"cable_spring": {"stiffness": 0.4, "length": 0.5, "x": 0.5, "y": 0.2, "z": -0.3}}
    truth, x, _ = plant({}, hidden)
    compare(Model(force=force), truth, x, tolerance=1e-5)  # the corner at r = length is met within a step


def test_rotor_inertia_reacts_and_turns_like_a_gyroscope() -> None:
    tau, inertia = 0.05, 2e-8
    truth, x, _ = plant({"rotor_inertia": {"inertia": inertia}}, motor_time_constant=tau)
    start = np.array([0.05, 0.06, 0.09, 0.045])
    x[at.ROTOR : at.ROTOR + 4] = start
    sign = np.array([1, -1, 1, -1])

    def thrust(t: float) -> np.ndarray:
        return THRUST + (start - THRUST) * np.exp(-t / tau)

    def spin(t: float) -> tuple[float, float]:
        f, df = thrust(t), -(start - THRUST) / tau * np.exp(-t / tau)
        return inertia * sign @ np.sqrt(f / 2e-8), inertia * sign @ (df / (2 * np.sqrt(f * 2e-8)))

    compare(Model(thrust=thrust, spin=spin), truth, x, tolerance=1e-4)


def test_spin_up_conserves_angular_momentum() -> None:
    truth, x, _ = plant({"rotor_inertia": {"inertia": 3e-8}}, motor_time_constant=0.05, torque_per_thrust=0.0)
    x[at.OMEGA : at.OMEGA + 3] = 0.0
    x[at.PWM : at.PWM + 4] = 30000, 0, 30000, 0
    advance(truth, x, 100)
    speed = np.sqrt(x[at.ROTOR : at.ROTOR + 4] / 2e-8)
    assert speed[0] > 1000
    Jw = matrix(INERTIA) @ x[at.OMEGA : at.OMEGA + 3]
    assert Jw[2] == pytest.approx(-3e-8 * (speed[0] - speed[1] + speed[2] - speed[3]), rel=1e-9)
