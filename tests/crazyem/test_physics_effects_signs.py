"""Signs and sizes of every effect, each by hand from docs: firmware_sim_effects.md, where their meaning is agreed."""

import math

import numpy as np
import pytest
from effects_cases import CF2, ROTORS, G, still, wild
from scipy.spatial.transform import Rotation

from crazyem.physics.effects.effect import Effects, Situation
from crazyem.physics.effects.rotors import TYPICAL_ROTOR_CONSTANT
from crazyem.physics.motion import RotorInput, measured, motion, rotor_thrust
from crazyem.physics.rotations import rotation_between

M = CF2.mass
IYY = CF2.inertia[1]
ARM = CF2.arm[0]


YAWED = Rotation.from_euler("z", np.pi / 2).as_matrix()  # nose to world +y


KAPPA = CF2.torque_per_thrust
# what the drone does, its effects -> force and torque that they add
BY_HAND: dict[str, tuple[Situation, Effects, list[float], list[float]]] = {
    # flying along world +x with the nose to +y: the air comes from the right, v_body = (0, -2, 0)
    "linear drag is against the velocity in body axes": (
        still(velocity=[2.0, 0, 0], rotation=YAWED), {"linear_drag": {"x": 0.5, "y": 0.01}}, [0, 0.02, 0], [0, 0, 0],
    ),
    "quadratic drag takes the whole airspeed": (
        still(velocity=[3.0, 0, 4.0]), {"quadratic_drag": {"x": 0.001, "z": 0.002}}, [-0.015, 0, -0.04], [0, 0, 0],
    ),
    "velocity moment": (
        still(velocity=[2.0, 3.0, 0]), {"velocity_moment": {"roll_per_vy": 1e-5, "pitch_per_vx": -2e-5}},
        [0, 0, 0], [3e-5, -4e-5, 0],
    ),
    "rate damping": (still(body_rate=[0, 0, 2.0]), {"rate_damping": {"z": 1e-5}}, [0, 0, 0], [0, 0, -2e-5]),
    "wind alone is a constant force in the world": (
        still(velocity=[5.0, 5.0, 0], rotation=YAWED), {"wind": {"x": 2.0}}, [0, -0.014, 0], [0, 0, 0],
    ),
    "wind with drag blows on the drone": (
        still(velocity=[1.0, 0, 0]), {"wind": {"x": 3.0}, "linear_drag": {"x": 0.01}}, [0.02, 0, 0], [0, 0, 0],
    ),
    # the moment of the air feels the wind, but is no drag: the wind's constant force stays
    "wind with a moment": (
        still(velocity=[1.0, 0, 0]), {"wind": {"x": 3.0}, "velocity_moment": {"pitch_per_vx": -1e-5}},
        [0.021, 0, 0], [0, 2e-5, 0],
    ),
    # M1 is front right: left side down, nose up
    "thrust scale also scales the drag torque": (
        still(thrust=[0.1, 0, 0, 0]), {"thrust_scale": {"scale": 1.1}},
        [0, 0, 0.01], [-0.01 * ARM, -0.01 * ARM, -0.01 * KAPPA],
    ),
    # M2 back right loses a tenth: the right sinks (positive roll), the tail sinks (negative pitch), less positive yaw
    "rotor fault": (
        still(thrust=0.1), {"rotor_fault": {"rotor": 2, "scale": 0.9}},
        [0, 0, -0.01], [0.01 * ARM, -0.01 * ARM, -0.01 * KAPPA],
    ),
    # front stronger: nose up, negative pitch
    "torque scale": (
        still(thrust=[0.08, 0.07, 0.07, 0.08]), {"torque_scale": {"scale": 1.5}}, [0, 0, 0], [0, -0.01 * ARM, 0],
    ),
    # one height up: a fraction 1/e of the strength
    "ground effect": (
        still(thrust=0.07, height=[0.1]), {"ground_effect": {"strength": 0.2, "height": 0.1}},
        [0, 0, 0.28 * 0.2 / math.e], [0, 0, 0],
    ),
    # only M1 turns, counter-clockwise: H along +z. Rolling right-handed about x turns H towards -y; the reaction is +y.
    "rotor inertia is a gyroscope": (
        still(thrust=[0.1, 0, 0, 0], body_rate=[2.0, 0, 0]), {"rotor_inertia": {"inertia": 2e-8}},
        [0, 0, 0], [0, 2.0 * 2e-8 * math.sqrt(0.1 / 2.5e-8), 0],
    ),
    # dW/dt of M1, counter-clockwise; the body turns the other way
    "a rotor that speeds up": (
        still(thrust=[0.1, 0, 0, 0], thrust_rate=[0.05, 0, 0, 0]), {"rotor_inertia": {"inertia": 2e-8}},
        [0, 0, 0], [0, 0, -2e-8 * 0.05 / (2 * math.sqrt(2.5e-8 * 0.1))],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BY_HAND.values(), ids=BY_HAND)
def test_force_and_torque_of_an_effect(case: tuple[Situation, Effects, list[float], list[float]]) -> None:
    situation, effects, force, torque = case
    plain, with_it = (motion(situation, vehicle=ROTORS, effects=e) for e in ({}, effects))
    added = M * (with_it.specific_force - plain.specific_force)[0]
    turning = np.diag(CF2.inertia) @ (with_it.angular_acceleration - plain.angular_acceleration)[0]
    np.testing.assert_allclose(added, force, atol=1e-12)
    np.testing.assert_allclose(turning, torque, atol=1e-15)


def test_a_rotor_fails_at_its_onset() -> None:
    dated: Effects = {"rotor_fault": {"rotor": 2, "scale": 0.9, "onset_time": 0.0225}}
    lost = 4 * 0.07 - M * motion(still(6), vehicle=ROTORS, effects=dated).specific_force[:, 2]
    np.testing.assert_allclose(lost / 0.007, [0, 0, 0, 0.75, 1, 1], atol=1e-9)


def test_torque_scale_leaves_the_torque_of_a_shifted_centre() -> None:
    both: Effects = {"torque_scale": {"scale": 1.5}, "center_of_mass": {"x": 0.002}}
    # thrust F at O, centre of mass 2 mm in front: torque -c x F = +0.002 F about y, unscaled
    situation = still(thrust=[0.08, 0.07, 0.07, 0.08])
    turned = motion(situation, vehicle=ROTORS, effects=both).angular_acceleration[0, 1] * IYY
    assert turned == pytest.approx(1.5 * -0.02 * ARM + 0.002 * 0.3)


@pytest.mark.parametrize(("gram", "rpm"), [(17.3, 13522), (28.6, 17174)])
def test_the_typical_rotor_is_that_of_the_stand(gram: float, rpm: float) -> None:
    """What four propellers of a brushed Crazyflie lift at a speed (Bitcraze, Measuring propeller RPM, part 3, 2015)."""
    speed = rpm * 2 * math.pi / 60
    assert pytest.approx(gram * 1e-3 * 9.81 / 4 / speed**2, rel=0.04) == TYPICAL_ROTOR_CONSTANT


def test_rotor_inertia_of_a_vehicle_without_rotor_constant_takes_a_typical_one() -> None:
    rolling = still(thrust=[0.1, 0, 0, 0], body_rate=[2.0, 0, 0], vehicle=CF2)
    gained = motion(rolling, vehicle=CF2, effects={"rotor_inertia": {"inertia": 2e-8}}).angular_acceleration[0, 1] * IYY
    plain = motion(rolling, vehicle=CF2, effects={}).angular_acceleration[0, 1] * IYY
    assert gained - plain == pytest.approx(2.0 * 2e-8 * math.sqrt(0.1 / 2.1e-8))


# --- before the lag --------------------------------------------------------------------------------------------------


def settled(effects: Effects, *, thrust=0.07, voltage=4.0, flown=10.0, speeds=False) -> np.ndarray:
    """Mean thrust (4,) long after a constant command."""
    n = 100
    inputs = RotorInput(
        0.01 * np.arange(n), np.full((n, 4), thrust), np.full(n, voltage), np.full(n, flown), measured=speeds
    )
    return rotor_thrust(inputs, np.array([0.9, 0.91]), vehicle=ROTORS, effects=effects)[0][-1]


HOVER = M * G / 4


@pytest.mark.parametrize(
    ("effect", "values", "seen", "expected"),
    [
        ("thrust_curve", {"slope_error": 0.2}, {"thrust": HOVER}, HOVER),
        ("thrust_curve", {"slope_error": 0.2}, {"thrust": HOVER + 0.01}, HOVER + 0.012),
        ("thrust_curve", {"slope_error": 3.0}, {"thrust": 0.119}, 0.119 + 3.0 * (0.119 - HOVER)),
        ("thrust_curve", {"slope_error": 2.0}, {"thrust": 0.01}, 0.0),
        ("thrust_curve", {"slope_error": -0.5}, {"thrust": 0.0}, 0.0),
        ("thrust_curve", {"slope_error": 0.2}, {"thrust": 0.09, "speeds": True}, 0.09),
        ("battery_sag", {"gain_per_volt": 0.2}, {"voltage": 3.2}, 0.07 * 0.9),
        ("battery_sag", {"gain_per_volt": 0.2}, {"voltage": math.nan}, 0.07),
        ("battery_sag", {"gain_per_second": -0.004}, {"flown": 25.0}, 0.07 * 0.9),
        ("battery_sag", {"gain_per_second": -0.004}, {"flown": -25.0}, 0.07),
        ("battery_sag", {"gain_per_second": -0.1}, {"flown": 25.0}, 0.0),
        ("battery_sag", {"gain_per_volt": 0.2}, {"voltage": 3.2, "speeds": True}, 0.07),
    ],
)
def test_thrust_curve_and_battery_sag(effect, values, seen, expected) -> None:
    np.testing.assert_allclose(settled({effect: values}, **seen), expected, atol=1e-15)


def test_thrust_curve_comes_before_sag() -> None:
    both: Effects = {"battery_sag": {"gain_per_volt": 0.2}, "thrust_curve": {"slope_error": 0.5}}
    np.testing.assert_allclose(settled(both, thrust=HOVER + 0.01, voltage=3.2), 0.9 * (HOVER + 0.015))


def test_rotor_sensor_that_counts_too_much_hides_a_weaker_rotor() -> None:
    found = settled({"rotor_sensor": {"rotor": 3, "scale": 1.1}}, speeds=True)
    np.testing.assert_allclose(found, [0.07, 0.07, 0.07 / 1.21, 0.07])
    np.testing.assert_allclose(settled({"rotor_sensor": {"rotor": 3, "scale": 1.1}}), 0.07)  # commands: nothing


def test_lag_and_delay_of_a_step() -> None:
    """A step of the command at 0.5 s, seen at 0.6 s: 1 - exp(-(0.1 - delay)/tau)."""
    time = 0.001 * np.arange(1000)
    thrust = np.where(time[:, None] >= 0.5, 0.1, 0.05) * np.ones(4)
    inputs = RotorInput(time, thrust, np.full(1000, 4.0), time, measured=False, aged=False)
    nodes = np.array([0.4, 0.5999, 0.6])
    for tau, delay in ((0.05, 0.0), (0.02, 0.0), (0.05, 0.03)):
        effects: Effects = {"motor_lag": {"time_constant": tau}, "input_delay": {"delay": delay}}
        mean, rate = rotor_thrust(inputs, nodes, vehicle=ROTORS, effects=effects)
        expected = 0.1 - 0.05 * math.exp(-(0.1 - delay) / tau)
        np.testing.assert_allclose(mean[-1], expected, rtol=1e-3)
        np.testing.assert_allclose(rate[-1], (0.1 - expected) / tau, rtol=1e-2)


# --- what sensors show -----------------------------------------------------------------------------------------------


def test_a_pose_frame_rolled_by_a_reports_roll_more_by_a() -> None:
    rotation = Rotation.from_euler("x", 0.2)
    situation = still(rotation=rotation.as_matrix())
    state = measured(situation, vehicle=CF2, effects={"attitude_misalignment": {"roll": 0.1}}).state[0]
    np.testing.assert_allclose(state, [0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0, 0, 0], atol=1e-15)
    shown = rotation * Rotation.from_rotvec(state[6:9])
    np.testing.assert_allclose(shown.as_euler("ZYX"), [0, 0, 0.3], atol=1e-12)
    angles = {"roll": 0.3, "pitch": -0.5, "yaw": 1.2}
    vector = measured(situation, vehicle=CF2, effects={"attitude_misalignment": angles}).state[0, 6:9]
    expected = Rotation.from_euler("ZYX", [1.2, -0.5, 0.3])
    np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), expected.as_matrix(), atol=1e-12)


def test_an_accelerometer_pitched_nose_down_sees_thrust_pull_it_back() -> None:
    situation = still(specific_force=[0, 0, G])
    shown = measured(situation, vehicle=CF2, effects={"accelerometer_misalignment": {"pitch": 0.1}}).specific_force[0]
    # the sensor's x axis points (cos, 0, -sin): the upward force has the part -g sin(0.1) along it
    np.testing.assert_allclose(shown, [-G * math.sin(0.1), 0, G * (math.cos(0.1) - 1)], atol=1e-12)


def test_gyro_bias_and_velocity_scale() -> None:
    situation = still(velocity=[1.0, 2.0, 3.0], rotation=YAWED)
    effects: Effects = {"gyro_bias": {"y": 0.02}, "velocity_scale": {"x": 1.1, "z": 0.9}}
    state = measured(situation, vehicle=CF2, effects=effects).state[0]
    np.testing.assert_allclose(state, [0, 0, 0, 0.1, 0, -0.3, 0, 0, 0, 0, 0.02, 0], atol=1e-15)


def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, Rotation, np.ndarray]:
    """Position, velocity, attitude and rate of a smooth flight that turns about a fixed axis."""
    axis = np.array([0.6, 0.0, 0.8])
    w = np.array([1.0, 1.3, 0.7])
    phase = np.multiply.outer(time, w)
    angle, rate = 1.5 * np.sin(2 * time), 3.0 * np.cos(2 * time)
    return np.sin(phase), w * np.cos(phase), Rotation.from_rotvec(np.outer(angle, axis)), np.outer(rate, axis)


@pytest.mark.parametrize("delay", [0.01, 0.0137, 0.05, 0.1])
def test_measurement_delay_shows_the_past(delay: float) -> None:
    n = 300
    time = 0.01 * np.arange(n)
    position, velocity, attitude, rate = path(time)
    force = np.c_[np.sin(time), np.cos(time), time]
    situation = still(
        n, position=position, velocity=velocity, rotation=attitude.as_matrix(), body_rate=rate, specific_force=force
    )
    before = path(time - delay)
    late = measured(situation, vehicle=CF2, effects={"measurement_delay": {"delay": delay, "streams": ["state"]}})
    later = slice(12, None)  # beyond the first moments, whose past was not recorded
    np.testing.assert_allclose((position + late.state[:, :3])[later], before[0][later], atol=1e-4)
    np.testing.assert_allclose((velocity + late.state[:, 3:6])[later], before[1][later], atol=1e-4)
    shown = attitude * Rotation.from_rotvec(late.state[:, 6:9])
    assert np.max((shown.inv() * before[2]).magnitude()[later]) < 2e-4
    assert np.max((shown.inv() * before[2]).magnitude()[:12]) < 3 * 0.5 * 6.0 * delay**2 + 1e-4  # held rate
    np.testing.assert_allclose((position + late.state[:, :3])[:12], before[0][:12], atol=1.0 * delay**2 + 1e-4)
    assert not late.state[:, 9:].any()
    assert not late.specific_force.any()
    gyro = measured(situation, vehicle=CF2, effects={"measurement_delay": {"delay": delay, "streams": "gyro"}})
    np.testing.assert_allclose((rate + gyro.state[:, 9:])[later], before[3][later], atol=2e-4)
    assert not gyro.state[:, :9].any()
    sensed = measured(
        situation, vehicle=CF2, effects={"measurement_delay": {"delay": delay, "streams": ["accelerometer"]}}
    ).specific_force
    np.testing.assert_allclose((force + sensed)[later, 2], (time - delay)[later], atol=1e-9)


def test_measurement_delay_does_not_look_across_a_gap() -> None:
    n = 20
    jumped = np.where(np.arange(n)[:, None] >= 10, 100.0, 0.0) * np.ones(3)
    effects: Effects = {"measurement_delay": {"delay": 0.03, "streams": ["state"]}}
    step = np.where(np.arange(n) % 10 > 0, 0.01, 0.0)
    assert not measured(still(n, position=jumped, step=step), vehicle=CF2, effects=effects).state.any()
    back = np.where(np.arange(n) >= 10, -5.0, 0.0) + 0.01 * np.arange(n)  # another recording, its clock begins anew
    assert not measured(still(n, position=jumped, time=back), vehicle=CF2, effects=effects).state.any()
    assert measured(still(n, position=jumped), vehicle=CF2, effects=effects).state.any()
    single = still(3, step=0.0, velocity=[1.0, 0, 0])  # moments that are no path: each for itself
    np.testing.assert_allclose(measured(single, vehicle=CF2, effects=effects).state[:, 0], -0.03)


def test_rotation_between_is_the_logarithm_also_near_half_a_turn() -> None:
    rng = np.random.default_rng(3)
    one = Rotation.random(400, random_state=1)
    axis = rng.standard_normal((400, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.concatenate([rng.uniform(0, np.pi, 200), np.pi - 10.0 ** rng.uniform(-9, -1, 100),
                            10.0 ** rng.uniform(-12, -1, 100)])  # fmt: skip
    vector = angle[:, None] * axis
    other = one * Rotation.from_rotvec(vector)
    found = rotation_between(one.as_matrix(), other.as_matrix())
    apart = (Rotation.from_rotvec(found).inv() * Rotation.from_rotvec(vector)).magnitude()
    assert apart.max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), angle, atol=1e-7)
    np.testing.assert_allclose(found[300:], vector[300:], rtol=1e-3, atol=1e-14)
    exactly = rotation_between(np.eye(3)[None], np.diag([1.0, -1.0, -1.0])[None])
    np.testing.assert_allclose(np.abs(exactly), [[np.pi, 0, 0]], atol=1e-12)


def test_effects_do_not_write_into_the_situation() -> None:
    situation = wild(10, seed=2)
    before = {k: v.copy() for k, v in vars(situation).items() if isinstance(v, np.ndarray)}
    effects: Effects = {
        "rotor_fault": {"scale": 0.5}, "thrust_scale": {"scale": 2.0}, "wind": {"x": 1.0},
        "rotor_inertia": {"inertia": 1e-8},
        "suspended_load": {"mass": 0.01}, "velocity_scale": {"x": 2.0}, "measurement_delay": {"delay": 0.01},
    }  # fmt: skip
    motion(situation, vehicle=ROTORS, effects=effects)
    measured(situation, vehicle=ROTORS, effects=effects)
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(situation, key), value)
