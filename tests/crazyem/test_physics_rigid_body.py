"""One step of the rigid body: fine integration, conservation laws, finite differences and Monte Carlo as oracles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from rigid_body import State, bridge_covariance, step, step_jacobians
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from crazyem.vehicle import GRAVITY

MASS = 0.036
INERTIA = np.array([[2.0e-5, 1e-6, -5e-7], [1e-6, 2.1e-5, 8e-7], [-5e-7, 8e-7, 3.6e-5]])
seeds = st.integers(0, 2**32 - 1)


def some_state(rng: np.random.Generator, rate: float = 3.0) -> State:
    return State(rng.normal(size=3), rng.normal(size=3), Rotation.random(random_state=rng).as_quat(),
                 rng.normal(size=3) * rate)  # fmt: skip


def flat(state: State) -> np.ndarray:
    """Position, velocity, rotation matrix, rate: no sign of the quaternion to worry about."""
    matrix = Rotation.from_quat(state.attitude).as_matrix()
    return np.concatenate([state.position, state.velocity, matrix.ravel(), state.body_rate])


def exact(state: State, thrust: float, torque: np.ndarray, span: float) -> np.ndarray:
    """The same motion by scipy, with the rotation matrix as state: dR/dt = R [w]x."""

    def motion(_, x):
        turn, w = x[6:15].reshape(3, 3), x[15:]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        force = turn[:, 2] * thrust / MASS - np.array([0, 0, GRAVITY])
        alpha = np.linalg.solve(INERTIA, torque - np.cross(w, INERTIA @ w))
        return np.concatenate([x[3:6], force, (turn @ cross).ravel(), alpha])

    solution = solve_ivp(motion, (0, span), flat(state), rtol=1e-11, atol=1e-12)
    return solution.y[:, -1]


def test_global_error_shrinks_with_the_order_of_the_method():
    """Midpoint in velocity and attitude, Euler in the rate: halving dt at least halves the error, and it is small."""
    rng = np.random.default_rng(1)
    state, thrust, torque = some_state(rng), MASS * 11.0, rng.normal(size=3) * 2e-5
    truth = exact(state, thrust, torque, 0.2)
    errors = []
    for n in (20, 40, 80, 160):
        x = state
        for _ in range(n):
            x = step(x, thrust, torque, dt=0.2 / n, mass=MASS, inertia=INERTIA)
        errors.append(np.abs(flat(x) - truth).max())
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert np.all(ratios > 1.85)
    assert errors[0] < 0.05


def test_without_gyroscopic_coupling_the_step_is_second_order():
    """About one principal axis the rate is exact, so the midpoint rule shows its order."""
    torque = np.array([0.0, 0.0, 3e-5])
    inertia = np.diag([2e-5, 2e-5, 3.6e-5])
    tilt = Rotation.from_rotvec([0.4, 0.0, 0.0])
    truth_angle = 0.5 * torque[2] / inertia[2, 2] * 0.2**2 + 4.0 * 0.2
    for n in (5, 10):
        x = State(np.zeros(3), np.zeros(3), tilt.as_quat(), np.array([0.0, 0.0, 4.0]))
        for _ in range(n):
            x = step(x, 0.4, torque, dt=0.2 / n, mass=MASS, inertia=inertia)
        turned = (tilt.inv() * Rotation.from_quat(x.attitude)).as_rotvec()
        np.testing.assert_allclose(turned, [0, 0, truth_angle], atol=1e-12)
        acceleration = tilt.as_matrix()[:, 2] * 0.4 / MASS - np.array([0, 0, GRAVITY])
        np.testing.assert_allclose(x.velocity, 0.2 * acceleration, atol=1e-12)
        np.testing.assert_allclose(x.position, 0.5 * 0.2**2 * acceleration, atol=1e-12)


@given(seeds)
def test_local_error_of_one_step(seed):
    """In one step of 10 ms at flight rates: 1e-5 m and m/s per step, 1e-4 in attitude, 1 % of a rad/s in the rate."""
    rng = np.random.default_rng(seed)
    state, thrust, torque = some_state(rng, 1.0), MASS * rng.uniform(5, 15), rng.normal(size=3) * 2e-5
    error = np.abs(flat(step(state, thrust, torque, dt=0.01, mass=MASS, inertia=INERTIA))
                   - exact(state, thrust, torque, 0.01))  # fmt: skip
    assert error[:3].max() < 2e-4
    assert error[3:6].max() < 2e-3
    assert error[6:15].max() < 2e-3
    assert error[15:].max() < 0.03


def test_free_rotation_conserves_angular_momentum():
    state = State(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, -2.0, 1.5]))

    def momentum(x: State) -> np.ndarray:
        return Rotation.from_quat(x.attitude).as_matrix() @ INERTIA @ x.body_rate

    drift = []
    for n in (500, 1000):
        x = state
        for _ in range(n):
            x = step(x, 0.0, np.zeros(3), dt=1.0 / n, mass=MASS, inertia=INERTIA)
        drift.append(np.linalg.norm(momentum(x) - momentum(state)) / np.linalg.norm(momentum(state)))
        np.testing.assert_allclose(np.linalg.norm(x.attitude), 1.0, rtol=1e-12)
        np.testing.assert_allclose(x.velocity, [0, 0, -GRAVITY], rtol=1e-9)
    assert drift[1] < 0.55 * drift[0] < 2e-3


def test_an_impulse_is_a_jump_of_velocity_and_rate():
    rng = np.random.default_rng(3)
    state, torque, dt = some_state(rng), rng.normal(size=3) * 1e-5, 0.01
    impulse = rng.normal(size=6) * 0.1
    without = step(state, 0.3, torque, dt=dt, mass=MASS, inertia=INERTIA)
    jumped = step(state, 0.3, torque, dt=dt, mass=MASS, inertia=INERTIA, impulse=impulse)
    np.testing.assert_allclose(jumped.body_rate - without.body_rate, impulse[3:], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(jumped.velocity - without.velocity), np.linalg.norm(impulse[:3]))
    np.testing.assert_allclose(jumped.position - without.position, dt / 2 * (jumped.velocity - without.velocity))


def error_between(a: State, b: State) -> np.ndarray:
    """a minus b as an error (12,), by scipy."""
    turn = (Rotation.from_quat(b.attitude).inv() * Rotation.from_quat(a.attitude)).as_rotvec()
    return np.concatenate([a.position - b.position, a.velocity - b.velocity, turn, a.body_rate - b.body_rate])


def displaced(x: State, error: np.ndarray) -> State:
    attitude = (Rotation.from_quat(x.attitude) * Rotation.from_rotvec(error[6:9])).as_quat()
    return State(x.position + error[:3], x.velocity + error[3:6], attitude, x.body_rate + error[9:])


@given(seeds)
def test_jacobians_are_those_of_finite_differences(seed):
    rng = np.random.default_rng(seed)
    state = some_state(rng)
    values = {"thrust": MASS * rng.uniform(5, 15), "torque": rng.normal(size=3) * 1e-5}
    constants = {"dt": rng.uniform(1e-3, 2e-2), "mass": MASS, "inertia": INERTIA}
    transition, noise = step_jacobians(state, **values, **constants)
    # what is left out: half a step's turn taken as small, third order in dt all together
    half, dt, acceleration = np.linalg.norm(state.body_rate) * constants["dt"] / 2, constants["dt"], 15.0
    tolerance = 0.25 * dt**2 * acceleration * half + dt * (2 * half) ** 3 + 1e-8
    h = 1e-6
    for i in range(12):
        d = np.eye(12)[i] * h
        plus, minus = (step(displaced(state, s * d), **values, **constants) for s in (1, -1))
        numeric = error_between(plus, minus) / (2 * h)
        np.testing.assert_allclose(transition[:, i], numeric, atol=tolerance)
        np.testing.assert_allclose(error_between(state.plus(d), state), d, atol=1e-14)
    for i in range(6):
        d = np.eye(6)[i] * h
        plus, minus = (step(state, **values, **constants, impulse=s * d) for s in (1, -1))
        np.testing.assert_allclose(noise[:, i], error_between(plus, minus) / (2 * h), atol=tolerance)


def test_bridge_covariance_against_brownian_motion():
    """A Brownian velocity pinned at both ends leaves its integral, the position, uncertain: as a fine walk shows."""
    rng = np.random.default_rng(5)
    dt, n, fine = 0.01, 4000, 50
    increments = rng.normal(size=(n, fine, 6)) * np.sqrt(dt / fine)
    walk = np.concatenate([np.zeros((n, 1, 6)), np.cumsum(increments, 1)], 1)
    integral = ((walk[:, :-1] + walk[:, 1:]) / 2).sum(1) * dt / fine
    within = integral - walk[:, -1] * dt / 2  # what the step says, given both ends, is missing
    q = np.array([0.1, 0.2, 0.3, 30.0, 40.0, 50.0]) ** 2
    state = State(np.zeros(3), np.zeros(3), Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat(), np.zeros(3))
    _, noise = step_jacobians(state, 0.0, np.zeros(3), dt=dt, mass=MASS, inertia=INERTIA)
    scaled = within * np.sqrt(q)
    turn = Rotation.from_quat(state.attitude).as_matrix()
    observed = np.zeros((12, 12))
    observed[:3, :3] = turn @ np.cov(scaled[:, :3].T) @ turn.T
    observed[6:9, 6:9] = np.cov(scaled[:, 3:].T)
    ours = bridge_covariance(noise, q, dt=dt)
    scale = np.sqrt(np.diag(ours))
    seen = np.outer(scale, scale) > 0
    assert np.array_equal(np.flatnonzero(scale), [0, 1, 2, 6, 7, 8])
    # correlations: relative error of a variance from n draws is sqrt(2/n) = 2.2 %; four of those
    np.testing.assert_allclose((observed / np.where(seen, np.outer(scale, scale), 1))[seen],
                               (ours / np.where(seen, np.outer(scale, scale), 1))[seen], atol=0.09)  # fmt: skip
