"""Posterior odds of a weak rotor or a load by the steady numbers of several flights, and what days of a drone are."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from test_diagnosis_balance import EACH, LOAD, SD, TRIMMED, balance, rotor

from crazyem.diagnosis.fitting.candidates import TRIM
from crazyem.diagnosis.fitting.days import day_freedom, day_sd
from crazyem.diagnosis.fitting.fit import local_precision, log_prior
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.naming.answer import _by_the_day
from crazyem.diagnosis.naming.baseline import spread_of, with_baseline
from crazyem.diagnosis.naming.steady_odds import decided_by_balance, explanations
from crazyem.errors import UsageError
from crazyem.vehicle import Days


def chances(*lacks):
    found = explanations([balance(lack) for lack in lacks])
    weights = np.array([weight for weight, _ in found.values()])
    return dict(zip(found, np.exp(weights - np.logaddexp.reduce(weights)), strict=True)), found


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_rotor_that_is_weak_in_every_flight_is_found_with_its_share(number):
    rng = np.random.default_rng(number)
    days = [0.3 * EACH[number - 1] + SD * rng.standard_normal(4) for _ in range(3)]
    chance, found = chances(*days)
    assert max(chance, key=chance.get) == ("rotor", number)
    assert chance["rotor", number] > 0.9
    assert found["rotor", number][1][0] == pytest.approx(0.3, abs=0.08)


def test_days_that_differ_are_nothing():
    """Two days of opposite signs: the first alone would be a weak rotor."""
    one = 0.25 * EACH[0]
    assert chances(one)[0]["", 0] < 0.5
    assert chances(one, -one)[0]["", 0] > 0.5
    assert chances(np.zeros(4))[0]["", 0] > 0.9


def test_healthy_drones_are_rarely_accused():
    """80 drones of two flights each, whose days scatter as they should: the prior is 0.05 for each effect."""
    rng = np.random.default_rng(5)
    accused = 0
    for _ in range(80):
        chance, _ = chances(*(SD * stats.t.rvs(8, size=4, random_state=rng) for _ in range(2)))
        accused += sum(p for (name, _), p in chance.items() if name in ("rotor", "load")) > 0.5
    assert accused <= 2  # 3 %


def test_a_load_has_no_torque_about_z():
    heavier = np.array([0.15, 0.15 * 0.02, -0.15 * 0.01, 0.0])
    chance, found = chances(heavier, heavier)
    assert max(chance, key=chance.get) == ("load", 0)
    assert found["load", 0][1][0] == pytest.approx(0.15, abs=0.02)


def test_a_load_is_as_sure_as_the_day_s_thrust_and_at_the_edge_as_the_torque_that_needs_it():
    """3.5 g are a tenth of this drone. Thrust differs by 2 %, and 0.5 mm of torque over thrust need 1.25 % at 40 mm."""
    shown = balance([0.1, 0.0, 0.0, 0.0])
    whole = TRIMMED.mass / 0.9
    for place, sd in ((0.01, 0.02), (0.0396, (0.02**-2 + (0.04 / 5e-4) ** 2) ** -0.5)):
        point = Point(TRIMMED, {"payload": {"mass": 0.1 * whole, "x": 0.0, "y": place, "z": 0.0}}, start_noise())
        found = _by_the_day(LOAD, point, shown)
        assert found["mass"].sd == pytest.approx(sd * whole / 0.9)
        assert found["y"].sd == pytest.approx(5e-4 / 0.1)
        assert found["y"].ci95[1] <= 0.04


def test_the_balance_alone_speaks_of_weak_rotors_only_where_a_trim_is_known():
    assert decided_by_balance(TRIMMED, rotor(1))
    assert decided_by_balance(TRIMMED, LOAD)
    assert not decided_by_balance(TRIMMED, rotor(1, onset=3.0))
    assert not decided_by_balance(DRONE, rotor(1))
    assert not decided_by_balance(replace(DRONE, effects={TRIM: dict.fromkeys("xyz", 0.0)}), rotor(1))


@given(st.floats(-1e2, 1e2), st.floats(1e-3, 1e3), st.floats(1.0, 50.0))
def test_a_heavy_tail_is_student_s_t_and_its_local_precision_never_lowers_it(away, precision, freedom):
    here, w, nu = np.array([away]), np.array([precision]), np.array([freedom])
    t = stats.t(freedom, scale=precision**-0.5)
    assert log_prior(here, w, nu) == pytest.approx(t.logpdf(away) - t.logpdf(0.0), rel=1e-6, abs=1e-9)
    local = local_precision(here, w, nu)
    for other in away * np.array([-1.5, 0.0, 0.3, 0.9, 1.1, 2.0]):
        touching = log_prior(here, w, nu) - 0.5 * float(local[0]) * (other**2 - away**2)
        assert log_prior(np.array([other]), w, nu) >= touching - 1e-9 * (1.0 + abs(touching))


def test_normal_priors_stay_normal():
    away, precision, freedom = np.array([3.0, -1.0]), np.array([4.0, 0.0]), np.full(2, np.inf)
    assert log_prior(away, precision, freedom) == pytest.approx(-18.0)
    np.testing.assert_array_equal(local_precision(away, precision, freedom), precision)


def test_the_spread_of_days_goes_from_that_of_other_drones_to_the_drone_s_own():
    rng = np.random.default_rng(3)
    usual = np.array([1.0, 1.0])
    mean, sd = spread_of(np.array([[1.0, 2.0], [1.0, 2.0]]), usual)
    np.testing.assert_allclose(mean, [1.0, 2.0])
    np.testing.assert_allclose(sd, np.sqrt(2.0 / 3.0 * 1.5))  # two flights that agree: still mostly other drones
    _, sd = spread_of(0.2 * rng.standard_normal((400, 2)), usual)
    np.testing.assert_allclose(sd, 0.2, rtol=0.1)


def test_a_vehicle_says_how_its_days_differ():
    assert (day_sd(DRONE), day_freedom(DRONE)) == ((0.02, 5e-4, 5e-4, 1.6e-4), 8.0)
    known = replace(DRONE, days=Days(5, 0.01, (1e-4, 2e-4, 3e-4)))
    assert (day_sd(known), day_freedom(known)) == ((0.01, 1e-4, 2e-4, 3e-4), 6.0)


def test_one_healthy_flight_says_nothing_of_days():
    with pytest.raises(UsageError, match="two healthy flights"):
        with_baseline(DRONE, [object()])
