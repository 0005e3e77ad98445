"""The checks that use physics: every fault planted and found with its number.

That they are silent on sound flights, and survive hostile ones: test_doctor_streams.py.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from doctor_checks import IMU, run, with_fields
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import ROTOR_CONSTANT, Motion, changed, made_flight

from crazyem.doctor.fix import repair
from crazyem.doctor.weight import apparent_mass
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording
from crazyem.vehicle import load_vehicle

DEGREES = 180.0 / math.pi
G = 9.81
UP = np.array([0.0, 0.0, 1.0])
SIZES = settings(max_examples=settings.default.max_examples // 5)  # each takes half a second


def found_in(recording: Recording, *checks: str) -> list[Finding]:
    return [finding for name in checks for finding in run(name, recording)]


@pytest.mark.parametrize("seconds", [0.0, 1.0, 4.0, 8.0])
def test_what_is_too_short_is_not_judged(seconds: float) -> None:
    flight = made_flight(seconds=seconds, more=("mocap", "angles", "accelerations")) if seconds else None
    recording = replace(flight or Recording("x", "made", {}), metadata={"claims": {"mass_kg": "0.03"}})
    assert found_in(recording, "angles", "rates", "velocities", "forces", "tilt", "lag", "weight") == []


# ---- what is wrong is named ----

FLIGHT = made_flight(seconds=12.0, seed=3, more=("mocap", "accelerations", "angles"))
_TURN = Motion(seconds=12.0, seed=3)


def _value(name: str) -> np.ndarray:
    return FLIGHT.signals[name].value


def _world(name: str) -> np.ndarray:
    return _TURN.attitude(FLIGHT.signals[name].time).apply(_value(name))


def _body(name: str) -> np.ndarray:
    return _TURN.attitude(FLIGHT.signals[name].time).inv().apply(_value(name))


FAULTS = {
    "deg/s": ("rates", "body_rate", _value("body_rate") * DEGREES, "in deg/s", True),
    "rad/s converted": ("rates", "body_rate", _value("body_rate") / DEGREES, "once too often", True),
    "inverted pitch rate": ("rates", "body_rate", _value("body_rate") * [1, -1, 1], "x, -y, z", True),
    "world rate": ("rates", "body_rate", _world("body_rate"), "in the world frame", True),
    "rate turned twice": ("rates", "body_rate", _body("body_rate"), "in the body frame already", False),
    "rate axes swapped": ("rates", "body_rate", _value("body_rate")[:, [1, 0, 2]], "y, x, z", False),
    "deg/s, inverted": ("rates", "body_rate", _value("body_rate") * [DEGREES, -DEGREES, DEGREES], "x, -y, z", True),
    "rate bias": ("rates", "body_rate", _value("body_rate") + np.array([0.0, 0.1, 0.0]), "bias of up to 0.1", False),
    "acc in g": ("forces", "specific_force", _value("specific_force") / G, "in g, not", True),
    "acc in mg": ("forces", "specific_force", _value("specific_force") * 1e3 / G, "in mg, not", True),
    "acc converted twice": ("forces", "specific_force", _value("specific_force") * G, "once too often", True),
    "acc in world": ("forces", "specific_force", _world("specific_force"), "in the world frame, not", True),
    "acc negated": ("forces", "specific_force", -_value("specific_force"), "-x, -y, -z", True),
    "acc FRD": ("forces", "specific_force", _value("specific_force") * [1, -1, -1], "x, -y, -z", True),
    "acc less 1 g": ("forces", "specific_force", _value("specific_force") - G * UP, "gravity was removed", False),
    "acc less gravity": (
        "forces", "specific_force",
        _value("specific_force") - _TURN.attitude(FLIGHT.signals["specific_force"].time).inv().apply(G * UP),
        "in the body frame without gravity", False,
    ),
    "acc is acceleration": (
        "forces", "specific_force", _world("specific_force") - G * UP, "in the world frame without gravity", False,
    ),
    "acc z bias": ("forces", "specific_force", _value("specific_force") + 0.8 * UP, "a bias of 0.80", False),
    "acceleration in g": ("forces", "acceleration", _value("acceleration") / G, "in g, not", True),
    "acceleration with g": ("forces", "acceleration", _value("acceleration") + G * UP, "gravity is still in", False),
    "acceleration in body": ("forces", "acceleration", _body("acceleration"), "in the body frame, not", False),
    "mm/s": ("velocities", "velocity", _value("velocity") * 1000.0, "in mm/s", True),
    "cm/s": ("velocities", "velocity", _value("velocity") * 100.0, "in cm/s", True),
    "body velocity": ("velocities", "velocity", _body("velocity"), "in the body frame", False),
    "inverted velocity": ("velocities", "velocity", _value("velocity") * [1, -1, 1], "x, -y, z", True),
    "mm": ("velocities", "position", _value("position") * 1000.0, "in mm", True),
    "mocap in mm": ("velocities", "position@mocap", _value("position@mocap") * 1000.0, "in mm", True),
    "w x y z": ("angles", "attitude", _value("attitude")[:, [3, 0, 1, 2]], "is w x y z", False),
    "world to body": ("angles", "attitude", _value("attitude") * [-1, -1, -1, 1], "world to body, not", True),
    "degrees": ("angles", "euler", _value("euler") * DEGREES, "in degrees", True),
    "radians converted": ("angles", "euler", _value("euler") / DEGREES, "once too often", True),
    "inverted pitch": ("angles", "euler", _value("euler") * [1, -1, 1], "sign of pitch is inverted", True),
    "degrees, inverted": ("angles", "euler", _value("euler") * [DEGREES, -DEGREES, DEGREES], "and it is in deg", True),
    "yaw first": ("angles", "euler", _value("euler")[:, ::-1], "yaw, pitch, roll", False),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named_and_nothing_else(fault: str) -> None:
    check, name, value, said, fixable = FAULTS[fault]
    broken = changed(FLIGHT, name, value=value)
    findings = found_in(broken, "angles", "rates", "velocities", "forces")
    if fault not in ("w x y z", "world to body"):  # with a wrong attitude among three the others still agree
        assert [f.check for f in findings] == [check], [f.text for f in findings]
    mine = [f for f in findings if f.check == check]
    assert mine[0].signal == name
    assert said in mine[0].text
    assert (mine[0].fix is not None) == fixable
    if fixable:
        again, more = broken, mine
        for _ in range(3):  # two faults in one signal come off one after the other
            again = repair(again, more[0])
            if not (more := found_in(again, check)):
                break
        assert more == []


def test_orders_of_quaternions_are_told_by_gravity_alone_in_a_hover() -> None:
    hover = made_flight(Motion(seconds=20.0, size=0.0, yaw=0.0))
    wrong = changed(hover, "attitude", value=hover.signals["attitude"].value[:, [3, 0, 1, 2]])
    assert "w x y z" in found_in(wrong, "angles")[0].text


def test_without_any_pose_the_norm_still_tells_g() -> None:
    flight = made_flight(seconds=20.0, without=["state"])
    in_g = changed(flight, "specific_force", value=flight.signals["specific_force"].value / G)
    assert "in g, not m/s^2" in found_in(in_g, "forces")[0].text


def test_a_scale_that_noise_hides_is_not_named() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.5, _value("velocity").shape)
    noisy = changed(FLIGHT, "velocity", value=_value("velocity") * [1.3, 1.0, 1.0] + noise)
    assert found_in(noisy, "velocities") == []


def test_one_attitude_is_no_proof_against_a_gyro() -> None:
    flight = made_flight(seconds=30.0, seed=3)
    (finding,) = found_in(changed(flight, "body_rate", value=flight.signals["body_rate"].value * 0.85), "rates")
    assert finding.fix is None
    assert abs(finding.evidence["slope"] - 0.85) < 0.01


scales = st.one_of(st.floats(0.8, 0.93), st.floats(1.07, 1.25))


@given(factor=scales, seed=st.integers(0, 50))
@SIZES
def test_scale_faults_are_found_with_their_size(factor: float, seed: int) -> None:
    flight = made_flight(Motion(seconds=20.0, seed=seed), seed=seed, more=("mocap", "accelerations"))
    for check, name in (("rates", "body_rate"), ("velocities", "velocity"), ("forces", "specific_force")):
        broken = changed(flight, name, value=flight.signals[name].value * factor)
        (finding,) = [f for f in found_in(broken, check) if f.signal == name]
        assert finding.grade == Grade.DEGRADES
        evidence = finding.evidence
        key = "scale" if check == "forces" else "slope"
        assert abs(evidence[key] / factor - 1.0) < 0.02
        assert evidence[f"{key}_low"] - 0.01 <= factor <= evidence[f"{key}_high"] + 0.01


@given(factor=scales, axis=st.integers(0, 2), seed=st.integers(0, 50))
@SIZES
def test_a_scale_fault_of_one_axis_is_that_axis_alone(factor: float, axis: int, seed: int) -> None:
    flight = made_flight(Motion(seconds=20.0, seed=seed), seed=seed, more=("mocap",))
    gains = np.ones(3)
    gains[axis] = factor
    (finding,) = found_in(changed(flight, "body_rate", value=flight.signals["body_rate"].value * gains), "rates")
    assert finding.fix is not None
    assert np.allclose(np.array(finding.fix.factor) * gains, 1.0, atol=0.02)


@given(factor=scales)
@SIZES
def test_positions_of_two_origins_are_compared(factor: float) -> None:
    (finding,) = found_in(changed(FLIGHT, "position@mocap", value=_value("position@mocap") * factor), "velocities")
    assert abs(finding.evidence["slope"] / factor - 1.0) < 0.01


@given(degrees=st.floats(0.8, 5.0), heading=st.floats(0.0, 6.2), seed=st.integers(0, 50))
@SIZES
def test_a_tilted_frame_is_told_from_a_biased_accelerometer(degrees: float, heading: float, seed: int) -> None:
    axis = np.array([math.cos(heading), math.sin(heading), 0.0])
    tilted = made_flight(Motion(seconds=20.0, seed=seed), seed=seed, tilt=math.radians(degrees) * axis)
    (finding,) = found_in(tilted, "tilt")
    assert "tilted by" in finding.text
    assert finding.grade == (Grade.DEGRADES if finding.evidence["tilt_deg"] >= 1.5 else Grade.HARMLESS)
    assert abs(finding.evidence["tilt_deg"] - degrees) < 0.15
    assert finding.evidence["tilt_low_deg"] - 0.1 <= degrees <= finding.evidence["tilt_high_deg"] + 0.1
    biased = made_flight(Motion(seconds=20.0, seed=seed), seed=seed, bias=G * math.radians(degrees + 2.0) * axis)
    (finding,) = found_in(biased, "tilt")
    assert finding.signal == "specific_force"
    assert abs(finding.evidence["body_deg"] - degrees - 2.0) < 0.15


def test_tilt_and_bias_are_not_told_apart_without_turning() -> None:
    still = Motion(seconds=30.0, seed=3, yaw=0.0, size=0.2)
    (finding,) = found_in(made_flight(still, tilt=(math.radians(2.0), 0.0, 0.0), noise=3.0), "tilt")
    assert "cannot" in finding.text or "tell these apart" in finding.text
    assert abs(finding.evidence["together_deg"] - 2.0) < 0.3


@given(
    late=st.one_of(st.floats(-0.15, -0.005), st.floats(0.005, 0.15)),
    stream=st.sampled_from(["imu", "mocap"]),
    seed=st.integers(0, 50),
)
@SIZES
def test_a_lag_is_found_with_its_size_and_taken_out(late: float, stream: str, seed: int) -> None:
    motion = Motion(seconds=20.0, seed=seed)
    flight = made_flight(motion, seed=seed, more=("mocap",), lags={stream: late}, jitter=0.1)
    (finding,) = found_in(flight, "lag")
    evidence = finding.evidence
    assert abs(evidence["lag_ms"] - 1e3 * late) < 1.5
    assert evidence["lag_low_ms"] - 1.0 <= 1e3 * late <= evidence["lag_high_ms"] + 1.0
    assert finding.fix is not None
    assert set(finding.fix.signals) == {name for name, array in flight.signals.items() if array.stream == stream}
    assert finding.grade == (Grade.DEGRADES if abs(evidence["lag_ms"]) >= 10.0 else Grade.HARMLESS)
    assert found_in(repair(flight, finding), "lag") == []


@given(drift=st.one_of(st.floats(-0.1, -0.015), st.floats(0.015, 0.1)), seed=st.integers(0, 50))
@SIZES
def test_a_drifting_lag_has_a_start_and_an_end_and_no_fix(drift: float, seed: int) -> None:
    flight = made_flight(Motion(seconds=60.0, seed=seed), seed=seed)
    late = flight.signals["body_rate"].time * (1.0 + drift / 60.0)
    (finding,) = found_in(with_fields(flight, *IMU, time=late), "lag")
    assert "drifting" in finding.text
    assert finding.fix is None
    assert abs(finding.evidence["drift_ms"] - 1e3 * drift) < 4.0
    assert abs(finding.evidence["end_ms"] - finding.evidence["start_ms"] - finding.evidence["drift_ms"]) < 0.1


@given(mass=st.floats(0.02, 0.042), seed=st.integers(0, 50))  # kg; of 29 g: within what a payload can do
@SIZES
def test_the_apparent_mass_is_thrust_over_specific_force(mass: float, seed: int) -> None:
    flight = made_flight(Motion(seconds=20.0, seed=seed, mass=mass), seed=seed)
    carried = apparent_mass(flight, load_vehicle("cf2"))
    assert carried is not None
    assert abs(carried.mass / mass - 1.0) < 0.02
    assert found_in(flight, "weight") == []
    for claim in (str(mass), "heavy", "", "nan", "-1", "inf"):
        assert found_in(replace(flight, metadata={"claims": {"mass_kg": claim}}), "weight") == []
    turning = made_flight(Motion(seconds=20.0, seed=seed, mass=mass), seed=seed, more=("rpm",), without=("motor",))
    by_speed = apparent_mass(turning, replace(load_vehicle("cf21bl"), rotor_constant=ROTOR_CONSTANT))
    assert by_speed is not None
    assert abs(by_speed.mass / mass - 1.0) < 0.02
    (finding,) = found_in(replace(flight, metadata={"claims": {"mass_kg": str(0.6 * mass)}}), "weight")
    assert abs(finding.evidence["ratio"] - 1.0 / 0.6) < 0.05
    assert finding.fix is None


def test_a_drone_far_heavier_than_its_vehicle_is_asked_for() -> None:
    (finding,) = found_in(made_flight(Motion(seconds=20.0, seed=1, mass=0.048), seed=1), "weight")
    assert "1.7 times the weight" in finding.text


# ---- real flights ----


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lee_34g_mass_pushed_midflight", "lee_brushless_39g"])
def test_faults_planted_in_real_flights_are_named(shared_recordings, name: str) -> None:
    flight = open_recording(shared_recordings / "real_firmware" / f"{name}.csv.gz")
    for signal, factor, check, said in (
        ("body_rate", np.full(3, DEGREES), "rates", "in deg/s"),
        ("body_rate", np.array([1, -1, 1]), "rates", "x, -y, z"),
        ("specific_force", np.full(3, 1 / G), "forces", "in g, not"),
        ("velocity", np.full(3, 1e3), "velocities", "in mm/s"),
        ("velocity", np.full(3, 1.1), "velocities", "its scale is"),
        ("attitude", np.array([-1, -1, -1, 1]), "angles", "world to body, not"),
    ):
        broken = changed(flight, signal, value=flight.signals[signal].value * factor)
        findings = found_in(broken, check)
        assert any(said in f.text for f in findings), (signal, factor, [f.text for f in findings])
