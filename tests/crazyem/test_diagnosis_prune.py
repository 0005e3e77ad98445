"""What is left out again: an effect that noise explains as well must speak on flights held out, or go."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted, nominal
from crazyem.diagnosis.fitting.gram import Gram
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import held_out_fit, refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming import prune
from crazyem.diagnosis.naming.detection_limits import exceeds_limit, is_implausible
from crazyem.diagnosis.naming.select import at_linear_size, shortlist
from crazyem.diagnosis.naming.trials import Step, Trial, significance
from crazyem.diagnosis.settings import SELECTION
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import Conditions

DRAG = Candidate("linear_drag", (), ("x", "y", "z"))
TAKEN = Step((), Trial(DRAG, gain=30.0, held_out=20.0, dispersion=2.0, p_value=1e-6, evidence=12.0))
POINT = Point(DRONE, {}, start_noise())


@pytest.fixture
def no_scatter(monkeypatch):
    """Fits that are no more than log-likelihoods scatter as their model says."""
    monkeypatch.setattr(prune, "dispersion_of", lambda *a, **k: 1.0)


def survivors(monkeypatch, *, p_value, held, gained=50.0, held_out=True):
    """What `without_noise_look_alikes` keeps where torques that wander gain `gained` nats; p-values it asked for."""
    asked = []

    def significance(fitted, count, *, offset):
        asked.append((count, offset))
        return p_value

    fitted = SimpleNamespace(point=POINT)
    monkeypatch.setattr(prune, "refine_base", lambda *a, **k: fitted)
    monkeypatch.setattr(prune, "significance", significance)
    monkeypatch.setattr(prune, "held_gain", lambda *a: held)
    apart = SimpleNamespace(fit_noise=lambda point: point, loglik=lambda point, passes: gained)
    data = SimpleNamespace(twin=lambda: apart, loglik=lambda point, passes: 0.0)  # what wanders is fitted on a twin
    _, accepted, steps = prune.without_noise_look_alikes(
        data, fitted, [DRAG], [TAKEN], SimpleNamespace() if held_out else None, lambda text: None
    )
    assert bool(accepted) == bool(steps)
    return accepted, asked


@pytest.mark.parametrize(
    ("p_value", "held", "held_out", "kept"),
    [
        (SELECTION.p_value / 2, 0.0, False, True),
        (SELECTION.p_value / 2, 0.0, True, True),
        (SELECTION.p_value * 2, 0.0, False, False),
        (SELECTION.p_value * 2, 0.0, True, False),
        (SELECTION.p_value * 2, 20.0, False, False),  # there is nothing held out to gain on
        (SELECTION.p_value * 2, 20.0, True, True),  # by chance with exp(-20 / dispersion)
        (SELECTION.p_value * 2, 1.0, True, False),
        (SELECTION.held_out_p_value * 2, 100.0, True, False),  # too doubtful where it was fitted
    ],
)
def test_an_effect_that_wandering_torques_explain(monkeypatch, p_value, held, held_out, kept):
    accepted, asked = survivors(monkeypatch, p_value=p_value, held=held, held_out=held_out)
    assert accepted == ([DRAG] if kept else [])
    assert asked == [(3, 0)]


def test_where_torques_do_not_wander_nothing_is_asked(monkeypatch):
    accepted, asked = survivors(monkeypatch, p_value=1.0, held=0.0, gained=SELECTION.memory_gain / 2)
    assert accepted == [DRAG]
    assert asked == []


@pytest.mark.slow
def test_what_is_expected_on_flights_held_out_is_what_their_likelihood_would_lose():
    """Against the curve of the likelihood held out over the size of the effect, what is always free fitted to each."""
    candidate = Candidate("torque_scale", (), ("scale",))
    data, apart = (Data([flight_of(fly(Hidden(torque=0.85), seconds=s, seed=s), DRONE)]) for s in (6, 14))
    point = nominal(data, POINT)
    begun = point.with_effects({"torque_scale": {"scale": 0.95}})
    fitted = refine_base(data, begun, [candidate], noise=False)
    here = fitted.point.effects["torque_scale"]["scale"]
    scales = here + np.linspace(-0.03, 0.03, 7)  # what is always free stays within its bounds
    points = [fitted.point.with_effects({"torque_scale": {"scale": s}}) for s in scales]
    values = [held_out_fit(apart, p, [candidate]).loglik for p in points]
    bend = np.polynomial.Polynomial.fit(scales, values, 2).deriv(2)(here)
    found = prune.expected(apart, fitted, [candidate], candidate)
    wanted = -0.5 * bend * (here - 1.0) ** 2
    # 34 against 52 nats when written: bounds of what is always free and terms of second order are left out. It decides
    # between a flight that can answer and one that cannot, for which a factor of two does.
    assert wanted / 2 < found < wanted * 2
    assert found > SELECTION.informative


@pytest.mark.usefixtures("no_scatter")
@pytest.mark.parametrize(("slope", "kept"), [(-0.9, True), (-0.5, False)])
def test_what_holds_another_within_its_range_stays(monkeypatch, slope, kept):
    """A thrust scale brings too little, but without it a thrust curve goes on to where commands are not heeded."""
    scale, curve = (Candidate(n, (), (p,)) for n, p in (("thrust_scale", "scale"), ("thrust_curve", "slope_error")))
    with_both = POINT.with_effects({"thrust_scale": {"scale": 0.8}, "thrust_curve": {"slope_error": -0.4}})
    alone = POINT.with_effects({"thrust_curve": {"slope_error": slope}})
    fitted, bare = SimpleNamespace(point=with_both), SimpleNamespace(point=alone)
    steps = [replace(TAKEN, taken=replace(TAKEN.taken, candidate=c)) for c in (scale, curve)]
    lost = {scale: 5.0, curve: 300.0}
    fits = {c: SimpleNamespace(point=alone, loglik=-nats) for c, nats in lost.items()}
    monkeypatch.setattr(prune, "fit_without", lambda data, held_out, fitted, accepted, c: (fits[c], 0.0))
    monkeypatch.setattr(prune, "refine_base", lambda *a, **k: bare)
    data = SimpleNamespace(loglik=lambda point, passes: 0.0, settle=lambda point: None, workers=Workers(1))
    found, accepted, left = prune.backward_elimination(data, fitted, [scale, curve], steps, None, lambda text: None)
    assert accepted == ([scale, curve] if kept else [curve])
    assert [s.taken.candidate for s in left] == accepted
    assert found is (fitted if kept else bare)


@pytest.mark.usefixtures("no_scatter")
@pytest.mark.parametrize(("expected", "held", "kept"), [(1.0, -25.0, True), (1.0, -31.0, False), (20.0, -25.0, True),
                                                        (50.0, -5.0, False), (50.0, 5.0, True)])  # fmt: skip
def test_flights_held_out_are_asked_where_they_can_answer(monkeypatch, expected, held, kept):
    """An effect that brings 300 nats where it was fitted, and `held` where `expected` nats would be the effect's.

    A flight that cannot show it, or less than a tenth of that, may speak against it with a tenth of that: hovers have
    biases of their own.
    """
    fitted = SimpleNamespace(point=POINT, loglik=0.0)
    bare = SimpleNamespace(point=POINT, loglik=-300.0)
    monkeypatch.setattr(prune, "expected", lambda *a: expected)
    monkeypatch.setattr(prune, "fit_without", lambda *a: (bare, -held))
    monkeypatch.setattr(prune, "held_out_fit", lambda *a: SimpleNamespace(loglik=0.0))
    monkeypatch.setattr(prune, "refine_base", lambda *a, **k: bare)
    data = SimpleNamespace(loglik=lambda point, passes: 0.0, workers=Workers(1))
    monkeypatch.setattr(prune, "nuisances", lambda *a: [])
    _, accepted, left = prune.backward_elimination(data, fitted, [DRAG], [TAKEN], SimpleNamespace(), lambda text: None)
    assert accepted == ([DRAG] if kept else [])
    for step in left:  # the probability of an effect is that in the final model
        taken = step.taken
        assert (taken.gain, taken.held_out, taken.expected, taken.dispersion) == (300.0, held, expected, 1.0)


@pytest.mark.usefixtures("no_scatter")
def test_what_no_flight_needs_goes_before_what_one_speaks_against(monkeypatch):
    """A payload of no mass beside a load on a string, which a hover does not confirm while the payload is there."""
    payload, load = (Candidate(n, (), ("mass",)) for n in ("payload", "suspended_load"))
    steps = [replace(TAKEN, taken=replace(TAKEN.taken, candidate=c)) for c in (payload, load)]
    fitted = SimpleNamespace(point=POINT, loglik=0.0)

    def bare_fit(data, held_out, fitted, accepted, candidate):
        nats, held = {payload: (2.0, 0.0), load: (200.0, -14.0 if payload in accepted else 300.0)}[candidate]
        return SimpleNamespace(point=POINT, loglik=-nats), -held

    monkeypatch.setattr(prune, "expected", lambda *a: 280.0)
    monkeypatch.setattr(prune, "fit_without", bare_fit)
    monkeypatch.setattr(prune, "held_out_fit", lambda *a: SimpleNamespace(loglik=0.0))
    monkeypatch.setattr(prune, "refine_base", lambda *a, **k: fitted)
    monkeypatch.setattr(prune, "nuisances", lambda *a: [])
    data = SimpleNamespace(loglik=lambda point, passes: 0.0, settle=lambda point: None, workers=Workers(1))
    said = []
    _, accepted, left = prune.backward_elimination(data, fitted, [payload, load], steps, SimpleNamespace(), said.append)
    assert accepted == [load]
    assert [s.taken.candidate for s in left] == [load]
    assert said == ["  left out again: payload"]


def test_one_number_at_the_end_of_its_range_is_no_finding():
    slope = Candidate("thrust_curve", (), ("slope_error",))
    low = slope.parameter("slope_error").low
    assert not exceeds_limit(POINT.with_effects({"thrust_curve": {"slope_error": low}}), slope)
    assert exceeds_limit(POINT.with_effects({"thrust_curve": {"slope_error": low + 1e-6}}), slope)
    assert not exceeds_limit(POINT.with_effects({"thrust_curve": {"slope_error": 0.02}}), slope)
    spun = Candidate("rotor_inertia", (), ("inertia",))  # no propeller is as light
    assert not exceeds_limit(POINT.with_effects({"rotor_inertia": {"inertia": 1.9e-9}}), spun)
    assert exceeds_limit(POINT.with_effects({"rotor_inertia": {"inertia": 5e-9}}), spun)
    assert exceeds_limit(POINT.with_effects({"linear_drag": {"x": 0.0, "y": 0.01, "z": 0.0}}), DRAG)  # one of three
    for axis, size, counts in (("y", 1.2e-3, True), ("y", 0.8e-3, False), ("z", 2e-3, False), ("z", 4e-3, True)):
        point = POINT.with_effects({"linear_drag": {"x": 0.0, "y": 0.0, "z": 0.0, axis: size}})
        assert exceeds_limit(point, DRAG) == counts


@pytest.mark.parametrize(
    ("roll", "pitch", "counts"),
    [
        (4e-6, -1e-6, True), (2e-6, -2e-6, False), (4e-6, 9e-6, True),
        (-7e-6, 9e-6, False), (-1.2e-5, 5e-6, False), (-2e-5, 1e-6, True),
    ],
)  # fmt: skip
def test_a_moment_that_no_rotor_makes_counts_from_a_larger_size_on(roll, pitch, counts):
    """Air on rotors above the centre of mass tips the drone back; what tips it onward is feigned where it is small."""
    moment = Candidate("velocity_moment", (), ("roll_per_vy", "pitch_per_vx"))
    point = POINT.with_effects({"velocity_moment": {"roll_per_vy": roll, "pitch_per_vx": pitch}})
    assert exceeds_limit(point, moment) == counts


def test_a_rotor_that_is_much_stronger_than_the_others_is_no_faulty_one():
    """1.2 and 1.3 were said of real drones with another propeller cut."""
    fault = Candidate("rotor_fault", (("rotor", 2), ("onset_time", None)), ("scale",))
    low, high = fault.range_of("scale")
    assert low == 0.0
    assert 1.0 < high < 1.2
    for scale, counts in ((0.8, True), (1.05, True), (high, False)):
        point = POINT.with_effects({"rotor_fault": {"rotor": 2, "scale": scale, "onset_time": None}})
        assert exceeds_limit(point, fault) == counts


def test_no_rotor_gets_stronger_in_flight():
    later = Candidate("rotor_fault", (("rotor", 2), ("onset_time", 11.0)), ("scale",))
    assert later.range_of("scale") == (0.0, 1.0)


def test_a_drag_that_no_air_has_stands_for_something_else():
    """0.5 N s/m along y, the end of its range, was said of a drone of 31 g that flew along x."""
    for drag, size, counts in (
        ("linear_drag", 4.0, True), ("linear_drag", 6.0, False),
        ("quadratic_drag", 2.5, True), ("quadratic_drag", 3.5, False),
    ):  # fmt: skip
        point = POINT.with_effects({drag: {"x": 0.01, "y": size * DRONE.mass, "z": 0.0}})
        candidate = Candidate(drag, (), ("x", "y", "z"))
        assert exceeds_limit(point, candidate) == counts
        assert is_implausible(point, candidate) != counts


def test_wind_that_only_sinks_is_thrust_that_is_a_little_wrong():
    wind = Candidate("wind", (), ("x", "y", "z"))
    trimmed = replace(DRONE, effects={"trim": dict.fromkeys("xyz", 0.0)})
    for vehicle, values, counts in (
        (DRONE, (0.05, 0.05, 3.0), False), (DRONE, (0.2, 0.0, 0.0), True),
        (DRONE, (-0.11, 0.03, 1.7), False), (DRONE, (1.0, 1.0, 1.7), True), (trimmed, (0.2, 0.0, 0.0), False),
        (trimmed, (0.9, 0.9, 0.0), True),
    ):  # fmt: skip
        point = Point(vehicle, {"wind": dict(zip("xyz", values, strict=True))}, start_noise())
        assert exceeds_limit(point, wind) == counts


def test_a_ground_effect_that_does_not_fade_is_thrust_that_is_a_little_wrong():
    lifting = Candidate("ground_effect", (), ("strength", "height"))
    for height, counts in ((0.1, True), (0.5, True), (10.0, False)):
        point = POINT.with_effects({"ground_effect": {"strength": 0.09, "height": height}})
        assert exceeds_limit(point, lifting) == counts


def test_a_scale_of_velocities_must_be_more_than_the_jitter_of_the_estimate():
    """20 % of the 7 mm/s of a hover are 1 mm/s, and any onboard estimate is as wrong; 20 % of 0.7 m/s are more."""
    for speed, counts in ((0.005, False), (0.5, True)):
        facts = Conditions(speed=np.full(3, speed), onboard=False)
        least = CATALOGUE["velocity_scale"].prior.detection_limit_in({}, facts)
        assert (least["x"][1] < 1.2 - 1.0) == counts


def test_a_thrust_within_what_days_differ_by_is_no_finding_of_a_drone_with_a_file_of_its_own():
    """Two standard deviations of a day: of other drones 2 % each, or as the file says."""
    trimmed = replace(POINT, vehicle=replace(DRONE, effects={"trim": {"x": 1e-4, "y": 0.0, "z": 0.0}}))
    thrust = Candidate("thrust_scale", (), ("scale",))
    for scale, new, filed in ((1.03, True, False), (0.95, True, True), (1.05, True, True)):
        there = {"thrust_scale": {"scale": scale}}
        assert exceeds_limit(POINT.with_effects(there), thrust) == new
        assert exceeds_limit(trimmed.with_effects(there), thrust) == filed


def test_a_load_counts_from_a_share_of_the_drone_s_mass_on_whatever_its_length():
    load = Candidate("suspended_load", (), ("mass", "length"))
    few, some = (POINT.with_effects({"suspended_load": {"mass": m, "length": 1.5}}) for m in (2.5e-4, 4e-4))
    assert not exceeds_limit(few, load)
    assert exceeds_limit(some, load)


def test_beside_a_load_less_thrust_than_its_swing_leaves_open_of_its_weight_is_none():
    data = Data([flight_of(fly(seconds=6.0), DRONE)])
    load = {"suspended_load": {"mass": 0.001, "length": 0.3}}
    scale, more = Candidate("thrust_scale", (), ("scale",)), Candidate("payload", (), ("mass", "x", "y"))
    for candidate, values, counts in (
        (scale, {"thrust_scale": {"scale": 0.993}}, False),
        (scale, {"thrust_scale": {"scale": 0.98}}, True),
        (more, {"payload": {"mass": 0.006 * DRONE.mass}}, False),
        (more, {"payload": {"mass": 0.02 * DRONE.mass}}, True),
    ):
        assert exceeds_limit(POINT.with_effects(values), candidate, data)  # without a load
        assert exceeds_limit(POINT.with_effects({**load, **values}), candidate, data) == counts


def test_a_load_is_as_significant_as_its_mass():
    """A length far from the one where fits begin, and exactly known, says nothing where the mass may be 0."""
    load = Candidate("suspended_load", (), ("mass", "length"))
    point = POINT.with_effects({"suspended_load": {"mass": 1e-4, "length": 1.5}})
    rng = np.random.default_rng(0)
    for mass_sd, sure in ((1e-4, False), (1e-5, True)):
        information = np.tile(np.diag([mass_sd**-2, 1e8]) / 40, (40, 1, 1))
        score = rng.normal(size=(40, 2)) * np.sqrt(np.diag(information[0]))
        score -= score.mean(axis=0)
        gram = Gram(score, information, np.zeros(40, int))
        fitted = Fitted(point, (load,), 0.0, gram, np.zeros(2))
        assert (significance(fitted, 2, offset=0) < SELECTION.p_value) == sure


def test_torques_and_inertias_are_fitted_together_or_not_at_all():
    def entry(effect, gain, p_value=1e-6):
        trial = Trial(Candidate(effect, (), ("x",)), gain, 0.0, 1.0, p_value, gain - 1.0)
        return trial, None

    linear = [entry("torque_scale", 100.0), entry("linear_drag", 50.0), entry("inertia", 3.0, p_value=0.5)]
    assert [t.candidate.effect for t, _ in shortlist(linear)] == ["torque_scale", "linear_drag", "inertia"]
    assert [t.candidate.effect for t, _ in shortlist(linear[1:])] == ["linear_drag"]


def test_heavy_rotors_are_fitted_beside_a_damping_from_where_they_are_heavy():
    def entry(effect, gain, p_value=1e-6):
        free = ("inertia",) if effect == "rotor_inertia" else ("x",)
        return Trial(Candidate(effect, (), free), gain, 0.0, 1.0, p_value, gain - 1.0), None

    damping, drag, rotors = entry("rate_damping", 200.0), entry("linear_drag", 50.0), entry("rotor_inertia", 0.0, 1.0)
    *_, (trial, _) = shortlist([damping, drag, rotors])
    assert trial.candidate.effect == "rotor_inertia"
    begun = at_linear_size(POINT, trial.candidate, SimpleNamespace(theta=np.array([-1e-7])))
    assert begun.effects["rotor_inertia"]["inertia"] == 5e-8  # derivatives at none do not lead there
    assert [t.candidate.effect for t, _ in shortlist([drag, rotors])] == ["linear_drag"]
    found = [entry("rotor_inertia", 300.0), damping]  # by its derivative: once is enough
    assert sum(t.candidate.effect == "rotor_inertia" for t, _ in shortlist(found)) == 1


@pytest.mark.parametrize(("left", "doubtful"), [(False, frozenset()), (True, frozenset({"linear_drag"}))])
def test_an_effect_that_leaves_no_hump_is_not_doubted(monkeypatch, left: bool, doubtful: frozenset[str]) -> None:
    """Beside the hump the effect is of another size; that counts only where a hump stays once the effect is there."""
    hump = [SimpleNamespace(axis=0, frequency=4.0)]
    drone = POINT.with_effects({"linear_drag": {"x": 0.02, "y": 0.02, "z": 0.02}})
    monkeypatch.setattr(prune, "peaks", lambda model, point: hump if left or point is POINT else [])
    monkeypatch.setattr(prune, "nuisances", lambda data, point, accepted: ())

    def gram(move: float) -> Gram:
        scores = np.random.default_rng(1).normal(100.0 * move, 10.0, (30, 3))
        return Gram(scores, np.broadcast_to(1e4 * np.eye(3), (30, 3, 3)), np.zeros(30, int))

    monkeypatch.setattr(prune, "off_peak_gram", lambda data, point, columns, found: gram(-1.0))
    data = SimpleNamespace(models=[None], gram=lambda point, columns: gram(0.0))
    fitted = SimpleNamespace(point=drone, precision=np.zeros(3))
    assert prune.vibration_look_alikes(data, POINT, fitted, [DRAG], lambda text: None) == doubtful  # type: ignore[arg-type]
