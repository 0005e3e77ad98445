"""Simulators' files: what was written is read again, templates keep their bytes, published files mean what they say."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from simulator_files import DRONE, PUBLISHED

from crazyem.errors import FileFormatError, UsageError
from crazyem.simulators.constants import NUMBERS, Constants, from_vehicle, to_vehicle
from crazyem.simulators.convert import FORMATS, NAMES, OWN, convert, format_of
from crazyem.simulators.fields import SimulatorFile, read, write
from crazyem.vehicle import Vehicle, load_vehicle

RPM = 60.0 / (2.0 * math.pi)
ROTORPY_HOVER = math.sqrt(0.03 * 9.81 / 4 / 2.3e-8)  # rad/s
INERTIA = {f"inertia_{a}" for a in ("xx", "yy", "zz")}
PRODUCTS = {f"inertia_{a}" for a in ("xy", "xz", "yz")}
CENTRE = {f"centre_{a}" for a in "xyz"}
ARMS = {"arm_x", "arm_y"}
DRAG = {f"drag_{a}" for a in "xyz"}
DAMPING = {f"damping_{a}" for a in "xyz"}
QUADRATIC = {f"quadratic_drag_{a}" for a in "xyz"}
SPEEDS = {"thrust_per_speed2", "torque_per_thrust", "thrust_max"}
BODY = {"mass"} | INERTIA

# What the table of fields of each simulator's own documentation has room for.
HOLDS = {
    "crazyflow": BODY | PRODUCTS | ARMS | SPEEDS | DRAG | {"lag"},
    "gym-pybullet-drones": BODY | ARMS | CENTRE | SPEEDS | DRAG,
    "mujoco": BODY | PRODUCTS | CENTRE | {"thrust_max"},
    "gazebo": BODY | PRODUCTS | CENTRE | ARMS | SPEEDS | {"lag", "drag_x", "drag_y"},
    "rotorpy": BODY | PRODUCTS | CENTRE | ARMS | SPEEDS | DRAG | QUADRATIC | {"lag"},
    "crazyswarm2": BODY,
    "px4-sih": BODY | PRODUCTS | ARMS | DRAG | {
        "torque_per_thrust", "thrust_max", "lag",
    } | {f"damping_{a}" for a in "xyz"},
    "omnidrones": BODY | PRODUCTS | ARMS | SPEEDS,
    "l2f": BODY | PRODUCTS | CENTRE | ARMS | {"torque_per_thrust", "thrust_max", "lag"},
    "rotorpy-json": BODY | PRODUCTS | CENTRE | ARMS | SPEEDS | DRAG | QUADRATIC | {"lag"},
}  # fmt: skip
ONE_ARM, ONE_DRAG_XY, ONE_DRAG = (
    {"crazyflow"},
    {"gym-pybullet-drones", "gazebo", "rotorpy", "rotorpy-json"},
    {"px4-sih"},
)


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


@st.composite
def drones(draw: st.DrawFn) -> Constants:
    """Constants of quadrotors between 20 g and 2 kg that are possible."""
    mass = math.exp(draw(number(math.log(0.02), math.log(2.0))))
    size = 0.03 * (mass / 0.03) ** (1 / 3)
    arm_x, arm_y = (size * draw(number(0.8, 1.25)) for _ in range(2))
    # three half-sums of squares are moments that obey the triangle inequality
    a, b, c = (mass * size**2 * draw(number(0.2, 0.5)) for _ in range(3))
    turn, _ = np.linalg.qr(np.array([[draw(number(-0.1, 0.1)) for _ in range(3)] for _ in range(3)]) + np.eye(3))
    matrix = turn @ np.diag([b + c, a + c, a + b]) @ turn.T
    hover = draw(number(40.0, 120.0)) / size  # rad/s, by the speed of blades
    thrust = mass * 9.81 / 4.0
    kf = thrust / hover**2
    return Constants(
        "drone", mass,
        *(float(matrix["xyz".index(p), "xyz".index(q)]) for p, q in ("xx", "yy", "zz", "xy", "xz", "yz")),
        *(size * draw(number(-0.3, 0.3)) for _ in range(3)), arm_x, arm_y, kf, draw(number(0.003, 0.03)),
        thrust * draw(number(1.5, 4.0)), draw(number(0.005, 0.2)),
        *(thrust * draw(number(0.0, 0.3)) for _ in range(3)), *(thrust * draw(number(0.0, 0.1)) for _ in range(3)),
        *(thrust * size * draw(number(0.0, 0.01)) for _ in range(3)),
    )  # fmt: skip


def shaped(c: Constants, name: str) -> Constants:
    """As far as a format has one number for several."""
    if name in ONE_ARM:
        c = replace(c, arm_y=c.arm_x)
    if name in ONE_DRAG_XY | ONE_DRAG:
        c = replace(c, drag_y=c.drag_x)
    if name in ONE_DRAG:
        c = replace(c, drag_z=c.drag_x, damping_y=c.damping_x, damping_z=c.damping_x)
    return c


def differing(first: Constants, second: Constants, names: set[str]) -> list[str]:
    scale = {"inertia": first.or_("inertia_zz", 0.0), "centre": first.or_("arm_x", 0.0)}
    found = []
    for n in sorted(names):
        a, b = first.or_(n, 0.0), second.or_(n, 0.0)  # what is not said is nothing
        if not math.isclose(a, b, rel_tol=1e-8, abs_tol=1e-9 * scale.get(n.split("_")[0], 1e-200)):
            found.append(f"{n}: {a!r} {b!r}")
    return found


# Small against the drone, and more than a rest of arithmetic: a centre of 1e-8 of an arm, a product of 2e-9 of Izz.
NEARLY_SYMMETRIC = Constants(
    "drone", 1.0, 5e-3, 5e-3, 3e-3, 0.0, 0.0, 6e-12, 0.0, 0.0, 9.65e-10, 0.0965, 0.0965, 1e-6, 0.02, 6.0, 0.05,
    *[0.0] * 9,
)  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
@given(drone=drones())
@example(drone=NEARLY_SYMMETRIC)
def test_what_was_written_is_read_again(name: str, drone: Constants) -> None:
    drone = shaped(drone, name)
    text = write(FORMATS[name], drone)
    found = read(FORMATS[name], text, where="written").constants
    assert differing(drone, found, HOLDS[name]) == []
    assert {n for n in NUMBERS if getattr(found, n) is not None} - HOLDS[name] <= {"lag", *DRAG, *CENTRE, *DAMPING}


@given(drone=drones())
def test_constants_become_a_vehicle_and_back(drone: Constants) -> None:
    found, left = from_vehicle(to_vehicle(drone))
    assert left == []
    assert differing(drone, found, set(NUMBERS)) == []


def test_a_text_is_told_by_its_content() -> None:
    texts = {**PUBLISHED, OWN: load_vehicle("cf2").to_toml()}
    assert {name: format_of(text, where="file") for name, text in texts.items()} == {name: name for name in NAMES}


def imported(name: str, text: str | None = None, *, strict: bool = True) -> SimulatorFile:
    source = PUBLISHED[name] if text is None else text
    return read(FORMATS[name], source, where=f"{name}.file", name=DRONE.get(name), strict=strict)


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_template_with_the_same_constants_keeps_every_byte(name: str) -> None:
    template = PUBLISHED[name]
    constants = imported(name).constants
    assert write(FORMATS[name], constants, template=with_both_controllers(template), name=DRONE.get(name, "")) == (
        with_both_controllers(template)
    )


def with_both_controllers(text: str) -> str:
    return text.replace("\n\n  cf5:", "\n      ctrlMel:\n        mass: 0.032\n\n  cf5:")


def test_a_second_controller_is_added_where_it_is_missing() -> None:
    constants, template = imported("crazyswarm2").constants, PUBLISHED["crazyswarm2"]
    text = write(FORMATS["crazyswarm2"], constants, template=template, name="cf231")
    assert text == with_both_controllers(template)
    text = write(FORMATS["crazyswarm2"], constants, template=template, name="cf5")
    assert read(FORMATS["crazyswarm2"], text, where="x", name="cf5").constants.inertia_zz == 29.26e-6


def words(text: str) -> list[str]:
    """A text without its numbers."""
    return re.sub(r"(?<![\w.])[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", "#", text).splitlines()


@pytest.mark.parametrize("name", [n for n in PUBLISHED if n not in ("rotorpy", "crazyswarm2", "gazebo")])
@settings(max_examples=settings.default.max_examples // 3)
@given(drone=drones())
def test_a_template_changes_in_its_numbers_alone(name: str, drone: Constants) -> None:
    drone = replace(shaped(drone, name), arm_y=drone.arm_x)
    text = write(FORMATS[name], drone, template=PUBLISHED[name], name=DRONE.get(name, ""))
    assert words(text) == words(PUBLISHED[name])
    held = HOLDS[name] - (PRODUCTS | {"torque_per_thrust"} if name == "mujoco" else set())
    found = read(FORMATS[name], text, where="written", name=DRONE.get(name), strict=False).constants
    assert differing(drone, found, held) == []


def test_of_several_drones_in_a_file_one_changes() -> None:
    drone = replace(imported("crazyflow").constants, mass=0.04)
    text = write(FORMATS["crazyflow"], drone, template=PUBLISHED["crazyflow"], name="my_drone")
    assert text.partition("[my_drone]")[0] == PUBLISHED["crazyflow"].partition("[my_drone]")[0]
    assert "mass = 0.04\n" in text.partition("[my_drone]")[2]


def test_a_centre_of_mass_moves_rotors_and_links() -> None:
    drone = replace(imported("gazebo").constants, centre_x=0.002, centre_z=-0.004)
    for name in ("gazebo", "rotorpy"):
        found = read(FORMATS[name], write(FORMATS[name], drone, template=PUBLISHED[name]), where="written").constants
        assert differing(drone, found, BODY | CENTRE | ARMS) == []


@pytest.mark.parametrize(
    ("name", "quantity", "value"),
    [
        ("crazyflow", "mass", 0.0328), ("crazyflow", "arm_x", 0.03253), ("crazyflow", "drag_z", 0.0139),
        ("gym-pybullet-drones", "thrust_per_speed2", 3.16e-10 * RPM**2),
        ("gym-pybullet-drones", "torque_per_thrust", 7.94e-12 / 3.16e-10),
        ("gym-pybullet-drones", "thrust_max", 2.25 * 0.027 * 9.81 / 4),
        ("gym-pybullet-drones", "arm_y", 0.028), ("mujoco", "thrust_max", 0.35 / 4),
        ("mujoco", "inertia_zz", 3.2347e-5),
        ("gazebo", "mass", 0.025 + 4 * 0.0008), ("gazebo", "thrust_max", 1.28192e-8 * 2618**2),
        # the body's centre is 21 mm below the rotors, and carries 25 of 28.2 g
        ("gazebo", "centre_z", -0.021 * 25 / 28.2), ("gazebo", "lag", 1 / math.sqrt(80 * 40)),
        ("rotorpy", "arm_x", 0.043 / math.sqrt(2)), ("rotorpy", "thrust_max", 2.3e-8 * 2500**2),
        ("rotorpy", "drag_x", 4 * 10.2506e-7 * ROTORPY_HOVER),
        # four forces -D/4 (w x r) at the corners
        ("rotorpy", "damping_x", 4 * 7.553e-7 * ROTORPY_HOVER * 0.043**2 / 2),
        ("rotorpy", "damping_z", 4 * 10.2506e-7 * ROTORPY_HOVER * 0.043**2),
        ("crazyswarm2", "inertia_yy", 16.66e-6), ("px4-sih", "torque_per_thrust", 0.02), ("px4-sih", "lag", 0.05),
        ("omnidrones", "arm_x", 0.048 / math.sqrt(2)), ("omnidrones", "torque_per_thrust", 7.24e-10 / 2.88e-8),
        ("l2f", "thrust_max", 0.149), ("l2f", "lag", math.sqrt(0.05 * 0.08)),
    ],
)  # fmt: skip
def test_published_constants_in_si(name: str, quantity: str, value: float) -> None:
    assert getattr(imported(name).constants, quantity) == pytest.approx(value, rel=1e-6)


def test_a_thrust_law_that_is_no_parabola_is_right_at_hover() -> None:
    found = imported("crazyflow")
    c = found.constants
    assert c.mass is not None
    assert c.thrust_per_speed2 is not None
    rpm = math.sqrt(c.mass * 9.81 / 4 / c.thrust_per_speed2) * RPM
    assert -5.382196214637237e-7 * rpm + 2.4582929831265485e-10 * rpm**2 == pytest.approx(c.mass * 9.81 / 4, rel=1e-9)
    assert any("no parabola" in r for r in found.remarks)
    assert any("rise" in r for r in found.remarks)


def test_a_plus_frame_is_said() -> None:
    assert any("plus" in r for r in imported("omnidrones").remarks)


def test_a_payload_is_folded_exactly() -> None:
    """By the parallel axis theorem, written out for one point mass."""
    plain = load_vehicle("cf21bl-busetto")
    loaded = replace(plain, effects={"payload": {"mass": 0.005, "x": 0.02, "y": 0.0, "z": -0.01}})
    made = convert(loaded, "rotorpy")
    reduced = plain.mass * 0.005 / (plain.mass + 0.005)
    assert made.held.mass == pytest.approx(0.05)
    assert made.held.inertia[1] == pytest.approx(plain.inertia[1] + reduced * (0.02**2 + 0.01**2))
    assert made.held.inertia_products[1] == pytest.approx(reduced * 0.02 * 0.01)
    assert made.held.effects["center_of_mass"]["x"] == pytest.approx(0.002)
    assert made.omissions == ()


def test_what_a_file_cannot_hold_costs_something() -> None:
    vehicle = replace(load_vehicle("cf21bl"), effects={"linear_drag": {"x": 0.02, "y": 0.02, "z": 0.02}})
    lost = {one.name: one for one in convert(vehicle, "gym-pybullet-drones").omissions}
    assert set(lost) == {"motor_lag", "thrust_curve"}
    assert lost["motor_lag"].cost is not None
    assert lost["motor_lag"].cost["velocity"] > 0.05
    lost = {one.name: one for one in convert(vehicle, "mujoco").omissions}
    # 0.02 N s/m slow 1.5/sqrt(2) m/s (root mean square of the made flight) by about a quarter in half a second
    assert lost["linear_drag"].cost is not None
    assert 0.1 < lost["linear_drag"].cost["velocity"] < 0.4


BAD = [
    ("gym-pybullet-drones", 'kf="3.16e-10"', 'kf="2.88e-8"', "properties.kf.*(rad/s)^2 it would fit"),
    ("omnidrones", "2.88e-8", "3.16e-10", "force_constants.*RPM^2 it would fit"),
    ("gym-pybullet-drones", 'izz="2.17e-5"', 'izz="3.17e-5"', "izz.*larger than the other two"),
    ("gym-pybullet-drones", '<mass value="0.027"/>', "", "mass.value.*is missing"),
    ("gym-pybullet-drones", '<mass value="0.027"/>', '<mass value="27"/>', "does not fit.*units"),
    ("gym-pybullet-drones", 'arm="0.0397"', 'arm="0.06"', "arm is 0.06 m, and by.*0.0396"),
    ("mujoco", "0.26487", "0.3", "ctrl.* is 0.3 N, and by.*0.2649"),
    ("mujoco", "<freejoint/>", "<freejoint>", "not valid XML"),
    ("gazebo", "<forceConstant>1.28192e-08", "<forceConstant>2e-08", "forceConstant is 2e-08.*1.282e-08"),
    ("gazebo", "<pose>0.031 0.031 0.021 0 0 0</pose>", "<pose>0.031 0.031</pose>", "six numbers"),
    ("rotorpy", "'mass': 0.03", "'mass': -0.03", "mass.*positive"),
    ("rotorpy", "'mass': 0.03", "'mass': weigh()", "mass.*is missing"),
    ("rotorpy", "'r4': d*np.array([-s, s, 0]),", "", "rotor_pos must hold r1 to r4"),
    ("rotorpy", "import numpy as np", "import numpy as", "not valid Python"),
    ("l2f", '"J_inv": [[259740.26', '"J_inv": [[1.0', "J_inv is not the inverse"),
    ("l2f", "[0.028, 0.028, 0.0]]", "[0.09, 0.028, 0.0]]", "not the corners of a rectangle"),
    ("px4-sih", "SIH_MASS 1.0", "SIH_MASS nan", "SIH_MASS must be a finite number"),
    ("px4-sih", "MPC_THR_HOVER 0.49", "MPC_THR_HOVER 0.8", "MPC_THR_HOVER is 0.8"),
    ("crazyflow", "mass = 0.0328", "mass = ", "not valid TOML"),
    ("crazyswarm2", "mass: 0.032", "mass: [0.032", "not valid YAML"),
]


@pytest.mark.parametrize(("name", "old", "new", "sentence"), BAD)
def test_bad_files_are_refused_by_their_field(name: str, old: str, new: str, sentence: str) -> None:
    assert old in PUBLISHED[name]
    count = 4 if name == "omnidrones" else 1
    with pytest.raises(
        FileFormatError, match=re.sub(r"\(rad/s\)\^2|RPM\^2", lambda m: re.escape(m[0]), sentence)
    ) as raised:
        imported(name, PUBLISHED[name].replace(old, new, count))
    assert str(raised.value).startswith(f"{name}.file: ")
    assert "\n" not in str(raised.value)


def test_contradictions_can_be_listed_instead() -> None:
    text = PUBLISHED["gazebo"].replace("<forceConstant>1.28192e-08", "<forceConstant>2e-08", 1)
    (found,) = imported("gazebo", text, strict=False).contradictions
    assert found.to_json()["value"] == 2e-8
    assert found.expected == pytest.approx(1.28192e-8)


def test_an_impossible_inertia_can_be_a_remark_instead() -> None:
    text = PUBLISHED["rotorpy"].replace("1.45e-5", "1.43e-5")  # as it is published
    assert "Izz" in imported("rotorpy", text, strict=False).remarks[0]


@pytest.mark.parametrize("text", ["", "hello", "[a]\nmass = 1\n", "<robot/>", "{}", "x = 1"])
def test_a_file_of_no_known_simulator(text: str) -> None:
    with pytest.raises(FileFormatError, match="no file of a known simulator"):
        format_of(text, where="file")


def test_closed_loop_models_are_not_converted() -> None:
    with pytest.raises(FileFormatError, match="closed-loop"):
        format_of("[cf2x_L250]\nacc_coef = 20.9\ncmd_f_coef = 3.5\nrpy_coef = [-46.0]\n", where="params.toml")


def test_a_python_module_is_not_executed() -> None:
    text = PUBLISHED["rotorpy"].replace("d = 0.043", "d = __import__('os').system('exit 1')")
    with pytest.raises(FileFormatError, match="rotor_pos"):
        imported("rotorpy", text)


def test_which_drone_is_asked() -> None:
    with pytest.raises(UsageError, match=r"several drones.*--name.*cf2x_L250, my_drone"):
        read(FORMATS["crazyflow"], PUBLISHED["crazyflow"], where="params.toml")
    with pytest.raises(UsageError, match="no drone 'x'"):
        read(FORMATS["crazyflow"], PUBLISHED["crazyflow"], where="params.toml", name="x")


def test_a_vehicle_without_rotor_constant_needs_a_template() -> None:
    with pytest.raises(FileFormatError, match="vehicle cf2: no rotor_constant, which a URDF"):
        convert(load_vehicle("cf2"), "gym-pybullet-drones")
    made = convert(load_vehicle("cf2"), "gym-pybullet-drones", template=PUBLISHED["gym-pybullet-drones"])
    assert 'kf="3.16e-10"' in made.text
    assert '<mass value="0.029"/>' in made.text


def test_a_vehicle_without_rotors_makes_a_body() -> None:
    bare = Vehicle("bare", 0.18, (2.5e-4, 3.1e-4, 2.0e-4))
    assert convert(bare, "mujoco").held.inertia == pytest.approx(bare.inertia)
