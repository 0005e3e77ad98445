"""Attitudes that an onboard filter made: one in 80 ms is used, because their errors hang together."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from made_flight import array_of

from crazyem.diagnosis.fitting.always import refine_base
from crazyem.diagnosis.fitting.fit import Data, nominal, starting_point
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.flights.flight import APART, Flight, flight_of
from crazyem.estimation import steps
from crazyem.recordings.recording import Recording, crazyflie_attitude, onboard_attitude
from crazyem.signals.vocabulary import MAVLINK_SOURCES, SOURCES

PULL, TILT = 0.04, 4e-3  # s, rad: how long an error lasts, and its standard deviation


def onboard(recording: Recording, *, source: str = "stateEstimateZ.quat", wrong: bool = False) -> Recording:
    """With an attitude said to come from `source`; `wrong`: with errors about x and y that last `PULL`."""
    signal = recording.signals["attitude"]
    value = signal.value.copy()
    if wrong:
        rng = np.random.default_rng(4)
        keep = np.exp(-0.01 / PULL)
        error = np.zeros((len(value), 2))
        for k in range(1, len(value)):
            error[k] = keep * error[k - 1] + TILT * np.sqrt(1 - keep**2) * rng.normal(size=2)
        half = 0.5 * np.hstack([error, np.zeros((len(value), 1))])
        # small turn on the right: q + q (half, 0), x y z w
        v, w = value[:, :3], value[:, 3:]
        value = value + np.hstack([w * half + np.cross(v, half), -np.sum(v * half, axis=1, keepdims=True)])
        value /= np.linalg.norm(value, axis=1, keepdims=True)
    shown = replace(array_of("attitude", signal.time, value, place=94), source=(source,))
    return replace(recording, signals={**recording.signals, "attitude": shown})


def seen(flight: Flight) -> np.ndarray:
    return flight.time[np.isfinite(flight.y[:, 6])]


def test_attitudes_of_motion_capture_are_all_used() -> None:
    recording = fly(seconds=6.0)
    flight = flight_of(onboard(recording, source="qx"), DRONE)
    assert flight.attitude is None
    assert seen(flight).size == flight.time.size


@pytest.mark.parametrize(
    ("source", "metadata", "expected"),
    [
        ("stateEstimateZ.quat", {}, True),
        ("kalman.q0", {}, True),
        ("vehicle_attitude.q[0]", {}, True),
        ("158/ATTITUDE_QUATERNION.q1", {}, True),
        ("quaternion", {"mavlink": {"system": "1"}}, True),
        ("qx", {"claims": {"attitude": "onboard"}}, True),
        ("qx", {"claims": {"mass_kg": "0.045"}}, False),
        ("ATT_POS_MOCAP.q1", {}, False),
    ],
)
def test_attitudes_that_a_filter_on_board_made(
    source: str, metadata: dict[str, dict[str, str]], expected: bool
) -> None:
    flown = replace(onboard(fly(seconds=2.0), source=source), metadata=metadata)
    assert onboard_attitude(flown) is expected
    # which filter: a Crazyflie's is told by its names, at the same 100 Hz as an autopilot's
    assert crazyflie_attitude(flown) is source.startswith(("stateEstimateZ", "kalman"))


def test_every_attitude_that_a_link_gives_is_of_a_filter_on_board() -> None:
    """So that a replay thins them as the flight did (`estimator_for`)."""
    given = [s.variables for s in (*SOURCES, *MAVLINK_SOURCES) if s.signal == "attitude"]
    assert len(given) >= 5
    flown = onboard(fly(seconds=2.0))
    for variables in given:
        signal = replace(flown.signals["attitude"], source=variables)
        assert onboard_attitude(replace(flown, signals={**flown.signals, "attitude": signal})), variables


@pytest.mark.parametrize(
    ("onboard", "crazyflie", "period", "predicted"),
    [(True, True, 0.05, 0.01), (True, False, 0.05, 0.0), (False, False, 0.0, 0.0)],
)
def test_the_estimator_of_the_commands_thins_attitudes_of_filters_on_board_and_no_others(
    monkeypatch: pytest.MonkeyPatch, onboard: bool, crazyflie: bool, period: float, predicted: float
) -> None:
    made = []
    monkeypatch.setattr(steps, "OnlineEstimator", lambda vehicle, **given: made.append(given) or SimpleNamespace())
    monkeypatch.setattr(steps, "StepAwareEstimator", lambda estimator: estimator)
    steps.estimator_for(DRONE, onboard=onboard, crazyflie=crazyflie)
    expected = {"window": 800, "every": 4, "attitude_period": period, "prediction_period": predicted}
    assert made == [{**expected, "input_signal": None}]


def test_of_onboard_attitudes_one_in_so_many_is_used_and_none_is_lost() -> None:
    recording = fly(seconds=6.0)
    whole, flight = flight_of(onboard(recording, source="qx"), DRONE), flight_of(onboard(recording), DRONE)
    assert flight.attitude is not None
    assert np.array_equal(flight.attitude, whole.y[:, 6:10])
    assert np.allclose(np.diff(seen(flight)), APART, atol=0.011)
    assert np.isfinite(flight.y[flight.starts, 6]).all()
    at = np.isfinite(flight.y[:, 6])
    assert np.array_equal(flight.y[at], whole.y[at])
    assert np.array_equal(flight.y[:, 10:], whole.y[:, 10:])


@pytest.mark.parametrize("late", [0.0, 2e-3, 4e-3, 5e-3, 8e-3])
def test_attitudes_in_a_log_block_of_their_own_are_not_lost(late: float) -> None:
    """Blocks have stamps of their own: of rows that begin with the others, none may hold an attitude."""
    recording = onboard(fly(seconds=6.0))
    signal = recording.signals["attitude"]
    apart = replace(recording, signals={**recording.signals, "attitude": replace(signal, time=signal.time + late)})
    flight = flight_of(apart, DRONE)
    assert np.allclose(np.diff(seen(flight)), APART, atol=0.011)


def test_where_the_filter_begins_anew_there_is_an_attitude() -> None:
    flight = flight_of(onboard(fly(seconds=6.0)), DRONE)
    starts = flight.starts.copy()
    starts[[101, 103, 250]] = True
    begun = flight.started(starts)
    assert np.isfinite(begun.y[starts, 6]).all()
    some = flight.rows(np.arange(flight.time.size) % 100 > 3)
    assert some.starts.sum() > 3
    assert np.isfinite(some.y[some.starts, 6]).all()
    assert np.array_equal(some.rows(np.ones(some.time.size, bool)).y, some.y, equal_nan=True)


@pytest.mark.slow
def test_errors_that_last_are_no_shaking_and_no_noise_of_the_gyro() -> None:
    """A filter that takes them for white noise at 100 Hz finds a gyro more than twice as noisy and a drone that is
    shaken less; one attitude in 80 ms leaves both as they are by an attitude without such errors."""
    recording = fly(seconds=15.0, seed=5, rate_noise=2e-3, shake=0.3)
    gyro, shaken = [], []
    for source, wrong in (("qx", False), ("qx", True), ("stateEstimateZ.quat", True)):
        data = Data([flight_of(onboard(recording, source=source, wrong=wrong), DRONE)])
        found = refine_base(data, nominal(data, starting_point(Point(DRONE, {}, None))), ()).point  # type: ignore[arg-type]
        gyro.append(float(found.noise.measurement[3]))
        shaken.append(found.noise.impulse[3:])
    assert gyro[1] > 2 * gyro[0]
    assert gyro[2] == pytest.approx(gyro[0], rel=0.3)
    assert np.all(shaken[1] < 0.93 * shaken[0])
    assert shaken[2] == pytest.approx(shaken[0], rel=0.02)
