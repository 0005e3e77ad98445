"""Which of several explanations that are not told apart gives the name."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_parts import INERTIA, LOAD, silent, start_point
from hypothesis import given
from hypothesis import strategies as st

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.naming import select
from crazyem.diagnosis.naming.evidence import occam_cost, posterior_covariance
from crazyem.diagnosis.naming.select import alike_with, compatible, step_of
from crazyem.diagnosis.naming.trials import Step, Trial, additions, better, distinguishable, preferred, scatter
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.diagnosis.workers import Workers

NOISE = np.random.default_rng(0).normal(size=40)


def trial(effect: str, free: str, value: float, *, scatter: float = 0.0) -> Trial:
    """An explanation by as many numbers as `free` has letters; its likelihood scatters over blocks."""
    there = SimpleNamespace()
    blocks = value / 40 + scatter * NOISE
    return Trial(
        Candidate(effect, (), tuple(free)), value, 0.0, 1.0, value - len(free), there, True, blocks, value,
    )  # fmt: skip


@pytest.fixture
def compared(monkeypatch):
    """`compared_with_refitted_noise` where no fit changes anything: the name, then its look-alikes."""
    monkeypatch.setattr(select, "with_noise_refit", lambda basis, trial: trial)
    basis = SimpleNamespace(held_out=None, data=SimpleNamespace(workers=Workers(1)))
    return lambda trials: select.compared_with_refitted_noise(basis, trials, say=silent)[1]


@pytest.mark.parametrize(
    ("nats", "name", "alike"),
    [
        (100.5, "center_of_mass", ["payload"]),  # worth less by half a nat
        (103.0, "payload", ["center_of_mass"]),  # more by two, whatever the number of parameters
        (105.0, "payload", []),
    ],
)
@pytest.mark.parametrize("first", [0, 1])
def test_the_name_goes_to_the_largest_worth(compared, nats: float, name: str, alike: list[str], first: int) -> None:
    """The nats less the parameters. What is not told apart from it is its look-alike."""
    payload, centre = trial("payload", "mxyz", nats), trial("center_of_mass", "xyz", 100.0)
    found = compared([payload, centre] if first == 0 else [centre, payload])
    assert [t.candidate.effect for t in found] == [name, *alike]


def test_what_is_beaten_steadily_is_no_look_alike() -> None:
    """Three inertias are worth 3.7 nats more than a factor on all torques, steadily from block to block or not."""
    inertia, torque = trial("inertia", "xyz", 105.7), trial("torque_scale", "s", 100.0, scatter=0.25)
    assert distinguishable(inertia, torque)
    unsteady = trial("torque_scale", "s", 100.0, scatter=1.0)
    assert not distinguishable(inertia, unsteady)
    for other in (torque, unsteady):  # neither is the better one
        assert not distinguishable(other, inertia)


@pytest.mark.parametrize(("share", "told"), [(0.99, False), (1.01, True)])
def test_a_look_alike_is_the_better_explanation_with_one_chance_in_twenty_or_more(share: float, told: bool) -> None:
    """Log odds of 19 where blocks agree, else 1.645 standard deviations of a normal distribution."""
    assert CONFIDENCE.min_look_alike == 0.05
    steady, nats = trial("wind", "x", 100.0), share * np.log(19.0)
    assert distinguishable(trial("payload", "m", 100.0 + nats), steady) == told
    unsteady = trial("wind", "x", 100.0, scatter=10.0)
    sd = scatter(unsteady.blocks)
    assert sd > 10.0
    assert distinguishable(trial("payload", "m", 100.0 + share * 1.6449 * sd), unsteady) == told


def test_recordings_that_differ_widen_the_group_but_do_not_give_the_name(compared) -> None:
    """Better by 20 nats in most of eight recordings, worse by 13 in three: one group, the better is named."""
    of = np.repeat(np.arange(8), 5)
    apart = np.repeat([20.0, 20.0, 20.0, -13.0, -13.0, -13.0, 20.0, 20.0], 5) / 5
    lags, late = trial("motor_lag", "xyz", 100.0), trial("input_delay", "d", 100.0)
    best = replace(lags, blocks=lags.blocks + apart, value=100.0 + apart.sum() + 2.0)
    assert distinguishable(best, late)
    best, other = replace(best, recording=of), replace(late, recording=of)
    assert not distinguishable(best, other)
    assert compared([other, best]) == [best, other]
    assert 0.8 < preferred(best, [other]) < 0.95


def test_the_group_is_that_of_the_name(compared) -> None:
    """A ground effect is better than a delay, but not surely; a lag loses to the first, though not to the second."""
    ground = trial("ground_effect", "sh", 130.0)
    late = trial("input_delay", "d", 110.0, scatter=8.0)
    lag = trial("motor_lag", "t", 109.0)
    assert not distinguishable(late, lag)
    assert compared([late, ground, lag]) == [ground, late]


@pytest.mark.parametrize("same", [True, False])
def test_an_effect_is_no_look_alike_of_itself(monkeypatch, same: bool) -> None:
    """Two rotors of which one is weak are one name with two choices."""
    one = trial("rotor_fault", "s", 100.0)
    other = replace(one, candidate=Candidate("rotor_fault", (("rotor", 2),), ("s",)))
    if not same:
        other = trial("torque_scale", "s", 100.0)
    monkeypatch.setattr(select, "fitted_trial", lambda basis, trial, solution, *, say: trial)
    monkeypatch.setattr(select, "compared_with_refitted_noise", lambda basis, trials, *, say: (trials, trials))
    basis = SimpleNamespace(held_out=None, data=SimpleNamespace(workers=Workers(1)))
    step = step_of(basis, [(one, None), (other, None)], say=silent)
    assert step.taken == one
    assert step.alike == (() if same else (other,))


def test_what_is_below_its_limit_or_has_little_evidence_is_no_look_alike():
    centre, payload = trial("center_of_mass", "xyz", 100.0), trial("payload", "mxyz", 101.0)
    assert alike_with(centre, [payload, centre], counted=False) == [centre, payload]
    for other in (replace(payload, admissible=False), replace(payload, dispersion=10.0)):  # 101 / 10 - 4 nats
        assert alike_with(centre, [other, centre], counted=False) == [centre]


def test_what_is_better_takes_a_name_its_worth():
    centre, payload = trial("center_of_mass", "xyz", 100.0), trial("payload", "mxyz", 130.0)
    assert preferred(centre, [payload]) < 1e-3
    assert preferred(payload, [centre]) > 0.999
    assert preferred(payload, []) == 1.0


def test_what_ruins_the_flights_held_out_explains_nothing_however_large():
    """A damping fitted in a hover, which took 22000 nats from a quick flight and half the trust in a rotor inertia."""
    taken, ruin = trial("rotor_inertia", "i", 219.0), replace(trial("rate_damping", "xyz", 25.0), evidence=-21964.0)
    assert Step((taken, ruin), taken).explanations() == [taken]
    assert Step((taken, ruin), taken, alike=(ruin,)).explanations() == [taken, ruin]
    both = replace(ruin, gain=50.0, value=taken.value + 1.0)  # fitted to all flights it explains more
    assert Step((taken, both), taken).explanations() == [taken, both]
    other = replace(both, gain=0.02 * taken.gain)  # a wind of the held-out flight beside the gyro bias of both
    assert Step((taken, other), taken).explanations() == [taken]


def test_what_is_already_there_in_another_form_is_not_asked():
    assert compatible("motor_lag", {"thrust_scale"})
    assert compatible("payload", {"thrust_scale"})
    assert not compatible("payload", {"thrust_scale", "motor_lag"})  # both heavier and stronger: more torque
    assert not compatible("motor_lag", {"thrust_scale", "payload", "wind"})
    assert not compatible("inertia", {"torque_scale"})
    assert not compatible("wind", {"wind"})
    assert compatible("wind", {"thrust_scale", "motor_lag"})


def test_the_better_explanation_of_all_flights_leads_whichever_ruins_those_held_out_least(monkeypatch):
    """Fitted to a hover, a linear drag happens to cost a quick flight less than the quadratic one that is right, which
    fitted to both explains it by thousands of nats more."""
    linear, quadratic = trial("linear_drag", "xyz", 2000.0), trial("quadratic_drag", "xyz", 9000.0)
    linear, quadratic = replace(linear, evidence=26000.0), replace(quadratic, evidence=12000.0)
    point = start_point()
    basis = SimpleNamespace(held_out=object(), point=point, data=SimpleNamespace(workers=Workers(1)))
    own, given = object(), []
    monkeypatch.setattr(select, "with_held_out_by", lambda basis, trial: own)
    monkeypatch.setattr(select, "with_noise_refit", lambda basis, trial: given.append(basis) or trial)
    monkeypatch.setattr(select, "by_evidence", lambda trials, counted: sorted(trials, key=lambda t: -t.evidence))
    trials, equals = select.compared_with_refitted_noise(basis, [linear, quadratic], say=silent)
    assert trials[0] is linear
    assert equals == [quadratic]
    assert given == [own, own]  # all that are compared begin with the same noise of the flights held out
    # what may not be taken does not lead, however well it would fit: a small effect, and one of little evidence
    for small in (replace(quadratic, admissible=False), replace(quadratic, dispersion=1000.0)):
        assert select.compared_with_refitted_noise(basis, [linear, small], say=silent)[1][0] is linear


@given(st.lists(st.floats(1e-3, 1.0), min_size=4, max_size=4), st.integers(0, 1000))
def test_what_tuning_costs_is_the_evidence_of_a_linear_model(known: list[float], seed: int) -> None:
    """Laplace's evidence is exact where the likelihood is Gaussian: log of the integral of likelihood times prior is
    that of the maximum less what tuning costs, but for what the prior says of where the maximum is."""
    load = LOAD
    usual = np.array([load.parameter(n).width for n in load.free])
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(4, 4)))[0]
    information = turn @ np.diag(np.array(known) ** -2.0) @ turn.T / np.outer(usual, usual)
    # integral of exp(-x'Ax/2) N(x; 0, U) = det(I + UA)^(-1/2), the maximum being at neutral
    wanted = 0.5 * np.linalg.slogdet(np.eye(4) + information * np.square(usual)[:, None])[1]
    assert occam_cost([load], posterior_covariance([load], information)) == pytest.approx(max(4.0, wanted), rel=1e-5)


@pytest.mark.parametrize("nats", [-2.0, 0.5, 2.0])
def test_few_nats_are_no_surer_for_coming_steadily(nats: float) -> None:
    """A factor on all torques was told with 0.95 for three inertias, ahead by 2 nats of what parameters cost."""
    one, other = trial("torque_scale", "s", 100.0 + nats), trial("inertia", "x", 100.0)
    assert better(one, other) == pytest.approx(1.0 / (1.0 + np.exp(-nats)))
    assert better(one, other) + better(other, one) == pytest.approx(1.0)
    unsteady = replace(other, blocks=other.blocks + NOISE)
    assert abs(better(one, unsteady) - 0.5) < abs(better(one, other) - 0.5)


def test_inertias_that_are_one_factor_are_no_coincidence() -> None:
    """More mass around a drone makes it heavier to turn about every axis: three inertias known within 3e-7 kg m^2 of
    some 1.5e-6, of which what they have in common is known, cost hardly more than a nat each, and not 4.9."""
    inertia = INERTIA
    width = inertia.parameter("xx").width
    usual = width**2 * (0.1 * np.eye(3) + 0.9)
    information = np.eye(3) / (width / 5) ** 2
    wanted = 0.5 * np.linalg.slogdet(np.eye(3) + usual @ information)[1]
    assert occam_cost([inertia], posterior_covariance([inertia], information)) == pytest.approx(wanted, rel=1e-9)
    assert wanted == pytest.approx(3.4, abs=0.1)
    assert 1.5 * np.log(1.0 + 25.0) == pytest.approx(4.9, abs=0.1)  # were they independent of each other


def test_what_no_flight_tells_costs_a_nat_and_no_more() -> None:
    load = LOAD
    told = np.zeros((6, 6))
    told[0, 0], told[4:, 4:] = 1e12, np.eye(2)
    assert occam_cost([load], posterior_covariance([load], told)) == pytest.approx(
        0.5 * np.log1p(1e12 * 2.5e-3**2), rel=1e-6
    )
    assert occam_cost([load], posterior_covariance([load], np.zeros((4, 4)))) == 4.0


def test_a_load_that_must_sit_in_the_middle_is_told_from_weak_rotors() -> None:
    """As likely with four numbers as with one, but two of them must be 0 within 0.1 mm of some 10: that it happens to
    sit there costs more than another nat for each."""
    weak, load = (
        replace(trial("thrust_scale", "s", 100.0), parameter_cost=5.0),
        trial("payload", "mxyz", 100.5, scatter=0.1),
    )
    assert not distinguishable(weak, replace(load, parameter_cost=None, value=103.5))
    scaled = np.diag(np.square([1e-5, 1e-4, 1e-4, 1.0]))
    at = LOAD
    cost = occam_cost([at], posterior_covariance([at], np.linalg.inv(scaled)))
    assert cost == pytest.approx(np.log(2.5e-3 / 1e-5) + 2 * np.log(1e-2 / 1e-4), abs=0.01)
    assert distinguishable(weak, replace(load, parameter_cost=cost))


# -- explanations of one thing -----------------------------------------------------------------------------------------


def tried(effect, gain, *, fitted=True, fixed=()):
    there = object() if fitted else None
    return Trial(Candidate(effect, fixed, ("x",)), gain, 0.0, 1.0, gain - 1, fitted=there, admissible=fitted)


def test_what_keeps_its_gain_is_another_thing():
    first = (
        tried("thrust_scale", 500.0), tried("payload", 490.0), tried("velocity_scale", 480.0),
        tried("wind", 100.0, fitted=False), tried("gyro_bias", -3.0),
    )  # fmt: skip
    later = [
        tried("payload", 2.0), tried("velocity_scale", 300.0), tried("velocity_scale", 470.0, fixed=(("a", 1),)),
        tried("wind", 99.0), tried("gyro_bias", 5.0),
    ]  # fmt: skip
    assert additions(Step(first, None), later) == {"velocity_scale"}
    assert additions(Step(first, None), []) == frozenset()  # what was not asked again stays a rival


def test_what_is_not_told_apart_is_a_rival_however_small_alone():
    taken, large = tried("motor_lag", 40.0), tried("inertia", 30.0)
    small, far = (replace(tried(*t), admissible=False) for t in (("torque_scale", 33.0), ("wind", 9.0)))
    trials = (taken, small, large, far)
    assert Step(trials, taken, (small,)).explanations() == [taken, small, large]
    assert Step(trials, taken).explanations() == [taken, large]


def compared_again(monkeypatch, gains, refitted):
    """What was asked with noise of its own, which makes `refitted` nats of `gains`; and what the comparison says."""
    asked = []

    def sharpened(basis, t):
        asked.append(t.candidate.effect)
        nats = refitted.get(t.candidate.effect, t.gain)
        return replace(t, gain=nats, value=nats)

    monkeypatch.setattr(select, "with_noise_refit", sharpened)
    basis = SimpleNamespace(held_out=None, point=start_point(), data=SimpleNamespace(workers=Workers(1)))
    first = [replace(tried(n, g), value=g, blocks=np.full(20, g / 20)) for n, g in gains.items()]
    return asked, *select.compared_with_refitted_noise(basis, first, say=silent)


def test_what_explains_nearly_as_much_is_compared_with_noise_of_its_own(monkeypatch):
    """Told apart under noise that still is the effect; with noise of its own the second is the better."""
    gains = {"torque_scale": 1200.0, "inertia": 1100.0, "wind": 900.0}  # wind: 0.75 of the best
    refitted = {"torque_scale": 2000.0, "inertia": 2100.0, "wind": 5000.0}
    _, trials, equals = compared_again(monkeypatch, gains, refitted)
    assert [t.candidate.effect for t in equals] == ["inertia"]
    assert {t.candidate.effect: t.value for t in trials} == {**refitted, "wind": 900.0}


@pytest.mark.parametrize(("other", "asked"), [("torque_scale", ["motor_lag", "torque_scale"]), ("wind", [])])
def test_what_turns_the_drone_as_well_is_compared_with_noise_of_its_own_however_little_it_gained(
    monkeypatch, other, asked
):
    """Torques 23 % too weak gained 15 nats where a longer lag gained 40, and 37 against 48 with noise of their own."""
    assert compared_again(monkeypatch, {"motor_lag": 40.0, other: 15.0}, {})[0] == asked
