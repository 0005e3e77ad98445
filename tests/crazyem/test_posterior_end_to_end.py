"""`diagnose --method posterior` on shipped flights: a whole document, of a drone that is told too weak."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from crazyem.cli import main
from crazyem.vehicle import load_vehicle

LOGS = Path(__file__).parents[2] / "logs"


@pytest.mark.slow
def test_a_thrust_that_the_file_has_too_large_is_named(tmp_path: Path) -> None:
    vehicle = load_vehicle("cf2")
    strong = replace(vehicle, name="strong", thrust_curve=tuple(1.15 * c for c in vehicle.thrust_curve))
    (tmp_path / "strong.toml").write_text(strong.to_toml())
    answer = tmp_path / "answer.json"
    words = [
        "diagnose", str(LOGS / "clean_figure8.mcap"), "--vehicle", str(tmp_path / "strong.toml"), "--jobs", "1",
        "--method", "posterior", "--json", str(answer), "--write-vehicle", str(tmp_path / "fitted.toml"),
    ]  # fmt: skip
    assert main(words) == 0
    document = json.loads(answer.read_text())
    first = document["effects"][0]
    assert document["mismatch"]
    assert first["name"] in {"thrust_scale", "payload"}
    assert first["evidence"]["p_value"] is None
    assert first["evidence"]["log_odds"] > 3.0
    assert 0.5 < first["confidence"] <= 1.0
    for effect in document["effects"]:
        for told in effect["parameters"].values():
            if not told.get("chosen"):
                assert told["ci95"][0] <= told["value"] <= told["ci95"][1]
    load_vehicle(str(tmp_path / "fitted.toml"))
