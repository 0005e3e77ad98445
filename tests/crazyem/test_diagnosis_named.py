"""What a name is said with: inertias that are one factor on the torques, and a group that says so."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import INERTIA, LAG, data_of, start_point
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Fitted, bounds_of, nominal
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import error_by_lag, nuisances, refine_base, systematic_sd
from crazyem.diagnosis.locating.locate import Finding
from crazyem.diagnosis.naming import answer, trials
from crazyem.diagnosis.naming.answer import (
    Named,
    _numbers,
    _rivals,
    _uncertainty,
    confidence_factor,
    one_factor,
    strongest_first,
)
from crazyem.diagnosis.naming.trials import Selection, Step, Trial, held_out_evidence, improbable, presence
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import CONFIDENCE, FITTING

OWN = np.array([1.66e-5, 1.67e-5, 2.93e-5])


@given(st.floats(0.5, 2.0), st.floats(0.001, 0.1), st.floats(0.0, 0.9))
def test_one_factor_is_told_as_one_whatever_its_size_and_what_the_axes_share(factor, relative, shared):
    covariance = relative**2 * np.outer(OWN, OWN) * (np.eye(3) * (1 - shared) + shared)
    assert one_factor(factor * OWN, OWN, covariance)
    apart = factor * OWN * np.exp(np.array([6.0, -6.0, 0.0]) * relative)
    assert not one_factor(apart, OWN, covariance)


def test_chance_tells_one_factor_as_several_in_one_of_twenty():
    rng = np.random.default_rng(0)
    covariance = np.diag((0.02 * OWN) ** 2)
    told = [one_factor(1.2 * OWN * (1 + 0.02 / 1.2 * rng.normal(size=3)), OWN, covariance) for _ in range(2000)]
    assert np.mean(told) == pytest.approx(0.95, abs=0.02)


def test_inertias_that_are_one_factor_are_told_with_the_torques_that_were_not_asked(monkeypatch):
    flown = fly(Hidden(torque=0.7), seconds=12.0, seed=6)
    brought = []
    monkeypatch.setattr(answer, "confidence_factor", lambda remains, nats: brought.append(nats) or 1.0)
    monkeypatch.setattr(trials, "presence", lambda *args, **kwargs: 0.623)
    monkeypatch.setattr(answer, "preferred", lambda taken, rivals: 1.0)
    found = diagnose([flown], DRONE, wanted=["inertia"])
    assert [(e.name, e.confidence) for e in found.effects] == [("inertia", pytest.approx(0.623))]
    (taken,) = [step.taken for step in found.selection.steps if step.taken]
    assert brought == [taken.held_out / taken.dispersion] != [0.0]  # what is weighed against what is left
    assert found.unexplained.gained == pytest.approx(taken.gain / taken.dispersion - 3)
    assert found.indistinguishable == (("inertia", "torque_scale"),)


def test_what_is_found_beside_the_selection_stands_where_its_evidence_puts_it():
    """A late input of 72 nats was told after a doubtful drag of 9."""

    def named(name: str, held_out: float) -> Named:
        return Named(name, name, {}, {}, held_out, 0.95)

    told = [named("thrust_scale", 500.0), named("linear_drag", 9.0), named("wind", 20.0)]  # by evidence on all flights
    found = strongest_first(told, [named("input_delay", 72.0), named("gusts", 3.0)])
    assert [e.name for e in found] == ["thrust_scale", "input_delay", "linear_drag", "wind", "gusts"]
    assert strongest_first((), [named("gusts", 3.0)])[0].name == "gusts"


NATS = st.floats(-100.0, 1e4)


@given(NATS, NATS, NATS, st.floats(0.0, 1e4))
def test_more_evidence_never_makes_a_name_less_sure(one: float, other: float, beside: float, expected: float) -> None:
    least, most = sorted((one, other))
    assert 0.0 <= presence(least, beside, expected) <= presence(most, beside, expected) <= CONFIDENCE.max_probability
    assert (
        0.0
        <= presence(beside, least, expected)
        <= presence(beside, most, expected) + 1e-12
        <= CONFIDENCE.max_probability + 1e-12
    )


@given(NATS, st.floats(-100.0, 0.0))
def test_flight_that_can_tell_nothing_of_an_effect_says_nothing_of_it(held: float, expected: float) -> None:
    assert held_out_evidence(held, expected) == pytest.approx(0.0, abs=1e-12)


def test_a_trial_is_judged_by_what_is_expected_of_it_on_held_out_flights() -> None:
    """90 nats over a dispersion of 3; without held-out flights, nothing is expected and nothing is said."""
    trial = Trial(Candidate("linear_drag", (), ("x",)), 90.0, -4.0, 3.0, 26.0)
    for expected in (0.0, 27.0):
        found = replace(trial, expected=expected).presence(2)
        assert found == pytest.approx(presence(30.0, -4.0, expected, 2, dispersion=3.0))
    for held in (-4.0, 500.0):  # of blocks of the fitted flights
        assert replace(trial, held_out=held).presence(1) == pytest.approx(presence(30.0, 0.0, 0.0))
    hover, quick = (replace(trial, expected=e).presence(1) for e in (0.0, 90.0))
    assert hover > 1.3 * quick


def test_an_effect_is_judged_by_the_flights_that_show_it_best() -> None:
    """Whichever of them are called held out, if those can show it at all."""
    trial = Trial(Candidate("linear_drag", (), ("x",)), 30.0, 90.0, 3.0, 26.0, expected=60.0)
    assert trial.presence(2) == pytest.approx(presence(30.0, 90.0, 60.0, 2, dispersion=3.0))
    assert replace(trial, gain=120.0).presence(2) == pytest.approx(presence(40.0, 90.0, 60.0, 2, dispersion=3.0))
    assert replace(trial, expected=0.0).presence(2) == pytest.approx(presence(10.0, 0.0, 0.0, 2))


def test_a_name_is_as_sure_as_what_it_brings_on_flight_held_out_and_fitted() -> None:
    """A power of the nats fitted, times a ratio of densities of those held out, by a formula of its own."""
    assert presence(0.0, 1e3, 1e3) == 0.0
    for held, expected, fitted, order in ((5.0, 20.0, 30.0, 1), (30.0, 30.0, 5.0, 2), (-8.0, 80.0, 80.0, 3)):
        density = [
            (1.0 + (held - mean) ** 2 / (CONFIDENCE.freedom * variance)) ** (-0.5 * (CONFIDENCE.freedom + 1.0))
            / math.sqrt(variance)
            for mean, share in ((expected, CONFIDENCE.real_sd), (0.0, CONFIDENCE.other_sd))
            for variance in (1.0 + 2.0 * 3.0 * expected + (share * expected) ** 2,)
        ]
        odds = (
            math.exp(CONFIDENCE.intercept)
            * (1.0 + fitted) ** CONFIDENCE.gain_power
            / order**CONFIDENCE.order_power
            * density[0]
            / density[1]
        )
        assert presence(fitted, held, expected, order, dispersion=3.0) == pytest.approx(odds / (1.0 + odds))
    assert presence(1e9, 1e9, 1e9) == CONFIDENCE.max_probability
    assert improbable(0.9 * CONFIDENCE.min_probability).startswith("not determined")
    assert not improbable(1.1 * CONFIDENCE.min_probability)


def left(nats: float) -> Unexplained:
    """Structure of so many nats."""
    where = Finding("force", "z", "time 3.1 to 7.6 s", "time", (3.1, 7.6), 0.006, 0.001, "N", nats, 1e-5)
    return Unexplained((where,), 1e6)


@given(st.floats(-100.0, 1e6), st.floats(-100.0, 1e6), st.floats(25.0, 1e5), st.floats(25.0, 1e5))
def test_what_is_left_says_less_the_less_of_it_there_is_and_the_more_a_name_brings(held, more, nats, other) -> None:
    least, most = sorted((held, more))
    few, many = sorted((nats, other))
    assert (
        confidence_factor(left(many), least)
        <= confidence_factor(left(few), least)
        <= confidence_factor(left(few), most)
        <= 1.0
    )
    assert confidence_factor(Unexplained((), 1.0), least) == 1.0


def test_a_name_is_sure_beside_what_it_outweighs() -> None:
    """Of 18 names that brought more than 4 times what was left 18 were right, of 70 that brought less 8."""
    for times, least, most in (
        (-1.0, CONFIDENCE.doubtful, CONFIDENCE.doubtful),
        (2.5, CONFIDENCE.doubtful, CONFIDENCE.doubtful),
        (3.0, 0.5, 0.5),
        (20.0, 0.95, 1.0),
    ):
        assert least - 1e-3 <= confidence_factor(left(26.0), times * 26.0) <= most


def point_of(**effects: dict[str, Any]) -> Point:
    return Point(DRONE, effects, start_noise())


def test_a_number_at_the_end_of_what_is_admitted_may_be_anywhere() -> None:
    load = Candidate("payload", (), ("mass", "x", "y"))
    point = point_of(payload={"mass": 0.002, "x": -0.04, "y": 0.01, "z": 0.0})
    told = _numbers(load, point, np.array([1e-4, 1e-3, 1e-3]), np.full(3, 2.0), {})
    assert told["y"].ci95 == pytest.approx((0.008, 0.012))
    assert told["x"].sd == pytest.approx(0.08 / 12**0.5)
    assert told["x"].ci95[0] == pytest.approx(-0.04)  # never beyond
    drag = Candidate("linear_drag", (), ("x", "z"))
    told = _numbers(drag, point_of(linear_drag={"x": 0.02, "z": 0.0}), np.array([1e-3, 1e-3]), np.full(2, 2.0), {})
    assert told["z"].ci95 == pytest.approx((0.0, 2e-3))  # none of it is no end


def test_intervals_count_by_how_much_flights_differ_where_there_are_many() -> None:
    """Nine flights that want +1 and -1 of a parameter in turns: all of their blocks agree, they do not."""
    wants = np.repeat(np.array([1.0, -1.0] * 4 + [0.0]), 10)
    noise = np.random.default_rng(1).normal(size=90)
    score = np.stack([100.0 * wants + 10.0 * noise, 10.0 * noise[::-1]], 1)
    information = np.tile(np.diag([100.0, 100.0]), (90, 1, 1))
    for flights, freedom in ((np.repeat(np.arange(9), 10), 8), (np.zeros(90, int), 0)):
        fitted = Fitted(point_of(), (), 0.0, Gram(score, information, flights), np.zeros(2))
        sd, width, covariance = _uncertainty(fitted)
        assert np.sqrt(np.diag(covariance)) == pytest.approx(sd)
        if freedom:
            assert sd[0] == pytest.approx(np.std(np.append([1.0, -1.0] * 4, 0.0), ddof=1) / 3.0, rel=0.1)
            assert width[0] == pytest.approx(stats.t.ppf(0.975, 8))
        else:
            assert sd[0] < 0.16
            assert width[0] == pytest.approx(stats.t.ppf(0.975, 88))
        assert sd[1] < 0.02


def test_what_no_scatter_shows_is_part_of_an_interval() -> None:
    data = data_of(fly(seconds=6.0))
    never = systematic_sd(data, point_of(suspended_load={"mass": 0.002, "length": 0.4}))
    assert never["suspended_load", "length"] == pytest.approx(0.002)
    assert never["suspended_load", "mass"] == pytest.approx(3e-3 * DRONE.mass)
    assert never["thrust_curve", "slope_error"] == pytest.approx(0.02)
    data.models[0]._diverging["suspended_load"] = True
    shaken = systematic_sd(data, point_of(suspended_load={"mass": 0.002, "length": 0.4}))
    assert shaken["suspended_load", "length"] == pytest.approx(0.008)
    assert shaken["suspended_load", "mass"] == never["suspended_load", "mass"]
    assert ("suspended_load", "length") not in systematic_sd(data, point_of())


def test_inertias_are_as_unsure_as_a_lag_that_is_a_little_wrong_makes_them() -> None:
    """Held to a lag 3 ms longer, they are elsewhere by as much."""
    data = data_of(fly(seconds=8.0))
    inertia = INERTIA
    start = nominal(data, point_of()).with_effects({"inertia": dict(zip(inertia.free, DRONE.inertia, strict=True))})
    fitted = refine_base(data, start, [inertia], rounds=3, noise=False)
    off = error_by_lag(data, fitted)
    free = [c for c, _ in nuisances(data, fitted.point, [inertia])]
    names = [*inertia.free, *((c.effect, n) for c in free for n in c.free)]
    lag, size = names.index(("motor_lag", "time_constant")), fitted.gram.size
    room = np.array(bounds_of([inertia, *free], fitted.point))
    low, high = np.where(np.any(room == 0.0, axis=0), 0.0, [[-np.inf], [np.inf]])  # what is at a bound stays there
    theta = []
    for change in (0.0, FITTING.lag_error):
        low[lag] = high[lag] = change
        theta.append(fitted.gram.solve(range(size), precision=fitted.precision, low=low, high=high).theta)
    for k, name in enumerate(inertia.free):
        assert off["inertia", name] == pytest.approx(abs(theta[1][k] - theta[0][k]), rel=1e-3)
        assert off["inertia", name] > 0.003 * DRONE.inertia[k]
    assert len(off) == 3
    assert error_by_lag(data, refine_base(data, start, [LAG], rounds=1)) == {}


@pytest.mark.parametrize(
    ("accepted", "rivals"),
    [
        (["velocity_moment"], {"inertia", "torque_scale", "rate_damping"}),
        (["velocity_moment", "rate_damping"], {"inertia", "torque_scale"}),
        (["velocity_moment", "inertia"], {"rate_damping"}),
        (["velocity_moment", "torque_scale"], {"inertia", "rate_damping"}),  # inertias may be more than a factor
    ],
)
def test_what_is_needed_beside_a_name_is_no_other_name_for_it(accepted: list[str], rivals: set[str]) -> None:
    """Of drag and gyro bias, both hidden and both found, each was told as perhaps the other (2045/0179)."""
    one, *others = (
        Trial(Candidate(n, (), ("x",)), 50.0, 20.0, 1.0, 60.0)
        for n in ("velocity_moment", "inertia", "torque_scale", "rate_damping")
    )
    step = Step((one, *others), one, alike=tuple(others))
    found = SimpleNamespace(accepted=tuple(Candidate(n, (), ("x",)) for n in accepted))
    assert {t.candidate.effect for t in _rivals(one.candidate, step, found, frozenset())} == rivals
    inertia = next(t for t in others if t.candidate.effect == "inertia")
    turned = Step((inertia, *others), inertia, alike=(others[1],))
    found = SimpleNamespace(accepted=(inertia.candidate,))
    assert "torque_scale" in {t.candidate.effect for t in _rivals(inertia.candidate, turned, found, frozenset())}


def test_later_effects_are_told_by_how_many_were_found_before_them_but_a_trim() -> None:
    names, point = ("wind", "trim", "payload", "motor_lag"), start_point()
    steps = tuple(Step((), Trial(Candidate(n, (), ()), 1.0, 1.0, 1.0, 1.0)) for n in names)
    selection = Selection(point, point, (*steps, Step((), None)), (), SimpleNamespace())
    assert selection.orders() == [1, 2, 2, 3]
