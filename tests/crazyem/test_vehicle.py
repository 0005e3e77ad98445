"""Vehicle files: shipped presets, the round trip through TOML, one sentence naming the key for each malformed file."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from crazyem.errors import FileFormatError
from crazyem.estimation.model import SPREAD, setup_for
from crazyem.vehicle import Days, Vehicle, load_vehicle, parse_vehicle, preset_names

GOOD = """
name = "test"
mass = 0.03
inertia = [1.6e-5, 1.7e-5, 2.9e-5]
arm = 0.03
thrust_curve = [0.0, 0.01, 0.01, 0.001]
torque_per_thrust = 0.007
"""

# Firmware of August 2026: ARM_LENGTH [m], CF_MASS [kg], THRUST2TORQUE [m], THRUST_MAX [N], first thrust coefficient.
FIRMWARE = {
    "cf2": (0.046, 0.029, 0.0069928948992470565, 0.12, -0.02476537915958403),
    "cf2-legacy": (0.046, 0.029, 0.007350862856566459, 0.12, -0.014830744918356092),
    "cf2-thrust-kit": (0.046, 0.0325, 0.0051648627905205285, 0.18, 0.006728127583707208),
    "cf21bl": (0.050, 0.0393, 0.00569278844371417, 0.2, -0.014058926705279723),
}


def test_every_preset_loads_under_its_own_name():
    assert set(preset_names()) == {*FIRMWARE, "zhao", "cf21bl-busetto"}
    for name in preset_names():
        assert load_vehicle(name).name == name


@pytest.mark.parametrize("name", FIRMWARE)
def test_presets_hold_the_constants_of_the_firmware(name):
    arm_length, mass, torque_per_thrust, thrust_max, constant = FIRMWARE[name]
    vehicle = load_vehicle(name)
    assert vehicle.arm == pytest.approx((arm_length / math.sqrt(2),) * 2, rel=1e-6)
    assert vehicle.mass == mass
    assert vehicle.torque_per_thrust == torque_per_thrust
    assert vehicle.thrust_max == thrust_max
    assert vehicle.thrust_curve[0] == constant
    # the curve of a fresh battery must at least carry the drone, and thrust_max must be within its reach
    assert np.polynomial.polynomial.polyval(4.2, vehicle.thrust_curve) > vehicle.thrust_max > mass * 9.81 / 4


positive = st.floats(1e-9, 1e3)
spread = st.floats(1e-3, 3.0)
days = st.builds(Days, st.integers(2, 50), st.floats(1e-6, 1.0), st.tuples(*[st.floats(1e-9, 0.1)] * 3))
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
value = st.recursive(
    st.booleans() | text | st.integers(-(2**40), 2**40) | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=4,
)


@st.composite
def inertias(draw):
    """Moments and products of a body: second moments of mass of a positive definite shape."""
    a = np.array(draw(st.lists(st.floats(-1, 1), min_size=9, max_size=9))).reshape(3, 3)
    second = (a @ a.T + 0.1 * np.eye(3)) * draw(st.floats(1e-6, 1.0))
    matrix = np.trace(second) * np.eye(3) - second
    return tuple(np.diag(matrix).tolist()), (float(matrix[0, 1]), float(matrix[0, 2]), float(matrix[1, 2]))


@st.composite
def vehicles(draw):
    moments, products = draw(inertias())
    curve = tuple(draw(st.just([]) | st.lists(st.floats(-1, 1), min_size=2, max_size=9)))
    rotor = draw(st.none() | positive)
    rotors = bool(curve) or rotor is not None
    return Vehicle(
        name=draw(text), mass=draw(positive), inertia=moments,
        inertia_products=draw(st.just((0.0, 0.0, 0.0)) | st.just(products)),
        arm=draw(st.tuples(st.floats(-1, 1), st.floats(-1, 1))),
        thrust_curve=curve, rotor_constant=rotor,
        torque_per_thrust=draw(positive) if rotors else 0.0,
        motor_time_constant=draw(st.floats(0, 1)),
        thrust_max=draw(positive | st.just(math.inf)),
        battery_compensated=draw(st.booleans()),
        effects=draw(st.dictionaries(text, st.dictionaries(text, value, max_size=3), max_size=2)),
        mass_sd=draw(st.none() | spread),
        inertia_sd=draw(st.none() | st.tuples(spread, spread, spread)),
        motor_time_constant_sd=draw(st.none() | spread),
        days=draw(st.none() | days),
    )  # fmt: skip


def test_the_brushless_preset_is_the_mean_of_its_sources_and_as_unsure_as_they_disagree():
    """Inertias by arXiv 2603.05944, crazyflow cf21B_500, arXiv 2512.14450 [kg m^2]; lag by the first."""
    sources = np.array([[33e-6, 36e-6, 59e-6], [25e-6, 28e-6, 49e-6], [23.95e-6, 23.95e-6, 32.35e-6]])
    vehicle = load_vehicle("cf21bl")
    assert vehicle.inertia == pytest.approx(np.exp(np.log(sources).mean(axis=0)), rel=2e-3)
    assert vehicle.motor_time_constant == 0.05
    t = stats.t.ppf(0.975, 2) / stats.norm.ppf(0.975)
    spread = np.maximum(t * np.log(sources).std(axis=0, ddof=1), SPREAD[1:])
    assert vehicle.inertia_sd == pytest.approx(spread, abs=0.01)


def test_the_estimator_is_as_unsure_as_the_file_says():
    unsaid = setup_for(parse_vehicle(GOOD)).prior
    assert unsaid.sd[:5] == pytest.approx([1.0, 0.5, 0.5, 0.5, 0.7])
    said = "motor_time_constant = 0.05\nmass_sd = 0.1\ninertia_sd = 0.2\nmotor_time_constant_sd = 0.3\n"
    assert setup_for(parse_vehicle(GOOD + said)).prior.sd[:5] == pytest.approx([0.1, 0.2, 0.2, 0.2, 0.3])
    assert setup_for(parse_vehicle(GOOD + said), mass=0.001).prior.sd[:4] == pytest.approx([10.0, 1.5, 1.5, 1.5])


@given(vehicles())
def test_a_vehicle_survives_the_round_trip(vehicle):
    assert parse_vehicle(vehicle.to_toml()) == vehicle


@pytest.mark.parametrize(
    ("lines", "key"),
    [
        ("flights = 1\nthrust_sd = 0.01\ntrim_sd = [1e-4, 1e-4, 1e-4]", "days.flights"),
        ("flights = 4\nthrust_sd = 0.01", "trim_sd"),
        ("flights = 4\nthrust_sd = 0.0\ntrim_sd = [1e-4, 1e-4, 1e-4]", "days.thrust_sd"),
        ("flights = 4\nthrust_sd = 0.01\ntrim_sd = [1e-4, 1e-4]", "trim_sd"),
    ],
)
def test_days_that_are_none_are_refused_by_name(lines, key):
    with pytest.raises(FileFormatError, match=key):
        parse_vehicle(load_vehicle("cf2").to_toml() + "\n[days]\n" + lines + "\n")


def replaced(key: str, line: str) -> str:
    """The good file with the line of `key` replaced (or left out)."""
    return "\n".join(line if other.startswith(f"{key} =") else other for other in GOOD.splitlines())


MALFORMED = {
    "not a number": ("mass", 'mass = "heavy"'),
    "a truth is no number": ("mass", "mass = true"),
    "negative mass": ("mass", "mass = -0.03"),
    "zero mass": ("mass", "mass = 0"), "NaN mass": ("mass", "mass = nan"), "missing mass": ("mass", ""),
    "missing name": ("name", ""), "name not text": ("name", "name = 3"), "missing inertia": ("inertia", ""),
    "inertia too short": ("inertia", "inertia = [1e-5, 1e-5]"),
    "inertia with five numbers": ("inertia", "inertia = [1e-5, 1e-5, 1e-5, 0, 0]"),
    "inertia a text": ("inertia", 'inertia = "round"'),
    "negative moment": ("inertia", "inertia = [-1e-5, 1e-5, 1e-5]"),
    "NaN moment": ("inertia", "inertia = [nan, 1e-5, 1e-5]"),
    "triangle inequality": ("inertia", "inertia = [1e-5, 1e-5, 3e-5]"),
    "not positive definite": ("inertia", "inertia = [1e-5, 1e-5, 1e-5, 2e-5, 0, 0]"),
    "missing arm": ("arm", ""),
    "arm with three numbers": ("arm", "arm = [1, 2, 3]"),
    "infinite arm": ("arm", "arm = inf"),
    "missing torque_per_thrust": ("torque_per_thrust", ""),
    "negative torque_per_thrust": ("torque_per_thrust", "torque_per_thrust = -1"),
    "curve of one number": ("thrust_curve", "thrust_curve = [1.0]"),
    "curve of texts": ("thrust_curve", 'thrust_curve = ["a", "b"]'),
    "negative rotor constant": ("rotor_constant", "rotor_constant = -1e-8"),
    "negative time constant": ("motor_time_constant", "motor_time_constant = -0.05"),
    "time constant in ms": ("motor_time_constant", "motor_time_constant = 50"),
    "zero thrust_max": ("thrust_max", "thrust_max = 0.0"),
    "battery_compensated not a truth": ("battery_compensated", "battery_compensated = 1"),
    "effects not tables": ("effects", "effects = 3"),
    "effects of numbers": ("effects", "effects = {drag = 3}"),
    "unknown key": ("wings", "wings = 2"),
    "no spread of the mass": ("mass_sd", "mass_sd = 0"),
    "two spreads of the mass": ("mass_sd", "mass_sd = [1, 1]"),
    "two spreads of the inertia": ("inertia_sd", "inertia_sd = [0.1, 0.2]"),
    "large spread of the time constant": ("motor_time_constant_sd", "motor_time_constant_sd = 4"),
}  # fmt: skip


@pytest.mark.parametrize(("key", "line"), MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_file_gives_one_sentence_naming_the_key(key, line, tmp_path):
    source = replaced(key, line) if f"{key} =" in GOOD else f"{line}\n{GOOD}"
    path = tmp_path / "bad.toml"
    path.write_text(source)
    with pytest.raises(FileFormatError) as caught:
        load_vehicle(path)
    message = str(caught.value)
    assert f"'{key}'" in message
    assert "bad.toml" in message
    assert "\n" not in message


def test_the_file_the_others_are_made_from_is_good():
    assert parse_vehicle(GOOD).mass == 0.03


@given(st.text(max_size=200))
def test_any_text_is_a_vehicle_or_a_user_error(source):
    with contextlib.suppress(FileFormatError):
        parse_vehicle(source)
