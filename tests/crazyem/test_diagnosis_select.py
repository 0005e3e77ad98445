"""Onsets in mid-flight, and names that a vibration alone speaks for; flights in closed loop made elsewhere."""

from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly

from crazyem.diagnosis.always import refine_base
from crazyem.diagnosis.candidates import Candidate
from crazyem.diagnosis.fit import Data, Fitted, nominal, remembering, remembering_anew
from crazyem.diagnosis.flight import flight_of
from crazyem.diagnosis.model import Point
from crazyem.diagnosis.noise import first_guess
from crazyem.diagnosis.onset import ONSET, date

ONSET_TIME = 4.37  # s


@pytest.fixture(scope="module")
def failing() -> tuple[Data, Point]:
    """A rotor loses a tenth in flight, and the nominal model of it."""
    data = Data([flight_of(fly(Hidden(thrust=(1, 1, 0.9, 1), onset=ONSET_TIME), seconds=8.0), DRONE)])
    return data, nominal(data, Point(DRONE, {}, first_guess()))


def test_a_failure_hides_its_moment_in_the_noise_until_it_is_fitted_again(failing: tuple[Data, Point]) -> None:
    data, point = failing
    guess = ONSET_TIME - 0.9
    candidate = Candidate("rotor_fault", (("rotor", 3), (ONSET, guess)), ("scale",))
    begun = point.with_effects({"rotor_fault": {"rotor": 3, "scale": 0.95, ONSET: guess}})
    rough: Fitted = refine_base(data, begun, [candidate], rounds=2)
    fitted, dated = date(data, rough, candidate)
    found: Any = dict(dated.fixed)[ONSET]
    assert abs(found - ONSET_TIME) < 0.05
    assert fitted.candidates == (dated,)
    assert fitted.point.effects["rotor_fault"]["scale"] == pytest.approx(0.9, abs=0.01)
    assert np.all(fitted.point.noise.disturbance[3:5] < 0.3 * point.noise.disturbance[3:5])  # what hid it is gone
    assert fitted.loglik > rough.loglik + 50.0


def test_an_effect_from_the_start_is_not_dated(failing: tuple[Data, Point]) -> None:
    data, point = failing
    candidate = Candidate("torque_scale", (), ("scale",))
    fitted = Fitted(point, (candidate,), 0.0, None, np.zeros(0))  # type: ignore[arg-type]
    assert date(data, fitted, candidate) == (fitted, candidate)


def test_noise_is_chosen_anew_as_for_a_flight_seen_first() -> None:
    data = Data([flight_of(fly(seconds=5.0), DRONE)])
    data.settle(Point(DRONE, {}, first_guess()))
    white = data.fit_noise(Point(DRONE, {}, first_guess()))
    first = remembering(data, white)
    again = remembering_anew(data, first)
    assert again.noise.memory == first.noise.memory
    assert data.loglik(again) == pytest.approx(data.loglik(first), abs=3.0)
