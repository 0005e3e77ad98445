"""`vehicle check`: what flights say of a simulator's file, in its names and units."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_flight import ROTOR_CONSTANT, made_flight
from simulator_files import PUBLISHED

from crazyem.api.vehicles import check_vehicle, disagreements
from crazyem.cli import main
from crazyem.simulators.convert import convert, load_source
from crazyem.simulators.cost import errors_after, flown, reference_flight, rms_distance
from crazyem.simulators.fields import SimulatorFile, read
from crazyem.simulators.findings import alternatives, field_findings, rescaled
from crazyem.simulators.registry import FORMATS
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
    sd = found.diagnosis.effects[0].parameters["scale"].sd
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
    assert main(["vehicle", "check", str(path), recording]) == 2
    assert "diagnose judges vehicle files" in capsys.readouterr().err


@pytest.mark.parametrize("to", ["crazyem", "gym-pybullet-drones"])
def test_what_a_file_holds_is_as_strong_at_a_command(to: str) -> None:
    """A scale of thrust is no effect of a file; it belongs into the law from command to thrust."""
    vehicle = replace(load_vehicle("cf2"), rotor_constant=3e-8, effects={"thrust_scale": {"scale": 0.8}})
    held = convert(vehicle, to, costs=False).held
    assert held.thrust_curve == pytest.approx([0.8 * c for c in vehicle.thrust_curve])
