"""What is left out again: an effect that noise explains as well must speak on flights held out, or go."""

from types import SimpleNamespace

import pytest
from closed_loop import DRONE

from crazyem.diagnosis import prune
from crazyem.diagnosis.candidates import Candidate
from crazyem.diagnosis.model import Point
from crazyem.diagnosis.noise import first_guess
from crazyem.diagnosis.trials import LIKELY, SURE, Step, Trial

DRAG = Candidate("linear_drag", (), ("x", "y", "z"))
TAKEN = Step((), Trial(DRAG, gain=30.0, held_out=20.0, dispersion=2.0, p_value=1e-6, evidence=12.0))
POINT = Point(DRONE, {}, first_guess())


def survivors(monkeypatch, *, p_value, held, gained=50.0, held_out=True):
    """What `survive` keeps where torques that wander gain `gained` nats, and the p-values it asked for."""
    asked = []

    def significance(fitted, count, *, offset):
        asked.append((count, offset))
        return p_value

    fitted = SimpleNamespace(point=POINT)
    monkeypatch.setattr(prune, "refine_base", lambda *a, **k: fitted)
    monkeypatch.setattr(prune, "significance", significance)
    monkeypatch.setattr(prune, "held_gain", lambda *a: held)
    data = SimpleNamespace(
        fit_noise=lambda point, iterations: point,
        loglik=lambda point, passes: gained if point.noise.disturbance.any() else 0.0,
    )
    _, accepted, steps = prune.survive(
        data, fitted, [DRAG], [TAKEN], SimpleNamespace() if held_out else None, lambda text: None
    )
    assert bool(accepted) == bool(steps)
    return accepted, asked


@pytest.mark.parametrize(
    ("p_value", "held", "held_out", "kept"),
    [
        (SURE / 2, 0.0, False, True),
        (SURE / 2, 0.0, True, True),
        (SURE * 2, 0.0, False, False),
        (SURE * 2, 0.0, True, False),
        (SURE * 2, 20.0, False, False),  # there is nothing held out to gain on
        (SURE * 2, 20.0, True, True),  # by chance with exp(-20 / dispersion)
        (SURE * 2, 1.0, True, False),
        (LIKELY * 2, 100.0, True, False),  # too doubtful where it was fitted
    ],
)
def test_an_effect_that_wandering_torques_explain(monkeypatch, p_value, held, held_out, kept):
    accepted, asked = survivors(monkeypatch, p_value=p_value, held=held, held_out=held_out)
    assert accepted == ([DRAG] if kept else [])
    assert asked == [(3, 0)]


def test_where_torques_do_not_wander_nothing_is_asked(monkeypatch):
    accepted, asked = survivors(monkeypatch, p_value=1.0, held=0.0, gained=prune.WANDERING / 2)
    assert accepted == [DRAG]
    assert asked == []
