"""A gyro that is late: found by how rates are behind the motion, not by differences of what a filter made of them.

The recording is flown by `closed_loop.py`, which shares no line with the diagnosis, and its rates are shifted by a
spline.
"""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from made_flight import array_of
from scipy.interpolate import CubicSpline

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import Conditions

GYRO = Candidate("measurement_delay", (("streams", ("gyro",)),), ("delay",))


@pytest.mark.parametrize("late", [0.0, 0.003, 0.006])
def test_a_late_gyro_is_late_by_what_it_was_shifted(late: float) -> None:
    """With what is always free of onboard filters, which starts at 1.2 ms and is 0 here. By differences of the filtered
    rates, which hold the noise of the sample that they are to explain, it was 0 for all three."""
    recording = fly(seconds=8.0, seed=3)
    rate = recording.signals["body_rate"]
    shown = array_of("body_rate", rate.time, CubicSpline(rate.time, rate.value)(rate.time - late), place=95)
    data = Data([flight_of(replace(recording, signals={**recording.signals, "body_rate": shown}), DRONE)])
    begun = nominal(data, Point(DRONE, {}, start_noise())).with_effects(
        {"measurement_delay": {"delay": 0.002, "streams": ("gyro",)}}
    )
    found = refine_base(data, begun, [GYRO]).point.effects
    total = found["measurement_delay"]["delay"] + found["onboard_filter"]["rate_lag"]
    assert total == pytest.approx(late, abs=0.6e-3)


@pytest.mark.parametrize(("onboard", "gyro", "state"), [(True, 0.002, 0.006), (False, 0.003, 0.003)])
def test_less_of_a_gyro_matters_where_the_attitude_is_made_of_it(onboard: bool, gyro: float, state: float) -> None:
    prior, conditions = CATALOGUE["measurement_delay"].prior, Conditions(onboard=onboard)
    for streams, limit in ((("gyro",), gyro), (("state",), state)):
        assert prior.detection_limit_in({"streams": streams}, conditions)["delay"][1] == limit
    lags = CATALOGUE["onboard_filter"].prior
    signals = frozenset({"position", "attitude", "body_rate"})
    mean = lags.centre_in(replace(conditions, signals=signals))["rate_lag"]
    sd = lags.usual_in(replace(conditions, signals=signals))["rate_lag"]
    # a gyro without a filter, and the Crazyflie's of 80 Hz beside a pose that is not made of it
    assert abs(mean - 0.0) <= 2.0 * sd
    assert onboard or abs(mean - np.sqrt(2.0) / (2.0 * np.pi * 80.0)) < 1e-4


def test_rates_of_motion_alone_are_turned_by_what_acts() -> None:
    """The rate but for a constant: the sum of angular accelerations over the steps, none across a gap."""
    recording = fly(seconds=8.0)
    data = Data([flight_of(recording, DRONE)])
    point = nominal(data, Point(DRONE, {}, start_noise()))
    model = data.models[0]
    model.settle(point)
    with_delay = point.with_effects({"measurement_delay": {"delay": 0.01, "streams": ("gyro",)}})
    acceleration, situation = model.accelerations(with_delay)
    offset = model.offsets(with_delay, acceleration)
    assert model.observed_acceleration is not None
    rows = np.flatnonzero(~model.flight.starts & (np.diff(model.flight.time, prepend=-1.0) > 0))[5:]
    assert np.allclose(situation.step[rows], 0.01, atol=1e-4)
    # a delay of one step of 10 ms takes back what acted over that step
    assert np.allclose(offset[rows, 9:12], -0.01 * model.observed_acceleration[rows, 3:], atol=2e-4)
