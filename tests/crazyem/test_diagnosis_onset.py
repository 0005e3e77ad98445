"""Since when an effect is there: the block by sums of scores, the tenth of a second by the likelihood."""

import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming.onset import ONSET, onset_of

ROTOR = Candidate("rotor_fault", (("rotor", 2), (ONSET, None)), ("scale",))


def found(hidden: Hidden) -> Candidate | None:
    data = Data([flight_of(fly(hidden, seconds=9.0, seed=5), DRONE)])
    point = nominal(data, Point(DRONE, {}, start_noise()))
    return onset_of(data, point, ROTOR, data.gram(point, ROTOR.columns(point)), [0])


@pytest.mark.parametrize("onset", [5.3, 5.7, 5.9])
def test_a_rotor_that_weakens_within_a_block(onset: float) -> None:
    late = found(Hidden(thrust=(1.0, 0.88, 1.0, 1.0), onset=onset))
    assert late is not None
    assert dict(late.fixed)["rotor"] == 2
    assert dict(late.fixed)[ONSET] == pytest.approx(onset, abs=0.1)


def test_a_rotor_that_is_weak_from_the_start() -> None:
    assert found(Hidden(thrust=(1.0, 0.88, 1.0, 1.0))) is None
