"""What is steady: a trim among its look-alikes, the file that is written with one, and another day of the drone."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import LAG, LOAD, ZERO_TRIM, rotor, silent
from made_flight import changed

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting import sweeps
from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, nominal
from crazyem.diagnosis.fitting.model import Noise, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.fitting.sampling import mean_torque
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming import select as selecting
from crazyem.diagnosis.naming import steady as steadying
from crazyem.diagnosis.naming.evidence import _inverse
from crazyem.diagnosis.naming.gusts import push_of
from crazyem.diagnosis.naming.select import Basis, shortlist, step_of
from crazyem.diagnosis.naming.steady import steady_rivals, with_exact_torques, without_trim_rivals
from crazyem.diagnosis.naming.trials import Selection, Trial, preferred
from crazyem.diagnosis.settings import WIND
from crazyem.diagnosis.workers import Workers
from crazyem.vehicle import Vehicle

NOISE = Noise(np.full(6, 0.3), np.full(4, 1e-2))
TWIST = 9e-4  # m: torque about z over thrust, as two real drones need it
ASKED = Candidate(TRIM, (), ("x", "y", "z"))
WEAK, LATE = rotor(3), rotor(3, onset=7.5)


def point_of(vehicle: Vehicle, **effects: dict[str, Any]) -> Point:
    return Point(vehicle, {**{n: dict(v) for n, v in vehicle.effects.items()}, **effects}, NOISE)


def shaking(recording, *, seed):
    """With commands that were logged between others that acted: white, a tenth of the command, with no effect."""
    logged = recording.signals["motor_command"].value
    noise = 0.1 * np.nanmean(logged) * np.random.default_rng(seed).standard_normal(logged.shape)
    return changed(recording, "motor_command", value=logged + noise)


def trial(candidate: Candidate, value: float, scatter: float = 0.1) -> Trial:
    blocks = np.full(20, value / 20) + scatter * np.random.default_rng(len(candidate.free)).standard_normal(20)
    fitted: Any = SimpleNamespace()
    return Trial(candidate, value, value, 1.0, value, fitted, True, blocks, value)


@pytest.mark.slow
def test_a_steady_torque_that_nothing_explains_is_written_as_a_trim() -> None:
    found = diagnose([fly(Hidden(twist=TWIST), seconds=14.0, seed=5)], DRONE)
    assert [(f.signal, f.axis, f.variable) for f in found.unexplained.findings][:1] == [("torque", "z", "")]
    trim = found.fitted_vehicle.effects[TRIM]
    assert trim["z"] == pytest.approx(TWIST, rel=0.1)  # a day is worth twice as much
    assert abs(trim["x"]) < 2e-5
    assert abs(trim["y"]) < 2e-5
    assert found.fitted_vehicle.effects["thrust_scale"]["scale"] == pytest.approx(1.0, abs=0.005)
    assert TRIM not in DRONE.effects
    # on another day thrust is 1 % less, the rotors on the left a little weaker, and the twist another
    other = fly(Hidden(twist=TWIST + 1e-4, thrust=(0.995, 0.995, 0.985, 0.985)), seconds=14.0, seed=6)
    assert not diagnose([other], found.fitted_vehicle).mismatch


@pytest.mark.slow
def test_a_drone_whose_commands_shake_has_a_trim_first() -> None:
    """As those of real drones with a deck, logged at 100 Hz; judged by a file that knows no trim, then by its own."""
    strong = 1.04  # within what any drone may have, and part of its file all the same
    healthy = shaking(fly(Hidden(twist=TWIST, thrust=(strong,) * 4), seconds=10.0, seed=8), seed=1)
    found = diagnose([healthy], DRONE)
    assert [e.name for e in found.effects] == [TRIM]
    assert found.fitted_vehicle.effects["thrust_scale"]["scale"] == pytest.approx(strong, abs=0.005)
    assert found.effects[0].name == TRIM
    assert found.effects[0].parameters["z"].value == pytest.approx(TWIST, rel=0.1)
    assert "center_of_mass" in found.left_out
    again = shaking(fly(Hidden(twist=TWIST, thrust=(strong,) * 4), seconds=10.0, seed=9), seed=2)
    assert not diagnose([again], found.fitted_vehicle).mismatch
    weak = Hidden(twist=TWIST, thrust=(strong, strong, 0.72 * strong, strong))
    cut = diagnose([shaking(fly(weak, seconds=10.0, seed=10), seed=3)], found.fitted_vehicle)
    assert (cut.effects[0].name, cut.effects[0].chosen["rotor"]) == ("rotor_fault", 3)
    assert cut.effects[0].parameters["scale"].value == pytest.approx(0.72, abs=0.05)


@pytest.mark.slow
def test_an_offset_of_the_gyro_is_found_where_commands_shake() -> None:
    """No command is needed to see that attitude and gyro part."""
    shaken = shaking(fly(seconds=10.0, seed=8), seed=1)
    offset = {"x": 0.03, "y": 0.0, "z": -0.02}
    gyro = shaken.signals["body_rate"].value + np.array([*offset.values()])
    found = diagnose([changed(shaken, "body_rate", value=gyro)], ZERO_TRIM)
    assert [e.name for e in found.effects] == ["gyro_bias"]
    for axis, value in found.effects[0].parameters.items():
        assert value.ci95[0] < offset[axis] < value.ci95[1]


def test_a_centre_of_mass_is_where_the_mean_commands_are_balanced() -> None:
    """Rotors on the left weaker, on the right stronger by 4 %, and quick torques off by 3 %, as sampled commands make
    them look. A drone that flies for a while and does not turn over has no torque on average: no fit needed."""
    flown = fly(Hidden(thrust=(1.04, 1.04, 0.96, 0.96)), seconds=14.0, seed=11)
    flight = flight_of(flown, DRONE)
    swung = flight.inputs.thrust - flight.inputs.thrust.mean(0)
    seen = replace(flight, inputs=replace(flight.inputs, thrust=flight.inputs.thrust.mean(0) + 1.03 * swung))
    along_x, along_y, _ = mean_torque(seen, DRONE)
    data = Data([seen])
    shifted = Candidate("center_of_mass", (), ("x", "y", "z"))
    fitted = refine_base(data, nominal(data, Point(DRONE, {"center_of_mass": {"y": 1e-3}}, start_noise())), [shifted])
    selection: Any = Selection(fitted.point, fitted.point, (), (shifted,), fitted)
    loose = fitted.point.effects["center_of_mass"]
    whole = with_exact_torques(data, selection).final.effects["center_of_mass"]
    assert whole["y"] == pytest.approx(along_x, rel=0.015)
    assert whole["x"] == pytest.approx(-along_y, abs=2e-5)
    assert abs(loose["y"] - along_x) > 2 * abs(whole["y"] - along_x)


def test_what_keeps_the_freedom_of_all_torques(monkeypatch) -> None:
    """Where torques were named, no centre is to be known, the day's trim is free, or the fit goes astray."""
    data: Any = SimpleNamespace()
    shifted, torques = (Candidate(n, (), ("y",)) for n in ("center_of_mass", "torque_scale"))
    asked: list[Any] = []

    def lost(*arguments: Any, **options: Any) -> Any:
        asked.append(arguments)
        raise DivergedError("lost")

    monkeypatch.setattr(steadying, "refine", lost)
    monkeypatch.setattr(steadying, "nuisances", lambda data, point, accepted: [])
    for accepted, vehicle in (((shifted, torques), DRONE), ((WEAK,), DRONE), ((), DRONE), ((shifted,), ZERO_TRIM)):
        kept: Any = SimpleNamespace(accepted=accepted, final=point_of(vehicle))
        assert with_exact_torques(data, kept) is kept
    assert not asked
    for name in ("center_of_mass", "payload"):
        tried: Any = SimpleNamespace(accepted=(replace(shifted, effect=name),), final=point_of(DRONE))
        assert with_exact_torques(data, tried) is tried
    assert len(asked) == 2


def test_with_a_trim_that_nobody_knew_what_is_steady_is_not_told_from_it() -> None:
    trim, weak, load = trial(ASKED, 100.0), trial(WEAK, 120.0), trial(LOAD, 60.0)
    assert steady_rivals(trim, [weak, load, trial(replace(ASKED, effect="wind"), 110.0)]) == (weak,)
    assert steady_rivals(trim, [load]) == ()
    # a trim is there in any case: what explains more makes it a toss, and no worse
    assert preferred(trim, [weak]) == pytest.approx(0.5)
    assert preferred(trial(Candidate("wind", (), ("x", "y", "z")), 100.0), [weak]) < 0.01


def test_a_trim_that_is_asked_for_is_fitted_and_taken_before_a_better_weak_rotor(monkeypatch) -> None:
    filed = point_of(ZERO_TRIM)
    better = [trial(rotor(r), 200.0 + r) for r in (1, 2, 3, 4)]
    others = [trial(Candidate(n, (), ("x",)), 150.0) for n in ("linear_drag", "wind", "gyro_bias", "velocity_scale")]
    linear: Any = [(t, None) for t in (*better, *others, trial(ASKED, 60.0))]
    assert sum(t.candidate.effect == TRIM for t, _ in shortlist(linear)) == 1
    monkeypatch.setattr(selecting, "fitted_trial", lambda basis, entry, solution, *, say: entry)
    data: Any = SimpleNamespace(workers=Workers(1))
    step = step_of(Basis(data, None, filed, (), 0.0, 0.0), linear, say=silent)
    assert step.taken.candidate is ASKED
    assert {t.candidate.effect for t in step.alike} == {"rotor_fault"}
    small: Any = [(replace(t, admissible=False) if t.candidate is ASKED else t, None) for t, _ in linear]
    monkeypatch.setattr(selecting, "compared_with_refitted_noise", lambda basis, trials, *, say: (trials, trials[:1]))
    step = step_of(Basis(data, None, filed, (), 0.0, 0.0), small, say=silent)
    assert step.taken.candidate.effect == "rotor_fault"


def test_a_trial_whose_scores_scatter_does_not_end_the_search(monkeypatch) -> None:
    """Fitted, a tilt has scores that scatter 60 times too much. By the common dispersion of 31 the tilt of 110 nats is
    before a lag of 90; by its own dispersion, it explains nothing."""
    tilt = Trial(Candidate("attitude_misalignment", (), ("roll",)), 110.0, 0.0, 20.0, 4.5, admissible=True)
    lag = Trial(LAG, 90.0, 0.0, 2.0, 44.0, admissible=True)

    def fitted_trial(basis, trial, solution, *, say):
        return replace(trial, fitted=object(), dispersion=60.0 if trial is tilt else 2.0)

    monkeypatch.setattr(selecting, "fitted_trial", fitted_trial)
    data: Any = SimpleNamespace(workers=Workers(1))
    basis = Basis(data, None, point_of(DRONE), (), 0.0, 0.0)
    entries: Any = [(lag, None), (tilt, None)]
    assert {t.candidate.effect for t, _ in shortlist(entries)} == {"attitude_misalignment", "motor_lag"}
    found = step_of(basis, entries, say=silent)
    assert found.taken.candidate is lag.candidate
    assert [t.candidate for t in found.trials] == [lag.candidate, tilt.candidate]
    assert step_of(basis, entries[1:], say=silent).taken is None


def test_beside_a_trim_neither_a_weak_rotor_nor_the_place_of_a_load_is_asked_for() -> None:
    assert without_trim_rivals([WEAK, LATE, LOAD], []) == [WEAK, LATE, LOAD]
    assert without_trim_rivals([WEAK, LATE, LOAD], [ASKED]) == [LATE, replace(LOAD, free=("mass",))]


def test_a_drag_that_is_free_near_nothing_does_not_make_a_storm_of_a_force() -> None:
    for drag, push in ((None, WIND.drag), (2e-5, WIND.drag), (0.012, 0.012)):
        effects = {"linear_drag": dict.fromkeys("xyz", drag)} if drag else {}
        assert push_of(point_of(DRONE, **effects)) == pytest.approx(push)


def test_a_curvature_that_says_nothing_of_a_parameter_has_an_inverse_and_one_that_is_not_finite_has_diverged() -> None:
    """The first was divided by 1e-300, and one flight of 320 ended with 'SVD did not converge'."""
    np.testing.assert_allclose(_inverse(np.diag([4.0, 0.0, 1e-12])), np.diag([0.25, 0.0, 1e12]))
    with pytest.raises(DivergedError, match="not finite"):
        _inverse(np.diag([1.0, np.inf]))


def test_noise_under_which_a_variance_is_none_is_not_likely(monkeypatch) -> None:
    flight = flight_of(fly(seconds=6.0), DRONE)
    data = Data([flight])
    point = point_of(DRONE)
    assert np.isfinite(data.loglik(point))
    kernel = sweeps.sweep

    def lost(*arrays: Any) -> float:
        value = kernel(*arrays)
        arrays[18][3, 0] = -1e299  # a variance
        return float(value) + 1e6  # as likely as it then seems

    monkeypatch.setattr(sweeps, "sweep", lost)
    assert data.loglik(point) == -np.inf
    with pytest.raises(DivergedError):
        refine_base(data, point, ())
    fitted = data.fit_noise(point)
    assert np.allclose(fitted.noise.impulse, point.noise.impulse)  # nothing is gained by going anywhere
