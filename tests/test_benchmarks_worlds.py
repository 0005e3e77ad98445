"""Random and foreign worlds: what is not hidden is drawn as promised, reaches the flight, and is not judged."""

import copy
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.concealed.conditions import GAINS, PERIODS, STYLES
from benchmarks.concealed.courses import course, size_of
from benchmarks.concealed.draw import draw
from benchmarks.concealed.foreign import fly as fly_abroad
from benchmarks.concealed.foreign_world import ABROAD, HIDEABLE, changed, constants, published
from benchmarks.concealed.ideal import held_out_error
from benchmarks.concealed.judge import named, without
from benchmarks.concealed.random_world import gains, scenario_of
from benchmarks.concealed.score import wilson
from benchmarks.concealed.simulate import boot, fly
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.registry import open_recording
from crazyem.vehicle import parse_vehicle
from firmware_sim.scenario import parse_scenario

Table = dict[str, Any]


def drawn(cases: int, seed: int, world: str) -> list[Table]:
    return draw(cases=cases, seed=seed, world=world)


@pytest.fixture(scope="module")
def many() -> list[Table]:
    return drawn(150, 3, "random")


# the draw


def test_the_same_seed_draws_the_same_random_world_and_the_order_of_worlds_changes_nothing() -> None:
    home = drawn(20, 4, "home")
    assert drawn(20, 4, "random") == drawn(20, 4, "random") != drawn(20, 5, "random")
    assert drawn(20, 4, "home") == home
    assert json.loads(json.dumps(drawn(20, 4, "random"))) == drawn(20, 4, "random")
    assert [c["strength"].keys() for c in home] == [c["strength"].keys() for c in drawn(20, 4, "random")]


def test_everything_that_can_differ_differs(many: list[Table]) -> None:
    logs = [c["conditions"]["log"] for c in many]
    assert {c["conditions"]["controller"] for c in many} == set(GAINS)
    assert {f["style"] for c in many for f in c["flights"].values()} == {*STYLES, "low"}
    assert {log["period"] for log in logs} == set(PERIODS)
    assert {log["layout"] for log in logs} == {"compact", "floats", "mixed", "card"}
    assert {c["air"] for c in many} == {"none", "right", "free"}
    assert {c["conditions"]["scenario"]["integration"]["step"] for c in many} == {1e-3, 2e-3, 4e-3}
    for key in ("voltage", "attitude", "accelerometer"):
        assert 0 < sum(log[key] for log in logs) < len(logs)
    assert 0.4 < np.mean(["trim" in c["own"] for c in many]) < 0.6
    assert 0.15 < np.mean([log["estimate"] == "none" for log in logs]) < 0.45
    assert 0.2 < np.mean([c["platform"] == "cf21bl" for c in many]) < 0.45


def test_sizes_of_what_differs_are_those_that_are_written(many: list[Table]) -> None:
    nominal = {"gyro_noise": 2.44e-4, "accelerometer_noise": 1.86e-3}
    for case in many:
        scenario, log = case["conditions"]["scenario"], case["conditions"]["log"]
        for key, value in nominal.items():
            assert 0.29 < scenario["sensors"][key] / value < 3.01
        offset = math.degrees(scenario["sensors"]["gyro_bias"])
        assert offset == pytest.approx(0.02, rel=1e-3) if "gyro_bias" in case["effects"] else 0.0499 < offset < 0.301
        assert 0.0 <= log["loss"] <= 0.05
        assert all(0.69 < g < 1.31 for g in case["conditions"]["gains"].values())
    factors = [math.log(c["conditions"]["scenario"]["sensors"]["gyro_noise"] / 2.44e-4) for c in many]
    # uniform in the logarithm: mean 0 (standard error 0.054), sd 2 ln(10/3) / sqrt(12) ...
    assert abs(np.mean(factors) - (math.log(0.3) + math.log(3)) / 2) < 4 * np.std(factors) / math.sqrt(len(factors))
    assert np.std(factors) == pytest.approx(math.log(10) / math.sqrt(12), rel=0.15)


def test_trims_of_days_scatter_around_the_drones_own(many: list[Table]) -> None:
    apart, own = [], []
    for case in (c for c in many if "trim" in c["own"]):
        own.append([case["own"]["trim"][a] for a in "xyz"])
        for flight in case["flights"]:
            trim = scenario_of(case, flight)["effects"]["trim"]
            apart.append([trim[a] - case["own"]["trim"][a] for a in "xyz"])
    heavy = math.sqrt(5 / 3)  # sd of a t distribution of 5 degrees of freedom
    assert np.std(own, axis=0) == pytest.approx([1e-3, 1e-3, 3e-4], rel=0.35)
    assert np.std(apart, axis=0) == pytest.approx(heavy * np.array([5e-4, 5e-4, 1.6e-4]), rel=0.35)


def test_what_is_hidden_can_be_seen_in_what_is_logged(many: list[Table]) -> None:
    for case in many:
        log, hidden = case["conditions"]["log"], {*case["effects"], *case["hidden"]}
        assert log["voltage"] or not hidden & {"battery_sag", "thrust_scale", "payload", "thrust_curve"}
        assert log["rotor_speed"] or "rotor_sensor" not in hidden
        assert log["attitude"] or not hidden & {"attitude_misalignment", "magnetic_yaw"}
        assert log["accelerometer"] or "accelerometer_misalignment" not in hidden
        assert log["estimate"] == "kalman" or "velocity_scale" not in hidden
        assert not set(case["aside"]) & hidden


# what is drawn reaches the flight


@pytest.mark.parametrize("controller", ["pid", "mellinger", "lee", "lqg"])
def test_every_key_of_a_case_is_one_that_the_simulator_takes(many: list[Table], controller: str) -> None:
    cases = [c for c in many if c["conditions"]["controller"] == controller]
    for case in cases:
        for flight in case["flights"]:
            wanted = scenario_of(case, flight)
            scenario = parse_scenario(wanted, "drawn")
            for section in ("sensors", "estimator", "noise", "battery", "integration"):
                for key, value in wanted[section].items():
                    assert getattr(getattr(scenario, section), key) == value
    case = cases[0]
    firmware = boot(case, "recording")
    parameters = {**scenario_of(case, "recording")["parameters"], **gains(case)}
    for name, value in parameters.items():
        assert firmware.param.table.by_name[name].value == pytest.approx(value, rel=1e-6)


def test_gains_are_the_platforms_times_what_was_drawn(many: list[Table]) -> None:
    case = next(c for c in many if c["conditions"]["controller"] == "lee")
    factor = case["conditions"]["gains"]["ctrlLee.KR_x"]
    assert gains(case)["ctrlLee.KR_x"] == pytest.approx(0.007 * factor)
    lqg = next(c for c in many if c["conditions"]["controller"] == "lqg")
    assert gains(lqg)["ctrlLqg.q_pos"] == pytest.approx(50.0 * lqg["conditions"]["gains"]["ctrlLqg.q_pos"] ** 2)


@pytest.mark.parametrize("style", ["helix", "vertical", "oval", "star", "multisine", "draught", "figure8", "excite"])
def test_courses_rise_hover_move_and_land_without_jumps(style: str) -> None:
    for seed in range(3):
        size = size_of(style, np.random.default_rng(seed))
        path = course({"style": style, "size": size, "waypoints": None}, 8.0)
        assert path.position[0] == pytest.approx([0, 0, 0])
        assert path.position[-1, 2] < 0.0
        flying = (path.time >= path.start) & (path.time <= path.end)
        assert path.position[flying, 2].min() > 0.4
        assert np.abs(path.position).max() < 2.2
        assert np.abs(path.acceleration[10:-10]).max() < 12.0  # m/s^2
        assert np.linalg.norm(np.diff(path.position, axis=0), axis=1).max() < 0.04  # m in 10 ms


def plain(many: list[Table], estimate: str) -> Table:
    """A case with nothing hidden and a quick, tidy log."""
    case = copy.deepcopy(next(c for c in many if c["kind"] == "nothing" and not c["own"] and not c["built"]))
    case["conditions"]["log"].update(
        estimate=estimate, layout="floats", period=10, command_period=20, voltage=True, attitude=True,
        rotor_speed=False, accelerometer=False, loss=0.04, burst=1.0, drift={"share": 0.0, "time": 0.1},
    )  # fmt: skip
    case["conditions"]["scenario"]["integration"]["step"] = 1e-3
    case["conditions"]["scenario"]["sensors"]["gyro_bias"] = 0.01
    case["flights"]["recording"].update(style="oval", size={"radius": 0.6, "width": 0.4, "period": 4.0, "heading": 0.0})
    return case


@pytest.mark.parametrize("estimate", ["kalman", "none"])
def test_a_flight_is_the_same_twice_and_logged_as_drawn(many: list[Table], tmp_path: Path, estimate: str) -> None:
    case, suffix = plain(many, estimate), ".mcap" if estimate == "kalman" else ".csv"
    read = []
    for turn in ("a", "b"):
        assert fly(case, "recording", tmp_path / turn, duration=5.0)["flown"]
        mapping = None if estimate == "kalman" else str(tmp_path / turn / "mapping.toml")
        read.append(open_recording(str(tmp_path / turn / f"recording{suffix}"), ReadOptions(mapping)))
    first, second = read
    for name, array in first.signals.items():
        np.testing.assert_array_equal(array.value, second.signals[name].value)
        np.testing.assert_array_equal(array.time, second.signals[name].time)
    position = first.signals["position"]
    assert position.period == pytest.approx(0.01, abs=1e-3)
    lost = 1.0 - position.time.size / ((position.time[-1] - position.time[0]) / 0.01 + 1)
    assert 0.01 < lost < 0.08
    assert first.signals["motor_command"].period == pytest.approx(0.02 if estimate == "kalman" else 0.01, abs=1e-3)
    assert ("velocity" in first.signals) == (estimate == "kalman")
    still = first.signals["body_rate"].time < 1.0  # on the floor: the offset, which stays, and noise
    assert 0.001 < np.abs(first.signals["body_rate"].value[still].mean(axis=0)).max() < 0.04


@pytest.mark.slow
def test_a_plain_random_flight_is_what_its_vehicle_file_predicts(many: list[Table], tmp_path: Path) -> None:
    """Hardly any noise, nothing hidden, all commands logged: 0.5 s ahead by the file's constants."""
    case = plain(many, "kalman")
    case["conditions"]["log"].update(command_period=2, period=2, loss=0.0)
    scenario = case["conditions"]["scenario"]
    scenario["noise"] = {"thrust": 1e-5, "torque": 1e-8}
    scenario["sensors"].update(gyro_noise=1e-6, gyro_bias=0.0, accelerometer_noise=1e-5)
    scenario["estimator"].update(position_noise=1e-5, attitude_noise=1e-5)
    assert fly(case, "recording", tmp_path, duration=4.0)["flown"]
    (tmp_path / "drone.toml").write_text(case["vehicle"])
    error = held_out_error(tmp_path / "recording.mcap", str(tmp_path / "drone.toml"))
    assert error is not None
    assert error["position"] < 0.008
    assert error["velocity"] < 0.04
    assert error["attitude"] < 0.04


# the judge


def test_what_is_set_aside_is_neither_an_alarm_nor_a_find() -> None:
    answer = {
        "mismatch": True,
        "effects": [{"name": "linear_drag"}, {"name": "payload"}],
        "indistinguishable": [["linear_drag", "gusts"], ["payload", "thrust_scale"]],
        "unexplained": [],
    }
    kept = without(answer, ["linear_drag"])
    assert named(kept) == ["payload"]
    assert kept["indistinguishable"] == [["payload", "thrust_scale"]]
    assert not without({**answer, "effects": [{"name": "linear_drag"}]}, ["linear_drag"])["mismatch"]
    left = {**answer, "effects": [{"name": "linear_drag"}], "unexplained": [{"axis": "x"}]}
    assert without(left, ["linear_drag"])["mismatch"]
    alone = {**answer, "effects": [{"name": "linear_drag"}]}  # as a document of the diagnosis has it
    assert not without({**alone, "unexplained": {"found": False, "where": []}}, ["linear_drag"])["mismatch"]
    assert without({**alone, "unexplained": {"found": True, "where": []}}, ["linear_drag"])["mismatch"]
    assert without({**answer, "effects": []}, ["linear_drag"])["mismatch"]  # an alarm without a name stays one


def test_intervals_of_shares_are_wilsons() -> None:
    # Brown, Cai, DasGupta (2001), eq. 4; by hand for 0 of 10: upper end z^2 / (n + z^2)
    assert wilson(0.0, 10) == pytest.approx((0.0, 0.27753), abs=1e-4)
    assert wilson(0.5, 10) == pytest.approx((0.23659, 0.76341), abs=1e-4)
    assert wilson(1.0, 30)[0] == pytest.approx(1 - 1.959964**2 / (30 + 1.959964**2), abs=1e-6)


# foreign worlds


def foreign(cases: int, seed: int) -> list[Table]:
    pytest.importorskip("rotorpy")
    return drawn(cases, seed, "foreign")


def test_foreign_cases_hide_what_the_simulator_can_and_are_the_same_twice() -> None:
    cases = foreign(60, 2)
    assert cases == foreign(60, 2)
    assert json.loads(json.dumps(cases)) == cases
    kinds = Counter(c["kind"] for c in cases)
    assert kinds["nothing"] >= 12
    assert kinds["outside"] == 6
    assert {n for c in cases for n in c["effects"]} == set(HIDEABLE)
    assert {n for c in cases for n in c["hidden"]} == set(ABROAD)
    assert len({c["platform"] for c in cases}) == 2


def test_hidden_effects_are_changes_of_the_foreign_simulators_parameters() -> None:
    case = next(c for c in foreign(20, 2) if c["kind"] == "nothing" and not c["own"])
    known, file = constants(case["platform"]), parse_vehicle(case["vehicle"])
    untouched = changed(case, "recording")
    assert untouched["mass"] == known["mass"] == file.mass
    assert untouched["k_eta"] == known["k_eta"] == file.rotor_constant
    assert untouched["tau_m"] == known["tau_m"] == file.motor_time_constant

    def hiding(**effects: Table) -> Table:
        return changed({**case, "effects": effects}, "recording")

    assert hiding(thrust_scale={"scale": 1.1})["k_eta"] == pytest.approx(1.1 * known["k_eta"])
    assert hiding(motor_lag={"time_constant": 0.08})["tau_m"] == 0.08
    moved = hiding(center_of_mass={"x": 0.002, "y": 0.0, "z": 0.0})
    assert moved["rotor_pos"]["r1"] - known["rotor_pos"]["r1"] == pytest.approx([-0.002, 0, 0])
    heavy = hiding(payload={"mass": 0.003, "x": 0.0, "y": 0.0, "z": -0.01})
    reduced = known["mass"] * 0.003 / (known["mass"] + 0.003)  # two bodies turn about their common centre
    assert heavy["mass"] == pytest.approx(known["mass"] + 0.003)
    assert heavy["Ixx"] == pytest.approx(known["Ixx"] + reduced * 0.01**2)
    assert heavy["Izz"] == pytest.approx(known["Izz"])
    twice = hiding(torque_scale={"scale": 1.2})
    assert twice["k_m"] == pytest.approx(1.2 * known["k_m"])
    assert twice["rotor_pos"]["r1"] == pytest.approx(1.2 * known["rotor_pos"]["r1"])


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["crazyflie", "crazyfliebrushless"])
def test_a_plain_foreign_flight_is_what_its_vehicle_file_predicts(tmp_path: Path, platform: str) -> None:
    """Little noise, nothing hidden: 0.5 s ahead by the file's constants, rotors' order and signs of the mapping."""
    cases = foreign(30, 2)
    case = copy.deepcopy(next(c for c in cases if c["kind"] == "nothing"))
    vehicle = published(platform, {})
    case.update(platform=platform, air="none", own={}, built={}, vehicle=vehicle.to_toml())
    case["flights"]["recording"].update(
        style="oval", size={"radius": 0.8, "width": 0.4, "period": 4.0, "heading": 0.3}, day={"charge": 1.0}
    )
    case["conditions"]["step"] = 5
    case["conditions"]["log"].update(
        period=5, velocity=True, attitude=True, specific_force=False, rotor_speed=False, voltage=True, loss=0.0
    )
    noise = case["conditions"]["noise"]
    noise.update(position=1e-5, attitude=1e-5, velocity=1e-4, body_rate=1e-4, gyro_offset=0.0, motor=0.02, share=0.0)
    assert fly_abroad(case, "recording", tmp_path, duration=5.0)["flown"]
    (tmp_path / "drone.toml").write_text(case["vehicle"])
    error = held_out_error(tmp_path / "recording.csv", str(tmp_path / "drone.toml"), mapping=tmp_path / "mapping.toml")
    assert error is not None
    # measured 2 to 3 mm, 14 mm/s, 13 mrad: rotors lag in speed there, in thrust here, and commands are held for 5 ms
    assert error["position"] < 0.008
    assert error["velocity"] < 0.04
    assert error["attitude"] < 0.04
