"""The paper's quadcopter, its state filter and a flight: against other integrators, finite differences and Table I."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_paper import plain_motion
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from crazyem.paper.flight import Flight, fly, reference
from crazyem.paper.plant import derivative, filter_step, step, transition
from crazyem.paper.settings import LITERAL, P5, Settings

GRAVITY = 9.81
INERTIA = np.array([2.5e-4, 3.1e-4, 2.0e-4])


# plant ----------------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 10**6))
def test_a_step_is_that_of_plain_matrices(seed):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.3, 1.3, 12)
    wrench, noise = rng.normal(size=(2, 4)) * [1.0, 1e-4, 1e-4, 1e-4]
    expected = plain_motion(x, wrench, noise, 0.005, 0.18, INERTIA)
    step(x, wrench, noise, 0.005, 0.18, INERTIA, False, np.empty(12))
    assert x == pytest.approx(expected, abs=1e-12)


def with_quaternions(_, y, thrust, torque):
    """The same drone in other coordinates: position, velocity, quaternion x y z w, angular momentum in the world."""
    attitude = Rotation.from_quat(y[6:10])
    spin = attitude.apply(attitude.inv().apply(y[10:]) / INERTIA)  # rate in the world
    x, z = y[6:9], y[9]
    quaternion = 0.5 * np.append(z * spin + np.cross(spin, x), -spin @ x)
    return np.concatenate(
        [y[3:6], attitude.apply([0, 0, thrust / 0.18]) - [0, 0, GRAVITY], quaternion, attitude.apply(torque)]
    )


def test_the_plant_tends_to_an_adaptive_integration_in_quaternions():
    """Without noise, error falling with the step as Euler's does."""
    thrust, torque = 2.1, np.array([3e-4, -2e-4, 1e-4])
    start = np.array([0.5, 1.0, 0.0, 0.2, -0.1, 0.3, 0.1, -0.2, 0.3, 1.0, -0.5, 0.8])
    attitude = Rotation.from_euler("xyz", start[6:9])
    y0 = np.concatenate([start[:6], attitude.as_quat(), attitude.apply(INERTIA * start[9:])])
    y = solve_ivp(with_quaternions, (0, 0.4), y0, args=(thrust, torque), rtol=1e-10, atol=1e-12).y[:, -1]
    end = Rotation.from_quat(y[6:10])
    exact = np.concatenate([y[:6], end.as_euler("xyz"), end.inv().apply(y[10:]) / INERTIA])
    errors = []
    for n in (400, 800, 1600):
        x, scratch = start.copy(), np.empty(12)
        for _ in range(n):
            step(x, np.array([thrust, *torque]), np.zeros(4), 0.4 / n, 0.18, INERTIA, False, scratch)
        errors.append(np.abs(x - exact).max())
    assert errors[2] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.05)


def test_a_floor_holds_until_thrust_exceeds_weight():
    scratch, at_rest = np.empty(12), np.zeros(12)
    weight = 0.18 * GRAVITY
    x = at_rest.copy()
    assert step(x, np.array([weight * 0.999, 1e-3, 0, 0]), np.zeros(4), 0.005, 0.18, INERTIA, True, scratch)
    assert np.array_equal(x, at_rest)
    assert np.all(scratch == 0)
    assert not step(x, np.array([weight * 1.001, 0, 0, 0]), np.zeros(4), 0.005, 0.18, INERTIA, True, scratch)
    assert x[5] > 0
    falling = np.array([1.0, 2.0, -1e-3, 0.3, 0.1, -2.0, 0.2, 0.1, 0.5, 1.0, 1.0, 1.0])
    assert step(falling, np.array([weight, 0, 0, 0]), np.zeros(4), 0.005, 0.18, INERTIA, True, scratch)
    assert falling.tolist() == [1.0, 2.0] + [0.0] * 10
    through = np.array([1.0, 2.0, -1e-3] + [0.0] * 9)  # without a floor it falls on
    assert not step(through, np.zeros(4), np.zeros(4), 0.005, 0.18, INERTIA, False, scratch)
    assert through[5] < 0


# state filter ---------------------------------------------------------------------------------------------------------


def printed_motion(x, acceleration, dt):
    """Eq. 58 by the plant's kinematics, acceleration as an input and the rate held."""
    out = np.empty(12)
    derivative(x, 0.0, np.zeros(3), 1.0, np.ones(3), out)
    out[3:6], out[9:] = acceleration, 0.0
    return x + dt * out


@given(seed=st.integers(0, 10**6))
def test_the_printed_jacobian_is_the_derivative_of_the_prediction(seed):
    x = np.random.default_rng(seed).uniform(-1, 1, 12)
    phi, h = np.empty((12, 12)), 1e-6
    transition(x, 0.005, phi)
    difference = [
        (printed_motion(x + h * e, np.ones(3), 0.005) - printed_motion(x - h * e, np.ones(3), 0.005)) / (2 * h)
        for e in np.eye(12)
    ]
    assert phi == pytest.approx(np.stack(difference, axis=1), abs=1e-8)


@given(seed=st.integers(0, 10**6))
def test_a_filter_step_is_that_of_whole_matrices(seed):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, 12)
    root = rng.normal(size=(12, 12))
    p = root @ root.T / 12
    acceleration, position, rate = rng.normal(size=(3, 3))
    got, got_p = x.copy(), p.copy()
    filter_step(got, got_p, acceleration, position, rate, 0.005, 0.0707, 0.00707)
    phi = np.empty((12, 12))
    transition(x, 0.005, phi)
    predicted, prior = printed_motion(x, acceleration, 0.005), phi @ p @ phi.T + 0.0707 * np.eye(12)
    h = np.eye(12)[[0, 1, 2, 9, 10, 11]]
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + 0.00707 * np.eye(6))
    assert got == pytest.approx(predicted + gain @ (np.r_[position, rate] - h @ predicted), abs=1e-9)
    assert got_p == pytest.approx(prior - gain @ h @ prior, abs=1e-9)


# flights --------------------------------------------------------------------------------------------------------------


def arrays(flight):
    return {
        name: getattr(flight, name) for name in ("truth", "estimate", "wrench", "readings", "contact", "_covariance")
    }


@given(data=st.data(), ground=st.booleans(), substeps=st.sampled_from([1, 3]))
def test_pieces_of_any_size_give_the_same_flight(data, ground, substeps):
    settings = Settings(duration=3.0, substeps=substeps)
    known = {"mass": settings.mass, "inertia": settings.inertia}
    whole, pieces = Flight(settings, 7, ground=ground), Flight(settings, 7, ground=ground)
    whole.advance(settings.steps, **known)
    while pieces.size <= settings.steps:
        pieces.advance(data.draw(st.integers(1, 250)), **known)
    for name, value in arrays(whole).items():
        assert np.array_equal(value, arrays(pieces)[name], equal_nan=True), name
    assert whole.lift_off == pieces.lift_off
    pieces.advance(10, **known)  # nothing is left to fly
    assert pieces.size == whole.size == settings.steps + 1


def test_what_only_sensors_b_and_c_read_does_not_move_the_drone():
    quiet = Settings(duration=1.0, position_sd=0.0, body_rate_sd=0.0, acceleration_sd=0.0)
    noisy = replace(quiet, velocity_sd=1.0, attitude_sd=1.0)
    assert np.array_equal(fly(quiet, 3).truth, fly(noisy, 3).truth)


def test_readings_are_truth_with_the_noise_that_was_set():
    flight = fly(replace(LITERAL, attitude_sd=0.03, velocity_sd=0.02), 5)
    error = (flight.readings[:, :12] - flight.truth).reshape(-1, 4, 3)
    assert error.std(axis=(0, 2)) == pytest.approx([0.0139, 0.02, 0.03, 0.0139], rel=0.03)
    moved = np.diff(flight.truth[:, 3:6], axis=0) / flight.settings.dt
    assert (flight.readings[1:, 12:15] - moved).std() == pytest.approx(0.0139, rel=0.03)
    attitude = Rotation.from_euler("xyz", flight.truth[:-1, 6:9])
    force = attitude.inv().apply(flight.readings[1:, 12:15] + [0, 0, GRAVITY])
    assert flight.readings[1:, 15:18] == pytest.approx(force, abs=1e-9)
    # what the specific force holds besides thrust over mass is the noise of thrust: s_F / (m sqrt(dt))
    rest = flight.readings[1:, 17] - flight.wrench[:-1, 0] / 0.18
    assert rest.std() == pytest.approx(0.005 / 0.18 / np.sqrt(0.005), rel=0.05)


def test_each_sensor_says_what_the_paper_gives_it():
    flight = fly(Settings(duration=0.1), 1)
    seen = {sensor: [(s.signal, round(s.time / 0.005)) for s in flight.samples(sensor, 3, 5)] for sensor in "ABC"}
    names = {sensor: [name for name, row in rows if row == 3] for sensor, rows in seen.items()}
    assert names["A"] == ["position", "body_rate", "specific_force", "wrench_command"]
    assert names["B"] == ["position", "velocity", "attitude", "body_rate", "wrench_command"]
    assert names["C"] == ["position", "velocity", "body_rate", "wrench_command"]
    last = list(flight.samples("B", flight.size - 1))
    assert "wrench_command" not in [s.signal for s in last]  # it is not decided yet
    angles = flight.readings[4, 6:9]
    attitude = next(s.value for s in flight.samples("B", 4, 5) if s.signal == "attitude")
    assert Rotation.from_quat(attitude).as_euler("xyz") == pytest.approx(angles, abs=1e-12)


def test_references_reach_the_waypoints_at_equal_times():
    steps, smooth = (reference(replace(Settings(), smooth=s)) for s in (False, True))
    points = np.array(Settings().waypoints)
    assert np.array_equal(steps[::800][:5, :3], points)
    assert smooth[800::800, :3] == pytest.approx(points)
    assert smooth[800::800, 3:] == pytest.approx(0.0, abs=1e-9)
    velocity = (smooth[2:, :3] - smooth[:-2, :3]) / 0.01
    acceleration = (smooth[2:, 3:6] - smooth[:-2, 3:6]) / 0.01
    assert velocity == pytest.approx(smooth[1:-1, 3:6], abs=1e-3)
    assert acceleration == pytest.approx(smooth[1:-1, 6:9], abs=1e-2)


def test_the_drone_passes_the_waypoints():
    for settings in (P5, LITERAL, replace(LITERAL, smooth=True)):
        flight = fly(settings, 2)
        miss = np.linalg.norm(flight.truth[800::800, :3] - np.array(settings.waypoints), axis=1)
        assert not flight.crashed
        assert miss.max() < 0.5


def test_table_1_and_figure_5_come_out():
    """Errors of one axis each: 0.0102, sd 0.0077, max 0.0524 m; 0.0104, 0.0083, 0.0867 rad. Twenty flights."""
    error = np.abs([(f := fly(LITERAL, seed)).estimate - f.truth for seed in range(20)])
    position, velocity, angles, rate = (error[..., i : i + 3] for i in (0, 3, 6, 9))
    assert position.mean() == pytest.approx(0.0102, rel=0.02)
    assert position.std() == pytest.approx(0.0077, rel=0.02)
    assert np.median(position.max(axis=(1, 2))) == pytest.approx(0.0524, rel=0.1)
    assert angles.mean() == pytest.approx(0.0104, rel=0.1)
    assert angles.std() == pytest.approx(0.0083, rel=0.2)
    assert angles.mean(axis=(1, 2)).max() < 0.025  # dead reckoning: flights differ
    assert np.mean(velocity < 0.03) > 0.95  # "below 3E-2 m/s for almost the whole trajectory"
    assert np.mean(angles < 0.03) > 0.95
    assert np.mean(rate < 0.15) > 0.6  # "most of the time"


def test_a_drone_that_believes_nonsense_crashes_and_says_so():
    flight = Flight(Settings(duration=4.0), 1)
    assert not flight.crashed
    flight.advance(800, mass=0.001, inertia=INERTIA)  # falls
    assert flight.crashed
    broken = Flight(Settings(duration=1.0), 1)
    broken.advance(200, mass=0.18, inertia=INERTIA * 1e6)
    assert broken.crashed
