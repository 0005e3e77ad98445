"""Where a diagnosis begins again, goes on, or is less sure.

Torques that turn nothing, names that were exchanged, effects that their own uncertainty would allow to be none, a load
beside two weak rotors, a day's differences; on flights of `closed_loop.py`.
"""

from dataclasses import replace

import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, THRUST, ZERO_TRIM, nominal_of, start_point

from crazyem.diagnosis import diagnose as diagnosing
from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import DivergedError
from crazyem.diagnosis.fitting.nuisances import COARSE_REASON, refine_base
from crazyem.diagnosis.locating.locate import Finding
from crazyem.diagnosis.locating.random_torques import AT_RANDOM
from crazyem.diagnosis.naming import answer, starting_points, trials
from crazyem.diagnosis.naming.answer import confidence_factor
from crazyem.diagnosis.naming.select import select
from crazyem.diagnosis.naming.trials import Selection
from crazyem.diagnosis.naming.unexplained import Unexplained, notable
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.physics.effects import mass_properties


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
    data, point = nominal_of(fly(Hidden(drag=(0.02, 0.02, 0.02), thrust=(0.9,) * 4), seconds=10.0))
    real, said = starting_points.refine_with_memory, []

    def unsound(data, point, accepted, **more):
        fit = real(data, point, accepted, **more)
        if accepted[-1] is not THRUST:
            return fit
        if diverges:
            raise DivergedError("the filter leaves the range of numbers")
        return replace(fit, point=fit.point.with_effects({"thrust_scale": {"scale": THRUST.range_of("scale")[0]}}))

    monkeypatch.setattr(starting_points, "refine_with_memory", unsound)
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
@pytest.mark.parametrize(("vehicle", "alike"), [(DRONE, False), (ZERO_TRIM, True)])
def test_with_a_trim_a_load_is_told_with_two_weak_rotors(vehicle, alike):
    """A tenth less thrust of the left rotors; a load there explains it, where nothing else is asked."""
    flown = fly(Hidden(thrust=(1.0, 1.0, 0.85, 0.85)), seconds=10.0)
    found = diagnose([flown], vehicle, wanted=["payload"])
    assert [e.name for e in found.effects] == ["payload"]
    assert found.effects[0].parameters["y"].value > 0.003
    assert any({"payload", "rotor_fault"} <= set(group) for group in found.indistinguishable) == alike


@pytest.mark.parametrize(
    ("share", "vehicle", "counts"), [(0.015, DRONE, True), (0.015, ZERO_TRIM, False), (0.025, ZERO_TRIM, True)]
)
def test_from_day_to_day_forces_differ_by_more(share, vehicle, counts):
    force = Finding("force", "x", "always", "", (0.0, 9.0), share * 9.81 * DRONE.mass, 1e-4, "N", 60.0, 1e-9)
    assert notable(force, start_point(vehicle)) == counts
    assert notable(force, start_point(vehicle), differ=True) == (share > 0.02)


def left(signal, nats, *, axis="x", regime="always", variable=""):
    return Finding(signal, axis, regime, variable, (0.0, 9.0), 1.0, 0.1, "", nats, 1e-9)


def test_where_torques_say_nothing_they_say_nothing_against_what_forces_tell():
    remains = Unexplained((left("torque", 300.0), left("body_rate", 90.0)), 900.0)
    assert confidence_factor(remains) == CONFIDENCE.doubtful
    assert confidence_factor(remains.of_forces()) == 1.0
    assert confidence_factor(remains.with_finding(left("force", 100.0)).of_forces()) == CONFIDENCE.doubtful


def test_a_rotor_that_pushes_at_random_says_nothing_against_forces_that_last():
    """One real drone's fourth rotor does, beside a thrust that is a quarter too weak by 80 000 nats."""
    remains = Unexplained((left("torque", 60.0, regime="rotor 4 at random", variable=AT_RANDOM),), 900.0)
    shaken = left("torque", 60.0, regime="frequency 5.2 Hz", variable="frequency")
    swinging = remains.with_finding(shaken)  # a loop that swings looks like a drag
    for said, factor in (
        (remains, CONFIDENCE.doubtful),
        (remains.without_random_rotor(), 1.0),
        (remains.without_random_rotor(4), 1.0),  # nor against its being weak
        (remains.without_random_rotor(1), CONFIDENCE.doubtful),
        (swinging.without_random_rotor(), CONFIDENCE.doubtful),
    ):
        assert confidence_factor(said) == factor
    data, point = nominal_of(fly(seconds=8.0))
    for left_over, name, fixed, free, against in (
        (remains, "linear_drag", (), "x", False),
        (remains, "inertia_products", (), "xy", True),
        (remains, "rotor_fault", (("rotor", 4),), "scale", False),
        (remains, "rotor_fault", (("rotor", 1),), "scale", True),
        (swinging, "velocity_scale", (), "x", False),
        (swinging, "gyro_bias", (), "x", True),
        (swinging, "linear_drag", (), "x", True),
    ):
        assert answer._against(left_over, Candidate(name, fixed, (free,)), data, point).found == against
