"""The paper's controller: gains by the Riccati equation, flatness there and back, thrust and torque in the plant."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from crazyem.control.lqg import SMALLEST_TILT_COSINE, control, position_gains, reference_angles, reference_rate
from crazyem.paper.plant import angle_rates, derivative

GRAVITY = 9.81
INERTIA = np.array([2.5e-4, 3.1e-4, 2.0e-4])
GAINS = np.array([4.0, 3.0, 40.0, 20.0])
weights = st.floats(0.01, 1000.0)


def double_integrator(dt):
    return np.array([[1.0, dt], [0.0, 1.0]]), np.array([[0.5 * dt * dt], [dt]])


@pytest.mark.parametrize("dt", [0.001, 0.005, 0.05])
@pytest.mark.parametrize(("position", "velocity"), [(16.0, 4.0), (1.0, 1.0), (400.0, 0.1)])
def test_gains_are_those_of_the_riccati_equation(dt, position, velocity):
    a, b = double_integrator(dt)
    p = solve_discrete_are(a, b, np.diag([position, velocity]), np.eye(1))
    wanted = np.linalg.solve(np.eye(1) + b.T @ p @ b, b.T @ p @ a)[0]
    assert position_gains(dt=dt, position_weight=position, velocity_weight=velocity) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_the_position_loop_has_margins(dt):
    """Broken at the acceleration; an optimal loop has 60 degrees in continuous time, and little less at these steps."""
    import control as ct

    a, b = double_integrator(dt)
    gains = position_gains(dt=dt, position_weight=16.0, velocity_weight=4.0)
    loop = ct.ss(a, b, gains[None], 0.0, dt)
    response = ct.frequency_response(loop, np.geomspace(0.1, 3.1 / dt, 2000))
    crossover = int(np.argmin(np.abs(np.log(response.magnitude))))
    assert np.degrees(response.phase[crossover]) > -180.0 + 55.0


def test_a_flight_does_not_wait_for_the_library_that_designs():
    code = "import sys, crazyem.control.lqg; assert 'control' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@given(position=weights, velocity=weights, dt=st.floats(0.001, 0.05))
def test_the_closed_loop_is_stable_and_optimal(position, velocity, dt):
    gains = position_gains(dt=dt, position_weight=position, velocity_weight=velocity)
    a, b = double_integrator(dt)
    closed = a - b @ gains[None]
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0

    def cost(k):
        """x0' P x0 for two starts, by summing the series by doubling."""
        m = a - b @ k[None]
        p, power = np.diag([position, velocity]) + np.outer(k, k), m
        for _ in range(40):
            p, power = p + power.T @ p @ power, power @ power
        return np.trace(p)

    best = cost(gains)
    for change in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * 0.02 * gains:
        assert cost(gains + change) >= best * (1 - 1e-12)


def test_gains_tend_to_the_continuous_closed_form():
    """K = sqrt(q), sqrt(r + 2 sqrt(q)) of a double integrator."""
    gains = position_gains(dt=1e-4, position_weight=16.0, velocity_weight=4.0)
    assert gains == pytest.approx([4.0, np.sqrt(4.0 + 8.0)], rel=1e-3)


@given(acceleration=st.tuples(*[st.floats(-8, 8)] * 3), yaw=st.floats(-3, 3))
def test_flatness_there_and_back(acceleration, yaw):
    """Thrust of the size returned along body z of the angles returned gives the acceleration; x_B lies above x_C."""
    angles = np.empty(3)
    size = reference_angles(np.array(acceleration), yaw, angles)
    attitude = Rotation.from_euler("xyz", angles).as_matrix()
    assert attitude[:, 2] * size - [0, 0, GRAVITY] == pytest.approx(acceleration, abs=1e-9)
    assert attitude[:, 0] @ [-np.sin(yaw), np.cos(yaw), 0] == pytest.approx(0.0, abs=1e-9)  # eq. 12


def test_free_fall_asks_for_no_attitude():
    angles = np.empty(3)
    assert reference_angles(np.array([0.0, 0.0, -GRAVITY]), 0.7, angles) < 1e-9
    assert angles.tolist() == [0.0, 0.0, 0.7]


@given(seed=st.integers(0, 10**6))
def test_the_rate_wanted_moves_the_angles_towards_theirs(seed):
    """Through the plant's own kinematics (eq. 47), which is the inverse of eq. 21."""
    rng = np.random.default_rng(seed)
    angles, wanted = rng.uniform(-1, 1, (2, 3))
    rate, moves = np.empty(3), np.empty(3)
    reference_rate(angles, wanted, 40.0, rate)
    angle_rates(angles, rate, moves)
    assert moves == pytest.approx(-40.0 * (angles - wanted), abs=1e-9)


def test_yaw_takes_the_short_way():
    rate = np.empty(3)
    reference_rate(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, -3.0]), 1.0, rate)
    assert rate[2] == pytest.approx(2 * np.pi - 6.0)


def commanded(state, reference, *, mass=0.18, inertia=INERTIA, limit=1e9, gains=GAINS):
    wrench = np.empty(4)
    control(state, reference, 0.0, gains, limit, mass, inertia, wrench)
    return wrench


def test_at_rest_at_the_reference_it_hovers():
    state, reference = np.zeros(12), np.zeros(9)
    state[:3] = reference[:3] = 4.0, 3.0, 3.0
    assert commanded(state, reference) == pytest.approx([0.18 * GRAVITY, 0, 0, 0], abs=1e-12)


@given(seed=st.integers(0, 10**6))
def test_with_the_true_parameters_the_plant_does_what_is_wanted(seed):
    """Vertical acceleration of eq. 82 and angular acceleration K_omega (w_ref - w), whatever the state."""
    rng = np.random.default_rng(seed)
    state, reference = rng.uniform(-0.5, 0.5, 12), rng.uniform(-0.5, 0.5, 9)
    wrench, rates = commanded(state, reference), np.empty(12)
    derivative(state, wrench[0], wrench[1:], 0.18, INERTIA, rates)
    error = state[:6] - reference[:6]
    acceleration = reference[6:] - 4.0 * error[:3] - 3.0 * error[3:]
    assert rates[5] == pytest.approx(acceleration[2], abs=1e-9)
    angles, rate = np.empty(3), np.empty(3)
    reference_angles(acceleration, 0.0, angles)
    reference_rate(state[6:9], angles, 40.0, rate)
    assert rates[9:] == pytest.approx(20.0 * (rate - state[9:]), rel=1e-9, abs=1e-9)


def test_believed_mass_and_inertia_scale_thrust_and_torque():
    rng = np.random.default_rng(3)
    state, reference = rng.uniform(-0.5, 0.5, 12), np.zeros(9)
    once = commanded(state, reference)
    twice = commanded(state, reference, mass=0.36, inertia=2 * INERTIA)
    assert twice == pytest.approx(2 * once)


def test_acceleration_is_limited_in_size_not_in_direction():
    state, reference = np.zeros(12), np.zeros(9)
    reference[:3] = 3.0, 0.0, 4.0
    wrench = commanded(state, reference, limit=5.0)
    assert wrench[0] == pytest.approx(0.18 * (4.0 + GRAVITY))  # 4/5 of the limit


def test_thrust_is_bounded_near_upside_down_and_never_negative():
    state, reference = np.zeros(12), np.zeros(9)
    state[6] = np.pi / 2
    assert commanded(state, reference)[0] == pytest.approx(0.18 * GRAVITY / SMALLEST_TILT_COSINE)
    state[6], reference[2] = 0.0, -100.0
    assert commanded(state, reference)[0] == 0.0
