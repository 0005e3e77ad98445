"""Files of other simulators by the command: converted there and back, checked, their logs as recordings."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_flight import ROTOR_CONSTANT, Motion, made_flight
from recording_files import fails
from scipy.spatial.transform import Rotation
from simulator_files import PUBLISHED

from crazyem.api.vehicles import check_vehicle, disagreements
from crazyem.cli import main
from crazyem.diagnosis.document import compare
from crazyem.recordings import open_recording
from crazyem.simulators.convert import (
    FORMATS,
    convert,
    errors_after,
    flown,
    load_source,
    reference_flight,
    rms_distance,
)
from crazyem.simulators.fields import SimulatorFile, read
from crazyem.simulators.findings import alternatives, field_findings, rescaled
from crazyem.simulators.sampling import sample
from crazyem.vehicle import Vehicle, load_vehicle, parse_vehicle

RPM = 60.0 / (2.0 * math.pi)
SCALE = {"name": "thrust_scale", "parameters": {"scale": {"value": 0.9, "sd": 0.01, "unit": ""}}}


@pytest.fixture
def urdf(tmp_path: Path) -> tuple[SimulatorFile, Vehicle]:
    path = tmp_path / "cf2x.urdf"
    path.write_text(PUBLISHED["gym-pybullet-drones"])
    source = load_source(path)
    assert source.imported is not None
    return source.imported, source.vehicle


def test_a_thrust_scale_is_told_as_kf(urdf: tuple[SimulatorFile, Vehicle]) -> None:
    imported, vehicle = urdf
    fitted = replace(vehicle, effects={**vehicle.effects, "thrust_scale": {"scale": 0.9}})
    told = {t.field: t for t in field_findings(imported, vehicle, fitted, [SCALE], {"inertia": "it hovers"})}
    kf = told["properties.kf"]
    assert kf.unit == "N/RPM^2"
    assert kf.value == pytest.approx(3.16e-10)
    assert kf.fitted == pytest.approx(0.9 * 3.16e-10)
    assert kf.sd == pytest.approx(0.01 * 3.16e-10, rel=1e-6)
    assert kf.off
    assert "3.16e-10 -> 2.844e-10 N/RPM^2 (95 %: 2.782e-10 to 2.906e-10)" in str(kf)
    # the torque per squared speed scales with it; the mass is not told at all
    assert told["properties.km"].fitted == pytest.approx(0.9 * 7.94e-12)
    assert not told["link[name=base_link].inertial.mass.value"].known
    assert "it hovers" in str(told["link[name=base_link].inertial.inertia.ixx"])


def test_less_than_the_tolerance_may_stay(urdf: tuple[SimulatorFile, Vehicle]) -> None:
    imported, vehicle = urdf
    fitted = replace(vehicle, effects={**vehicle.effects, "thrust_scale": {"scale": 0.97}})
    (kf,) = (t for t in field_findings(imported, vehicle, fitted, [SCALE], {}) if t.field == "properties.kf")
    assert kf.known
    assert not kf.off


def test_mass_and_thrust_are_not_told_apart(urdf: tuple[SimulatorFile, Vehicle]) -> None:
    imported, vehicle = urdf
    fitted = replace(vehicle, effects={**vehicle.effects, "thrust_scale": {"scale": 0.9}})
    first, second = (one["fields"] for one in alternatives(imported, fitted, vehicle.mass))
    assert first["properties.kf"] == pytest.approx(0.9 * 3.16e-10)
    assert second["properties.kf"] == pytest.approx(3.16e-10)
    assert second["link[name=base_link].inertial.mass.value"] == pytest.approx(0.027 / 0.9)


def test_a_vehicle_with_another_mass_flies_the_same() -> None:
    """Forces, torques, mass and inertia larger by one factor: the same accelerations, by Newton and Euler."""
    vehicle = Vehicle(
        "v", 0.03, (1.5e-5, 1.6e-5, 2.5e-5), arm=(0.03, 0.03), rotor_constant=2e-8, torque_per_thrust=0.006,
        motor_time_constant=0.04,
        effects={
            "payload": {"mass": 0.004, "x": 0.01, "y": 0.0, "z": 0.0}, "linear_drag": {"x": 0.01, "y": 0.01, "z": 0.01},
            "rate_damping": {"x": 1e-6, "y": 1e-6, "z": 1e-6}, "motor_lag": {"time_constant": 0.03},
            "center_of_mass": {"x": 0.001, "y": 0.0, "z": 0.0}, "trim": {"x": 1e-4, "y": 0.0, "z": 0.0},
            "velocity_moment": {"roll_per_vy": 1e-5, "pitch_per_vx": -1e-5},
        },
    )  # fmt: skip
    reference = reference_flight(vehicle)
    other = rescaled(vehicle, 0.05)
    heavier = replace(reference, inputs=replace(
        reference.inputs, rotor=replace(reference.inputs.rotor, thrust=reference.inputs.rotor.thrust * 0.05 / 0.034)
    ))  # fmt: skip
    assert max(rms_distance(flown(reference, vehicle), flown(heavier, other)).values()) < 1e-9


def test_two_files_of_a_drone_that_disagree() -> None:
    """As crazyflow's TOML and its MJCF do about the inertia."""
    toml = read(FORMATS["crazyflow"], PUBLISHED["crazyflow"], where="params.toml", name="cf2x_L250")
    heavier = PUBLISHED["mujoco"].replace('mass="0.027"', 'mass="0.0328"').replace("0.26487", "0.32177")
    mjcf = read(FORMATS["mujoco"], heavier, where="cf2x_L250.xml")
    found = disagreements(toml, mjcf)
    assert len([f for f in found if "inertia" in f]) == 3
    assert "J[0][0] [kg m^2] of params.toml is 1.68e-05" in found[0]
    assert "2.395e-05" in found[0]


@pytest.mark.slow
def test_a_wrong_file_is_corrected_by_a_flight(tmp_path: Path) -> None:
    """A flight in closed form: 36 g, 3e-8 N/(rad/s)^2, drag of 0.2 1/s. The file says a tenth more thrust, no drag."""
    flight = made_flight(seconds=12.0, seed=3, more=("rpm",), without=("motor_command",))
    path = tmp_path / "mine.urdf"
    wrong = replace(load_vehicle("cf2"), mass=0.036, rotor_constant=1.1 * ROTOR_CONSTANT)
    path.write_text(convert(wrong, "gym-pybullet-drones").text)
    found = check_vehicle(path, flight, candidates=["thrust_scale", "linear_drag"])
    told = {t.field: t for t in found.fields}
    low, high = told["properties.kf"].interval
    assert low < ROTOR_CONSTANT / RPM**2 < high
    assert told["properties.kf"].off
    assert not found.fits
    right = replace(wrong, rotor_constant=ROTOR_CONSTANT, effects={"linear_drag": dict.fromkeys("xyz", 0.2 * 0.036)})
    best = errors_after(flight, {"right": right})["right"]  # what is left is the noise of the recorded speeds
    assert found.errors["before"]["velocity"] > 1.3 * best["velocity"]
    assert found.errors["after"]["velocity"] < 1.02 * best["velocity"]
    fitted = found.diagnosis.named_vehicle("fitted")
    assert fitted.posterior is not None
    assert parse_vehicle(fitted.to_toml()) == fitted
    row = fitted.posterior.parameters.index("thrust_scale.scale")
    sd = next(e for e in found.diagnosis.effects if e.name == "thrust_scale").parameters["scale"].sd
    assert np.sqrt(fitted.posterior.covariance[row][row]) == pytest.approx(sd, rel=1e-3)
    drawn = sample(fitted, 20, days=False, mass_sd=0.0).arrays()["thrust_per_speed2"]
    assert np.isclose(drawn.mean(), ROTOR_CONSTANT, rtol=0.02)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["simulator"] == "gym-pybullet-drones"
    again = read(FORMATS["gym-pybullet-drones"], found.corrected.text, where="new")
    assert np.isclose(again.constants.or_("thrust_per_speed2", 0.0), ROTOR_CONSTANT, rtol=0.02)


def test_a_vehicle_file_is_for_diagnose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "v.toml"
    path.write_text(Vehicle("v", 0.03, (1.5e-5, 1.6e-5, 2.5e-5)).to_toml())
    recording = str(Path(__file__).parents[2] / "logs" / "clean_figure8.mcap")
    assert "diagnose judges vehicle files" in fails(capsys, "vehicle", "check", path, recording, code=2)


@pytest.mark.parametrize("to", ["crazyem", "gym-pybullet-drones"])
def test_what_a_file_holds_is_as_strong_at_a_command(to: str) -> None:
    """A scale of thrust is no effect of a file; it belongs into the law from command to thrust."""
    vehicle = replace(load_vehicle("cf2"), rotor_constant=3e-8, effects={"thrust_scale": {"scale": 0.8}})
    held = convert(vehicle, to, costs=False).held
    assert held.thrust_curve == pytest.approx([0.8 * c for c in vehicle.thrust_curve])


# `crazyem vehicle` as a user calls it


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
    assert sentence in fails(capsys, "vehicle", "convert", *words, code=code)


# logs of simulators as recordings, and as the simulated side of `diagnose --against`


MOTION = Motion(seconds=12.0, seed=2)
HEAD = "pos_x,pos_y,pos_z,quat_x,quat_y,quat_z,quat_w,vel_x,vel_y,vel_z,ang_vel_x,ang_vel_y,ang_vel_z"


def table(path: Path, head: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="")


@pytest.mark.parametrize("simulator", ["crazyflow", "gym_pybullet_drones"])
def test_states_of_a_simulator_are_a_recording(simulator: str, tmp_path: Path) -> None:
    t = np.arange(0.0, 12.0, 0.01)
    turn, rate = MOTION.attitude(t), MOTION.body_rate(t)
    speeds = np.tile([1000.0, 1100.0, 1200.0, 1300.0], (t.size, 1)) * 60 / (2 * np.pi)
    path = tmp_path / "simulated.csv"
    if simulator == "crazyflow":
        head = f"time,{HEAD},rotor_vel_0,rotor_vel_1,rotor_vel_2,rotor_vel_3"
    else:
        head, rate = f"t,{HEAD},rpm0,rpm1,rpm2,rpm3", turn.apply(rate)  # Bullet's rates are in the world
    table(path, head, t, MOTION.position(t), turn.as_quat(), MOTION.velocity(t), rate, speeds)
    found = open_recording(path)
    assert np.allclose(found.signals["position"].value, MOTION.position(t))
    assert np.allclose(found.signals["body_rate"].value, MOTION.body_rate(t), atol=1e-6)
    off = Rotation.from_quat(found.signals["attitude"].value).inv() * turn
    assert off.magnitude().max() < 1e-6
    if simulator == "crazyflow":
        assert np.allclose(found.signals["rotor_speed"].value, [1000.0, 1100.0, 1200.0, 1300.0])
    other = tmp_path / "other.csv"
    table(
        other, head, t, MOTION.position(t) + np.array([0.1, 0.0, 0.0]), turn.as_quat(), MOTION.velocity(t), rate, speeds
    )
    against = compare(found, open_recording(other))
    assert against["signals"]["position"]["rms"] == pytest.approx(0.1)
    assert against["signals"]["body_rate"]["rms"] == pytest.approx(0.0, abs=1e-9)
