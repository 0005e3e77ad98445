"""What a model's turning is worth in a prediction: by regression on the past alone, against a plain version."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import changed
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.cli import main
from crazyem.diagnosis.prediction.bias_correction import (
    Turned,
    Weights,
    correction_weights,
    moments,
    regression,
    weighted_mean,
)
from crazyem.diagnosis.prediction.predict import _at_start, predict, recorded
from crazyem.diagnosis.settings import PREDICTION
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

STEP = 0.01  # s


def flight(seed: int, *, seconds: float, weight: float, offset: float, error: float) -> Turned:
    """Rates that change by `weight` of what the model says, an offset [rad/s^2] and white noise [rad/s]."""
    draw = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, STEP)
    acceleration = 4.0 * np.stack([np.sin(2 * np.pi * f * time) for f in (0.7, 1.1, 1.7)], 1)
    gained = acceleration * STEP
    rate = np.concatenate([np.zeros((1, 3)), np.cumsum(weight * gained + offset * STEP, axis=0)[:-1]])
    shown = rate + error * draw.standard_normal(rate.shape)
    start = np.zeros((time.size, 3, len(PREDICTION.feedback_sd)))  # nothing else is known
    return Turned(time, shown, gained, start, np.ones(time.size, bool), np.zeros((time.size, 3)))


@pytest.mark.parametrize(("weight", "offset"), [(0.4, 1.5), (1.0, 0.0)], ids=["of a wrong model", "of a right model"])
def test_weight_and_offset_are_found_by_the_past(weight, offset):
    turned = flight(0, seconds=30.0, weight=weight, offset=offset, error=0.01)
    found = correction_weights(turned, np.array([0.5, 29.0]), horizon=0.5)
    assert np.array_equal(found.weight[0], np.ones((11, 3)))  # nothing was seen yet
    assert np.array_equal(found.added[0], np.zeros((11, 3)))
    assert found.weight[1, 4:] == pytest.approx(weight, abs=0.03)
    assert found.added[1, 4:] == pytest.approx(offset * found.lags[4:, None] * np.ones(3), abs=0.05)


@given(st.integers(0, 1000), st.floats(3.0, 9.0))
def test_nothing_after_a_start_counts(seed: int, start: float) -> None:
    turned = flight(seed, seconds=10.0, weight=0.5, offset=0.0, error=0.1)
    turned = replace(turned, start=np.random.default_rng(seed).standard_normal(turned.start.shape))
    after = turned.time > start + 1e-9
    changed = Turned(
        turned.time,
        np.where(after[:, None], 7.0 * turned.rate + 3.0, turned.rate),
        np.where(after[:, None], -turned.gained, turned.gained),
        np.where(after[:, None, None], 2.0 - turned.start, turned.start),
        turned.flying & ~(turned.time > start + 0.3),
        np.where((turned.time > start - STEP / 2)[:, None], 5.0, turned.lacking),
    )
    one, other = (correction_weights(t, np.array([start]), horizon=0.5) for t in (turned, changed))
    assert np.array_equal(one.weight, other.weight)
    assert np.array_equal(one.added, other.added)
    assert np.array_equal(one.force, other.force)


def test_the_running_sums_are_those_of_a_plain_loop() -> None:
    draw = np.random.default_rng(5)
    x, alike = draw.standard_normal((400, 3)) * [1.0, 30.0, 1e-3], 20.0
    y = 0.3 * x[:, 0] + 0.1 * x[:, 1] + 0.2 * draw.standard_normal(400)
    sd = np.array([1.0, 0.3, 5.0])
    last = (250, 399)
    found = regression(x, y, sd, alike, STEP, np.array(last))
    for row, k in zip(found, last, strict=True):
        age, rows = np.exp(-(k - np.arange(k + 1)) * STEP / PREDICTION.memory), x[: k + 1]
        a, b = (rows * age[:, None]).T @ rows, (rows * age[:, None]).T @ y[: k + 1]
        rest = y[: k + 1] - rows @ np.linalg.solve(a, b)
        noise = (age * rest**2).sum() / age.sum() * alike
        prior = np.diag(sd**-2.0)
        wanted = np.linalg.solve(a / noise + prior, b / noise + prior @ np.array([1.0, 0.0, 0.0]))
        assert row == pytest.approx(wanted, rel=1e-6)


def test_earlier_flights_count_as_if_they_had_just_been_flown() -> None:
    draw, rows = np.random.default_rng(8), 2000
    x, sd = draw.standard_normal((rows, 2)), np.array([1.0, 0.5])
    y = 0.4 * x[:, 0] - 0.2 * x[:, 1] + 0.1 * draw.standard_normal(rows)
    i, j = np.triu_indices(2)
    mean = np.column_stack([x[:, i] * x[:, j], x * y[:, None], y * y, np.ones(rows)]).mean(axis=0)
    later_x, later_y = draw.standard_normal((50, 2)), draw.standard_normal(50)
    found = regression(later_x, later_y, sd, 1.0, STEP, np.array([-1, 49]), before=mean)
    # the earlier rows again and again, until the memory is full of them
    many = round(10 * PREDICTION.memory / STEP / rows) + 1
    flown_x, flown_y = (np.concatenate([*[old] * many, new]) for old, new in ((x, later_x), (y, later_y)))
    wanted = regression(flown_x, flown_y, sd, 1.0, STEP, np.array([many * rows - 1, many * rows + 49]))
    assert found == pytest.approx(wanted, abs=5e-3)


def test_earlier_flights_tell_the_weights_of_the_first_start() -> None:
    earlier, turned = (flight(seed, seconds=30.0, weight=0.4, offset=1.5, error=0.01) for seed in (2, 3))
    found = correction_weights(turned, turned.time[:1], horizon=0.5, before=moments(earlier, horizon=0.5))
    assert found.weight[0, 4:] == pytest.approx(0.4, abs=0.03)
    assert found.added[0, 4:] == pytest.approx(1.5 * found.lags[4:, None] * np.ones(3), abs=0.05)


def test_a_loop_that_takes_rates_back_is_learned() -> None:
    """Rates fall back by themselves with 0.2 s, shaken by a noise, and the model knows of no torque at all."""
    draw = np.random.default_rng(6)
    time, rate = np.arange(0.0, 40.0, STEP), np.zeros((4000, 3))
    for k in range(1, time.size):
        rate[k] = rate[k - 1] * np.exp(-STEP / 0.2) + 0.1 * draw.standard_normal(3)
    start = np.zeros((time.size, 3, len(PREDICTION.feedback_sd)))
    start[:, :, 1] = rate
    nothing, flying = np.zeros((time.size, 3)), np.ones(time.size, bool)
    turned = Turned(time, rate, nothing, start, flying, nothing)
    rows = np.arange(2000, 3900)
    found = correction_weights(turned, time[rows], horizon=0.5)
    for lag, k in ((0.1, 2), (0.5, 10)):
        came = rate[rows + round(lag / STEP)] - rate[rows]
        best = (np.exp(-lag / 0.2) - 1.0) * rate[rows]  # what can be known
        left, least = (np.mean((came - guess) ** 2) for guess in (found.added[:, k], best))
        assert left < least + 0.15 * (np.mean(came**2) - least)


def test_what_is_known_at_a_start() -> None:
    """A body that rolls right flies to its right; pitch turns what is forward, and yaw has neither tilt nor way."""
    turned = Rotation.from_euler("ZYX", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [2.0, 0.3, 0.0], [0.5, 0.0, 0.0]])
    along = np.array([[1.0, 2.0, 3.0]] * 4)  # m/s, body
    rate = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3], [0.1, 0.5, 0.3], [0.4, 0.5, 0.3]])
    place = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [2.0, 1.0, 1.0], [0.0, 4.0, 1.0]])
    state = np.concatenate([place, turned.apply(along), turned.as_quat(), rate], axis=1)
    gained = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [9.0, 9.0, 9.0], [0.0, 0.0, 0.0]])
    shown = SimpleNamespace(state=state, time=np.array([0.0, 0.01, 0.03, 0.04]), period=0.01)
    start = _at_start(shown, gained, np.array([True, True, False, False]))
    assert start[:, :, 0] == pytest.approx(  # in the step that ends there, of those that count
        np.array([[0, 0, 0], [0, 20, 30], [0, 10, 0], [0, 0, 0]], float), abs=1e-9
    )
    assert np.array_equal(start[:, :, 1], rate)
    leaning = [[0, 0, 0], [np.sin(0.2), 0, 0], [0, np.sin(0.3), 0], [0, 0, 0]]
    assert start[:, :, 2] == pytest.approx(np.array(leaning), abs=1e-9)
    assert start[:, :, 3] == pytest.approx(np.array([[2.0, -1.0, 0.0]] * 4), abs=1e-9)
    assert start[:, :, 4] == pytest.approx(np.array([[6.0, -3.0, 0.0]] * 4), abs=1e-9)
    # where it has flown to is the second and third place; what is 10 ms older counts a thousandth less
    weight = np.exp(-0.01 / PREDICTION.memory)
    mean = [place[0], place[1], *[(weight * place[1] + place[2]) / (weight + 1.0)] * 2]
    away = turned.inv().apply(place - np.array(mean))
    assert start[:, :, 5] == pytest.approx(np.column_stack([away[:, 1], -away[:, 0], np.zeros(4)]), abs=1e-9)


def test_a_mean_of_what_counts_so_far_is_that_of_a_plain_loop() -> None:
    draw = np.random.default_rng(7)
    value, counts = draw.standard_normal((300, 3)), draw.random(300) < 0.6
    counts[:20], value[50] = False, np.nan
    found = weighted_mean(value, counts, STEP)
    for row in (0, 19, 120, 299):
        use = np.flatnonzero(counts[: row + 1] & np.isfinite(value[: row + 1, 0]))
        weight = np.exp(-(row - use) * STEP / PREDICTION.memory)
        wanted = weight @ value[use] / weight.sum() if use.size else value[row]
        assert found[row] == pytest.approx(wanted, rel=1e-9)


def test_what_is_flown_after_a_start_changes_no_prediction_from_it() -> None:
    """The whole shipped recording, with all that is learned before a start 14 s into it."""
    recording = open_recording(str(Path(__file__).parents[2] / "logs" / "payload_excite.mcap"))
    vehicle = load_vehicle("cf2")
    shown = recorded(recording, vehicle)
    found = predict(shown, horizon=50, every=10)
    row = int(np.searchsorted(found.start_time, recording.signals["position"].time[0] + 14.0))
    broken = recording
    for name in ("velocity", "attitude", "body_rate"):
        array = recording.signals[name]
        value, later = array.value.copy(), array.time > found.start_time[row] + 1e-6
        value[later] = np.roll(value[later], 1, axis=1)
        broken = changed(broken, name, value=value)
    other = predict(recorded(broken, vehicle), horizon=50, every=10)
    assert found.airborne[row]
    assert np.array_equal(found.prediction[: row + 1], other.prediction[: row + 1])
    plain = predict(shown, horizon=50, every=10, plain=True)
    assert np.abs(plain.prediction[row, -1, 10:] - found.prediction[row, -1, 10:]).max() > 1e-3  # something was learned


def test_gaps_and_missing_rates_are_left_out() -> None:
    turned = flight(2, seconds=20.0, weight=0.6, offset=0.0, error=0.01)
    rate = turned.rate.copy()
    rate[900:1100] += 50.0  # a jump on either side of what is not known
    rate[898:900] = np.nan
    rate[1100:1102] = np.nan
    found = correction_weights(replace(turned, rate=rate), np.array([19.9]), horizon=0.5)
    assert found.weight[0, 3:] == pytest.approx(0.6, abs=0.03)


def test_a_force_that_the_model_lacks_is_the_mean_of_what_it_lacked() -> None:
    turned = flight(4, seconds=40.0, weight=1.0, offset=0.0, error=0.01)
    draw = np.random.default_rng(4)
    lacking = np.array([0.1, -0.2, 0.6]) + 0.3 * draw.standard_normal((turned.time.size, 3))
    lacking[turned.time < 15.0] += 1.0  # long forgotten
    found = correction_weights(replace(turned, lacking=lacking), np.array([0.2, 0.6, 39.9]), horizon=0.5)
    assert np.array_equal(found.force[0], np.zeros(3))
    independent = 60.0 / 10.0  # rows: ten rows have one error
    early = lacking[:60].mean(0) / (1.0 + lacking[:60].var(0) / (independent * PREDICTION.force_sd**2))
    assert found.force[1] == pytest.approx(early, rel=0.02)
    assert found.force[2] == pytest.approx([0.1, -0.2, 0.6], abs=0.12)


def test_a_learned_force_acts_before_a_start_that_is_shown_late() -> None:
    """Where states are shown 30 ms late, 10 ms of prediction lie wholly before the moment at which it begins."""
    recording, bare = (
        open_recording(str(Path(__file__).parents[2] / "logs" / "payload_excite.mcap")),
        load_vehicle("cf2"),
    )
    vehicle = replace(bare, effects={"measurement_delay": {"delay": 0.03, "streams": ("state", "gyro")}})
    shown = recorded(recording, vehicle)
    errors = {}
    for plain in (False, True):
        found = predict(shown, horizon=1, every=10, plain=plain)
        keep = found.airborne & (found.start_time > found.start_time[found.airborne][0] + 3.0)
        came = shown.state[np.searchsorted(shown.time, found.time[keep, 0]), 5]
        errors[plain] = abs(float(np.mean(found.prediction[keep, 0, 5] - came)))
    assert errors[True] > 1e-2  # m/s: thrust is 29 g's, the drone weighs 36 g
    assert errors[False] < 0.2 * errors[True]


def test_between_lags_weights_are_interpolated() -> None:
    lags = np.array([0.0, 0.1, 0.2])
    weights = Weights(
        lags, np.ones((1, 3, 3)) * np.array([1.0, 0.5, 0.0])[:, None], np.zeros((1, 3, 3)), np.zeros((1, 3))
    )
    for since, wanted in ((0.0, 1.0), (0.05, 0.75), (0.15, 0.25), (0.3, 0.0)):
        changed: NDArray = weights.changed(np.array([since]), np.full((1, 3), 2.0))
        assert changed == pytest.approx(2.0 * wanted * np.ones((1, 3)), abs=1e-5)


def test_a_short_flight_says_nothing() -> None:
    turned = flight(3, seconds=PREDICTION.min_rotation_time, weight=0.1, offset=0.0, error=0.0)
    found = correction_weights(turned, turned.time[-1:], horizon=0.5)
    assert np.array_equal(found.weight, np.ones((1, 11, 3)))


def test_the_command_predicts_better_than_the_model_alone(tmp_path: Path) -> None:
    """The shipped flight by a file that knows nothing of what was done to the drone."""
    log = Path(__file__).parents[2] / "logs" / "payload_excite.mcap"
    errors = {}
    for name, more in (("earned", []), ("plain", ["--plain"])):
        out = tmp_path / f"{name}.npz"
        words = ["predict", str(log), "--vehicle", "cf2", "--horizon", "50", "--every", "10", "-o", str(out), *more]
        assert main(words) == 0
        with np.load(out) as found:
            flying = found["airborne"]
            last, at = found["prediction"][flying, -1], found["start_index"][flying] + 50
        truth = open_recording(str(log)).signals["body_rate"]
        when = open_recording(str(log)).signals["position"].time[at]
        shown = np.stack([np.interp(when, truth.time, v) for v in np.asarray(truth.value).T], 1)
        errors[name] = float(np.sqrt(np.mean(np.sum((last[:, 10:13] - shown) ** 2, axis=1))))
    assert errors["earned"] < errors["plain"]
