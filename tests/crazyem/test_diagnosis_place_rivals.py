"""A cable is no wind and no lift near the floor; wind stays wind. Flown by `closed_loop.py`."""

from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import DRAG, WIND, ZERO_TRIM

from crazyem.diagnosis.diagnose import Diagnosis, diagnose
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.naming import place_rivals
from crazyem.diagnosis.naming.trials import Selection, Step, Trial
from crazyem.diagnosis.settings import CONFIDENCE
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.effect import Body
from crazyem.physics.effects.external_force import FORCE_BY_PLACE, pulling
from crazyem.vehicle import Vehicle

AIR = ("wind", "ground_effect", "linear_drag")
BLOCKS = np.linspace(-1.0, 1.0, 20)


def test_the_force_is_a_constant_and_a_matrix_times_the_place() -> None:
    """By hand: 90 degrees of yaw take world x to body -y."""
    quarter = np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    there = SimpleNamespace(size=1, position=np.array([[1.0, 2.0, 3.0]]))
    there.to_body = lambda world: np.einsum("nji,nj->ni", quarter, world)
    values = FORCE_BY_PLACE.complete({"x": 0.1, "z": -0.2, "xy": 0.01, "zz": -0.05}, {})
    found = pulling(there, Body(0.03, np.eye(3), np.zeros(3)), **values)
    np.testing.assert_allclose(found.force, [[0.0, -(0.1 + 0.01 * 2.0), -0.2 - 0.05 * 3.0]], atol=1e-15)
    assert not found.torque.any()


def diagnosed(hidden: Hidden) -> Diagnosis:
    flights = [fly(hidden, seed=seed, seconds=12.0) for seed in range(2)]
    return diagnose(flights[:1], DRONE, held_out=flights[1:], wanted=AIR)


@pytest.mark.slow
def test_a_cable_is_unexplained_and_told_by_place() -> None:
    """Pulled down the more the higher it is, and to one side: wind and lift near the floor to the catalogue."""
    found = diagnosed(Hidden(cable=(0.06, 0.4)))
    assert not {"wind", "ground_effect", "gusts"} & {e.name for e in found.effects}
    assert found.mismatch
    worst = found.unexplained.findings[0]
    assert (worst.signal, worst.regime) == ("force", f"{worst.axis} position")  # it pulls back from all sides
    assert worst.effect_size < 0
    assert "force_by_place" not in found.fitted_vehicle.effects


@pytest.mark.slow
def test_wind_stays_wind() -> None:
    found = diagnosed(Hidden(breeze=(0.02, -0.01, 0.0)))
    assert [e.name for e in found.effects] == ["wind"]
    assert not found.unexplained.found


def asked(
    monkeypatch: pytest.MonkeyPatch,
    *,
    named: float,
    force: float,
    unsteady: float = 0.0,
    vehicle: Vehicle = DRONE,
    left: float = 30.0,
) -> Selection:
    """Wind and a drag, worth `named` nats, against a force by place and the drag, worth `force`.

    `unsteady`: nats by which the force is better and worse in turns, block by block.
    """
    bare = Point(vehicle, {}, start_noise())
    point = bare.with_effects({"wind": {"x": 1.0, "y": 0.0, "z": 0.0}, "linear_drag": {"x": 0.01, "y": 0.0, "z": 0.0}})
    steps = tuple(Step((), Trial(c, 50.0, 50.0, 1.0, 50.0)) for c in (WIND, DRAG))
    selection = Selection(bare, point, steps, (WIND, DRAG), SimpleNamespace())
    scatter = unsteady * np.tile([-1.0, 1.0], 10)

    together = SimpleNamespace(block_loglik=lambda at: BLOCKS if "wind" in at.effects else BLOCKS + scatter)
    data = SimpleNamespace(signals={"position"}, together_with=lambda other: together, workers=Workers(1))
    data.twin = lambda: data

    def fitted(flights, at, accepted):
        assert list(accepted) == ([WIND, DRAG] if "wind" in at.effects else [DRAG, place_rivals.FORCE])
        return SimpleNamespace(point=at, candidates=tuple(accepted), loglik=named if WIND in accepted else force)

    monkeypatch.setattr(place_rivals, "left_by_place", lambda data, point: left)
    monkeypatch.setattr(place_rivals, "refine_base", fitted)
    monkeypatch.setattr(place_rivals, "with_torque_memory_refit", lambda data, at: at)
    monkeypatch.setattr(place_rivals, "_finding", lambda data, found, nats: SimpleNamespace(nats=nats))
    found, finding = place_rivals.by_place(data, None, selection)
    assert (finding is None) == (found is selection)
    assert finding is None or finding.nats == force - named - 9  # twelve parameters against three
    return found


def test_what_is_better_as_a_force_by_place_loses_its_name_and_the_rest_stays(monkeypatch) -> None:
    found = asked(monkeypatch, named=100.0, force=150.0)
    assert found.accepted == (DRAG,)
    assert [s.taken.candidate for s in found.steps if s.taken] == [DRAG]
    assert "force_by_place" in found.final.effects


@pytest.mark.parametrize(("force", "unsteady"), [(100.0, 0.0), (130.0, 0.0), (150.0, 60.0)])
def test_what_is_little_better_or_here_and_there_only_keeps_it(monkeypatch, force: float, unsteady: float) -> None:
    assert asked(monkeypatch, named=100.0, force=force, unsteady=unsteady).accepted == (WIND, DRAG)


@pytest.mark.parametrize(("deviations", "kept"), [(1.60, True), (1.69, False)])
def test_a_force_by_place_is_the_better_one_with_all_but_one_chance_in_twenty(
    monkeypatch, deviations: float, kept: bool
) -> None:
    """41 nats after the cost of parameters, over their standard deviation: 1.645 of a normal distribution are 5 %."""
    assert CONFIDENCE.min_look_alike == 0.05
    found = asked(monkeypatch, named=100.0, force=150.0, unsteady=41.0 / deviations / 20**0.5)
    assert found.accepted == ((WIND, DRAG) if kept else (DRAG,))


@pytest.mark.parametrize("more", [{"left": 20.0}, {"vehicle": ZERO_TRIM}], ids=["little is left by place", "a trim"])
def test_where_nothing_is_left_by_place_and_beside_a_trim_nothing_is_compared(monkeypatch, more):
    assert asked(monkeypatch, named=100.0, force=150.0, **more).accepted == (WIND, DRAG)
