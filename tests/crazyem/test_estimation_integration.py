"""The rule of integration: simulations that step explicitly, in between, or semi-implicitly are followed exactly."""

import numpy as np
import pytest
import reference
import test_estimation_kernels as midpoint
from hypothesis import given
from hypothesis import strategies as st
from rigid_body import State, angular_acceleration, bridge_covariance, step, step_jacobians
from scipy.spatial.transform import Rotation
from test_estimation_kernels import INERTIA, MASS, Q, R, filled_tape, scaled

from crazyem.vehicle import GRAVITY

LEADS = [0.0, 0.3, 0.5, 1.0]
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


def assert_states_close(a: State, b: State, *, atol):
    for name in ("position", "velocity", "body_rate"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=atol)
    assert np.linalg.norm(reference.difference(a, b)[6:9]) < atol


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 2e-2))
def test_an_explicit_simulation_is_predicted_exactly(seed, dt):
    rng = np.random.default_rng(seed)
    theirs = upright(rng)
    ours = as_state(theirs)
    for _ in range(20):
        thrust, torque, impulse = MASS * rng.uniform(5, 15), rng.normal(size=3) * 1e-5, rng.normal(size=6) * 0.02
        theirs = euler_step(theirs, thrust, torque, dt=dt, impulse=impulse)
        ours = step(ours, thrust, torque, dt=dt, mass=MASS, inertia=INERTIA, impulse=impulse, lead=0.0)
    assert_states_close(ours, as_state(theirs), atol=1e-9)


def test_a_semi_implicit_simulation_is_predicted_exactly():
    rng = np.random.default_rng(1)
    theirs = some_motion(rng)
    ours = as_state(theirs)
    for _ in range(20):
        thrust, torque = MASS * rng.uniform(5, 15), rng.normal(size=3) * 1e-5
        theirs = semi_implicit_step(theirs, thrust, torque, dt=0.01)
        ours = step(ours, thrust, torque, dt=0.01, mass=MASS, inertia=INERTIA, lead=1.0)
    assert_states_close(ours, as_state(theirs), atol=1e-9)


def test_euler_angles_stepped_explicitly_differ_by_the_square_of_the_step_from_a_turn():
    """Zhao's simulation steps roll, pitch and yaw, which a turn by the rate differs from in dt^2."""
    rng = np.random.default_rng(3)
    state = as_state(upright(rng))
    turn = Rotation.from_quat(state.attitude)
    gap = []
    for dt in (0.01, 0.005):
        after = step(state, 0.3, np.zeros(3), dt=dt, mass=MASS, inertia=INERTIA, lead=0.0)
        turned = turn * Rotation.from_rotvec(dt * state.body_rate)
        gap.append((Rotation.from_quat(after.attitude).inv() * turned).magnitude())
    assert gap[0] == pytest.approx(4 * gap[1], rel=0.05)
    assert 0 < gap[0] < 2 * (np.linalg.norm(state.body_rate) * 0.01) ** 2


def test_near_a_right_angle_of_pitch_the_attitude_turns_as_a_rotation():
    turn = Rotation.from_euler("ZYX", [0.4, np.pi / 2 - 1e-6, 0.3])
    state = State(np.zeros(3), np.zeros(3), turn.as_quat(), np.array([2.0, 3.0, -4.0]))
    after = step(state, 0.3, np.zeros(3), dt=0.01, mass=MASS, inertia=INERTIA, lead=0.0)
    expected = turn * Rotation.from_rotvec(0.01 * state.body_rate)
    assert (Rotation.from_quat(after.attitude).inv() * expected).magnitude() < 1e-9


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_those_of_finite_differences(lead, seed):
    rng = np.random.default_rng(seed)
    state = as_state(some_motion(rng))
    dt = rng.uniform(1e-3, 1e-2)
    arguments = {"thrust": MASS * rng.uniform(5, 15), "torque": rng.normal(size=3) * 1e-5}
    arguments |= {"dt": dt, "mass": MASS, "inertia": INERTIA, "lead": lead}
    transition, noise = step_jacobians(state, **arguments)
    turn = np.linalg.norm(state.body_rate) * dt
    tolerance = dt**2 * 15.0 * turn * lead**2 + dt * turn**3 + 1e-8  # what is left out: third order in dt
    h = 1e-6
    for i in range(12):
        plus, minus = (step(state.plus(s * h * np.eye(12)[i]), **arguments) for s in (1, -1))
        np.testing.assert_allclose(transition[:, i], reference.difference(plus, minus) / (2 * h), atol=tolerance)
    for i in range(6):
        plus, minus = (step(state, **arguments, impulse=s * h * np.eye(6)[i]) for s in (1, -1))
        np.testing.assert_allclose(noise[:, i], reference.difference(plus, minus) / (2 * h), atol=tolerance)


def test_only_the_midpoint_rule_has_something_within_a_step():
    noise = np.ones((12, 6))
    assert bridge_covariance(noise, np.ones(6), dt=0.01).any()
    for lead in (0.0, 0.3, 1.0):
        assert not bridge_covariance(noise, np.ones(6), dt=0.01, lead=lead).any()


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_filter_and_smoother_are_the_textbook_ones(lead, missing):
    tape = filled_tape(3, missing=missing)
    value = midpoint.forward(tape, lead=lead)
    midpoint.backward(tape, lead=lead)
    filtered, smoothed = midpoint.twin(tape, lead=lead)
    assert value == pytest.approx(filtered.log_likelihood, rel=1e-9, abs=1e-6)
    for k in range(tape.size):
        midpoint.assert_same_state(tape.xp[k], filtered.predicted[k])
        midpoint.assert_same_state(tape.xf[k], filtered.filtered[k])
    np.testing.assert_allclose(scaled(tape.pp), scaled(filtered.predicted_cov, tape.pp), atol=1e-7)
    # as in test_estimation_kernels: equal to second order in the smoother's correction of the attitude
    force, acceleration = reference.expected_accelerations(
        tape.time, tape.thrust, tape.torque, smoothed, mass=MASS, inertia=INERTIA
    )
    spread = np.sqrt(Q / 0.01)
    np.testing.assert_allclose(tape.moments[1:, :3] / spread[:3], force[1:] / spread[:3], atol=0.02)
    np.testing.assert_allclose(tape.moments[1:, 3:6] / spread[3:], acceleration[1:] / spread[3:], atol=0.03, rtol=5e-3)


@pytest.mark.parametrize("lead", [0.0, 1.0])
@pytest.mark.parametrize("name", range(9))
def test_score_and_information_against_finite_differences(lead, name):
    tape = filled_tape(7, missing=0.2)
    midpoint.forward(tape, lead=lead)
    info = midpoint.sensitivities(tape, lead=lead)
    h = 1e-4
    (high, e_high), (low, e_low) = midpoint.moved(7, name, h, lead=lead), midpoint.moved(7, name, -h, lead=lead)
    sd = 1 / np.sqrt(info[name, name])
    assert tape.score[:, name].sum() * sd == pytest.approx((high - low) / (2 * h) * sd, abs=0.05)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.where(tape.s > 0, ((e_high - e_low) / (2 * h)) ** 2 / tape.s, 0.0)
    assert info[name, name] == pytest.approx(squares.sum(), rel=0.02)


@pytest.mark.parametrize("lead", [0.0, 1.0])
def test_innovations_of_a_simulation_are_white_with_its_own_rule_only(lead):
    """A noisy simulation that steps by one rule: squared innovations are what the filter expects with that rule."""
    rng = np.random.default_rng(5)
    n, dt = 400, 0.02
    tape = kernels_tape(rng, n, dt=dt, lead=lead)
    own = whiteness(tape, lead=lead)
    assert own == pytest.approx(1.0, abs=4 * np.sqrt(2 / (12 * n)))
    assert whiteness(tape, lead=1.0 - lead) > own + 0.5


def kernels_tape(rng, n, *, dt, lead):
    """A drone that tumbles slowly under noise, simulated with `step`'s own rule, all measured precisely."""
    tape = midpoint.Tape(n)
    x = State(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.5, -0.4, 0.3]))
    for k in range(n):
        if k:
            torque = INERTIA @ (-3.0 * x.body_rate + rng.normal(size=3))
            thrust = MASS * GRAVITY * rng.uniform(0.8, 1.2)
            impulse = rng.normal(size=6) * np.sqrt(Q * dt)
            x = step(x, thrust, torque, dt=dt, mass=MASS, inertia=INERTIA, impulse=impulse, lead=lead)
        error = rng.normal(size=12) * np.sqrt(R) * 0.05
        seen = x.plus(error)
        y = np.concatenate([seen.position, seen.velocity, seen.attitude, seen.body_rate])
        tape.append(k * dt, y, starts=k == 0, keep=n)
        if k:
            tape.mean[k] = [thrust, *torque]
        else:
            tape.xp[0] = np.concatenate([x.position, x.velocity, x.attitude, x.body_rate])
    tape.spread_inputs(0, n, np.zeros(3))
    tape.kind[0] = 0
    tape.pp[0] = np.diag(R * 0.05**2)
    return tape


def whiteness(tape, *, lead):
    """Mean square of the normalised innovations."""
    midpoint.forward(tape, r=R * 0.05**2, lead=lead)
    return float(np.mean(tape.e[1:] ** 2 / tape.s[1:]))


def test_angular_acceleration_at_the_end_is_not_needed():
    """The rules share one evaluation of Euler's equation, at the start of the step."""
    rng = np.random.default_rng(2)
    state, torque = as_state(some_motion(rng)), rng.normal(size=3) * 1e-5
    expected = state.body_rate + 0.01 * angular_acceleration(state.body_rate, torque, inertia=INERTIA)
    for lead in LEADS:
        after = step(state, 0.3, torque, dt=0.01, mass=MASS, inertia=INERTIA, lead=lead)
        np.testing.assert_allclose(after.body_rate, expected, rtol=1e-12)
