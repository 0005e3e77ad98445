"""The recordings that come with the project are what logs/README.md says of them."""

import json
from pathlib import Path

import pytest

from crazyem.cli import main
from crazyem.doctor import examine
from crazyem.recordings import Grade, open_recording

LOGS = Path(__file__).resolve().parents[2] / "logs"
PERIOD_MS = 10  # of every log block


def missing(name):
    """Records missing in each log block: what its first and last stamp leave room for, less what is there."""
    lost = {}
    for array in open_recording(LOGS / name).signals.values():
        if array.stream.startswith("log/"):
            room = round((array.time[-1] - array.time[0]) * 1000.0 / PERIOD_MS) + 1
            lost[array.stream] = room - array.time.size
    return lost


@pytest.mark.parametrize("name", ["clean_figure8.mcap", "payload_excite.mcap"])
def test_sound_flights_are_called_sound(name):
    assert [f for f in examine(open_recording(LOGS / name)) if f.grade is not Grade.HARMLESS] == []
    assert set(missing(name).values()) == {0}


def test_the_lossy_flight_lost_what_the_link_counted():
    recording = open_recording(LOGS / "lossy_figure8.mcap")
    counted = int(recording.metadata["statistics"]["lost"])
    by_stamps = missing("lossy_figure8.mcap")
    found = {f.text.split(":")[0]: f.evidence["lost"] for f in examine(recording) if f.check == "gaps"}
    for name, lost in by_stamps.items():
        # a late record beside a lost one may hide it: the doctor counts what certainly is missing
        assert 0.97 * lost <= found[name] <= lost, name
    # a stamp that jitters at either end of a block makes room for one record more or less
    assert abs(counted - sum(by_stamps.values())) <= len(by_stamps)
    assert 0.07 < counted / (counted + int(recording.metadata["statistics"]["received"])) < 0.13


def test_each_holds_what_a_viewer_needs():
    for path in sorted(LOGS.glob("*.mcap")):
        kinds = {event.kind for event in open_recording(path).events}
        assert {"estimate", "residual", "link", "setpoint", "log"} <= kinds, path.name
    assert len(list(LOGS.glob("*.mcap"))) == 3


FLIGHT = LOGS / "payload_excite.mcap"
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
