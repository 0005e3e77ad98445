"""What a drone needs to hover against what days differ by: a weak rotor, a load, a wind, by one flight and several."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, LOAD, THRUST, WIND, nominal_of, rotor
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.days import day_freedom, day_sd
from crazyem.diagnosis.fitting.fit import Data, DivergedError, local_precision, log_prior
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.naming import balance as balancing
from crazyem.diagnosis.naming.answer import _by_the_day, _steady_rivals
from crazyem.diagnosis.naming.balance import (
    FREE,
    Balance,
    balance_loglik,
    balance_of,
    by_balance,
    decided_by_balance,
    explanations,
    hidden_by_daily_variation,
    log_odds_by_balance,
    rotor_loss,
    rotor_signatures,
    steady,
)
from crazyem.diagnosis.naming.steady import spread_of, with_baseline
from crazyem.diagnosis.naming.trials import Trial
from crazyem.errors import UsageError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.vehicle import Days, Vehicle

DAYS = 8.0  # degrees of freedom
SD = np.array([0.02, 5e-4, 5e-4, 1.6e-4])  # thrust, relative; torque over thrust, m
ARM, TURN = 0.033, 0.006  # m
# Rotors 1 to 4 are front right, rear right, rear left, front left; 1 and 3 turn counter-clockwise and drag clockwise.
PLACES = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) * ARM
DRAGS = np.array([-1, 1, -1, 1]) * TURN
# a force f up at (x, y) turns by (y f, -x f)
EACH = np.column_stack([np.full(4, 0.25), -0.25 * PLACES[:, 1], 0.25 * PLACES[:, 0], -0.25 * DRAGS])
TRIMMED = replace(DRONE, effects={TRIM: {"x": 2e-4, "y": -3e-4, "z": 9e-4}, "thrust_scale": {"scale": 0.97}})


def balance(lack: NDArray) -> Balance:
    return Balance(np.asarray(lack, float), np.diag(SD**2), EACH, DAYS)


def loaded(share: float, x: float, y: float) -> NDArray:
    """A load of a share of the whole weight at (x, y) m: thrust acts beside the centre of mass."""
    return np.array([share, -share * y, share * x, 0.0])


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_weak_rotor_is_told_from_every_other_and_from_a_load_by_its_drag(number: int) -> None:
    shown = balance(0.3 * EACH[number - 1])
    assert rotor_loss(shown, number)[0] == pytest.approx(0.3)
    assert balance_loglik(shown, "rotor_fault", {"rotor": number}) == pytest.approx(-1.0)
    for other in (*(rotor(k) for k in (1, 2, 3, 4) if k != number), WIND, THRUST):
        told = log_odds_by_balance(shown, rotor(number), other)
        assert told > 3.0
    # 0.3 of a rotor is 0.45 mm of drag torque, 2.8 days
    told = log_odds_by_balance(shown, rotor(number), LOAD)
    assert told == pytest.approx(0.5 * (DAYS + 4) * np.log1p((0.3 * 0.25 * TURN / SD[3]) ** 2 / DAYS) + 2.0)


def test_no_load_is_further_out_than_the_drone() -> None:
    """2.3 mm of torque over thrust with no thrust missing: 40 mm from the middle it would be 6 % of the weight."""
    distance = 0.0023 / 0.04
    nearest = min(((m / SD[0]) ** 2 + (0.0023 - 0.04 * m) ** 2 / SD[1] ** 2) for m in np.linspace(0.0, distance, 2000))
    found = balance_loglik(balance(np.array([0.0, -0.0023, 0.0, 0.0])), "payload", {})
    assert found == pytest.approx(-0.5 * (DAYS + 4) * np.log1p(nearest / DAYS) - 3.0, abs=1e-3)
    assert found < -4.0


def test_a_healthy_drone_is_best_explained_by_nothing_and_two_weak_rotors_by_a_load() -> None:
    assert all(
        balance_loglik(balance(np.zeros(4)), name, {"rotor": 1}) == pytest.approx(-FREE[effect.imbalance], abs=1e-6)
        for name, effect in CATALOGUE.items()
        if effect.imbalance
    )
    two = balance(0.2 * (EACH[2] + EACH[3]))
    assert balance_loglik(two, "payload", {}) == pytest.approx(-3.0, abs=1e-3)  # left rotors: their drags cancel


@given(st.floats(0.0, 0.3), st.floats(-0.04, 0.04), st.floats(-0.04, 0.04), st.floats(-3, 3), st.floats(-3, 3))
def test_the_nearest_load_is_as_near_as_any_on_a_grid(share, x, y, thrust, twist) -> None:
    shown = balance(loaded(share, x, y) + SD * [thrust, 0.0, 0.0, twist])
    shares, xs, ys = np.meshgrid(np.linspace(0, 0.49, 50), np.linspace(-0.04, 0.04, 41), np.linspace(-0.04, 0.04, 41))
    tried = np.stack([shares, -shares * ys, shares * xs, np.zeros_like(xs)], -1)
    distance = float(np.square((shown.lack - tried) / SD).sum(-1).min())
    found = balance_loglik(shown, "payload", {})
    assert found >= -0.5 * (DAYS + 4) * np.log1p(distance / DAYS) - 3.0 - 1e-3
    assert found <= -3.0 + 1e-9


def test_days_are_drawn_with_the_uncertainty_that_is_told() -> None:
    """Of 400 drones with a rotor weaker by 0.2, on days of a covariance that is known from few, 95 % are held."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        day = SD * rng.standard_normal(4) * np.sqrt(DAYS / rng.chisquare(DAYS))
        lack, sd = rotor_loss(balance(0.2 * EACH[2] + day), 3)
        held += abs(lack - 0.2) < sd * stats.t.ppf(0.975, DAYS)
    assert held / 400 == pytest.approx(0.95, abs=0.03)


def test_what_moves_no_balance_or_sets_in_later_is_not_weighed() -> None:
    shown = balance(0.2 * EACH[0])
    assert balance_loglik(shown, "linear_drag", {}) is None
    assert log_odds_by_balance(shown, rotor(1), DRAG) is None
    assert log_odds_by_balance(shown, rotor(1, onset=4.0), LOAD) is None
    assert not steady(rotor(1, onset=4.0))


def test_the_balance_of_a_flight_is_what_was_hidden_in_it() -> None:
    """The file is of a drone with a twist and 0.97 of the thrust; another day has 1 % more thrust and another twist."""
    hidden = Hidden(twist=9e-4 + 2e-4, thrust=(0.98,) * 4)
    data, point = nominal_of(fly(hidden, seconds=9.0, seed=4), vehicle=TRIMMED)
    found = balance_of(data, point)
    assert found.lack[0] == pytest.approx(1.0 - 0.98 / 0.97, abs=2e-3)
    # the made drone has no trim about x and y, the file has
    assert found.lack[1:] == pytest.approx([-2e-4, 3e-4, 2e-4], abs=3e-5)
    sd = np.sqrt(np.diag(found.covariance))
    assert np.all(sd >= SD)
    assert np.all(sd < 1.5 * SD)
    assert found.rotors == pytest.approx(rotor_signatures(data, point))
    # each rotor's torque by its thrust; the twist is held against by those that turn one way
    assert found.rotors / found.rotors[:, :1] == pytest.approx(EACH / EACH[:, :1])
    assert found.rotors[:, 0] == pytest.approx(0.25 + 0.25 * 1.1e-3 / TURN * np.array([1, -1, 1, -1]), abs=5e-3)


def test_a_name_stands_unless_another_is_better_or_a_simpler_one_no_worse(monkeypatch) -> None:
    """A load of three numbers gives way to a rotor of one, where its drag is there; a rotor to a load, where two rotors
    are weak."""
    instead: list[Trial] = []
    sized: list[float] = []
    monkeypatch.setattr(balancing, "_instead", lambda data, s, old, trial: instead.append(trial) or s)
    monkeypatch.setattr(balancing, "_sized", lambda data, s, mine, values: sized.append(values["scale"]) or s)
    fitted: Any = SimpleNamespace()

    def trial(candidate: Candidate) -> Trial:
        return Trial(candidate, 100.0, 100.0, 1.0, 100.0, fitted=fitted)

    unfitted = replace(trial(THRUST), fitted=None)
    point = Point(TRIMMED, {}, start_noise())
    data: Any = None
    left = loaded(0.08, 0.0, 0.03)
    for lack, name, rival, taken in (
        (0.25 * EACH[2], LOAD, rotor(3), "rotor_fault"),  # as good, and simpler
        (left, LOAD, rotor(3), ""),
        (left, rotor(3), LOAD, "payload"),
        (0.25 * EACH[2], rotor(3), LOAD, ""),
        (0.1 * EACH[2], rotor(3), LOAD, ""),  # too little to tell
    ):
        shown = balance(lack)
        trials = (trial(name), trial(rival), trial(DRAG), unfitted)
        step: Any = SimpleNamespace(taken=trials[0], explanations=lambda trials=trials: list(trials[1:]))
        taken_before = {name.effect: trials[0]}
        selection: Any = SimpleNamespace(accepted=(name, DRAG), steps=(step,), taken=taken_before, nominal=point)
        monkeypatch.setattr(balancing, "balance_of", lambda data, point, shown=shown: shown)
        instead.clear()
        sized.clear()
        assert by_balance(data, selection)[1] is shown
        assert [t.candidate.effect for t in instead] == ([taken] if taken else [])
        lacks = {"rotor_fault": True, "payload": False, "": name is not LOAD}[taken]
        assert sized == pytest.approx([1.0 - rotor_loss(shown, 3)[0]] if lacks else [])
    # two steady effects, one that sets in, a trim that was found, no trim in the file: nothing is weighed
    trimmed = (LOAD, Candidate(TRIM, (), ("x",)))
    asked = [((LOAD, THRUST), TRIMMED), ((rotor(2, onset=3.0),), TRIMMED), (trimmed, TRIMMED), ((LOAD,), DRONE)]
    for accepted, vehicle in asked:
        other: Any = SimpleNamespace(accepted=accepted, taken={}, nominal=Point(vehicle, {}, start_noise()))
        assert by_balance(data, other) == (other, None)

    def lost(data: Data, point: Point) -> Balance:
        raise DivergedError("lost")

    monkeypatch.setattr(balancing, "balance_of", lost)
    assert by_balance(data, selection) == (selection, None)


def test_where_nothing_steady_is_found_it_is_said_what_a_day_hides_of_a_weak_rotor(monkeypatch) -> None:
    shown, asked = balance(0.07 * EACH[2]), [rotor(k) for k in (1, 2, 3, 4)]
    monkeypatch.setattr(balancing, "balance_of", lambda data, point: shown)
    data: Any = None

    def selection(*accepted: Candidate, vehicle: Vehicle = TRIMMED) -> Any:
        return SimpleNamespace(accepted=accepted, nominal=Point(vehicle, {}, start_noise()))

    reach = 100 * stats.t.ppf(0.975, DAYS) * max(rotor_loss(shown, k)[1] for k in (1, 2, 3, 4))
    each = ", ".join(f"{100 * rotor_loss(shown, k)[0]:.0f}" for k in (1, 2, 3, 4)).replace("-0", "0")
    (text,) = hidden_by_daily_variation(data, selection(DRAG), asked).values()
    assert f"lacks up to {reach:.0f} % of its thrust" in text
    assert f"rotors 1 to 4 lack {each} %, each +- {reach:.0f} (95 %)" in text
    assert each.split(", ")[2] == "7"
    # what was found or not asked for, and a drone without a trim of the day
    assert not hidden_by_daily_variation(data, selection(rotor(3)), asked)
    assert not hidden_by_daily_variation(data, selection(), [DRAG, THRUST])
    assert not hidden_by_daily_variation(data, selection(vehicle=DRONE), asked)

    def lost(data: Data, point: Point) -> Balance:
        raise DivergedError("lost")

    monkeypatch.setattr(balancing, "balance_of", lost)
    assert set(hidden_by_daily_variation(data, selection(), asked)) == {
        "rotor_fault",
        "payload",
    }  # neither was asked for


def test_a_rotor_is_told_with_the_day_as_its_uncertainty_and_rivals_by_the_balance() -> None:
    shown = balance(0.25 * EACH[2])
    point = Point(TRIMMED, {"rotor_fault": {"rotor": 3, "scale": 0.75, "onset_time": None}}, start_noise())
    numbers = _by_the_day(rotor(3), point, shown)
    assert numbers is not None
    sd = rotor_loss(shown, 3)[1]
    reach = sd * stats.t.ppf(0.975, DAYS)
    assert numbers["scale"].ci95 == pytest.approx((0.75 - reach, 0.75 + reach))
    assert _by_the_day(rotor(3), point, None) is None
    assert _by_the_day(WIND, point, shown) is None
    assert _by_the_day(rotor(3, onset=2.0), point, shown) is None
    rivals = [Trial(c, 1.0, 1.0, 1.0, 1.0) for c in (LOAD, DRAG, WIND)]
    rest, nats = _steady_rivals(rotor(3), rivals, shown)
    assert [t.candidate.effect for t in rest] == ["linear_drag"]
    assert nats == {
        "payload": log_odds_by_balance(shown, rotor(3), LOAD),
        "wind": log_odds_by_balance(shown, rotor(3), WIND),
    }
    assert _steady_rivals(rotor(3), rivals, None) == (rivals, {})


# -- odds by several flights -------------------------------------------------------------------------------------------


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
