"""Proof with concealed physics: the draw keeps its promises, made-up answers get the figures counted by hand."""

import json
import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.concealed import report as reports
from benchmarks.concealed.__main__ import main
from benchmarks.concealed.diagnose import diagnose_all
from benchmarks.concealed.draw import draw, write_cases
from benchmarks.concealed.fly import _words
from benchmarks.concealed.judge import coverage, credit, errors, outside
from benchmarks.concealed.nuisances import spread
from benchmarks.concealed.paths import Study, read, write
from benchmarks.concealed.report import report, table
from benchmarks.concealed.score import QUANTITIES, Outcome, figures
from benchmarks.concealed.sizes import CATALOGUE, OUTSIDE
from crazyem.control.named_trajectories import waypoints
from crazyem.vehicle import load_vehicle
from firmware_sim.plant.effects.catalogue import EFFECTS, HIDDEN
from firmware_sim.scenario import load_scenario

# the draw


def test_the_same_seed_draws_the_same_cases_and_another_others() -> None:
    assert draw(cases=60, seed=1) == draw(cases=60, seed=1)
    assert draw(cases=60, seed=1) != draw(cases=60, seed=2)
    assert json.loads(json.dumps(draw(cases=20, seed=3))) == draw(cases=20, seed=3)


@pytest.mark.parametrize(("cases", "seed"), [(60, 1), (320, 2025)])
def test_shares_are_as_promised_and_every_effect_is_there(cases: int, seed: int) -> None:
    found = draw(cases=cases, seed=seed)
    kinds = Counter(c["kind"] for c in found)
    assert len(found) == len({c["case"] for c in found}) == cases
    assert kinds["nothing"] >= 0.2 * cases
    assert abs(kinds["pair"] - 0.15 * cases) <= 1
    assert abs(kinds["outside"] - 0.1 * cases) <= 1
    alone = Counter(name for c in found if c["kind"] == "single" for name in c["effects"])
    # a trim is not drawn: every real drone has one, and none that is simulated here; nor is what every log has
    assert set(alone) == set(CATALOGUE) == set(EFFECTS) - {"trim", "onboard_filter", "sampled_commands"}
    assert max(alone.values()) - min(alone.values()) <= 1
    assert {n for c in found for n in c["hidden"]} == set(OUTSIDE) == set(HIDDEN)
    assert all(len(c["effects"]) == 2 for c in found if c["kind"] == "pair")
    assert not any(c["effects"] or c["hidden"] for c in found if c["kind"] == "nothing")


def test_order_and_names_tell_nothing_of_the_kind() -> None:
    kinds = np.array([c["kind"] == "nothing" for c in draw(cases=320, seed=2025)], float)
    assert abs(np.corrcoef(kinds, np.arange(320))[0, 1]) < 4 / math.sqrt(320)


def test_every_drawn_scenario_is_one_the_simulator_takes_and_every_path_one_that_can_be_flown(tmp_path: Path) -> None:
    study = Study(tmp_path)
    assert write_cases(study, cases=60, seed=7) == 60
    assert write_cases(study, cases=60, seed=7) == 0  # what exists stays
    for name in study.cases():
        case = read(study.truth(name))
        assert load_scenario(study.scenario(name)).platform == case["platform"]
        for flight in case["flights"].values():
            if flight["waypoints"]:
                path = waypoints(path=_words(flight, str(tmp_path))[1], position=(0.0, 0.0, 1.0))
                assert min(path.at(t).position[2] for t in np.linspace(0, 20, 400)) > 0.08


def test_drawn_products_of_inertia_belong_to_a_body() -> None:
    vehicle, random = load_vehicle("cf2"), np.random.default_rng(0)
    for u in (0.0, 0.9, 1.0):
        for _ in range(300):
            p = CATALOGUE["inertia_products"].draw(u, random, vehicle)
            xy, xz, yz = p["xy"], p["xz"], p["yz"]
            products = np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
            moments = np.linalg.eigvalsh(np.diag(vehicle.inertia) + products)
            assert moments[2] < moments[0] + moments[1]


def test_the_truth_without_effects_is_the_nominal_vehicle(tmp_path: Path) -> None:
    write_cases(Study(tmp_path), cases=1, seed=1)
    for name in ("cf2", "cf21bl"):
        file = tmp_path / "plain.toml"
        file.write_text(f'platform = "{name}"\nvehicle_file = "vehicles/{name}.toml"\n')
        true, told = load_scenario(file).vehicle, load_vehicle(name)
        assert true.mass == told.mass
        assert tuple(true.inertia)[:3] == told.inertia
        assert tuple(true.thrust_curve) == told.thrust_curve
        assert true.motor_time_constant == told.motor_time_constant


# one answer against one truth


def answer(*effects: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"mismatch": bool(effects), "effects": list(effects), "indistinguishable": [], "unexplained": {}, **more}


def effect(name: str, confidence: float = 0.9, **parameters: tuple[float, float, float]) -> dict[str, Any]:
    told = {k: {"value": v, "ci95": [low, high]} for k, (v, low, high) in parameters.items()}
    return {"name": name, "parameters": told, "confidence": confidence}


@pytest.mark.parametrize(
    ("result", "worth"),
    [
        (answer(effect("payload")), 1.0),
        (answer(effect("payload"), indistinguishable=[["payload", "thrust_scale"]]), 0.5),
        (answer(effect("thrust_scale"), indistinguishable=[["payload", "thrust_scale"]]), 0.5),
        (answer(effect("thrust_scale")), 0.0),
        (answer(effect("wind"), effect("payload")), 0.0),
        (answer(effect("wind"), indistinguishable=[["payload", "thrust_scale"]]), 0.0),
        (answer(), 0.0),
        (None, 0.0),
        ({**answer(effect("payload")), "mismatch": False}, 0.0),
    ],
)
def test_credit_of_a_name(result: dict[str, Any] | None, worth: float) -> None:
    assert credit("payload", result) == worth


def test_errors_are_of_the_size_of_the_effect() -> None:
    vehicle = load_vehicle("cf2")
    found = effect("thrust_scale", scale=(1.06, 1.02, 1.10))
    assert errors("thrust_scale", {"scale": 1.05}, found, vehicle) == {"": pytest.approx(0.2)}
    found = effect("payload", mass=(0.002, 0.001, 0.003), x=(0.0, -1, 1), y=(0.004, -1, 1), z=(0.0, -1, 1))
    off = errors("payload", {"mass": 0.0025, "x": 0.003, "y": 0.004, "z": 0.0}, found, vehicle)
    assert off == {"kg": pytest.approx(0.2), "m": pytest.approx(0.6)}
    found = effect("motor_lag", time_constant=(0.07, 0.06, 0.065))
    assert errors("motor_lag", {"time_constant": 0.06}, found, vehicle) == {"s": pytest.approx(1.0)}
    assert coverage({"time_constant": 0.066}, found) == [("time_constant", False)]
    assert coverage({"scale": 1.0, "rotor": 2}, found) == [("scale", None)]


def test_outside_the_catalogue() -> None:
    where = [{"signal": "attitude", "axis": "z", "regime": "x -1 to -0.5 m"}]
    right = {"mismatch": True, "effects": [], "unexplained": {"where": where}}
    assert outside("magnetic_yaw", right) == {"unexplained": True, "axis": True, "regime": True, "wrong_name": False}
    assert not outside("vibration", right)["axis"]
    wrong = {**right, "effects": [effect("wind", 0.8), effect("unexplained", 0.99)]}
    assert outside("magnetic_yaw", wrong)["wrong_name"]
    unsure = {**right, "effects": [effect("wind", 0.4)]}
    assert not outside("magnetic_yaw", unsure)["wrong_name"]
    assert outside("vibration", None) == dict.fromkeys(("unexplained", "axis", "regime", "wrong_name"), False)


# the figures


def truth(kind: str, strength: float = 0.9, **effects: Any) -> dict[str, Any]:
    hidden = {} if kind != "outside" else effects
    return {
        "case": "0001", "kind": kind, "platform": "cf2", "effects": {} if hidden else effects, "hidden": hidden,
        "strength": dict.fromkeys(effects, strength), "flights": {},
    }  # fmt: skip


def test_figures_of_made_up_answers_are_those_counted_by_hand() -> None:
    scale = {"thrust_scale": {"scale": 1.1}}
    good = effect("thrust_scale", 0.96, scale=(1.11, 1.09, 1.13))
    one, twice = dict.fromkeys(QUANTITIES, 1.0), dict.fromkeys(QUANTITIES, 2.0)
    pair = {"thrust_scale": {"scale": 1.1}, "wind": {"x": 1.0, "y": 0.0, "z": 0.0}}
    group = [["wind", "linear_drag"]]
    cases = [
        *[Outcome(truth("nothing"), answer(), 10.0)] * 3,
        Outcome(truth("nothing"), answer(effect("wind", 0.7)), 20.0),
        Outcome(truth("single", **scale), answer(good), 10.0, 50.0, {"fitted": one, "true": one}),
        Outcome(truth("single", 0.2, **scale), answer(), 10.0, 50.0, {"fitted": twice, "true": one}),
        Outcome(truth("single", 0.1, **scale), answer(), 10.0, 3.0),  # nobody could see it
        Outcome(
            truth("pair", **pair),
            answer(good, effect("linear_drag", 0.6), indistinguishable=group),
            10.0,
            90.0,
            {"fitted": one, "true": one},
        ),
        Outcome(truth("pair", **pair), answer(good, effect("wind", 0.9)), 10.0, 90.0, {}, {"thrust_scale": 80.0}),
        Outcome(truth("pair", **pair), answer(good), 10.0, 90.0, {}, {"thrust_scale": 80.0, "wind": 4.0}),
        Outcome(truth("outside", cable_spring={}), answer(effect("wind", 0.95)), 10.0),
        Outcome(truth("outside", cable_spring={}), None),
    ]
    f = figures(cases)
    assert f["cases"] == {"nothing": 4, "single": 3, "pair": 3, "outside": 2}
    assert f["no_answer"] == 1
    assert f["nothing"]["false_alarms"] == {"n": 4, "share": 0.25}
    assert f["single"]["detectable"] == {"n": 2, "of": 3}
    assert f["single"]["named_first_strong"] == {"n": 1, "share": 1.0}
    assert f["single"]["named_first_all"] == {"n": 2, "share": 0.5}
    assert f["parameters"]["interval_coverage"] == {"n": 4, "share": 1.0}
    assert f["parameters"]["error"] == {"n": 5, "median": pytest.approx(0.1)}  # 0.1 four times, a wind without numbers
    assert f["pairs"]["both_and_only_both"] == {"n": 3, "share": pytest.approx(1 / 3)}
    assert f["pairs"]["each_detectable"] == {"n": 2, "share": 0.5}  # of the third one effect only could be seen
    assert f["pairs"]["each_known"] == 2
    assert f["pairs"]["up_to_declared_groups"] == {"n": 3, "share": pytest.approx(2 / 3)}
    assert f["outside"]["wrong_confident_name"] == {"n": 2, "share": 0.5}
    assert f["held_out"] == {  # 1, 2 and 1
        "within_10_percent_of_true_model": {"n": 3, "share": pytest.approx(2 / 3)},
        "median_ratio": 1.0,
        "mean_ratio": pytest.approx(4 / 3),
    }
    # claims: 0.7 wrong, 0.96 right four times, 0.6 right (declared alike), 0.9 right, 0.95 wrong
    assert f["confidence"]["n"] == 8
    brier = (0.7**2 + 4 * 0.04**2 + 0.4**2 + 0.1**2 + 0.95**2) / 8
    assert f["confidence"]["brier"] == pytest.approx(brier)
    assert [r["why"] for r in f["failures"]] == [
        "false alarm", "missed", "not both and only both", "not both and only both", "wrong confident name",
        "no answer",
    ]  # fmt: skip
    assert "| nothing hidden: false alarms | 25.0 % of 4 (5 to 70) | at most 3 % |" in table(f)


def test_no_cases_give_no_figures_rather_than_good_ones() -> None:
    f = figures([])
    assert f["nothing"]["false_alarms"] == {"n": 0, "share": None}
    assert "not measured" in table(f)


# the files


def test_the_diagnosing_process_sees_two_recordings_and_a_name(tmp_path: Path) -> None:
    study = Study(tmp_path / "study")
    write(study.truth("0001"), {**truth("nothing"), "quality": {}})
    for flight in ("recording", "held_out"):
        study.recording("0001", flight).parent.mkdir(parents=True, exist_ok=True)
        study.recording("0001", flight).write_bytes(b"recorded")
    spy = tmp_path / "spy.py"
    spy.write_text(
        "import json, os, sys\n"
        "seen = {'mismatch': False, 'effects': [], 'words': sys.argv[1:], 'files': sorted(os.listdir('.'))}\n"
        "json.dump(seen, open('answer.json', 'w'))\n"
    )
    assert diagnose_all(study, command=[sys.executable, str(spy)]) == 1
    assert diagnose_all(study, command=[sys.executable, str(spy)]) == 0  # answered already
    result = read(study.answer("0001"))["result"]
    assert result["files"] == ["held_out.mcap", "recording.mcap"]
    assert not any(str(tmp_path) in word or "/" in word for word in result["words"])
    assert "0.0 % of 1" in report(study)
    alone = Study(study.folder, alone=True)
    assert diagnose_all(alone, command=[sys.executable, str(spy)]) == 1
    result = read(alone.answer("0001"))["result"]
    assert result["files"] == ["recording.mcap"]
    assert "--held-out" not in result["words"]
    assert alone.answer("0001") != study.answer("0001")
    assert "0.0 % of 1" in report(alone)


def test_the_documents_tell_of_two_flights_alone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["score", "--out", str(tmp_path), "--alone", "--write-docs"])
    assert ended.value.code == 2
    assert "--write-docs goes without --alone" in capsys.readouterr().err


def test_the_ideal_observer_is_asked_for_what_went_wrong_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, asked = Study(tmp_path), []
    for case, said in (("0001", "wind"), ("0002", "gusts")):
        write(study.truth(case), {**truth("single", wind={"x": 1.0}), "case": case})
        write(study.answer(case), {"result": answer(effect(said)), "seconds": 1.0})
    monkeypatch.setattr(reports, "ideal_nats", lambda recording, *_, **__: asked.append(recording.parent.name) or 3.0)
    monkeypatch.setattr(reports, "held_out_error", lambda *_, **__: pytest.fail("predictions are not asked for"))
    assert [o.nats for o in reports.outcomes(study, ideal="kept")] == [None, None]
    assert [o.nats for o in reports.outcomes(study, ideal="failures")] == [None, 3.0]
    assert [o.nats for o in reports.outcomes(study, ideal="failures")] == [None, 3.0]  # kept
    assert asked == ["0002"]


@pytest.mark.parametrize(("mean", "sd"), [(0.0, 0.2), (1.5, 0.5), (-1.0, 2.0)])
def test_the_prior_of_a_nuisance_is_that_of_the_draw_whatever_prior_the_fits_had(mean: float, sd: float) -> None:
    """Values and standard deviations of fits with the prior N(0, 1), to measurements with errors of many sizes."""
    random = np.random.default_rng(3)
    error = random.uniform(0.1, 1.0, 20000)
    measured = random.normal(mean, sd, error.size) + error * random.normal(size=error.size)
    precision = 1.0 + error**-2.0
    found_mean, found_sd, gain = spread(measured * error**-2.0 / precision, precision**-0.5)
    assert found_mean == pytest.approx(mean, abs=0.1)
    assert found_sd == pytest.approx(sd, rel=0.1)
    assert gain > 10.0
