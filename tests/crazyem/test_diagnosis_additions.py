"""Two explanations of one thing gain no more together than the better one alone; two things do."""

from typing import Any

from crazyem.diagnosis.candidates import Candidate
from crazyem.diagnosis.select import additions
from crazyem.diagnosis.trials import Step, Trial


def trial(effect: str, gain: float, *, fitted: bool = True, fixed: tuple[tuple[str, object], ...] = ()) -> Trial:
    there: Any = object() if fitted else None
    return Trial(Candidate(effect, fixed, ("x",)), gain, 0.0, 1.0, 1e-9, gain - 1, fitted=there)


def test_what_keeps_its_gain_is_another_thing() -> None:
    step = Step(
        (
            trial("thrust_scale", 500.0),
            trial("payload", 490.0),
            trial("velocity_scale", 480.0),
            trial("wind", 100.0, fitted=False),
            trial("gyro_bias", -3.0),
        ),
        None,
    )
    later = [
        trial("payload", 2.0),
        trial("velocity_scale", 300.0),
        trial("velocity_scale", 470.0, fixed=(("a", 1),)),
        trial("wind", 99.0),
        trial("gyro_bias", 5.0),
    ]
    assert additions(step, later) == {"velocity_scale"}


def test_what_was_not_asked_again_stays_a_rival() -> None:
    assert additions(Step((trial("inertia", 50.0),), None), []) == frozenset()
