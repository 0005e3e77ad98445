"""`crazyem vehicle` as a user calls it."""

import json
from pathlib import Path

import pytest
from simulator_files import PUBLISHED

from crazyem.cli import main
from crazyem.vehicle import load_vehicle


def test_convert_there_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf, toml = tmp_path / "cf.urdf", tmp_path / "cf.toml"
    assert main(["vehicle", "convert", "cf21bl-busetto", "-o", str(urdf)]) == 0
    assert "gym-pybullet-drones" in capsys.readouterr().out
    assert main(["vehicle", "convert", str(urdf), "-o", str(toml), "--to", "crazyem"]) == 0
    before, after = load_vehicle("cf21bl-busetto"), load_vehicle(toml)
    assert after.mass == pytest.approx(before.mass)
    assert after.rotor_constant == pytest.approx(before.rotor_constant)
    assert after.torque_per_thrust == pytest.approx(before.torque_per_thrust)


def test_convert_edits_a_template_and_tells_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    template, target = tmp_path / "mine.xml", tmp_path / "new.xml"
    template.write_text(PUBLISHED["mujoco"])
    words = ["vehicle", "convert", "cf21bl", "-o", str(target), "--template", str(template), "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["format"] == "mujoco"
    assert {one["name"] for one in told["omissions"]} >= {"motor_lag", "thrust_per_speed2"}
    assert (
        '<!-- the drone hovers -->\n    <key name="hover" qpos="0 0 0.3 1 0 0 0" ctrl="0.385533' in target.read_text()
    )


def test_rotorpy_is_json_where_the_name_says_so(tmp_path: Path) -> None:
    target = tmp_path / "cf.json"
    assert main(["vehicle", "convert", "cf21bl", "-o", str(target), "--to", "rotorpy"]) == 0
    assert json.loads(target.read_text())["mass"] == 0.0393


@pytest.mark.parametrize(
    ("words", "sentence", "code"),
    [
        (["nowhere.urdf", "-o", "x.sdf"], "cannot read nowhere.urdf", 2),
        (["cf2", "-o", "x.toml"], "--to says which", 2),
        (["cf2", "-o", "x.sdf", "--to", "webots"], "unknown format 'webots'", 2),
        (["cf2", "-o", "x.sdf"], "no rotor_constant", 3),
        (["bad.urdf", "-o", "x.sdf"], "kf", 3),
        (["noise.bin", "-o", "x.sdf"], "not a text file", 3),
        (["cf2", "-o", "here.sdf"], "exists already", 2),
        (["cf2", "-o", "no/where/x.sdf"], "cannot write", 2),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str], sentence: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("here.sdf").touch()
    Path("noise.bin").write_bytes(b"\xff\xfe\x00\x81")
    Path("bad.urdf").write_text(PUBLISHED["gym-pybullet-drones"].replace("3.16e-10", "2.88e-8"))
    assert main(["vehicle", "convert", *words]) == code
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert "Traceback" not in error
