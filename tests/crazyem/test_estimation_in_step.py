"""Commands sampled in step with the onboard estimate: torques of unknown size as nuisance parameters."""

from dataclasses import replace

import numpy as np
import pytest

from crazyem.estimation import in_step, verdict
from crazyem.estimation.online import OnlineEstimator
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle


@pytest.mark.parametrize(
    ("period", "locked"),
    [(0.010, True), (0.020, True), (0.0101, True), (0.011, False), (0.009, False), (0.0125, False), (0.002, False)],
)
def test_which_periods_stay_in_step_with_predictions_every_10_ms(period, locked):
    late = 1e-3 * (np.random.default_rng(0).uniform(size=200) < 0.05)
    assert in_step.in_step(period * np.arange(200) + late, in_step.PERIOD) is locked


def test_few_stamps_tell_no_period():
    assert not in_step.in_step(0.01 * np.arange(5), in_step.PERIOD)


def test_an_onboard_estimate_whose_predictions_are_not_known_is_in_step_with_nothing():
    assert not in_step.in_step(0.01 * np.arange(200), 0.0)


@pytest.fixture(scope="module")
def turning():
    """An estimator that has seen 5 s of a drone turning about all axes, its commands as logged every 10 ms."""
    vehicle = load_vehicle("cf2")
    estimator = OnlineEstimator(vehicle, window=400, every=50, attitude_period=0.05, prediction_period=in_step.PERIOD)
    rng = np.random.default_rng(1)
    inertia, angle, rate, acts = np.array(vehicle.inertia), np.zeros(3), np.zeros(3), np.zeros(3)
    arm = np.array([vehicle.arm[1], vehicle.arm[0], vehicle.torque_per_thrust])
    signs = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]], float)
    volts = np.linspace(1.5, 4.0, 4000)
    curve = np.polynomial.polynomial.polyval(volts, vehicle.thrust_curve)
    for k in range(500):
        t = 0.01 * k
        torque = 1e-4 * np.sin(2 * np.pi * np.array([1.3, 1.9, 1.1]) * t) - inertia * (200 * angle + 25 * rate)
        rotors = vehicle.mass * 9.81 / 4 + signs.T @ (torque / arm) / 4
        command = np.interp(rotors, curve, volts) / 4.0
        half = np.append(angle / 2, 1.0)
        for name, value in (
            ("voltage", (4.0,)),
            ("flying", (1.0,)),
            ("motor_command", tuple(command)),
            ("position", tuple(np.array([0.0, 0.0, 1.0]) + 1e-3 * rng.normal(size=3))),
            ("velocity", tuple(5e-3 * rng.normal(size=3))),
            ("attitude", tuple(half / np.linalg.norm(half))),
            ("body_rate", tuple(rate + 2e-3 * rng.normal(size=3))),
        ):
            estimator.feed(Sample(name, t, value))
        for _ in range(10):
            acts = acts + (torque - acts) * (1 - np.exp(-1e-3 / vehicle.motor_time_constant))
            rate = rate + 1e-3 * (acts + 5e-6 / np.sqrt(1e-3) * rng.normal(size=3)) / inertia
            angle = angle + 1e-3 * rate
    return estimator


def plain(estimator):
    em, last = estimator._em, estimator._tape.size
    first = max(0, last - estimator.window)
    return em, first, last, em.converge(first, last, passes=3)


def test_information_of_the_sizes_by_differences_of_the_likelihood(turning):
    em, first, last, _ = plain(turning)
    shapes = in_step._shapes(em, first, last, em.tape.time[[first, last - 1]])
    _, among, score = em.torque_sensitivities(first, last, shapes)
    torque, small = em.tape.torque.copy(), 1e-2
    for k in (0, 4, 5, 8, 11):
        likelihoods = []
        for size in (-small, 0.0, small):
            em.tape.torque[:last] = torque[:last] + size * shapes[:, :, k]
            likelihoods.append(em.forward(first, last, restart=True))
        low, middle, high = likelihoods
        assert among[k, k] == pytest.approx((2 * middle - low - high) / small**2, rel=0.02, abs=1e-4)
        assert score[k] == pytest.approx((high - low) / (2 * small), abs=0.02 * (1.0 + np.sqrt(among[k, k])))
    em.tape.torque[:] = torque
    em.forward(first, last, restart=True)


def test_information_between_sizes_and_theta_by_torques_that_are_derivatives(turning):
    """A torque that acts as another lag, delay or offset has the information of these."""
    em, first, last, _ = plain(turning)
    unit, tape = em.setup.unit, em.tape
    shapes = np.zeros((last, 3, 2))
    shapes[:, :, 0] = unit[5] * tape.torque_delay[:last]
    shapes[:, 1, 1] = unit[7]
    tape.thrust_delay[:] = 0.0  # only what turns
    matrix = em.sensitivities(first, last)
    cross, among, score = em.torque_sensitivities(first, last, shapes)
    np.testing.assert_allclose(cross, matrix[:, [5, 7]], rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    np.testing.assert_allclose(among, matrix[np.ix_([5, 7], [5, 7])], rtol=1e-9)
    np.testing.assert_allclose(score, tape.score[first:last, [5, 7]].sum(0), rtol=1e-9, atol=1e-6)
    em.refill_inputs(first, last)


def test_nuisance_parameters_only_widen(turning):
    em, first, last, information = plain(turning)
    wider = in_step.corrected(em, first, last, information)
    assert (wider.open_sd >= np.abs(wider.shift)).all()
    assert (wider.open_sd[1:4] > 0.0).all()
    assert wider.open_sd[0] < 0.1 * information.sd[0]  # thrust is left as it was
    np.testing.assert_array_equal(wider.covariance, information.covariance)
    said = estimate(turning, wider), estimate(turning, information)
    assert all(said[0][name].sd > said[1][name].sd for name in ("Ixx", "Iyy", "Izz"))


def estimate(estimator, information):
    return verdict.estimate_of(
        estimator._em.parameters, estimator._setup, information, time=5.0, samples=400, updates=9, converged=True
    )


def test_the_step_is_that_of_theta_and_sizes_together(turning):
    """By elimination, in the other order: sizes first, then theta with what they explain taken off."""
    em, first, last, information = plain(turning)
    ends = em.tape.time[[first, last - 1]]
    cross, among, score = em.torque_sensitivities(first, last, in_step._shapes(em, first, last, ends))
    free, precision = em.setup.free, em.setup.prior.precision
    assert free.all()
    rest = np.linalg.inv(among + np.kron(np.eye(2), in_step.PRECISION))
    reduced = information.matrix + np.diag(precision) - cross @ rest @ cross.T
    expected = -np.linalg.solve(reduced, cross @ rest @ score)
    wider = in_step.corrected(em, first, last, information)
    np.testing.assert_allclose(wider.shift, expected, rtol=1e-6, atol=1e-9)
    added = np.linalg.inv(reduced) - np.linalg.inv(information.matrix + np.diag(precision))
    np.testing.assert_allclose(wider.open_sd**2, np.diag(added) + expected**2, rtol=1e-5, atol=1e-12)


def test_values_are_told_corrected(turning):
    information = replace(plain(turning)[3], shift=np.array([0, 0.1, -0.2, 0.3, 0, 0, 0, 0, 0]), open_sd=np.zeros(9))
    said = estimate(turning, information)
    theta = turning._em.parameters.theta
    values = np.array([said[name].value for name in ("mass", "Ixx", "Iyy", "Izz")])
    assert np.log(values / theta[:4]) == pytest.approx([0, 0.1, -0.2, 0.3])


def test_full_passes_of_a_log_in_step_are_corrected(turning):
    assert turning._information.shift is not None
    assert turning._information.shift[1:4].any()
