"""Attitudes that an onboard filter made: all are used, with errors that have a memory."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from diagnosis_parts import data_of, start_point
from made_flight import array_of

from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.estimation import steps
from crazyem.recordings.recording import Recording, crazyflie_attitude, onboard_attitude, onboard_estimate
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


def test_who_made_the_attitudes_is_known_and_all_are_used() -> None:
    recording = fly(seconds=6.0)
    captured, made = (flight_of(onboard(recording, source=s), DRONE) for s in ("qx", "stateEstimateZ.quat"))
    assert made.fused
    assert not captured.fused
    assert np.array_equal(made.y, captured.y, equal_nan=True)
    assert np.isfinite(made.y[:, 6]).all()


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


def test_without_an_attitude_the_velocity_says_whether_a_filter_made_the_states() -> None:
    flown = fly(seconds=2.0)
    for source, expected in (("stateEstimate.vx", True), ("vehicle_local_position.vx", True), ("mocap.vx", False)):
        velocity = replace(flown.signals["velocity"], source=(source,) * 3)
        blind = {n: a for n, a in flown.signals.items() if n != "attitude"} | {"velocity": velocity}
        assert onboard_estimate(replace(flown, signals=blind)) is expected
        assert not onboard_attitude(replace(flown, signals=blind))
    still = {n: a for n, a in flown.signals.items() if n not in ("attitude", "velocity")}
    assert not onboard_estimate(replace(flown, signals=still))


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


@pytest.mark.slow
def test_errors_that_last_are_found_and_are_no_noise_of_the_gyro() -> None:
    """Errors of 4 mrad about two of three axes that last 0.04 s: gyro and shaking stay as without such errors."""
    recording = fly(seconds=15.0, seed=5, rate_noise=2e-3, shake=0.3)
    right, wrong = (
        refine_base(data, nominal(data, start_point()), ()).point.noise
        for data in (data_of(onboard(recording, wrong=w)) for w in (False, True))
    )
    assert wrong.measurement[3] == pytest.approx(right.measurement[3], rel=0.2)
    np.testing.assert_allclose(wrong.impulse[3:], right.impulse[3:], rtol=0.05)
    assert wrong.coloured[2] == pytest.approx(TILT * np.sqrt(2 / 3), rel=0.15)
    assert wrong.recall[2] == pytest.approx(PULL, rel=0.35)
