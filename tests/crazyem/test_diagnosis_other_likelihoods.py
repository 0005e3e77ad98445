"""What the diagnosis judges beside the regression: a tilted accelerometer, gusts, a simulated recording; on the shipped
flight, changed here by known amounts."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_parts import nominal_of, silent, start_point
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.diagnose import diagnose
from crazyem.diagnosis.document import compare, text_of
from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.flights.flight import without
from crazyem.diagnosis.locating.locate import Finding
from crazyem.diagnosis.locating.place import pushes_away
from crazyem.diagnosis.naming import accelerometer
from crazyem.diagnosis.naming.gusts import Gusts, find_gusts, lateral_force
from crazyem.diagnosis.naming.other_likelihoods import other_likelihoods
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import ACCELEROMETER, CONFIDENCE
from crazyem.errors import DataError
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

FLIGHT = Path(__file__).parents[2] / "logs" / "clean_figure8.mcap"


@pytest.fixture(scope="module")
def recording():
    return open_recording(FLIGHT)


def with_values(recording, name, change):
    array = recording.signals[name]
    return replace(recording, signals={**recording.signals, name: replace(array, value=change(array.value.copy()))})


def fitted(recording):
    return nominal_of(recording, vehicle=load_vehicle("cf2"))


NOTHING_LEFT = Unexplained((), 0.0)


def judged(data, point, name, remains=NOTHING_LEFT):
    """What is named beside the regression, where only this effect is asked for."""
    return other_likelihoods(data, None, point, remains, [name], {}, False, silent)


def tilted(recording, roll, pitch):
    """With the axes of its accelerometer turned in the body by these angles [rad]."""
    axes = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()
    return with_values(recording, "specific_force", lambda value: value @ axes)


@pytest.mark.slow
def test_a_tilted_accelerometer_is_measured_and_an_upright_one_is_not_accused(recording):
    turned = tilted(recording, 0.03, -0.02)
    for flown, true in ((turned, (0.03, -0.02)), (recording, (0.0, 0.0))):
        data, point = fitted(flown)
        solution = accelerometer.tilt(data, point)
        sd = np.sqrt(np.diag(solution.covariance)[:2])
        assert np.all(np.abs(solution.theta[:2] - true) < 4 * sd)
        assert np.all((sd > ACCELEROMETER.angle_sd) & (sd < 2e-3))
        named = judged(data, point, accelerometer.MISALIGNED)
        assert [f.name for f in named] == [accelerometer.MISALIGNED] * (flown is turned)
        # thrust along z does not show the yaw: a board's few degrees, not what the residuals' scatter makes of it
        yaw, unsure = solution.theta[2], np.sqrt(solution.covariance[2, 2])
        assert abs(yaw) < 2 * unsure
        assert 0.02 < unsure < 1.01 * ACCELEROMETER.yaw_sd


@pytest.mark.parametrize(("roll", "held", "told"), [(2e-3, 50.0, False), (5e-3, 50.0, True), (5e-3, 5.0, False)])
def test_a_yaw_that_nothing_shows_is_no_tilt(recording, monkeypatch, roll, held, told):
    """Nor is a roll that held-out flights do not confirm."""
    data, point = fitted(recording)
    solution = accelerometer.tilt(data, point)
    theta, sds = np.array([roll, 0.0, 0.08, *np.zeros(4)]), np.array([1e-4, 1e-4, 0.1, *np.ones(4)])
    monkeypatch.setattr(
        "crazyem.diagnosis.naming.other_likelihoods.tilt",
        lambda *_: replace(solution, theta=theta, covariance=np.diag(sds**2)),
    )
    monkeypatch.setattr("crazyem.diagnosis.naming.other_likelihoods.held_out_gain", lambda *given, **more: held)
    found = judged(data, point, accelerometer.MISALIGNED)
    assert [f.name for f in found] == [accelerometer.MISALIGNED] * told
    left = Finding("force", "z", "z position", "z", (0.0, 9.0), 5e-3, 5e-4, "N", 250.0, 1e-9)
    doubtful = judged(data, point, accelerometer.MISALIGNED, Unexplained((left,), 0.0))
    for one, other in zip(found, doubtful, strict=True):
        assert other.confidence == pytest.approx(CONFIDENCE.doubtful * one.confidence)
        assert other.log_odds == one.log_odds


def test_a_yaw_that_was_not_seen_does_not_cost_what_the_tilt_brings(recording):
    """0.3 rad by a hover, which hardly shows it, spoils what a quick flight with drag says of roll and pitch, unless it
    is known to be unsure."""
    data, point = fitted(tilted(recording, 0.03, -0.02))
    point = point.with_effects({"linear_drag": {"x": 0.03, "y": 0.03, "z": 0.03}})
    sure, unsure = (
        accelerometer.held_out_gain(data, point, np.array([0.03, -0.02, 0.3]), yaw_sd=sd) for sd in (1e-4, 0.3)
    )
    assert unsure > sure + 1.0


def test_what_a_prior_says_is_no_weaker_because_residuals_scatter(recording):
    """A bias that stands for the tilt costs what its prior says, 0.5 (g angle / sd)^2, however the rest scatters."""
    data, point = fitted(tilted(recording, 0.03, -0.02))
    instead = 0.5 * (0.03**2 + 0.02**2) * (9.81 / ACCELEROMETER.bias_sd) ** 2
    assert instead > 60
    for model in data.models:  # from second to second, on the whole nothing
        model.flight.force[:] += 0.2 * (-1.0) ** np.floor(model.flight.time)[:, None]
    assert accelerometer.gram_dispersion(data, point) > 3
    assert accelerometer.held_out_gain(data, point, np.array([0.03, -0.02, 0.0]), yaw_sd=0.3) > 0.5 * instead


def test_without_an_accelerometer_nothing_is_said(recording):
    assert accelerometer.tilt(*fitted(without(recording, ["specific_force"]))) is None


def test_a_calm_flight_has_no_gusts(recording):
    assert find_gusts(*fitted(recording)) is None


@pytest.mark.parametrize(("memory", "found"), [(0.05, False), (0.25, False), (0.7, True), (2.0, True)])
def test_moving_air_has_a_memory(memory, found):
    """Log-likelihoods with their maximum at a memory: one at the shortest that is tried is no gust."""

    def loglik(point, passes):
        disturbed = point.noise.disturbance[:3].any()
        lasts = np.broadcast_to(np.asarray(point.noise.memory, float), (6,))[0]
        return 500.0 - 30.0 * np.log(lasts / memory) ** 2 if disturbed else 0.0

    def fit_noise(point):
        spread = np.append(np.full(3, 0.3), point.noise.disturbance[3:])
        return replace(point, noise=replace(point.noise, disturbance=spread))

    data = SimpleNamespace(flights=[SimpleNamespace(duration=60.0)], models=[], loglik=loglik, fit_noise=fit_noise)
    gusts = find_gusts(data, start_point(load_vehicle("cf2")))
    assert (gusts is not None) == found
    assert gusts is None or gusts.memory == pytest.approx(memory, rel=1e-6)


@pytest.mark.parametrize("memory", [0.6, 2.0])
def test_an_accelerometer_shows_lateral_gusts_that_an_onboard_filter_hides(memory):
    """A force of 0.4 m/s^2 along x and y with a memory, and white noise alone: simulated exactly."""
    rng = np.random.default_rng(8)
    decay = np.exp(-0.01 / memory)
    push = lfilter([1.0], [1.0, -decay], 0.4 * np.sqrt(1.0 - decay**2) * rng.standard_normal((20000, 2)), axis=0)
    noise = 0.1 * rng.standard_normal((20000, 2))
    by_memory = {m: lateral_force([(noise[:, 0] + push[:, 0], 0.01)], m) for m in (0.1, memory, 10.0)}
    gain, spread = by_memory[memory]
    assert gain > 1000.0
    assert gain == max(g for g, _ in by_memory.values())
    assert spread == pytest.approx(0.4, rel=0.2)
    calm, none = lateral_force([(noise[:, 1], 0.01)], memory)
    assert calm < 3.0
    assert none < 0.05


def gusts_named(monkeypatch, memory, unsure, nats=0.0):
    """Gusts of 5000 nats and 1.6 m/s, with a memory [s] whose logarithm has this error, beside what is left [nats]."""
    air = Gusts(5000.0, np.ones(3), memory, unsure, True, 1.6, 0.05)
    monkeypatch.setattr("crazyem.diagnosis.naming.other_likelihoods.find_gusts", lambda data, point: air)
    where = Finding("attitude", "y", "changes at 7 s", "time", (7.0, 28.0), 0.04, 0.005, "rad", nats, 1e-7)
    remains = Unexplained((where,) if nats else (), 0.0)
    (named,) = judged(Data(()), start_point(load_vehicle("cf2")), "gusts", remains)
    return named


def test_gusts_whose_memory_nothing_tells_are_an_interval_as_wide_as_it_may_be(monkeypatch):
    """At the longest memory that is tried the likelihood bends so little that the error of its logarithm is huge."""
    named = gusts_named(monkeypatch, memory=4.0, unsure=3e4)
    assert named.parameters["correlation_time"].ci95 == (0.01, 100.0)
    assert named.parameters["standard_deviation"].ci95 == pytest.approx((1.502, 1.698))


@pytest.mark.parametrize(
    ("nats", "confidence"), [(0.0, 0.95), (1700.0, 0.49 * 0.95), (4000.0, CONFIDENCE.doubtful * 0.95)]
)
def test_gusts_are_as_sure_as_what_they_leave_allows(monkeypatch, nats, confidence):
    """A gain of 5000 nats is 2.94 times what is left: 0.49 by the rule for imitations."""
    named = gusts_named(monkeypatch, memory=0.25, unsure=0.1, nats=nats)
    assert named.confidence == pytest.approx(confidence, abs=1e-3)


def test_what_pushes_the_drone_away_is_no_place_that_it_is_tied_to():
    """Gusts move a drone that its loop holds: their force goes with its place, on every flight alike."""
    said = {
        (axis, by, size): pushes_away(
            Finding("force", axis, f"{by} position", by, (0.0, 20.0), size, 1e-3, "N", 30.0, 0.0)
        )
        for axis, by, size in (("x", "x", 0.009), ("x", "x", -0.009), ("y", "x", 0.009))
    }
    assert list(said.values()) == [True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "gusts"), [(0.009, True), (-0.009, False)])
def test_a_diagnosis_leaves_to_gusts_what_pushes_away_and_keeps_what_pulls_back(monkeypatch, recording, size, gusts):
    where = Finding("force", "x", "x position", "x", (0.0, 20.0), size, 1e-3, "N", 30.0, 0.0)
    air = Gusts(5000.0, np.ones(3), 1.0, 0.1, True, 1.6, 0.05)
    monkeypatch.setattr("crazyem.diagnosis.diagnose.depends_on_place", lambda *_: where)
    monkeypatch.setattr("crazyem.diagnosis.naming.other_likelihoods.find_gusts", lambda data, point: air)
    found = diagnose([recording], load_vehicle("cf2"), wanted=["gusts"])
    assert ("gusts" in [e.name for e in found.effects]) == gusts
    assert (where in found.unexplained.findings) == (not gusts)
    assert gusts or found.unexplained.found


def test_gusts_explain_every_force_and_nothing_else():
    force, torque = (
        Finding(signal, "x", "always", "", (0.0, 20.0), 0.01, 1e-3, unit, 30.0, 0.0)
        for signal, unit in (("force", "N"), ("torque", "N m"))
    )
    remains = Unexplained((), 0.0).with_finding(force)
    assert (remains.explained, remains.without_force()) == (0.0, Unexplained((), 0.0))
    assert remains.without_force().explained == 1.0
    assert remains.with_finding(torque).without_force().findings == (torque,)
    assert Unexplained((force,), 90.0).explained == pytest.approx(0.75)


def test_what_is_not_finite_is_said_as_a_dash():
    """The document has null for it."""
    unknown = {"value": 0.2, "unit": "s", "sd": None, "ci95": [0.01, None]}
    gusts = {"name": "gusts", "label": "gusts", "parameters": {"correlation_time": unknown}, "confidence": 0.4,
             "evidence": {"held_out_nats": None, "p_value": None}}  # fmt: skip
    where = {"signal": "force", "axis": "z", "regime": "always", "effect_size": 0.1, "sd": None, "unit": "N"}
    text = text_of({"mismatch": True, "effects": [gusts], "where": [where]})
    assert re.search(r"gusts +40 % +– +correlation time +0.2 s +0.01 to – s", text)
    assert re.search(r"force +z +always +0.1 N", text)


def test_it_is_said_what_the_flight_could_not_reveal():
    reasons = {"inertia": "needs attitude", "gyro_bias": "needs body rate", "torque_scale": "needs attitude"}
    document = {
        "mismatch": False, "where": [], "effects": [], "indistinguishable": [], "would_separate": [],
        "unexplained": {"found": False, "where": []}, "swapped": False, "recordings": [], "held_out_recordings": [],
        "of_recordings": [], "fit": {"train": {}, "held_out": {}},
        "not_identifiable": [{"name": n, "reason": r} for n, r in reasons.items()],
    }  # fmt: skip
    said = [
        "  What this flight could not reveal:",
        "  - inertia, torque scale: needs attitude",
        "  - gyro bias: needs body rate",
    ]
    assert text_of(document).splitlines()[-3:] == said


def test_a_recording_compared_with_itself_and_with_itself_moved(recording):
    same = compare(recording, recording)["signals"]
    assert all(entry["rms"] < 1e-6 for entry in same.values())
    moved = with_values(recording, "position", lambda value: value + np.array([0.3, 0.0, 0.4]))
    assert compare(recording, moved)["signals"]["position"]["rms"] == pytest.approx(0.5, rel=1e-6)


def test_a_signal_that_is_not_there_cannot_be_withheld(recording):
    with pytest.raises(DataError, match=r"no signal 'pm\.vbta'"):
        without(recording, ["pm.vbta"])
