"""Effects on commands and thrust against closed forms: what a first-order lag makes of a step, factor by factor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.drive import present_wrench, rotors_step
from firmware_sim.plant.effects.step import plant_step_with_effects
from firmware_sim.plant.rotors import lag, wrench
from firmware_sim.scenario import parse_scenario

TAU, GAIN = 0.05, 0.03
VEHICLE = {
    "mass": 0.03, "arm": [0.03, 0.035], "torque_per_thrust": 0.006, "thrust_curve": [0.0, GAIN], "thrust_max": 0.12,
    "motor_time_constant": TAU, "rotor_constant": 2e-8,
}  # fmt: skip
QUIET = {
    "noise": {"thrust": 0.0, "torque": 0.0},
    "battery": {"resistance": 0.0, "power_coefficient": 0.0, "electronics_power": 0.0},
    "ground": {"height": -1000.0},
}
PWM = np.array([30000.0, 34000.0, 38000.0, 42000.0])
GOAL = GAIN * PWM / 65535 * 4.2


def plant(
    effects: dict | None = None, hidden: dict | None = None, table: dict | None = None, **vehicle: float
) -> tuple[np.ndarray, np.ndarray]:
    given_ = {"effects": effects or {}, "hidden": hidden or {}, "vehicle": VEHICLE | vehicle}
    scenario = parse_scenario(QUIET | given_ | (table or {}), "test")
    x = scenario.start_state()
    x[at.PWM : at.PWM + 4] = PWM
    return scenario.truth(), x


def rotors(truth: np.ndarray, x: np.ndarray, milliseconds: int) -> np.ndarray:
    """[F, Mx, My, Mz] of every millisecond; the body does not move."""
    mean, u, rows = np.empty(4), np.empty(4), []
    for _ in range(milliseconds):
        rotors_step(truth, x, 1e-3, mean, u)
        x[at.CLOCK] += 1
        rows.append(u.copy())
    return np.array(rows)


def expected(thrust: np.ndarray, c: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Force and torque about (cx, cy) of thrusts at the four corners, r x f written out."""
    places = np.array([(0.03, -0.035), (-0.03, -0.035), (-0.03, 0.035), (0.03, 0.035)]) - np.array(c)
    return np.array(
        [
            thrust.sum(),
            (places[:, 1] * thrust).sum(),
            -(places[:, 0] * thrust).sum(),
            0.006 * (np.array([-1, 1, -1, 1]) * thrust).sum(),
        ]
    )


def test_without_effects_the_plain_rotors_and_these_agree() -> None:
    truth, x = plant()
    y, mean, u = x.copy(), np.empty(4), np.empty(4)
    rows = rotors(truth, x, 30)
    for row in rows:
        lag(truth, y, 1e-3, mean)
        wrench(truth, mean, 0, u)
        assert u == pytest.approx(row, rel=1e-12)
    assert x[at.ROTOR : at.ROTOR + 4] == pytest.approx(y[at.ROTOR : at.ROTOR + 4], rel=1e-12)
    assert expected(mean) == pytest.approx(u, rel=1e-12)


@given(delay=st.floats(0.0, 0.1), tau=st.sampled_from([0.0, 0.02, 0.3]))
def test_a_delayed_command_gives_the_delayed_step_response(delay: float, tau: float) -> None:
    truth, x = plant({"input_delay": {"delay": delay}, "motor_lag": {"time_constant": tau}})
    force = rotors(truth, x, 200)[:, 0]
    since = 0.2 - delay
    reached = 1 - np.exp(-since / tau) if tau else 1.0
    assert x[at.ROTOR : at.ROTOR + 4] == pytest.approx(GOAL * reached, rel=1e-9)
    impulse = since - tau * reached  # integral of 1 - exp(-t/tau)
    assert force.sum() * 1e-3 == pytest.approx(GOAL.sum() * impulse, rel=1e-9)
    assert np.all(force[: int(1000 * delay - 1e-9)] == 0)


def test_thrust_scale_scales_force_and_torque_and_no_speed() -> None:
    truth, x = plant({"thrust_scale": {"scale": 0.8}})
    last = rotors(truth, x, 1000)[-1]
    assert last == pytest.approx(expected(0.8 * GOAL), rel=1e-6)
    assert x[at.ROTOR : at.ROTOR + 4] == pytest.approx(GOAL, rel=1e-6)
    u = np.empty(4)
    present_wrench(truth, x, u)
    assert u == pytest.approx(last, rel=1e-6)


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_a_fault_begins_at_its_time_with_its_rotor(rotor: int) -> None:
    truth, x = plant({"rotor_fault": {"rotor": rotor, "scale": 0.6, "onset_time": 0.5}}, motor_time_constant=0.0)
    rows = rotors(truth, x, 1000)
    weak = GOAL.copy()
    weak[rotor - 1] *= 0.6
    assert rows[:500] == pytest.approx(np.tile(expected(GOAL), (500, 1)), rel=1e-9)
    assert rows[500:] == pytest.approx(np.tile(expected(weak), (500, 1)), rel=1e-9)


def test_torque_scale_leaves_the_force() -> None:
    truth, x = plant({"torque_scale": {"scale": 1.3}}, motor_time_constant=0.0)
    assert rotors(truth, x, 1)[0] == pytest.approx(expected(GOAL) * [1, 1.3, 1.3, 1.3], rel=1e-9)


def test_torque_is_about_the_centre_of_mass() -> None:
    effects = {"center_of_mass": {"x": 0.004, "y": -0.007, "z": 0.02}, "torque_scale": {"scale": 1.0}}
    truth, x = plant(effects, motor_time_constant=0.0)
    assert rotors(truth, x, 1)[0] == pytest.approx(expected(GOAL, (0.004, -0.007)), rel=1e-9)


def test_sag_per_volt_is_neutral_at_the_nominal_voltage() -> None:
    for volts, factor in ((3.7, 1.0), (4.1, 1.0 + 0.25 * 0.4), (3.2, 1.0 - 0.25 * 0.5)):
        truth, x = plant({"battery_sag": {"gain_per_volt": 0.25}}, motor_time_constant=0.0)
        x[at.VOLTS] = volts
        assert rotors(truth, x, 1)[0, 0] == pytest.approx(GOAL.sum() * volts / 4.2 * factor, rel=1e-9)


def test_sag_per_second_counts_from_the_take_off() -> None:
    truth, x = plant({"battery_sag": {"gain_per_second": -0.05}}, motor_time_constant=0.0)
    x[at.FEET] = 4.0
    assert rotors(truth, x, 700)[-1, 0] == pytest.approx(GOAL.sum(), rel=1e-9)
    x[at.FEET] = 0.0
    rows = rotors(truth, x, 2001)[:, 0]
    assert rows[[0, 1000, 2000]] == pytest.approx(GOAL.sum() * np.array([1.0, 0.95, 0.9]), rel=1e-9)
    x[at.FEET] = 4.0  # landed: the battery has not recovered
    assert rotors(truth, x, 1)[0, 0] < 0.9 * GOAL.sum()


def test_slope_error_turns_the_curve_about_hover() -> None:
    hover = 0.03 * 9.81 / 4
    truth, x = plant({"thrust_curve": {"slope_error": 0.2}, "payload": {"mass": 0.01}}, motor_time_constant=0.0)
    f = np.array([hover, 0.0, 1.1 * hover, 0.01])  # of the bare vehicle: the payload does not move the pivot
    x[at.PWM : at.PWM + 4] = f / GAIN / 4.2 * 65535
    rotors(truth, x, 1)
    turned = [hover, 0.0, 1.12 * hover, max(0.0, 0.01 + 0.2 * (0.01 - hover))]
    assert x[at.ROTOR : at.ROTOR + 4] == pytest.approx(turned, rel=1e-9, abs=1e-12)
    x[at.PWM : at.PWM + 4] = 65535
    rotors(truth, x, 1)
    assert x[at.ROTOR : at.ROTOR + 4] == pytest.approx([0.12] * 4)  # never above the rotor's limit


def test_ground_effect_falls_off_with_the_height_of_the_origin() -> None:
    ground = {"height": 0.5}
    for z in (0.5, 0.6, 1.5):
        table = {"ground": ground, "start": {"position": [0.0, 0.0, z]}}
        effects = {"ground_effect": {"strength": 0.3, "height": 0.1}, "center_of_mass": {"z": 0.02}}
        truth, x = plant(effects, table=table, motor_time_constant=0.0)
        factor = 1 + 0.3 * np.exp(-(z - 0.5) / 0.1)
        assert rotors(truth, x, 1)[0, 0] == pytest.approx(GOAL.sum() * factor, rel=1e-9)


def test_ground_effect_makes_a_drone_leave_the_floor_below_its_weight() -> None:
    table = {"ground": {"height": 0.0}}
    for strength, leaves in ((0.0, False), (0.3, True)):
        effects = {"ground_effect": {"strength": strength, "height": 0.1}}
        truth, x = plant(effects, table=table, thrust_curve=[0.95 * 0.03 * 9.81 / 4])
        highest = 0.0
        for _ in range(1000):
            plant_step_with_effects(truth, x, np.zeros(at.NOISE_WIDTH), 1e-3)
            highest = max(highest, x[at.POS + 2])
        assert bool(highest > 0.02) == leaves


def test_a_sticky_rotor_follows_only_beyond_its_deadband_and_stops_with_the_others() -> None:
    truth, x = plant({}, {"sticky_rotor": {"rotor": 4, "deadband": 0.1}}, motor_time_constant=0.0)
    followed = []
    for command in (30000, 33000, 37000, 31000, 30000, 0):
        x[at.PWM + 3] = command
        rotors(truth, x, 1)
        followed.append(x[at.ROTOR + 3] / GAIN / 4.2 * 65535)
    assert followed == pytest.approx([30000, 30000, 37000, 37000, 30000, 0])
    assert x[at.ROTOR] == pytest.approx(GOAL[0])
