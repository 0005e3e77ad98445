"""What filters on board do to the log: against a low-passed path, and lags of made flights; a gyro that is late."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import data_of, nominal_of, start_point
from made_flight import array_of
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_continuous_are
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Situation
from crazyem.physics.effects.onboard_estimate import filtered
from crazyem.physics.effects.prior import Conditions
from crazyem.physics.rotations import rotation_matrix
from crazyem.recordings.recording import Recording


def test_the_offset_is_that_of_a_slow_low_pass():
    """A first-order low pass of 2 ms, run at 20 kHz on rates and velocities of 2 Hz; second order is left out."""
    step, lag, pulse = 5e-5, 2e-3, 4 * np.pi
    time = step * np.arange(40000)
    rate = np.stack([np.sin(pulse * time), np.cos(pulse * time), 0 * time], 1)
    velocity = 0.3 * rate[:, [1, 2, 0]]
    keep = np.exp(-step / lag)
    shown = lfilter([1 - keep], [1, -keep], np.hstack([velocity, rate]), axis=0)
    at = np.arange(20000, 40000, 200)  # settled
    turned = Rotation.from_rotvec([0.3, -0.2, 0.5])
    acceleration = np.gradient(velocity, step, axis=0)[at] + [0, 0, 9.81]
    n = at.size
    none = np.zeros((n, 3))
    situation = Situation(
        time=time[at], flown=time[at], step=np.full(n, step), position=none, height=np.zeros(n), velocity=velocity[at],
        rotation=np.tile(rotation_matrix(turned.as_quat()), (n, 1, 1)), body_rate=rate[at],
        specific_force=turned.inv().apply(acceleration), angular_acceleration=np.gradient(rate, step, axis=0)[at],
        thrust=np.zeros((n, 4)), thrust_rate=np.zeros((n, 4)), voltage=np.zeros(n), rotor_constant=np.nan, air=none,
    )  # fmt: skip
    offset = filtered(situation, rate_lag=lag, velocity_lag=lag, attitude_lag=0.0, lateral_time_constant=0.3).state
    wanted = (shown - np.hstack([velocity, rate]))[at]
    second_order = (pulse * lag) ** 2
    assert np.abs(offset[:, 9:] - wanted[:, 3:]).max() < 1.5 * second_order
    assert np.abs(offset[:, 3:6] - wanted[:, :3]).max() < 1.5 * 0.3 * second_order
    assert np.abs(wanted).max() > 10 * second_order  # not a comparison of nothings
    assert not offset[:, [0, 1, 2, 6, 7, 8]].any()
    spin = np.array([0.5, -1.0, 2.0])  # rad/s, all the time: then the attitude of 2 ms ago is a turn back by 2 ms of it
    turning = replace(situation, body_rate=np.tile(spin, (n, 1)))
    late = filtered(turning, rate_lag=0.0, velocity_lag=0.0, attitude_lag=lag, lateral_time_constant=0.0).state[0, 6:9]
    now, before = (turned * Rotation.from_rotvec(spin * t) for t in (1.0, 1.0 - lag))
    np.testing.assert_allclose(late, (now.inv() * before).as_rotvec(), atol=1e-12)


@pytest.mark.parametrize("memory", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("tilt", [None, (0.02, -0.03, 0.01)])
def test_a_filter_that_knows_no_drag_is_off_as_a_plain_integration_says(memory, tilt):
    """A constant force along body x and y of a body that is turned, and an attitude that is shown tilted.

    Thrust, along z, the filter knows. Where the pose is that of motion capture, nothing is off.
    """
    n, step = 300, 0.01
    turned, none, force = Rotation.from_rotvec([0.3, -0.2, 0.5]), np.zeros((n, 3)), np.array([0.8, -0.5, 9.0])
    situation = Situation(
        time=step * np.arange(n), flown=none[:, 0], step=np.full(n, step), position=none, height=none[:, 0],
        velocity=none, rotation=np.tile(rotation_matrix(turned.as_quat()), (n, 1, 1)), body_rate=none,
        specific_force=none, model_force=np.tile(force, (n, 1)), angular_acceleration=none, thrust=np.zeros((n, 4)),
        thrust_rate=np.zeros((n, 4)), voltage=np.zeros(n), rotor_constant=np.nan, air=none, fused=True,
        tilt=None if tilt is None else np.tile(tilt, (n, 1)),
    )  # fmt: skip
    believed = np.array([0.0, 0.0, 9.0]) + np.cross(tilt or np.zeros(3), [0.0, 0.0, 9.0])  # to first order
    drive = turned.apply([*(believed - force)[:2], 0.0])

    def off(_, x):
        return np.concatenate([x[3:] - 2.0 * x[:3] / memory, drive - 2.0 * x[:3] / memory**2])

    plain = solve_ivp(off, (0.0, situation.time[-1]), np.zeros(6), t_eval=situation.time, rtol=1e-9, atol=1e-12).y.T
    lags = {"rate_lag": 0.0, "velocity_lag": 0.0, "attitude_lag": 0.0, "lateral_time_constant": memory}
    shown = filtered(situation, **lags).state
    np.testing.assert_allclose(shown[:, :6], plain, rtol=1e-6, atol=1e-9)
    if memory < 0.5:  # settled
        assert shown[-1, 3:6] == pytest.approx(memory * drive, rel=1e-5)
    assert not filtered(replace(situation, fused=False), **lags).state[:, :6].any()


@pytest.mark.parametrize(("acceleration", "position"), [(0.1, 1e-4), (1.0, 1e-5), (3.0, 1e-6)])
def test_the_gains_of_such_a_filter_are_those_of_its_riccati_equation(acceleration, position):
    """p' = v, v' = white noise, p is measured in white noise: with T = 2 / first gain the second gain is 2 / T^2."""
    covariance = solve_continuous_are(
        np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0], [0.0]]), np.diag([0.0, acceleration]), [[position]]
    )
    first, second = covariance[:, 0] / position
    assert second == pytest.approx(2.0 / (2.0 / first) ** 2)


@pytest.mark.parametrize("effect", ["linear_drag", "wind"])
def test_what_a_force_changes_in_the_velocity_that_is_shown_is_a_difference_of_likelihoods(effect):
    """Score by a force's parameter, which acts and shows at once, against differences of whole passes."""
    recording = fly(Hidden(), seconds=6.0, seed=3)
    flight = replace(flight_of(recording, DRONE), fused=True)
    effects = {
        "onboard_filter": {"lateral_time_constant": 0.2},
        "linear_drag": {"x": 0.01, "y": 0.01},
        "wind": {"x": 0.5},
    }
    point = Point(DRONE, effects, start_noise())
    model = Model(flight)
    model.settle(point, passes=4)
    column = Candidate(effect, (), ("x",)).columns(point)
    score = model.twin().sweep(point, column).score.sum()

    def loglik(change):
        moved = point.with_effects({effect: {"x": effects[effect]["x"] + change}})
        return model.twin().sweep(moved).loglik

    width = 1e-4
    assert score == pytest.approx((loglik(width) - loglik(-width)) / (2.0 * width), rel=0.02)
    blind = replace(flight, fused=False)
    alone = Model(blind)
    alone.settle(point, passes=4)
    assert alone.twin().sweep(point, column).score.sum() != pytest.approx(score, rel=0.02)


def behind(recording: Recording, name: str, lag: float) -> Recording:
    """The signal as it was `lag` s ago."""
    signal = recording.signals[name]
    then = np.stack([np.interp(signal.time - lag, signal.time, c) for c in signal.value.T], 1)
    return replace(recording, signals={**recording.signals, name: array_of(name, signal.time, then, place=95)})


def test_a_log_that_is_late_does_not_tilt_the_filter_on_board():
    """The filter believes a tilted frame, and its velocity is off by it. A late log shows the same filter later."""
    model = Model(replace(flight_of(fly(Hidden(), seconds=6.0, seed=3), DRONE), fused=True))
    point = start_point()
    model.settle(point)
    acceleration = model.accelerations(point)[0]

    def shown(**effects):
        return model.offsets(replace(point, effects=effects), acceleration)[:, :6]

    filter_on_board = {"lateral_time_constant": 0.2}
    alone = shown(onboard_filter=filter_on_board)
    for other, adds_up in (
        ({"measurement_delay": {"delay": 0.02, "streams": ("state",)}}, True),
        ({"attitude_misalignment": {"roll": 0.02}}, False),
    ):
        together = shown(onboard_filter=filter_on_board, **other)
        assert np.allclose(together, alone + shown(**other), atol=1e-12) == adds_up


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameter", "lags"), [("body_rate", "rate_lag", (0.0, 2e-3)),
                                                         ("velocity", "velocity_lag", (0.0, 1.5e-3))])  # fmt: skip
def test_lags_of_the_log_are_found(name, parameter, lags):
    """What is put on comes back where there is no prior about it.

    The drone is hardly shaken: the model does not know the derivative of what random impulses do, so with `shake` 1 the
    rates' lag comes out as 1.2 ms.
    """
    free, found = Candidate("onboard_filter", (), ("rate_lag", "velocity_lag")), []
    for lag in lags:
        recording = behind(fly(seconds=12.0, seed=5, rate_noise=2e-3, shake=0.05), name, lag)
        data, point = nominal_of(recording)
        begun = point.with_effects({"onboard_filter": {"rate_lag": 0.0, "velocity_lag": 0.0}})
        found.append(refine_base(data, begun, [free]).point.effects["onboard_filter"][parameter])
    assert found[1] - found[0] == pytest.approx(lags[1], abs=0.3e-3)


def test_a_torque_that_the_model_lacks_is_no_bias_of_a_late_gyro():
    """Weak rotors on one side are 10 rad/s^2 that the nominal model does not have: 12 mrad/s in a gyro 1.2 ms behind,
    if it were the model's own acceleration by which a late gyro shows less."""
    recording = behind(fly(Hidden(thrust=(0.95, 0.95, 1.0, 1.0)), seconds=10.0, rate_noise=2e-3), "body_rate", 1.2e-3)
    data = data_of(recording)
    bias = Candidate("gyro_bias", (), ("x", "y", "z"))
    point = nominal(data, start_point())
    begun = refine_base(data, point, ()).point.with_effects({"gyro_bias": dict.fromkeys("xyz", 0.0)})
    found = refine_base(data, begun, [bias]).point
    assert found.noise.disturbance[3:5].max() > 1.0  # the filter carries the torque along as a disturbance
    assert max(abs(v) for v in found.effects["gyro_bias"].values()) < 2e-3


# -- a gyro that is late -----------------------------------------------------------------------------------------------


GYRO = Candidate("measurement_delay", (("streams", ("gyro",)),), ("delay",))


@pytest.mark.parametrize("late", [0.0, 0.003, 0.006])
def test_a_late_gyro_is_late_by_what_it_was_shifted(late: float) -> None:
    """With what is always free of onboard filters, which starts at 1.2 ms and is 0 here. By differences of the filtered
    rates, which hold the noise of the sample that they are to explain, it was 0 for all three."""
    recording = fly(seconds=8.0, seed=3)
    rate = recording.signals["body_rate"]
    shown = array_of("body_rate", rate.time, CubicSpline(rate.time, rate.value)(rate.time - late), place=95)
    data, point = nominal_of(replace(recording, signals={**recording.signals, "body_rate": shown}))
    begun = point.with_effects({"measurement_delay": {"delay": 0.002, "streams": ("gyro",)}})
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
    data, point = nominal_of(recording)
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
