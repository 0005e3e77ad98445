"""Where a diagnosis begins again, goes on, or is less sure.

Torques that turn nothing, names that were exchanged, effects that their own uncertainty would allow to be none, a load
beside two weak rotors, a day's differences; on flights of `closed_loop.py`.
"""

from dataclasses import replace

import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis import diagnose as diagnosing
from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, DivergedError, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import COARSE_REASON, refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.locating.locate import Finding
from crazyem.diagnosis.locating.random_torques import AT_RANDOM
from crazyem.diagnosis.naming import answer, onset, trials
from crazyem.diagnosis.naming.named import confidence_factor
from crazyem.diagnosis.naming.select import select
from crazyem.diagnosis.naming.trials import Selection
from crazyem.diagnosis.naming.unexplained import Unexplained, notable
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.physics.effects import mass_properties

DRAG = Candidate("linear_drag", (), ("x", "y", "z"))
THRUST = Candidate("thrust_scale", (), ("scale",))
TRIMMED = replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}})


@pytest.fixture(scope="module")
def slow_to_turn():
    """Looks as if it were heavier to turn by 1/0.6, and is dragged."""
    return fly(Hidden(torque=0.6, drag=(0.02, 0.02, 0.02)), seconds=12.0, seed=5)


@pytest.mark.slow
def test_an_inertia_that_no_body_has_leaves_open_what_turns_the_drone(slow_to_turn, monkeypatch):
    wanted = ("inertia", "linear_drag")
    monkeypatch.setattr(trials, "presence", lambda *given, **more: 0.9)  # one short flight says little for either
    found = diagnose([slow_to_turn], DRONE, wanted=wanted)
    assert {e.name for e in found.effects} == {"inertia", "linear_drag"}
    assert not found.left_out
    monkeypatch.setattr(mass_properties, "FAR_OUT", 0.1)  # as if the drone were that much smaller than what it needs
    said = []
    again = diagnose([slow_to_turn], DRONE, wanted=wanted, say=said.append)
    assert [e.name for e in again.effects] == ["linear_drag"]
    assert again.left_out == {"inertia": COARSE_REASON}
    assert sum("once more without what is fast" in text for text in said) == 1
    for axis in "xyz":
        assert again.effects[0].parameters[axis].value == pytest.approx(0.02, abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("diverges", [False, True])
def test_an_effect_without_a_sound_fit_is_left_out_and_the_selection_goes_on(monkeypatch, diverges):
    """In the fit with all nuisances, a thrust scale is at the end of its range, or the filter leaves the numbers."""
    data = Data([flight_of(fly(Hidden(drag=(0.02, 0.02, 0.02), thrust=(0.9,) * 4), seconds=10.0), DRONE)])
    point = nominal(data, Point(DRONE, {}, start_noise()))
    real, said = onset.refine_with_memory, []
    end = THRUST.range_of("scale")[0]

    def unsound(data, point, accepted, **more):
        fit = real(data, point, accepted, **more)
        if accepted[-1] is not THRUST:
            return fit
        if diverges:
            raise DivergedError("the filter leaves the range of numbers")
        return replace(fit, point=fit.point.with_effects({"thrust_scale": {"scale": end}}))

    monkeypatch.setattr(onset, "refine_with_memory", unsound)
    found = select(data, point, [THRUST, DRAG], say=said.append)
    reason = "the model leaves the range of numbers" if diverges else "at the end of its physical range"
    assert sum(f"{reason}: thrust_scale" in text for text in said) == 1
    assert "thrust_scale" not in {c.effect for c in found.accepted}
    assert "thrust_scale" not in found.final.effects
    assert all(s.taken.candidate.effect != "thrust_scale" for s in found.steps if s.taken)


@pytest.mark.slow
def test_after_an_exchange_the_selection_goes_on(slow_to_turn, monkeypatch):
    """Made to exchange what it found for nothing, it finds it again; where nothing is exchanged, it is not asked."""
    calls = []
    real = diagnosing.select

    def counted(*arguments, begun=None, **more):
        calls.append(begun)
        return real(*arguments, begun=begun, **more)

    def emptied(data, apart, selection, say):
        return Selection(selection.nominal, selection.nominal, (), (), refine_base(data, selection.nominal, ()))

    monkeypatch.setattr(diagnosing, "select", counted)
    assert [e.name for e in diagnose([slow_to_turn], DRONE, wanted=["linear_drag"]).effects] == ["linear_drag"]
    assert calls == [None]
    monkeypatch.setattr(diagnosing, "with_better_rivals", emptied)
    assert [e.name for e in diagnose([slow_to_turn], DRONE, wanted=["linear_drag"]).effects] == ["linear_drag"]
    assert len(calls) == 3
    assert calls[2].accepted == ()


@pytest.mark.slow
@pytest.mark.parametrize(("vehicle", "alike"), [(DRONE, False), (TRIMMED, True)])
def test_with_a_trim_a_load_is_told_with_two_weak_rotors(vehicle, alike):
    """A tenth less thrust of the left rotors; a load there explains it, where nothing else is asked."""
    flown = fly(Hidden(thrust=(1.0, 1.0, 0.85, 0.85)), seconds=10.0)
    found = diagnose([flown], vehicle, wanted=["payload"])
    assert [e.name for e in found.effects] == ["payload"]
    assert found.effects[0].parameters["y"].value > 0.003
    assert any({"payload", "rotor_fault"} <= set(group) for group in found.indistinguishable) == alike


def test_from_day_to_day_forces_differ_by_more():
    point = Point(DRONE, {}, start_noise())
    weight = 9.81 * DRONE.mass
    for share, vehicle, counts in ((0.015, DRONE, True), (0.015, TRIMMED, False), (0.025, TRIMMED, True)):
        force = Finding("force", "x", "always", "", (0.0, 9.0), share * weight, 1e-4, "N", 60.0, 1e-9)
        assert notable(force, replace(point, vehicle=vehicle)) == counts
        assert notable(force, replace(point, vehicle=vehicle), differ=True) == (share > 0.02)


def test_where_torques_say_nothing_they_say_nothing_against_what_forces_tell():
    def left(signal: str, nats: float) -> Finding:
        return Finding(signal, "x", "always", "", (0.0, 9.0), 1.0, 0.1, "", nats, 1e-9)

    remains = Unexplained((left("torque", 300.0), left("body_rate", 90.0)), 900.0)
    assert confidence_factor(remains) == CONFIDENCE.doubtful
    assert confidence_factor(remains.of_forces()) == 1.0
    assert confidence_factor(remains.with_finding(left("force", 100.0)).of_forces()) == CONFIDENCE.doubtful


def test_a_rotor_that_pushes_at_random_says_nothing_against_forces_that_last():
    """One real drone's fourth rotor does, beside a thrust that is a quarter too weak by 80 000 nats."""
    rotor = Finding("torque", "x", "rotor 4 at random", AT_RANDOM, (0.0, 9.0), 1e-4, 1e-5, "N m", 60.0, 1e-9)
    shaken = Finding("torque", "x", "frequency 5.2 Hz", "frequency", (0.0, 9.0), 1e-4, 1e-5, "N m", 60.0, 1e-9)
    remains = Unexplained((rotor,), 900.0)
    assert confidence_factor(remains) == CONFIDENCE.doubtful
    assert confidence_factor(remains.without_random_rotor()) == 1.0
    assert confidence_factor(remains.without_random_rotor(4)) == 1.0  # nor against its being weak
    assert confidence_factor(remains.without_random_rotor(1)) == CONFIDENCE.doubtful
    swinging = remains.with_finding(shaken)  # a loop that swings looks like a drag
    assert confidence_factor(swinging.without_random_rotor()) == CONFIDENCE.doubtful
    data = Data([flight_of(fly(seconds=8.0), DRONE)])
    point = nominal(data, Point(DRONE, {}, start_noise()))
    for name, rotor, against in (
        ("linear_drag", 0, False), ("inertia_products", 0, True), ("rotor_fault", 4, False), ("rotor_fault", 1, True),
    ):  # fmt: skip
        free = {"inertia_products": "xy", "rotor_fault": "scale"}.get(name, "x")
        candidate = Candidate(name, (("rotor", rotor),) if rotor else (), (free,))
        assert answer._against(remains, candidate, data, point).found == against
    for name, against in (("velocity_scale", False), ("gyro_bias", True), ("linear_drag", True)):
        assert answer._against(swinging, Candidate(name, (), ("x",)), data, point).found == against
