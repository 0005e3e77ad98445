"""One step of the rigid body: simulations of any rule are followed exactly; fine integration, conservation laws, finite
differences and Monte Carlo as oracles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigid_body import State, bridge_covariance, step, step_jacobians
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from test_estimation_kernels import INERTIA, LEADS, MASS, R, forward, simulated

from crazyem.vehicle import GRAVITY

E3 = np.array([0.0, 0.0, 1.0])


def euler_step(x, thrust, torque, *, dt, impulse):
    """Explicit Euler (Zhao eq. 54 to 56): every derivative at the start of the step, that of roll, pitch, yaw too."""
    p, v, turn, w = x
    gyroscopic = np.cross(w, INERTIA @ w)
    force = thrust * E3 + MASS * impulse[:3] / dt
    return (
        p + dt * v,
        v + dt * (turn.apply(force) / MASS - GRAVITY * E3),
        Rotation.from_euler("ZYX", turn.as_euler("ZYX") + dt * angle_rates(turn, w)),
        w + dt * np.linalg.inv(INERTIA) @ (torque - gyroscopic) + impulse[3:],
    )


def angle_rates(turn, w):
    """Derivatives of yaw, pitch and roll: the body rate is what they cause about z, the y after that, x after that."""
    _, pitch, roll = turn.as_euler("ZYX")
    x = np.array([1.0, 0.0, 0.0])
    y = Rotation.from_rotvec([-roll, 0, 0]).apply([0.0, 1.0, 0.0])
    z = (Rotation.from_rotvec([-roll, 0, 0]) * Rotation.from_rotvec([0, -pitch, 0])).apply([0.0, 0.0, 1.0])
    return np.linalg.solve(np.column_stack([z, y, x]), w)


def upright(rng):
    """Motion whose pitch stays away from a right angle for some steps."""
    while True:
        x = some_motion(rng)
        if abs(x[2].as_euler("ZYX")[1]) < 1.0:
            return x[0], x[1], x[2], 0.3 * x[3]


def semi_implicit_step(x, thrust, torque, *, dt):
    """New velocities first, then positions with those; force along the attitude that the old rate leads to."""
    p, v, turn, w = x
    ahead = turn * Rotation.from_rotvec(dt * w)
    v = v + dt * (ahead.apply(thrust * E3) / MASS - GRAVITY * E3)
    w = w + dt * np.linalg.inv(INERTIA) @ (torque - np.cross(w, INERTIA @ w))
    return p + dt * v, v, turn * Rotation.from_rotvec(dt * w), w


def as_state(x):
    p, v, turn, w = x
    return State(p, v, turn.as_quat(), w)


def some_motion(rng):
    return rng.normal(size=3), rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=3) * 3.0


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 2e-2))
def test_an_explicit_simulation_is_predicted_exactly(seed, dt):
    rng = np.random.default_rng(seed)
    theirs = upright(rng)
    ours = as_state(theirs)
    for _ in range(20):
        thrust, torque, impulse = MASS * rng.uniform(5, 15), rng.normal(size=3) * 1e-5, rng.normal(size=6) * 0.02
        theirs = euler_step(theirs, thrust, torque, dt=dt, impulse=impulse)
        ours = step(ours, thrust, torque, dt=dt, mass=MASS, inertia=INERTIA, impulse=impulse, lead=0.0)
    np.testing.assert_allclose(error_between(ours, as_state(theirs)), 0.0, atol=1e-9)


def test_a_semi_implicit_simulation_is_predicted_exactly():
    rng = np.random.default_rng(1)
    theirs = some_motion(rng)
    ours = as_state(theirs)
    for _ in range(20):
        thrust, torque = MASS * rng.uniform(5, 15), rng.normal(size=3) * 1e-5
        theirs = semi_implicit_step(theirs, thrust, torque, dt=0.01)
        ours = step(ours, thrust, torque, dt=0.01, mass=MASS, inertia=INERTIA, lead=1.0)
    np.testing.assert_allclose(error_between(ours, as_state(theirs)), 0.0, atol=1e-9)


def test_near_a_right_angle_of_pitch_the_attitude_turns_as_a_rotation():
    turn = Rotation.from_euler("ZYX", [0.4, np.pi / 2 - 1e-6, 0.3])
    state = State(np.zeros(3), np.zeros(3), turn.as_quat(), np.array([2.0, 3.0, -4.0]))
    after = step(state, 0.3, np.zeros(3), dt=0.01, mass=MASS, inertia=INERTIA, lead=0.0)
    expected = turn * Rotation.from_rotvec(0.01 * state.body_rate)
    assert (Rotation.from_quat(after.attitude).inv() * expected).magnitude() < 1e-9


@pytest.mark.parametrize("lead", [0.0, 1.0])
def test_innovations_of_a_simulation_are_white_with_its_own_rule_only(lead):
    """A noisy simulation that steps by one rule: squared innovations are what the filter expects with that rule."""
    rng = np.random.default_rng(5)
    n, dt = 400, 0.02
    tape = simulated(rng, n, dt=dt, lead=lead, error=0.05)
    own = whiteness(tape, lead=lead)
    assert own == pytest.approx(1.0, abs=4 * np.sqrt(2 / (12 * n)))
    assert whiteness(tape, lead=1.0 - lead) > own + 0.5


def whiteness(tape, *, lead):
    """Mean square of the normalised innovations."""
    forward(tape, r=R * 0.05**2, lead=lead)
    return float(np.mean(tape.e[1:] ** 2 / tape.s[1:]))


# -- one step of the rigid body ----------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_those_of_finite_differences(lead, seed):
    rng = np.random.default_rng(seed)
    state, dt = some_state(rng), rng.uniform(1e-3, 1e-2)
    arguments = {"thrust": MASS * rng.uniform(5, 15), "torque": rng.normal(size=3) * 1e-5}
    arguments |= {"dt": dt, "mass": MASS, "inertia": INERTIA, "lead": lead}
    transition, noise = step_jacobians(state, **arguments)
    turn = np.linalg.norm(state.body_rate) * dt
    tolerance = dt**2 * 15.0 * turn * lead**2 + dt * turn**3 + 1e-8  # what is left out: third order in dt
    h = 1e-6
    for i, d in enumerate(h * np.eye(12)):
        plus, minus = (step(displaced(state, s * d), **arguments) for s in (1, -1))
        np.testing.assert_allclose(transition[:, i], error_between(plus, minus) / (2 * h), atol=tolerance)
        np.testing.assert_allclose(error_between(state.plus(d), state), d, atol=1e-14)
    for i, d in enumerate(h * np.eye(6)):
        plus, minus = (step(state, **arguments, impulse=s * d) for s in (1, -1))
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
