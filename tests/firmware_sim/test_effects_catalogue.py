"""Tables of effects: the shared names, what is refused and how, neutral equal to absent, vehicle files as truth."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.vehicle import Vehicle, load_vehicle
from firmware_sim.errors import ScenarioError
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.catalogue import EFFECTS, HIDDEN, STREAMS
from firmware_sim.plant.effects.constants import neutral
from firmware_sim.scenario import load_scenario, parse_scenario

ISSUE = """
payload mass x y z | thrust_scale scale | rotor_fault rotor scale onset_time | center_of_mass x y z
linear_drag x y z | quadratic_drag x y z | velocity_moment roll_per_vy pitch_per_vx | rate_damping x y z
motor_lag time_constant | input_delay delay | measurement_delay delay streams
battery_sag gain_per_volt gain_per_second | thrust_curve slope_error | ground_effect strength height | wind x y z
gusts standard_deviation correlation_time | attitude_misalignment roll pitch yaw
accelerometer_misalignment roll pitch yaw | gyro_bias x y z | velocity_scale x y z | rotor_inertia inertia
inertia xx yy zz | inertia_products xy xz yz | torque_scale scale | trim x y z
suspended_load mass length | rotor_sensor rotor scale
"""


def test_names_are_those_that_host_and_simulator_share() -> None:
    wanted = {
        words[0]: words[1:] for words in (part.split() for part in ISSUE.replace("\n", " | ").split("|")) if words
    }
    got = {e.name: [p.name for p in e.parameters] + ["streams"] * e.streams for e in EFFECTS.values()}
    assert got == wanted
    assert len(HIDDEN) >= 4


def neutral_table(section: str, name: str) -> dict:
    """The TOML table that spells an effect's neutral values out."""
    effect = (EFFECTS if section == "effects" else HIDDEN)[name]
    values = {k: v for k, v in neutral(effect).items() if v is not None and k != "streams"}
    return values | ({"rotor": 2} if "rotor" in values else {})


EVERY = [("effects", name) for name in EFFECTS] + [("hidden", name) for name in HIDDEN]


@pytest.mark.parametrize(("section", "name"), EVERY)
def test_neutral_constants_switch_nothing_on(section: str, name: str) -> None:
    platform = {"platform": "cf21bl"}
    truth = parse_scenario({**platform, section: {name: neutral_table(section, name)}}, "test").truth()
    assert [truth[i] for i in (at.EFFECT_ROTORS, at.EFFECT_BODY, at.EFFECT_SENSING)] == [0, 0, 0]
    plain = parse_scenario(platform, "test").truth()
    read_only_with_an_effect = [at.FAULT_ROTOR, at.STICKY_ROTOR, at.VIBRATION_ROTOR]
    differs = [i for i in np.flatnonzero(truth != plain) if i not in read_only_with_an_effect]
    assert differs == []


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[effects.paylod]\nmass = 1", "effects.paylod"),
        ("[effects.payload]\nmas = 1", "effects.payload.mas"),
        ("[effects.payload]\nmass = -0.1", "effects.payload.mass"),
        ("[effects.payload]\nmass = 'heavy'", "effects.payload.mass"),
        ("[effects.payload]\nmass = true", "effects.payload.mass"),
        ("[effects.payload]\nmass = [1]", "effects.payload.mass"),
        ("[effects.payload]\nz = nan", "effects.payload.z"),
        ("[effects]\npayload = 3", "effects.payload"),
        ("effects = 3", "effects"),
        ("[effects.rotor_fault]\nscale = 0.9", "effects.rotor_fault.rotor"),
        ("[effects.rotor_fault]\nrotor = 5", "effects.rotor_fault.rotor"),
        ("[effects.rotor_fault]\nrotor = 1.5", "effects.rotor_fault.rotor"),
        ("[effects.input_delay]\ndelay = 0.2", "effects.input_delay.delay"),
        ("[effects.measurement_delay]\ndelay = 0.01\nstreams = ['poses']", "effects.measurement_delay.streams"),
        ("[effects.measurement_delay]\ndelay = 0.01\nstreams = []", "effects.measurement_delay.streams"),
        ("[effects.measurement_delay]\ndelay = 0.01\nstreams = 'pose'", "effects.measurement_delay.streams"),
        ("[effects.input_delay]\nstreams = ['pose']", "effects.input_delay.streams"),
        ("[effects.battery_sag]\ngain_per_volt = 0.1\ngain_per_second = -0.1", "effects.battery_sag"),
        ("[effects.inertia]\nzz = 1e-3", "effects.inertia"),
        ("[effects.inertia_products]\nxy = 1e-4", "effects.inertia_products"),
        ("[effects.rotor_sensor]\nrotor = 1\nscale = 0.9", "effects.rotor_sensor"),
        ("[effects.vibration]\nrotor = 1", "effects.vibration"),
        ("[hidden.payload]\nmass = 0.1", "hidden.payload"),
        ("[hidden.vibration]\ntorque = 1e-3", "hidden.vibration.rotor"),
        ("[hidden.cable_spring]\nstiffness = -1", "hidden.cable_spring.stiffness"),
        ("vehicle_file = 3", "vehicle_file"),
        ("vehicle_file = 'missing.toml'", "missing.toml"),
        ('vehicle_file = "a\\u0000b"', "cannot be read"),
        ("vehicle_file = 'bad.toml'", "bad.toml: not a TOML"),
        ("vehicle_file = 'wing.toml'", "wing.toml: span"),
        ("vehicle_file = 'light.toml'", "light.toml: inertia is missing"),
        ("vehicle_file = 'heavy.toml'", "heavy.toml: mass"),
        ("vehicle_file = 'odd.toml'", "odd.toml: effects.soap"),
        ("vehicle_file = 'impossible.toml'", "impossible.toml"),
        ("vehicle_file = 'huge.toml'", "huge.toml: larger"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, named: str) -> None:
    body = "mass = 0.03\ninertia = [2e-5, 2e-5, 3e-5]\n"
    files = {
        "bad": "mass = ",
        "wing": body + "span = 1",
        "light": "mass = 0.03",
        "heavy": body.replace("0.03", "30"),
        "odd": body + "[effects.soap]\nx = 1",
        "impossible": body.replace("3e-5", "9e-5"),
        "huge": "#" * (1 << 21),
    }
    for name, content in files.items():
        (tmp_path / f"{name}.toml").write_text(content)
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert str(tmp_path) in message
    assert named in message
    assert "\n" not in message


values = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=4), st.lists(st.text(max_size=4))
)
parameters = sorted({p.name for e in [*EFFECTS.values(), *HIDDEN.values()] for p in e.parameters} | {"streams"})


@given(
    st.dictionaries(
        st.sampled_from([*EFFECTS, "x"]), st.dictionaries(st.sampled_from(parameters), values, max_size=5) | values
    ),
    st.dictionaries(st.sampled_from([*HIDDEN, "x"]), st.dictionaries(st.sampled_from(parameters), values, max_size=5)),
)
def test_any_table_is_a_scenario_or_a_scenario_error(effects: dict, hidden: dict) -> None:
    try:
        scenario = parse_scenario({"effects": effects, "hidden": hidden}, "any")
    except ScenarioError:
        return
    assert np.all(np.isfinite(scenario.truth()))


VEHICLE = Vehicle(
    name="measured", mass=0.0312, inertia=(1.8e-5, 1.9e-5, 3.1e-5), inertia_products=(1e-7, -2e-7, 3e-7),
    arm=(0.031, 0.033), thrust_curve=(0.0, 0.02, 0.004), rotor_constant=2.1e-8, torque_per_thrust=0.0061,
    motor_time_constant=0.043,
    effects={"linear_drag": {"x": 0.01, "y": 0.012}, "rotor_fault": {"rotor": 3, "scale": 0.9, "onset_time": 4.0}},
)  # fmt: skip


def test_a_vehicle_file_is_the_truth(tmp_path: Path) -> None:
    (tmp_path / "drone.toml").write_text(VEHICLE.to_toml())
    path = tmp_path / "scenario.toml"
    path.write_text('vehicle_file = "drone.toml"')
    truth = load_scenario(path).truth()
    assert truth[at.MASS] == 0.0312
    J = [[1.8e-5, 1e-7, -2e-7], [1e-7, 1.9e-5, 3e-7], [-2e-7, 3e-7, 3.1e-5]]
    assert truth[at.INERTIA : at.INERTIA + 9].reshape(3, 3).tolist() == J
    assert (truth[at.ARM], truth[at.ARM_Y]) == (0.031, 0.033)
    assert truth[at.CURVE : at.CURVE + 6].tolist() == [0.0, 0.02, 0.004, 0, 0, 0]
    assert truth[[at.ROTOR_CONSTANT, at.TORQUE_PER_THRUST, at.MOTOR_TAU]].tolist() == [2.1e-8, 0.0061, 0.043]
    assert truth[at.THRUST_MAX] == 100.0  # the file says inf
    assert truth[at.LINEAR_DRAG : at.LINEAR_DRAG + 3].tolist() == [0.01, 0.012, 0.0]
    assert truth[[at.FAULT_ROTOR, at.FAULT_SCALE, at.FAULT_ONSET]].tolist() == [3, 0.9, 4000.0]


def test_the_scenarios_own_keys_override_the_vehicle_file(tmp_path: Path) -> None:
    (tmp_path / "drone.toml").write_text(VEHICLE.to_toml())
    text = 'vehicle_file = "drone.toml"\n[effects.linear_drag]\nz = 0.02\n[vehicle]\nmass = 0.04\n'
    truth = parse_scenario(tomllib.loads(text), "test", folder=tmp_path).truth()
    assert truth[at.MASS] == 0.04
    assert truth[at.MOTOR_TAU] == 0.043
    assert truth[at.LINEAR_DRAG : at.LINEAR_DRAG + 3].tolist() == [0.0, 0.0, 0.02]  # a table as a whole
    assert truth[at.FAULT_ROTOR] == 3
    assert truth[at.HOVER_THRUST] == pytest.approx(0.04 * 9.81 / 4)


@pytest.mark.parametrize("preset", ["cf2", "cf21bl"])
def test_a_shipped_preset_flies_like_the_platform_it_describes(tmp_path: Path, preset: str) -> None:
    (tmp_path / "drone.toml").write_text(load_vehicle(preset).to_toml())
    of_file = parse_scenario({"platform": preset, "vehicle_file": "drone.toml"}, "test", folder=tmp_path).truth()
    plain = parse_scenario({"platform": preset}, "test").truth()
    same = [at.ARM, at.ARM_Y, at.TORQUE_PER_THRUST, *range(at.CURVE, at.CURVE + 6)]
    assert of_file[same] == pytest.approx(plain[same], rel=1e-6)


def test_streams_are_told_apart() -> None:
    for stream, place in zip(STREAMS, (at.DELAY_POSE, at.DELAY_GYRO, at.DELAY_ACC, at.DELAY_STATE)):
        table = {"effects": {"measurement_delay": {"delay": 0.012, "streams": [stream]}}}
        truth = parse_scenario(table, "test").truth()
        delays = truth[at.DELAY_POSE : at.DELAY_POSE + 4]
        assert (truth[place], delays.sum()) == (12.0, 12.0)
    truth = parse_scenario({"effects": {"measurement_delay": {"delay": 0.012}}}, "test").truth()
    assert truth[at.DELAY_POSE : at.DELAY_POSE + 4].tolist() == [12.0, 0, 0, 0]  # left out: pose
