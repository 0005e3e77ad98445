"""Whole diagnoses of closed-loop flights made elsewhere (`closed_loop.py`), their JSON, and what bad input gives."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, LOG, PER_VOLT, SIGNS, G, Hidden, fly
from diagnosis_parts import TORQUE, data_of, start_point
from numpy.typing import NDArray
from test_diagnosis_determined import impossible

from crazyem.cli import main
from crazyem.diagnosis.diagnose import Diagnosis, diagnose
from crazyem.diagnosis.document import document_of
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.prediction.horizon import UNITS
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings.mcap.signals import write_recording
from crazyem.recordings.recording import Recording
from crazyem.vehicle import load_vehicle


def holds(diagnosis: Diagnosis, effect: str, **truth: float) -> None:
    """The effect is named, and each 95 % interval holds the truth."""
    named = next(e for e in diagnosis.effects if e.name == effect)
    for name, value in truth.items():
        low, high = named.parameters[name].ci95
        assert low < value < high, (name, value, low, high)


def first(diagnosis: Diagnosis) -> set[str]:
    """The first name, and what is declared to be indistinguishable from it."""
    name = diagnosis.effects[0].name
    return {name, *(n for g in diagnosis.indistinguishable if name in g for n in g)}


# -- the document, key by key ---------------------------------------------------------------------------------------

NUMBER, TEXT = (int, float), str


def finding(value: dict[str, Any]) -> None:
    assert set(value) >= {"signal", "axis", "regime", "interval", "effect_size", "unit"}
    assert len(value["interval"]) == 2
    assert isinstance(value["effect_size"], NUMBER)
    assert all(isinstance(value[k], TEXT) for k in ("signal", "axis", "regime", "unit"))


def horizon_errors(value: dict[str, Any]) -> None:
    assert value["horizon_s"] == [0.01, 0.1, 0.5]
    for name, unit in (("position", "m"), ("velocity", "m/s"), ("attitude", "rad"), ("body_rate", "rad/s")):
        assert value[name]["unit"] == unit
        assert len(value[name]["rms"]) == 3


def schema(document: dict[str, Any], *, held_out: bool) -> None:
    """Keys as the issue has them; more keys are allowed."""
    assert isinstance(document["mismatch"], bool)
    for one in document["where"]:
        finding(one)
    for effect in document["effects"]:
        assert effect["name"] in CATALOGUE
        assert 0 <= effect["confidence"] <= 1
        assert set(effect["evidence"]) == {"held_out_nats", "p_value", "log_odds"}
        assert isinstance(effect["evidence"]["held_out_nats"], NUMBER)
        assert effect["evidence"]["p_value"] is None
        assert isinstance(effect["evidence"]["log_odds"], NUMBER)
        known = {p.name: p.unit for p in CATALOGUE[effect["name"]].parameters}
        for name, parameter in effect["parameters"].items():
            assert name in known
            if not parameter.get("chosen"):
                assert set(parameter) == {"value", "unit", "sd", "ci95"}
                assert parameter["unit"] == known[name]
                assert parameter["ci95"][0] <= parameter["value"] <= parameter["ci95"][1]
        told = {n: (v["value"], *v["ci95"]) for n, v in effect["parameters"].items() if not v.get("chosen")}
        assert impossible(effect["name"], told) == []
    assert all(tried["p_value"] is None for tried in document["ranking"])
    assert all(isinstance(n, TEXT) for group in document["indistinguishable"] for n in group)
    assert all(isinstance(t, TEXT) for t in document["would_separate"])
    for one in document["unexplained"]["where"]:
        finding(one)
    assert isinstance(document["unexplained"]["found"], bool)
    for part in ("train", "held_out") if held_out else ("train",):
        horizon_errors(document["fit"][part]["before"])
        horizon_errors(document["fit"][part]["after"])
    assert isinstance(document["not_identifiable"], list)
    assert all({"quantity", "horizon_s"} <= set(w) for part in document["fit"].values() for w in part.get("worse", ()))
    assert {(e["words"], e["parameter"]) for e in document["left_free"]} >= {("input delay", "delay")}
    finite(document)


def finite(value: Any) -> None:
    """JSON knows neither NaN nor infinity."""
    if isinstance(value, float):
        assert math.isfinite(value)
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        finite(inner)


# -- flights with something hidden ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dragged() -> list[Recording]:
    return [fly(Hidden(drag=(0.02, 0.015, 0.01)), seed=s, seconds=12.0) for s in (0, 1)]


@pytest.mark.slow
def test_nothing_hidden_is_nothing_found() -> None:
    recording = fly(seconds=10.0)
    found = diagnose([recording], DRONE)
    assert not found.mismatch
    assert found.effects == ()
    assert found.fitted_vehicle == DRONE
    document, pictures = document_of(found, [recording])
    schema(document, held_out=False)
    assert document["where"] == []
    assert set(pictures) == {f"error {q}" for q in UNITS}


@pytest.mark.slow
def test_ten_seconds_are_enough_for_what_is_plain() -> None:
    """A thrust that is a tenth too weak is; a payload of the right place and size is nearly the same thing.

    A drag beside it needs a longer flight.
    """
    recording = fly(Hidden(thrust=(0.9,) * 4, drag=(0.02, 0.02, 0.02)), seconds=10.0)
    found = diagnose([recording], DRONE)
    assert "thrust_scale" in {*first(found), *(e.name for e in found.effects)}
    if found.effects[0].name == "thrust_scale":
        holds(found, "thrust_scale", scale=0.9)
    assert any("weigh the drone" in text for text in found.would_separate)
    document, pictures = document_of(found, [recording])
    accused = {f"{f['signal']} {f['axis']}" for f in document["where"]}
    assert accused
    assert {n for n in pictures if not n.startswith("error")} == accused or len(accused) > 4


@pytest.mark.slow
def test_a_rotor_that_fails_in_flight_is_named_with_its_moment() -> None:
    found = diagnose([fly(Hidden(thrust=(1, 1, 0.9, 1), onset=8.37), seconds=14.0)], DRONE)
    assert found.effects[0].name == "rotor_fault"
    holds(found, "rotor_fault", scale=0.9)
    chosen: Any = found.effects[0].chosen
    assert chosen["rotor"] == 3
    assert abs(chosen["onset_time"] - 8.37) < 0.15
    changes = [f for f in found.before.findings if "changes" in f.regime and f.signal == "torque"]
    assert abs(changes[0].interval[0] - 8.37) < 1.0


@pytest.mark.slow
def test_torques_that_wander_are_noise() -> None:
    """Random angular accelerations of 1 rad/s^2 with a memory of 0.5 s, as moving air brings them, are no effect."""
    assert diagnose([fly(sway=1.0, seconds=12.0)], DRONE).effects == ()


@pytest.mark.slow
def test_a_pull_on_one_side_is_left_unexplained_there() -> None:
    """Beyond x = 0.1 m something pulls with 20 mN: no effect of the catalogue does."""
    found = diagnose([fly(Hidden(rope=0.02), seconds=12.0)], DRONE)
    assert found.mismatch
    assert found.unexplained.found
    worst = found.unexplained.findings[0]
    assert (worst.signal, worst.axis) == ("force", "x")
    assert worst.regime.startswith("x ")


# -- closed loops ---------------------------------------------------------------------------------------------------


def regressed(recording: Recording) -> NDArray[np.float64]:
    """(3,) factor on the torques by least squares of differenced rates on torque over inertia, without an offset."""
    rate = recording.signals["body_rate"].value
    command = recording.signals["motor_command"].value * recording.signals["voltage"].value * PER_VOLT
    lag, f, mean = DRONE.motor_time_constant, np.full(4, DRONE.mass * G / 4), []
    for c in command[:-1]:
        fall = np.exp(-LOG / lag)
        mean.append(c + (f - c) * (1 - fall) * lag / LOG)
        f = c + (f - c) * fall
    levers = np.array([*DRONE.arm[::-1], DRONE.torque_per_thrust])
    x = levers * (np.array(mean) @ SIGNS.T) / DRONE.inertia
    return np.sum(x * np.diff(rate, axis=0) / LOG, axis=0) / np.sum(x * x, axis=0)


def gain(recording: Recording, *, sway: float) -> tuple[float, float]:
    """The factor on the torques by the likelihood, and its standard deviation; `sway` begins the disturbances."""
    data = data_of(recording)
    point = start_point()
    disturbance = np.array([0.0] * 3 + [sway] * 3)
    point = replace(point, noise=replace(point.noise, disturbance=disturbance, memory=1.0))
    data.settle(point)
    point = data.fit_noise(point).with_effects({"torque_scale": {"scale": 1.0}})
    fitted = refine_base(data, point, [TORQUE])
    solution = fitted.gram.solve(range(fitted.gram.size), precision=fitted.precision)
    return fitted.point.effects["torque_scale"]["scale"], float(np.sqrt(solution.covariance[0, 0]))


@pytest.mark.parametrize(
    ("made", "regression", "sway", "unsure"),
    [
        # noise of a rate is in the command that answers to it and in the difference that begins with it: regression
        # finds a gain that is not there; what a loop sends between logged commands is not known, which widens the sd
        ({"rate_noise": 0.1}, (0.88, np.inf), 0.0, 0.1),
        # commands are mostly minus the disturbance; disturbances as states, with twice the true memory, leave the gain
        ({"sway": 5.0}, (-np.inf, 0.5), 2.0, 0.07),
    ],
    ids=["feedback from a noisy gyro", "disturbances that the controller fights"],
)
def test_a_closed_loop_does_not_bend_a_gain(made, regression, sway, unsure):
    recording = fly(Hidden(torque=0.8), seconds=15.0, **made)
    low, high = regression
    assert np.all((low < regressed(recording)) & (regressed(recording) < high))
    value, sd = gain(recording, sway=sway)
    assert abs(value - 0.8) < 2.5 * sd
    assert sd < unsure


# -- the command ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, dragged: list[Recording]) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    write_recording(dragged[0], folder / "drag.mcap")
    write_recording(dragged[1], folder / "other.mcap")
    (folder / "made.toml").write_text(DRONE.to_toml())
    return folder


def test_drag_is_named_measured_and_taken_away_and_the_command_writes_what_it_says(
    flown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [str(flown / n) for n in ("report.html", "d.json", "fitted.toml")]
    other = str(flown / "other.mcap")
    outputs = ["--against", other, "--report", out[0], "--json", out[1], "--write-vehicle", out[2]]
    options = ["--vehicle", str(flown / "made.toml"), "--held-out", other, *outputs]
    code = main(["diagnose", str(flown / "drag.mcap"), *options])
    shown = capsys.readouterr()
    assert code == 0
    assert "linear drag" in shown.out
    assert "diagnose:" in shown.err  # progress
    document = json.loads(Path(out[1]).read_text())
    schema(document, held_out=True)
    assert document["mismatch"]
    assert [e["name"] for e in document["effects"]] == ["linear_drag"]
    for axis, truth in (("x", 0.02), ("y", 0.015), ("z", 0.01)):
        low, high = document["effects"][0]["parameters"][axis]["ci95"]
        assert low < truth < high
    both = document["fit"]["held_out"]
    assert both["after"]["velocity"]["rms"][1] < 0.85 * both["before"]["velocity"]["rms"][1]
    assert document["where"]
    assert document["against"]["signals"]["position"]["rms"] > 0.05
    report = Path(out[0]).read_text(encoding="utf-8")
    assert "linear drag" in report
    fitted = load_vehicle(out[2])
    assert fitted.name == "fitted"
    assert fitted.mass == DRONE.mass
    assert set(fitted.effects) == {"linear_drag"}
    assert abs(fitted.effects["linear_drag"]["x"] - 0.02) < 0.005
    assert not list(flown.glob("*.part"))


def test_json_on_standard_output_is_alone_there(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--vehicle", str(flown / "made.toml"), "--candidates", "gyro_bias", "--json", "-"]
    assert main(["diagnose", str(flown / "drag.mcap"), *options]) == 0
    schema(json.loads(capsys.readouterr().out), held_out=False)


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Exit code and the one sentence."""
    code = main(["diagnose", *map(str, arguments)])
    error = capsys.readouterr().err
    assert "Traceback" not in error
    lines = [line for line in error.splitlines() if not line.startswith("diagnose:")]
    assert len(lines) == 1, error
    return code, lines[0]


def test_bad_input_is_one_sentence(
    flown: Path, dragged: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drone = ("--vehicle", flown / "made.toml")
    signals = dragged[0].signals
    without_inputs = {n: a for n, a in signals.items() if n not in ("motor_command",)}
    write_recording(replace(dragged[0], signals=without_inputs), tmp_path / "inputs.mcap")
    write_recording(fly(seconds=3.0), tmp_path / "short.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.csv").write_text("hello\n")
    cases: list[tuple[tuple[object, ...], int, str]] = [
        ((tmp_path / "short.mcap", *drone), 5, "too short"),
        ((tmp_path / "inputs.mcap", *drone), 5, "no motor commands, rotor speeds or commanded thrust"),
        ((tmp_path / "empty.mcap", *drone), 3, "empty"),
        ((tmp_path / "text.csv", *drone), 3, "text.csv"),
        ((tmp_path / "none.mcap", *drone), 2, "none.mcap"),
        ((flown / "drag.mcap", *drone, "--candidates", "ghosts"), 2, "unknown effect 'ghosts'"),
        ((flown / "drag.mcap", *drone, "--withhold", "pm.vbat"), 5, "no signal 'pm.vbat' to withhold"),
        ((flown / "drag.mcap", *drone, "--withhold", "motor_command"), 5, "motor commands"),
        ((flown / "drag.mcap", "--vehicle", "nonesuch"), 2, "unknown vehicle 'nonesuch'"),
        ((flown / "drag.mcap", *drone, "--json", tmp_path / "no" / "d.json"), 2, "d.json"),
        ((), 2, "RECORDING"),
    ]
    for arguments, code, words in cases:
        found, sentence = said(capsys, *arguments)
        assert found == code, sentence
        assert words in sentence, sentence


def test_a_drone_that_stands_still_is_not_diagnosed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On the floor, rotors off: nothing was flown."""
    recording = fly(seconds=6.0)
    still = {}
    for name, array in recording.signals.items():
        value = np.repeat(array.value[:1], len(array.value), axis=0)
        still[name] = replace(array, value=np.zeros_like(value) if name in ("motor_command", "flying") else value)
    write_recording(replace(recording, signals=still), tmp_path / "still.mcap")
    (tmp_path / "made.toml").write_text(DRONE.to_toml())
    code, sentence = said(capsys, tmp_path / "still.mcap", "--vehicle", tmp_path / "made.toml")
    assert code == 5
    assert "nothing was flown" in sentence
