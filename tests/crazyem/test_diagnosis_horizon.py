"""Open-loop errors at fixed horizons: closed forms, the same starts for every model, the benchmark's own numbers."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flown import DRONE, START, G, fly, recording_of, smooth_thrust, speeds
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.prediction.horizon import (
    HORIZONS,
    UNITS,
    HorizonErrors,
    Windows,
    errors,
    lengths,
    open_loop,
    windows,
    worse,
)
from crazyem.diagnosis.prediction.predict import Recorded, recorded
from crazyem.errors import DataError
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

Array = NDArray[np.float64]
TIMES = np.arange(0.0, 2.5, 0.01)
FINE = np.arange(0.0, 2.5, 0.001)


def horizon_errors(shown: Recorded, at: Windows | None = None, **model: Any) -> HorizonErrors:
    at = windows(shown) if at is None else at
    return errors(open_loop(shown, at, **model), at)


@pytest.fixture(scope="module")
def flown() -> Recorded:
    thrust = smooth_thrust(2)
    states = fly(thrust, TIMES)
    return recorded(recording_of(TIMES, states, rotor_speed=(FINE, speeds(thrust, FINE))), DRONE)


def test_the_right_model_has_no_error(flown: Recorded) -> None:
    found = horizon_errors(flown)
    assert found.horizons == HORIZONS
    assert found.starts >= 15
    assert max(found.rms["position"]) < 5e-5
    assert max(found.rms["attitude"]) < 5e-4
    assert max(found.rms["body_rate"]) < 5e-3  # inputs are held in the last sample of the longest horizon


def test_a_wrong_mass_errs_by_half_the_force_times_time_squared(flown: Recorded) -> None:
    """Five per cent of the weight, at every horizon, along body z: about g/20 t^2/2."""
    at = windows(flown)
    found = horizon_errors(flown, vehicle=replace(DRONE, mass=DRONE.mass / 1.05), at=at)
    right = horizon_errors(flown, at=at)
    for k, t in enumerate(HORIZONS):
        assert found.mean["position"][k] == pytest.approx(0.05 * G * t * t / 2, rel=0.08)
        assert found.mean["velocity"][k] == pytest.approx(0.05 * G * t, rel=0.08)
        assert found.rms["attitude"][k] == pytest.approx(right.rms["attitude"][k], abs=1e-9)
    assert found.starts == right.starts


def test_effects_given_are_used_instead_of_the_vehicles(flown: Recorded) -> None:
    scaled = horizon_errors(flown, effects={"thrust_scale": {"scale": 1.05}})
    heavier = horizon_errors(flown, vehicle=replace(DRONE, mass=DRONE.mass / 1.05))
    assert scaled.rms["position"][0] == pytest.approx(heavier.rms["position"][0], rel=1e-6)


def test_with_the_measured_attitude_forces_are_judged_alone(flown: Recorded) -> None:
    at = windows(flown)
    wrong = replace(DRONE, inertia=(4e-5, 4e-5, 6e-5))
    loose = errors(open_loop(flown, at, vehicle=wrong), at)
    led = errors(open_loop(flown, at, vehicle=wrong, measured_attitude=True), at)
    assert loose.rms["position"][2] > 0.01
    assert led.rms["position"][2] < 1e-3


def test_runs_lie_within_the_intervals_that_are_asked_for(flown: Recorded) -> None:
    at = windows(replace(flown, flights=((0.2, 1.0), (1.5, 1.6))), spacing=0.05)
    assert at.times.min() >= 0.2
    assert at.times.max() <= 1.0 + 0.006
    with pytest.raises(DataError, match=r"no stretch of flight is long enough for 0\.5 s"):
        windows(replace(flown, flights=((0.2, 0.4),)))


def test_rms_and_mean_are_of_the_lengths() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 40, 3))
    assert np.allclose(lengths(a, b, attitude=False), np.sqrt(((a - b) ** 2).sum(1)))
    p, q = Rotation.random(40, random_state=1), Rotation.random(40, random_state=2)
    expected = (p.inv() * q).magnitude()
    assert np.allclose(lengths(p.as_quat(), -q.as_quat(), attitude=True), expected)


def test_what_was_not_measured_has_no_error_and_a_broken_model_an_infinite_one(flown: Recorded) -> None:
    at = windows(flown)
    truth = at.truth.copy()
    truth[:, :, 10:13] = np.nan
    prediction = at.truth.copy()
    prediction[3, 2, 0] = np.nan
    found = errors(prediction, replace(at, truth=truth))
    assert all(math.isnan(v) for v in found.rms["body_rate"])
    assert found.rms["position"][2] == math.inf
    document = found.to_json()
    assert document["body_rate"]["rms"] == [None, None, None]
    assert document["position"] == {"unit": "m", "rms": [0.0, 0.0, None], "mean": [0.0, 0.0, None]}


def test_start_states_and_stamps_of_streams_may_differ() -> None:
    """The gyro of another packet, 5 ms apart: the newest is used at starts, and lines between samples as the truth."""
    thrust = smooth_thrust(3)
    fine = fly(thrust, FINE)
    recording = recording_of(FINE[::10], fine[::10], rotor_speed=(FINE, speeds(thrust, FINE)))
    array = recording.signals["body_rate"]
    shifted = replace(array, time=FINE[5::10], value=fine[5::10, 10:13])
    found = horizon_errors(recorded(replace(recording, signals={**recording.signals, "body_rate": shifted}), DRONE))
    assert found.starts >= 15
    assert found.rms["body_rate"][0] < 0.2
    assert found.rms["position"][2] < 0.05
    assert START.size == 13


def test_the_numbers_of_real_flights(shared_recordings: Path) -> None:
    """34 g and 30 ms are right there; the issue's 0.77 m of nanobench are those of 27 g with the measured attitude."""
    real = open_recording(shared_recordings / "real_firmware" / "lee_34g_mass_pushed_midflight.csv.gz")
    right = replace(load_vehicle("cf2"), mass=0.034, motor_time_constant=0.03)
    shown = recorded(real, right)
    at = windows(replace(shown, flights=((12.0, 29.0),)))
    good = horizon_errors(shown, at=at)
    bad = horizon_errors(shown, vehicle=replace(right, mass=0.029), at=at)
    assert good.rms["position"][1] < 0.006
    assert bad.rms["position"][2] > 4 * good.rms["position"][2]
    bench = open_recording(shared_recordings / "nanobench" / "B3_figure8_medium_rep1.csv.gz")
    shown = recorded(bench, replace(load_vehicle("cf2"), mass=0.027))
    at = windows(shown)
    found = errors(open_loop(shown, at, measured_attitude=True), at)
    assert found.rms["position"][2] == pytest.approx(0.77, abs=0.05)


def lengths_of(length: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """All quantities with errors of these lengths (n,) at every horizon."""
    return dict.fromkeys(UNITS, np.repeat(length[:, None], len(HORIZONS), axis=1))


def test_worse_is_what_grows_by_more_than_chance_and_visibly() -> None:
    rng = np.random.default_rng(0)
    before = rng.uniform(0.5, 1.5, 400)
    grown = before * 1.1
    assert {(w["quantity"], w["horizon_s"]) for w in worse([(lengths_of(before), lengths_of(grown))])} == {
        (n, h) for n in UNITS for h in HORIZONS
    }
    assert worse([(lengths_of(grown), lengths_of(before))]) == []
    assert worse([(lengths_of(before), lengths_of(before * 1.001))]) == []  # sure, and nothing that anyone sees
    assert worse([(lengths_of(before), lengths_of(before + rng.normal(0.0, 0.01, 400)))]) == []
    assert worse([(lengths_of(before[:4]), lengths_of(grown[:4]))]) == []  # too few to know what chance does
    assert worse([]) == []


def test_windows_that_overlap_count_as_one() -> None:
    """Starts every 0.1 s: what is 0.5 s ahead of five of them is the same half second."""
    rng = np.random.default_rng(1)
    alarms = dict.fromkeys(HORIZONS, 0)
    for _ in range(300):
        change = np.repeat(rng.normal(0.0, 0.1, 30), 5)
        for one in worse([(lengths_of(np.ones(150)), lengths_of(np.sqrt(1.0 + change)))]):
            alarms[one["horizon_s"]] += one["quantity"] == "position"
    assert alarms[0.5] < 0.06 * 300 < alarms[0.1]


def test_what_leaves_the_range_of_numbers_is_worse_and_what_is_not_measured_is_not() -> None:
    before, after = lengths_of(np.ones(50)), lengths_of(np.ones(50))
    after["attitude"] = np.full((50, len(HORIZONS)), np.inf)
    after["velocity"] = before["velocity"] = np.full((50, len(HORIZONS)), np.nan)
    found = worse([(before, after)])
    assert {w["quantity"] for w in found} == {"attitude"}
    assert found[0] == {"quantity": "attitude", "horizon_s": 0.01, "standard_errors": None}
