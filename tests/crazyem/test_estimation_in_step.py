"""Commands sampled in step with the onboard estimate: torques of unknown size as nuisance parameters."""

import numpy as np
import pytest

from crazyem.estimation import in_step
from crazyem.estimation.online import OnlineEstimator
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle


@pytest.mark.parametrize(
    ("period", "locked"),
    [(0.010, True), (0.020, True), (0.0101, True), (0.011, False), (0.009, False), (0.0125, False), (0.002, False)],
)
def test_which_periods_stay_in_step_with_predictions_every_10_ms(period, locked):
    late = 1e-3 * (np.random.default_rng(0).uniform(size=200) < 0.05)
    assert in_step.in_step(period * np.arange(200) + late) is locked


def test_few_stamps_tell_no_period():
    assert not in_step.in_step(0.01 * np.arange(5))


@pytest.fixture(scope="module")
def turning():
    """An estimator that has seen 5 s of a drone turning about all axes, its commands as logged every 10 ms."""
    vehicle = load_vehicle("cf2")
    estimator = OnlineEstimator(vehicle, window=400, every=50, attitude_period=0.05)
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


def test_nuisance_parameters_only_widen(turning):
    em, first, last, information = plain(turning)
    wider = in_step.corrected(em, first, last, information)
    added = wider.covariance - information.covariance
    assert np.linalg.eigvalsh(added).min() > -1e-9 * np.abs(added).max()
    assert (wider.sd[1:5] > information.sd[1:5]).all()
    assert wider.sd[0] == pytest.approx(information.sd[0], rel=0.01)  # thrust is left as it was
    assert np.isfinite(wider.shift).all()


def test_the_tape_is_left_as_it_was(turning):
    em, first, last, information = plain(turning)
    names = ("torque_tau", "torque_delay", "thrust_tau", "thrust_delay", "score")
    before = {name: getattr(em.tape, name).copy() for name in names}
    in_step.corrected(em, first, last, information)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(em.tape, name), array)
    assert em.tape.score[first:last].any()


def test_values_are_told_corrected(turning):
    shift = turning._information.shift
    assert shift is not None
    assert shift[1:4].any()
    if turning._marginal is None:
        theta = turning._em.parameters.theta
        said = np.array([turning._estimate()[name].value for name in ("Ixx", "Iyy", "Izz")])
        assert np.log(said / theta[1:4]) == pytest.approx(shift[1:4], abs=1e-9)
