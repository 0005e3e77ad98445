"""The rule of integration: simulations that step explicitly, in between, or semi-implicitly are followed exactly."""

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from rigid_body import State, step, step_jacobians
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
