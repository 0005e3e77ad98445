"""Whole flights: closed loops that must hold height, scenarios that must not break, tables that must be live."""

import numpy as np
import pytest
from flights import boot, hold, read, write
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import parameters
from firmware_sim.plant import layout as at

HEAVY = {"mass": 0.036, "inertia": [2.0e-5, 2.1e-5, 3.6e-5], "motor_time_constant": 0.06}
POSITION, ROTOR = slice(at.POS, at.POS + 3), slice(at.ROTOR, at.ROTOR + 4)


@pytest.mark.parametrize(
    ("platform", "controller"),
    [("cf2", 1), ("cf2", 2), ("cf2", 5), ("cf2", 6), ("cf21bl", 1), ("cf21bl", 5), ("cf21bl", 6)],
)
def test_holds_position(platform: str, controller: int) -> None:
    flight = boot({"platform": platform}, stabilizer__controller=controller)
    end = hold(flight, (0.3, -0.2, 1.0), 7.0)[-200:]
    assert end[:, POSITION].mean(axis=0) == pytest.approx([0.3, -0.2, 1.0], abs=0.06 if controller == 1 else 0.02)
    assert end[:, POSITION].std(axis=0).max() < 0.02
    weight = flight._truth[at.MASS] * 9.81
    assert end[:, ROTOR].sum(axis=1).mean() == pytest.approx(weight, rel=0.01)


@pytest.mark.parametrize("effects", [{}, {"linear_drag": {"x": 0.01}, "input_delay": {"delay": 0.005}}])
def test_a_longer_integration_step_moves_the_plant_less_often_and_flies_the_same(effects: dict) -> None:
    fine = boot({"effects": effects}, stabilizer__controller=5)
    coarse = boot({"effects": effects, "integration": {"step": 0.004}}, stabilizer__controller=5)
    near, far = (hold(flight, (0.3, -0.2, 1.0), 5.0)[-100:] for flight in (fine, coarse))
    assert far[:, POSITION].mean(axis=0) == pytest.approx(near[:, POSITION].mean(axis=0), abs=0.005)
    moved = []
    for _ in range(40):
        before = coarse.state[at.OMEGA]
        coarse.step()
        moved.append(coarse.state[at.OMEGA] != before)
    assert sum(moved) == 10


def test_the_seen_pose_is_that_of_the_origin_turned_as_the_pose_frame_is() -> None:
    turned = {"attitude_misalignment": {"yaw": 0.1}, "center_of_mass": {"x": 0.01}}
    flight = boot({"effects": turned, "start": {"position": [0.2, -0.1, 0.0]}})
    flight.step()
    position, quaternion = flight.seen_pose()
    assert position[:2] == pytest.approx([0.2, -0.1], abs=1e-6)
    assert quaternion == pytest.approx([0.0, 0.0, np.sin(0.05), np.cos(0.05)], abs=1e-6)


def test_pid_has_no_mass_and_integrates_the_load_away() -> None:
    flight = boot({"vehicle": HEAVY})
    low = hold(flight, (0, 0, 1.0), 4.0)[-50:, at.POS + 2].mean() - 1.0
    end = hold(flight, (0, 0, 1.0), 12.0)[-100:]
    assert abs(low) < 0.1
    assert end[:, POSITION].mean(axis=0) == pytest.approx([0, 0, 1], abs=0.02)
    assert read(flight, "controller.cmd_thrust") == pytest.approx(0.036 * 9.81 / 4 / 0.12 * 65535, rel=0.1)
    assert read(flight, "stabilizer.thrust") == read(flight, "controller.cmd_thrust")


@pytest.mark.parametrize("controller", [1, 2, 5, 6])
def test_follows_yaw_and_velocity(controller: int) -> None:
    flight = boot(stabilizer__controller=controller)
    hold(flight, (0, 0, 1.0), 4.0)
    s = flight.setpoint
    s[sp.MODE_X] = s[sp.MODE_Y] = s[sp.MODE_YAW] = sp.VELOCITY
    s[sp.VX], s[sp.VY], s[sp.VELOCITY_BODY], s[sp.RATE_YAW] = 0.0, 0.2, 1.0, 0.0
    for _ in range(2000):
        flight.step()
    if controller == 2:  # as in the firmware, Mellinger takes no velocities: it stays level
        assert abs(flight.state[at.VEL + 1]) < 0.1
    elif controller == 5:  # and Lee adds them to its pull towards the place
        assert flight.state[at.POS + 1] == pytest.approx(4.0 * 0.2 / 7.0, abs=0.01)  # Kpos_D v = Kpos_P y
    else:
        assert flight.state[at.VEL : at.VEL + 2] == pytest.approx([0.0, 0.2], abs=0.08)
    assert flight.state[at.POS + 2] == pytest.approx(1.0, abs=0.08)
    before = read(flight, "stabilizer.yaw")
    s[sp.RATE_YAW], s[sp.VY] = 45.0, 0.0
    for _ in range(1000):
        flight.step()
    turned = read(flight, "stabilizer.yaw") - before
    assert 10 < turned < 60


@pytest.mark.parametrize("controller", [1, 2, 5, 6])
def test_attitude_and_thrust_setpoints_tilt_the_way_they_say(controller: int) -> None:
    flight = boot({"start": {"position": [0, 0, 5]}}, stabilizer__controller=controller)
    s = flight.setpoint
    s[sp.MODE_ROLL] = s[sp.MODE_PITCH] = sp.ABSOLUTE
    s[sp.MODE_YAW] = sp.VELOCITY
    s[sp.ROLL], s[sp.PITCH], s[sp.THRUST] = 8.0, -5.0, 0.0
    flight.step()
    s[sp.THRUST] = 27000.0
    for _ in range(700):
        flight.step()
    assert read(flight, "stabilizer.roll") == pytest.approx(8.0, abs=3.5)
    assert read(flight, "stabilizer.pitch") == pytest.approx(-5.0, abs=3.5)
    assert flight.state[at.VEL] > 0  # nose down: forward
    assert flight.state[at.VEL + 1] < 0  # to the right


def test_cold_start_beliefs_corrected_in_time_fly_under_lqg() -> None:
    flight = boot(
        stabilizer__controller=6, ctrlLqg__mass=0.001, ctrlLqg__J_x=1e-4, ctrlLqg__J_y=2e-4, ctrlLqg__J_z=1e-4
    )
    hold(flight, (0, 0, 0.5), 1.0)
    write(flight, "ctrlLqg.mass", 0.029)
    end = hold(flight, (0, 0, 0.5), 5.0)[-100:]
    assert end[:, at.POS + 2].mean() == pytest.approx(0.5, abs=0.02)


def test_setpoints_that_are_not_numbers_pass() -> None:
    flight = boot(stabilizer__controller=5)
    hold(flight, (0, 0, 0.5), 2.0)
    flight.setpoint[sp.X] = float("nan")
    for _ in range(20):
        flight.step()
    end = hold(flight, (0, 0, 0.5), 5.0)[-100:]
    assert end[:, POSITION].mean(axis=0) == pytest.approx([0, 0, 0.5], abs=0.05)


QUICK = settings(phases=[Phase.explicit, Phase.reuse, Phase.generate])  # shrinking flights takes minutes
scenarios = st.fixed_dictionaries(
    {
        "platform": st.sampled_from(["cf2", "cf21bl"]),
        "vehicle": st.fixed_dictionaries(
            {
                "mass": st.floats(1e-3, 5.0),
                "inertia": st.tuples(*[st.floats(1e-6, 1e-3)] * 2).map(lambda v: [*v, max(v)]),
                "arm": st.floats(5e-3, 1.0),
                "motor_time_constant": st.floats(0.0, 1.0),
                "torque_per_thrust": st.floats(0.0, 1.0),
            }
        ),
        "noise": st.fixed_dictionaries({"thrust": st.floats(0, 0.1), "torque": st.floats(0, 1e-3)}),
        "battery": st.fixed_dictionaries({"charge": st.floats(0, 1), "resistance": st.floats(0, 10)}),
        "estimator": st.fixed_dictionaries({"positioning": st.sampled_from(["pose", "position", "none"])}),
        "start": st.fixed_dictionaries(
            {"position": st.lists(st.floats(-1, 3), min_size=3, max_size=3), "yaw": st.floats(-3, 3)}
        ),
    }
)


@QUICK
@given(table=scenarios, controller=st.sampled_from([1, 2, 5, 6]), seed=st.integers(0, 1000))
def test_no_scenario_gives_what_is_not_a_number(table: dict, controller: int, seed: int) -> None:
    flight = boot(table, seed, stabilizer__controller=controller)
    states = hold(flight, (0, 0, 1.0), 1.0, ramp=0.3)
    assert np.all(np.isfinite(states))
    assert all(np.isfinite(array[index]) for array, index in flight.log.values())


@QUICK
@given(
    values=st.dictionaries(
        st.sampled_from(parameters.PARAMETER_NAMES),
        st.sampled_from([0.0, -1.0, 1e-9, 1e9, float("nan"), float("inf"), -float("inf")]),
        min_size=1,
        max_size=6,
    ),
    controller=st.sampled_from([1, 2, 5, 6]),
)
@example(values={"ctrlLee.J_x": float("nan"), "stabilizer.controller": 1e-9}, controller=5)
def test_no_parameter_breaks_the_simulation(values: dict, controller: int) -> None:
    flight = boot(stabilizer__controller=controller)
    hold(flight, (0, 0, 0.5), 0.5, ramp=0.3)
    # Integers stay out: what is not a number cannot be written to them, and a controller that no longer runs would
    # keep showing its last, spoilt values.
    names = set(values) - {"stabilizer.controller", "stabilizer.estimator", "kalman.resetEstimation"}
    for name in names:
        write(flight, name, values[name])
    assert np.all(np.isfinite(hold(flight, (0, 0, 0.5), 0.5)))
    for name in names:
        write(flight, name, flight.param_defaults[name])
    hold(flight, (0, 0, 0.5), 0.1)
    shown = {name: array[index] for name, (array, index) in flight.log.items()}
    assert not [name for name, value in shown.items() if not np.isfinite(value)]


def test_onboard_estimate_error_is_small_and_correlated() -> None:
    flight = boot(stabilizer__controller=5)
    hold(flight, (0, 0, 1.0), 3.0)
    error = []
    for n in range(10_000):
        flight.step()
        if n % 10 == 0:
            error.append([read(flight, f"stateEstimate.{a}") - flight.state[at.POS + i] for i, a in enumerate("xyz")])
    e = np.array(error) - np.mean(error, axis=0)
    sd = e.std(axis=0)
    lag_one = (e[1:] * e[:-1]).mean(axis=0) / sd**2
    assert np.all((sd > 5e-5) & (sd < 2e-3))  # better than one fix of 1 mm in most, never perfect
    assert np.all(lag_one > 0.5)  # not white: 10 ms apart


def test_tables_are_live_and_consistent() -> None:
    flight = boot({"vehicle": HEAVY}, stabilizer__controller=5, ctrlLee__mass=0.036)
    hold(flight, (0, 0, 1.0), 4.0)
    assert read(flight, "stateEstimateZ.z") == int(1000 * read(flight, "stateEstimate.z"))
    assert read(flight, "stateEstimateZ.az") == pytest.approx(9810 * (read(flight, "stateEstimate.az") + 1), abs=1)
    gyro_y = read(flight, "gyro.y")
    assert read(flight, "stateEstimateZ.ratePitch") == pytest.approx(-1000 * np.radians(gyro_y), abs=1)
    assert read(flight, "ctrlLee.omegay") == pytest.approx(np.radians(gyro_y), abs=0.05)
    assert read(flight, "stabilizer.thrust") == read(flight, "ctrlLee.torquey")  # the firmware's union
    assert read(flight, "controller.cmd_thrust") == read(flight, "controller.cmd_roll") == 0.0  # of the PID
    assert read(flight, "pm.vbatMV") == int(1000 * read(flight, "pm.vbat"))
    assert 0.9 < read(flight, "acc.z") < 1.1
    assert read(flight, "ctrlLee.thrustSi") == pytest.approx(0.036 * 9.81, rel=0.1)
    quaternion = [read(flight, f"stateEstimate.{q}") for q in ("qw", "qx", "qy", "qz")]
    pitch = np.degrees(np.arcsin(2 * (quaternion[0] * quaternion[2] - quaternion[1] * quaternion[3])))
    assert read(flight, "stateEstimate.pitch") == pytest.approx(-pitch, abs=1e-9)  # legacy sign


def test_external_pose_positions_a_drone_that_has_no_fixes() -> None:
    flight = boot({"estimator": {"positioning": "none"}}, stabilizer__controller=5)
    s = flight.setpoint
    s[sp.MODE_X : sp.MODE_Z + 1] = s[sp.MODE_YAW] = sp.ABSOLUTE
    for n in range(6000):
        s[sp.Z] = min(1.0, n / 2000)
        if n % 10 == 0:
            q = flight.state[at.QUAT : at.QUAT + 4]
            flight.external_pose(flight.state[POSITION], np.roll(q, -1))
        flight.step()
    assert flight.state[POSITION] == pytest.approx([0, 0, 1], abs=0.05)
    assert read(flight, "ext_pos.Z") == read(flight, "locSrv.z") == pytest.approx(flight.state[at.POS + 2], abs=0.05)
    flight.external_position([float("nan")] * 3)
    flight.step()
    assert np.isfinite(read(flight, "stateEstimate.x"))


def test_parameters_show_what_really_runs() -> None:
    flight = boot()

    def written(name: str, value: float) -> float:
        write(flight, name, value)
        return float(flight.param[name][0][flight.param[name][1]])

    assert written("stabilizer.controller", 6) == 6
    assert written("stabilizer.controller", 77) == 6  # invalid: unchanged
    assert written("stabilizer.controller", 0) == flight.param_defaults["stabilizer.controller"]
    assert written("stabilizer.estimator", 0) == 2
    assert written("kalman.resetEstimation", 1) == 0


def test_the_truth_is_in_no_table() -> None:
    secret = {"vehicle": {**HEAVY, "mass": 0.0365432, "motor_time_constant": 0.0612345}}
    flight = boot(secret)
    hold(flight, (0, 0, 1.0), 1.0)
    shown = [float(a[i]) for a, i in [*flight.log.values(), *flight.param.values()]]
    hidden = [0.0365432, 0.0612345, 2.0e-5, 2.1e-5, 3.6e-5]
    assert not any(v == pytest.approx(h, rel=1e-6) for v in shown for h in hidden)


def test_truth_row_matches_its_header() -> None:
    flight = boot()
    hold(flight, (0, 0, 0.5), 2.0)
    row = dict(zip(flight.truth_header, flight.truth_row(), strict=True))
    assert row["t"] == pytest.approx(2.0)
    assert row["F"] == pytest.approx(flight.state[ROTOR].sum())
    assert row["qw"] > 0.9
    assert row["pwm1"] == read(flight, "motor.m1")
