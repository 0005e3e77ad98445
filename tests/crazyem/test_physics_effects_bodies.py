"""payload, center_of_mass, inertia and suspended load against point masses by Newton and Euler, written about O."""

from dataclasses import replace

import numpy as np
import pytest
from effects_cases import CF2, G, still, wild
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from crazyem.physics.effects.effect import Effects
from crazyem.physics.effects.pendulum import swing_along, swing_on
from crazyem.physics.effects.suspended_load import swing_of
from crazyem.physics.motion import motion
from crazyem.physics.rotations import skew
from crazyem.physics.rotors import wrench
from crazyem.vehicle import Vehicle


def rigid_points(masses, places, force, torque, rate):
    """Specific force at O and angular acceleration of rigidly joined point masses: a 6 x 6 system about O.

    sum m a_i = F and sum r_i x m a_i = M with a_i = a + alpha x r_i + w x (w x r_i); gravity cancels in both.
    """
    left, right = np.zeros((6, 6)), np.concatenate([force, torque])
    for m, r in zip(masses, places, strict=True):
        left[:3, :3] += m * np.eye(3)
        left[:3, 3:] -= m * skew(r)
        left[3:, :3] += m * skew(r)
        left[3:, 3:] -= m * skew(r) @ skew(r)
        turned = np.cross(rate, np.cross(rate, r))
        right -= np.concatenate([m * turned, np.cross(r, m * turned)])
    solved = np.linalg.solve(left, right)
    return solved[:3], solved[3:]


def assembly(seed: int) -> tuple[Vehicle, np.ndarray, np.ndarray, np.ndarray]:
    """A vehicle made of seven point masses, those masses and their places, and its centre of mass."""
    rng = np.random.default_rng(seed)
    masses = 0.03 * rng.dirichlet(np.ones(7))
    places = 0.03 * rng.standard_normal((7, 3))
    centre = masses @ places / masses.sum()
    inertia = sum(m * (d @ d * np.eye(3) - np.outer(d, d)) for m, d in zip(masses, places - centre, strict=True))
    vehicle = replace(
        CF2, mass=masses.sum(), inertia=tuple(np.diag(inertia)),
        inertia_products=(inertia[0, 1], inertia[0, 2], inertia[1, 2]),
    )  # fmt: skip
    return vehicle, masses, places, centre


@pytest.mark.parametrize("seed", range(5))
def test_payload_on_a_crooked_body_is_an_assembly_of_points(seed: int) -> None:
    vehicle, masses, places, centre = assembly(seed)
    rng = np.random.default_rng(seed + 100)
    place = 0.05 * rng.standard_normal(3)
    situation = wild(4, seed=seed)
    effects: Effects = {
        "payload": {"mass": 0.006, **dict(zip("xyz", place, strict=True))},
        "center_of_mass": dict(zip("xyz", centre, strict=True)),
        "linear_drag": {"x": 0.01, "y": 0.02, "z": 0.03},
    }
    found = motion(situation, vehicle=vehicle, effects=effects)
    for k in range(4):
        rotors = wrench(situation.thrust[k], arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)
        drag = -np.array([0.01, 0.02, 0.03]) * (situation.rotation[k].T @ situation.velocity[k])
        force = drag + np.array([0.0, 0.0, rotors[0]])
        specific, angular = rigid_points([*masses, 0.006], [*places, place], force, rotors[1:], situation.body_rate[k])
        np.testing.assert_allclose(found.specific_force[k], specific, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.angular_acceleration[k], angular, rtol=1e-9, atol=1e-7)


def test_inertia_replaces_what_is_given_and_keeps_the_rest() -> None:
    situation = wild(3, seed=8)
    effects: Effects = {"inertia": {"yy": 2e-5}, "inertia_products": {"xz": 1e-6}}
    xx, _, zz = CF2.inertia
    other = replace(CF2, inertia=(xx, 2e-5, zz), inertia_products=(0.0, 1e-6, 0.0))
    found = motion(situation, vehicle=CF2, effects=effects)
    expected = motion(situation, vehicle=other, effects={})
    np.testing.assert_array_equal(found.angular_acceleration, expected.angular_acceleration)
    matrix = np.array([[xx, 0, 1e-6], [0, 2e-5, 0], [1e-6, 0, zz]])
    torque = wrench(situation.thrust, arm=CF2.arm, torque_per_thrust=CF2.torque_per_thrust)[:, 1:]
    for k in range(3):  # J alpha = M - w x J w
        w = situation.body_rate[k]
        left = matrix @ found.angular_acceleration[k]
        np.testing.assert_allclose(left, torque[k] - np.cross(w, matrix @ w), rtol=1e-9, atol=1e-12)


# --- the load on a string ---------------------------------------------------------------------------------------------


def tied_points(masses, places, force, torque, rate, rotation, swing, load, length, velocity, air):
    """The same points with a load on a rod at O: unknown a, alpha (body), acceleration of the load (world), tension.

    Ten equations; the rod: n . (a_load - a_O) = -L |dn/dt|^2. Accelerations less gravity, world, for the load too.
    """
    n, turning = swing[:3], swing[3:]
    nb = rotation.T @ n
    left, right = np.zeros((10, 10)), np.zeros(10)
    right[:3], right[3:6] = force, torque
    for m, r in zip(masses, places, strict=True):
        left[:3, :3] += m * np.eye(3)
        left[:3, 3:6] -= m * skew(r)
        left[3:6, :3] += m * skew(r)
        left[3:6, 3:6] -= m * skew(r) @ skew(r)
        turned = np.cross(rate, np.cross(rate, r))
        right[:3] -= m * turned
        right[3:6] -= np.cross(r, m * turned)
    left[:3, 9] = -nb  # the tension pulls O towards the load
    left[6:9, 6:9] = load * np.eye(3)
    left[6:9, 9] = n
    right[6:9] = -0.1 * load * (velocity + length * turning - air)
    left[9, :3], left[9, 6:9] = -nb, n
    right[9] = -length * turning @ turning
    return np.linalg.solve(left, right)


@pytest.mark.parametrize("seed", range(4))
def test_tension_is_that_of_the_coupled_system(seed: int) -> None:
    vehicle, masses, places, centre = assembly(seed)
    rng = np.random.default_rng(seed + 50)
    n = rng.standard_normal((3, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    turning = np.cross(n, rng.standard_normal((3, 3)))
    situation = replace(wild(3, seed=seed), swing=np.hstack([n, turning]))
    effects: Effects = {
        "center_of_mass": dict(zip("xyz", centre, strict=True)),
        "suspended_load": {"mass": 0.008, "length": 0.4},
        "linear_drag": {"x": 0.01, "y": 0.01, "z": 0.01},
        "wind": {"x": 1.0, "y": -2.0, "z": 0.5},
    }
    found = motion(situation, vehicle=vehicle, effects=effects)
    air = np.array([1.0, -2.0, 0.5])
    for k in range(3):
        rotors = wrench(situation.thrust[k], arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)
        rotation, velocity = situation.rotation[k], situation.velocity[k]
        force = -0.01 * rotation.T @ (velocity - air) + [0.0, 0.0, rotors[0]]
        expected = tied_points(
            masses, places, force, rotors[1:], situation.body_rate[k], rotation, situation.swing[k], 0.008, 0.4,
            velocity, air,
        )  # fmt: skip
        np.testing.assert_allclose(found.specific_force[k], expected[:3], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(found.angular_acceleration[k], expected[3:6], rtol=1e-8, atol=1e-6)


def pivot(t, amplitude=1.0):
    """Velocity and acceleration of a pivot that wanders in three directions."""
    w = np.array([2.1, 3.3, 1.7])
    phase = np.array([0.3, 1.1, 2.0])
    v = amplitude * np.sin(np.multiply.outer(t, w) + phase)
    a = amplitude * w * np.cos(np.multiply.outer(t, w) + phase)
    return v, a


@pytest.mark.parametrize("length", [0.1, 0.3, 2.0])
def test_swing_follows_a_pendulum_with_a_moving_pivot(length: float) -> None:
    """The load in Cartesian coordinates with the rod's constraint, by SciPy: another form of the same physics."""
    air = np.array([0.5, 0.0, -0.2])

    def slope(t, state):
        position, velocity = state[:3], state[3:]  # relative to the pivot
        v, a = pivot(t)
        direction = position / length
        free = np.array([0, 0, -G]) - a - 0.1 * (v + velocity - air)
        tension = direction @ free + velocity @ velocity / length
        return np.concatenate([velocity, free - tension * direction])

    time = np.arange(0, 4.0, 0.01)
    start = np.array([0, 0, -length, 0, 0, 0.0])
    exact = solve_ivp(slope, (0, 4), start, t_eval=time, rtol=1e-10, atol=1e-12).y.T
    v, _ = pivot(time)
    gap = np.r_[0.0, np.diff(time)]
    found = swing_along(gap=gap, broken=gap == 0, velocity=v, air=np.tile(air, (len(time), 1)), length=length)
    np.testing.assert_allclose(found[:, :3], exact[:, :3] / length, atol=2e-3)  # the path is a polygon of velocities
    np.testing.assert_allclose(found[:, 3:], exact[:, 3:] / length, atol=2e-2)
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1.0, atol=1e-12)


def test_swing_of_a_small_angle_has_the_textbook_period_and_dies_in_twenty_seconds() -> None:
    length, step = 0.5, 0.01
    n = 4000
    swing = np.zeros((n, 6))
    swing[0] = [np.sin(0.02), 0, -np.cos(0.02), 0, 0, 0]
    none, rest = np.zeros((1, 3)), np.full(1, step)
    for k in range(1, n):
        swing[k] = swing_on(swing[k - 1 : k], acceleration=none, velocity=none, air=none, step=rest, length=length)[0]
    t = step * np.arange(n)
    w = np.sqrt(G / length - 0.05**2)
    expected = 0.02 * np.exp(-0.05 * t) * (np.cos(w * t) + 0.05 / w * np.sin(w * t))
    np.testing.assert_allclose(swing[:, 0], expected, atol=1e-4)


def test_one_step_of_many_is_a_row_of_a_path() -> None:
    time = np.arange(0, 1.0, 0.02)
    v, _ = pivot(time, 0.5)
    gap = np.r_[0.0, np.diff(time)]
    air = np.zeros_like(v)
    path = swing_along(gap=gap, broken=gap == 0, velocity=v, air=air, length=0.3)
    acceleration = np.diff(v, axis=0) / gap[1:, None]
    steps = swing_on(path[:-1], acceleration=acceleration, velocity=v[:-1], air=air[:-1], step=gap[1:], length=0.3)
    np.testing.assert_allclose(steps, path[1:], rtol=1e-9, atol=1e-12)


@given(at=st.integers(1, 199), size=st.floats(-5, 5))
def test_swing_knows_no_later_row_and_starts_anew_after_a_gap(at: int, size: float) -> None:
    v, _ = pivot(0.01 * np.arange(200))
    path = still(200, velocity=v)
    changed = v.copy()
    changed[at:] += size
    before, after = swing_of(path, length=0.3), swing_of(replace(path, velocity=changed), length=0.3)
    np.testing.assert_array_equal(before[:at], after[:at])
    step = path.step.copy()
    step[at] = 0.0
    broken = swing_of(replace(path, step=step), length=0.3)
    np.testing.assert_array_equal(broken[at], [0, 0, -1, 0, 0, 0])
    apart = replace(path, time=path.time + np.where(np.arange(200) >= at, 0.5, 0.0))
    np.testing.assert_allclose(swing_of(apart, length=0.3), broken, atol=1e-9)
