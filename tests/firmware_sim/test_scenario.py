"""Scenario files: what is wrong is named in one sentence, what is right becomes the plant's constants."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.errors import ScenarioError
from firmware_sim.plant import layout as at
from firmware_sim.scenario import Scenario, load_scenario, parse_scenario

FULL = """
platform = "cf2"
[vehicle]
mass = 0.036
inertia = [2.0e-5, 2.1e-5, 3.6e-5, 1e-7, -2e-7, 0]
arm = 0.0325
thrust_curve = [0.0, 0.02, 0.004]
torque_per_thrust = 0.006
thrust_max = 0.14
motor_time_constant = 0.06
[noise]
thrust = 1e-3
torque = [1e-6, 2e-6, 3e-6]
[battery]
charge = 0.8
[estimator]
positioning = "position"
[parameters]
"ctrlLee.mass" = 0.029
ctrlLqg.J_x = 2e-5
"""


def test_a_full_file(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(FULL)
    scenario = load_scenario(path)
    truth = scenario.truth()
    assert truth[at.MASS] == 0.036
    J = truth[at.INERTIA : at.INERTIA + 9].reshape(3, 3)
    assert J.tolist() == [[2e-5, 1e-7, -2e-7], [1e-7, 2.1e-5, 0], [-2e-7, 0, 3.6e-5]]
    assert J @ truth[at.INERTIA_INV : at.INERTIA_INV + 9].reshape(3, 3) == pytest.approx(np.eye(3))
    assert truth[at.CURVE : at.CURVE + 6].tolist() == [0.0, 0.02, 0.004, 0, 0, 0]
    assert truth[at.NOISE_TORQUE : at.NOISE_TORQUE + 3].tolist() == [1e-6, 2e-6, 3e-6]
    assert truth[at.FIX_KIND] == 1
    assert scenario.parameters == {"ctrlLee.mass": 0.029, "ctrlLqg.J_x": 2e-5}
    board = scenario.board()  # the firmware's own constants do not move with the truth
    assert np.array_equal(board, Scenario().board())


def test_no_file_is_the_default() -> None:
    assert load_scenario(None) == Scenario()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('platform = "cf3"', "platform"),
        ("[vehicle]\nmas = 1", "vehicle.mas"),
        ("[vehicle]\nmass = 'heavy'", "vehicle.mass"),
        ("[vehicle]\nmass = true", "vehicle.mass"),
        ("[vehicle]\nmass = -0.1", "vehicle.mass"),
        ("[vehicle]\nmass = nan", "vehicle.mass"),
        ("[vehicle]\ninertia = [1e-5, 1e-5]", "vehicle.inertia"),
        ("[vehicle]\ninertia = 1e-5", "vehicle.inertia"),
        ("[vehicle]\ninertia = [1e-5, 1e-5, 9e-5]", "vehicle.inertia"),
        ("[vehicle]\ninertia = [1e-5, 1e-5, -1e-5]", "vehicle.inertia"),
        ("[noise]\ntorque = [1e-6, 1e-6]", "noise.torque"),
        ("[estimator]\npositioning = 'gps'", "estimator.positioning"),
        ("[wings]\nspan = 1", "wings"),
        ("mass = 0.03", "mass"),
        ("[parameters]\n'ctrlLee.mass' = 'x'", "ctrlLee.mass"),
        ("[vehicle\nmass = 1", "TOML"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert str(path) in message
    assert named in message
    assert "\n" not in message


def test_a_missing_file_is_a_scenario_error(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"none\.toml"):
        load_scenario(tmp_path / "none.toml")


@given(
    st.dictionaries(
        st.sampled_from(["platform", "vehicle", "noise", "start", "parameters", "ground", "x"]),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.text(max_size=5),
            lambda c: st.lists(c, max_size=4) | st.dictionaries(st.sampled_from(["mass", "inertia", "a.b"]), c),
            max_leaves=6,
        ),
    )
)
def test_any_table_is_a_scenario_or_a_scenario_error(table: dict) -> None:
    try:
        scenario = parse_scenario(table, "any")
    except ScenarioError:
        return
    assert np.all(np.isfinite(scenario.truth()))


@pytest.mark.parametrize(("full_scale", "limit"), [("0.12", 0.15), ("2", 2.5), ("90.0", 100.0), ("inf", 100.0)])
def test_a_rotor_has_more_thrust_than_the_full_scale_of_commands(tmp_path: Path, full_scale: str, limit: float) -> None:
    (tmp_path / "drone.toml").write_text(f"mass = 0.03\ninertia = [1e-5, 1e-5, 2e-5]\nthrust_max = {full_scale}\n")
    truth = parse_scenario({"vehicle_file": "drone.toml"}, "test", folder=tmp_path).truth()
    assert truth[at.THRUST_MAX] == pytest.approx(limit)
