"""The recording that comes with the project: its replay finds what the scenario hid, and its pushes are in it."""

import json
from pathlib import Path

import pytest

from crazyem.cli import main
from crazyem.recordings import open_recording

FLIGHT = Path(__file__).resolve().parents[2] / "logs" / "payload_excite.mcap"
TRUTH = {"mass": 0.036, "Ixx": 2.0e-5, "Iyy": 2.1e-5, "Izz": 3.6e-5, "motor_time_constant": 0.060}  # of the scenario


def test_replay_finds_the_payload(tmp_path):
    out = tmp_path / "replay.json"
    plot = ["--plot", str(tmp_path / "replay.png"), "--every", "40"]
    assert main(["replay", str(FLIGHT), "--json", str(out), *plot]) == 0
    estimates = json.loads(out.read_text())["estimates"]
    for name, truth in TRUTH.items():
        estimate = estimates[name]
        assert estimate["identifiable"], name
        # one flight, five parameters: within 3 sd fails once in 75 such flights if calibrated; this one is fixed
        assert abs(estimate["value"] - truth) < 3 * estimate["sd"], name
    assert estimates["mass"]["value"] == pytest.approx(0.036, rel=0.005)


def test_it_holds_pushes_that_were_confirmed():
    writes = [e for e in open_recording(FLIGHT).events if e.kind == "parameter_write"]
    assert any(e.data["name"] == "ctrlLee.mass" and e.data["verified"] for e in writes)
