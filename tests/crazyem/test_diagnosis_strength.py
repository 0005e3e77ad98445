"""The thrust of each of several recordings: flights made elsewhere, every one with rotors of another strength."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import THRUST, start_point

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.fitting.candidates import OfRecordings, of_recordings
from crazyem.diagnosis.fitting.days import THRUST_SD
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import OWN, Point, deviations, of_recording
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances, refine_base, with_thrust_scales
from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.diagnosis.settings import FITTING

STRONG = (0.97, 1.0, 1.03, 1.02)


def flights() -> list[Flight]:
    made = [
        replace(flight_of(fly(Hidden(thrust=(s,) * 4), seed=k, seconds=9.0), DRONE), name=f"{k}.csv")
        for k, s in enumerate(STRONG)
    ]
    return with_thrust_scales(made, [], DRONE)[0]


@pytest.mark.slow
def test_each_is_found_and_the_mean_is_left_to_the_thrust_scale() -> None:
    data = Data(flights())
    point = nominal(data, start_point())
    scale = THRUST
    found = refine_base(data, point.with_effects({"thrust_scale": {"scale": 1.0}}), [scale]).point
    own = deviations(found.effects, "thrust_scale")
    away = np.array([own[f"{k}.csv"]["scale"] for k in range(4)])
    assert away + found.effects["thrust_scale"]["scale"] == pytest.approx(STRONG, abs=4e-3)
    assert away.mean() == pytest.approx(0.0, abs=2e-3)  # priors


@pytest.mark.slow
def test_a_recording_hears_of_its_own_strength_only() -> None:
    """Derivatives by the strength of one recording, against differences of the log-likelihood of each."""
    data = Data(flights()[:3])
    own = of_recordings("thrust_scale", ("scale",), data.flights)
    point = nominal(data, Point(DRONE, {OWN + "thrust_scale": own.neutral(start_point())}, start_noise()))
    gram = data.gram(point, own.columns(point))
    score = np.stack([gram.score[gram.flight == k].sum(0) for k in range(3)])
    assert np.count_nonzero(score) == 3
    assert (np.diag(score) != 0).all()
    for k, name in enumerate(own.free):
        up, down = (point.with_effects({OWN + "thrust_scale": {name: d}}) for d in (1e-4, -1e-4))
        slope = [(a.sweep(up).loglik - b.sweep(down).loglik) / 2e-4
                 for a, b in zip(data.twin().models, data.twin().models, strict=True)]  # fmt: skip
        assert slope[k] == pytest.approx(score[k, k], rel=0.02)
        assert np.delete(slope, k) == pytest.approx(0.0, abs=1e-6)


def test_it_is_added_to_what_all_recordings_share_and_nothing_of_the_vehicle() -> None:
    effects = {
        "thrust_scale": {"scale": 0.9},
        OWN + "thrust_scale": {"a/scale": 0.1},
        OWN + "gyro_bias": {"/b/x": 0.01},
    }
    assert of_recording(effects, "a") == {"thrust_scale": {"scale": pytest.approx(1.0)}}
    assert of_recording(effects, "c") == {"thrust_scale": {"scale": 0.9}}
    there = {"thrust_scale": {"scale": 0.9}, "gyro_bias": {"x": 0.01, "y": 0.0, "z": 0.0}}
    assert of_recording(effects, "/b") == there
    assert of_recording({}, "a") == {}


def test_it_is_free_only_among_several_recordings_of_commands() -> None:
    some = flights()
    assert FITTING.min_thrust_flights == 3
    two = with_thrust_scales(some[:2], some[2:], DRONE)
    assert not any(f.differs for part in two for f in part)
    speeds = [replace(f, inputs=replace(f.inputs, measured=True)) for f in some]
    assert not with_thrust_scales(speeds, [], DRONE)[0][0].differs
    assert not with_thrust_scales([replace(f, levelled=True) for f in some], [], DRONE)[0][0].differs
    trimmed = replace(DRONE, effects={"trim": {"x": 0.0}})
    assert not with_thrust_scales(some, [], trimmed)[0][0].differs
    data = Data(some)
    free = {c.effect: (c, p) for c, p in nuisances(data, start_point(), ())}
    strengths, precisions = free[OWN + "thrust_scale"]
    assert isinstance(strengths, OfRecordings)
    assert strengths.free == ("0.csv/scale", "1.csv/scale", "2.csv/scale", "3.csv/scale")
    assert precisions == (THRUST_SD**-2,) * 4


@pytest.mark.slow
def test_days_of_other_strengths_are_told_and_not_named() -> None:
    """About a mean of one, thrust curve and sag asked as well: nothing is missing, each day's strength is a note."""
    made = [
        replace(fly(Hidden(thrust=(s,) * 4), seed=k, seconds=15.0), path=f"{k}.csv")
        for k, s in enumerate((0.97, 1.0, 1.03))
    ]
    found = diagnose(made, DRONE, wanted=["thrust_scale", "thrust_curve", "battery_sag"])
    assert not found.mismatch
    for own, truth in zip(found.own, (0.97, 1.0, 1.03), strict=True):
        assert own.strength == pytest.approx(truth, abs=6e-3)
        assert any("thrust" in text for text in own.notices) == (truth != 1.0)
