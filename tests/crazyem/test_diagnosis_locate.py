"""Where a flight and a model part, in axes of the body and of the world: flights made elsewhere."""

import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.locating.locate import Located, locate


def located(hidden: Hidden, seed: int) -> Located:
    """Of the nominal model; the drone's yaw swings by 0.8 rad."""
    data = Data([flight_of(fly(hidden, seed=seed, seconds=6.0), DRONE)])
    return locate(data, nominal(data, Point(DRONE, {}, start_noise())))


def along_the_world(found: Located) -> dict[str, float]:
    return {f.axis: f.effect_size for f in found.findings if f.axis.startswith("world") and f.variable == ""}


@pytest.mark.parametrize(("axis", "breeze"), [("world x", (0.02, 0.0, 0.0)), ("world y", (0.0, -0.02, 0.0))])
def test_a_breeze_on_a_drone_that_turns_belongs_to_the_world(axis: str, breeze: tuple[float, float, float]) -> None:
    found = along_the_world(located(Hidden(breeze=breeze), seed=1))
    assert found[axis] == pytest.approx(sum(breeze), rel=0.1)


def test_nothing_and_a_weak_rotor_belong_to_no_axis_of_the_world() -> None:
    assert along_the_world(located(Hidden(), seed=2)) == {}
    weak = located(Hidden(thrust=(0.9, 1.0, 1.0, 1.0)), seed=3)
    strongest = max(weak.findings, key=lambda f: f.nats)
    assert not strongest.axis.startswith("world")
