"""The commands on recordings: which files are found, and `info` on one, on many and in parts."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from made_flight import made_flight
from recording_files import cut, fails, flight_fixture, folder_fixture, link_pair, run, save

from crazyem.commands import files
from crazyem.commands.merge import merge_findings, merge_inventories
from crazyem.doctor.inventory import inventory
from crazyem.errors import UsageError
from crazyem.recordings import Finding, Grade

flight = pytest.fixture(scope="module")(flight_fixture)
folder = pytest.fixture(folder_fixture)


# --- what is found ------------------------------------------------------------------------------------------------


def test_folders_patterns_and_links_give_each_recording_once(folder: Path) -> None:
    found = files.find([str(folder)])
    names = [str(f.path.relative_to(folder)) for f in found.found]
    assert names == ["a.csv", "b.csv", "broken.csv", "day two/a.csv"]
    assert [f.below for f in found.found] == ["", "", "", "day two"]
    assert found.skipped == 7  # a README, four descriptions, a pipe, a link to nothing
    again = files.find([str(folder / "b.csv"), str(folder), str(folder / "*.csv"), str(folder / "day two" / "up")])
    assert [f.path.name for f in again.found] == ["b.csv", "a.csv", "broken.csv", "a.csv"]


def test_a_pattern_goes_into_folders_if_it_says_so(folder: Path) -> None:
    assert len(files.find([str(folder / "**" / "a.csv")]).found) == 2
    assert len(files.find([str(folder / "[ab].csv")]).found) == 2
    with pytest.raises(UsageError, match="nothing matches"):
        files.find([str(folder / "*.mcap")])


def test_a_file_whose_name_is_a_pattern_is_that_file(tmp_path: Path, flight: Path) -> None:
    link_pair(flight, tmp_path / "a[1].csv")
    link_pair(flight, tmp_path / "a1.csv")
    assert [f.path.name for f in files.find([str(tmp_path / "a[1].csv")]).found] == ["a[1].csv"]


def test_a_folder_without_recordings(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    assert "no recording in" in fails(capsys, "info", tmp_path, code=2)


def test_a_pipe_is_refused_not_waited_for(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    assert "neither a file nor a folder" in fails(capsys, "info", folder / "pipe", code=2)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a.csv.gz", "a"), ("a.csv", "a"), ("a.MCAP", "a"), ("log07", "log07"), (".csv", ".csv"),
        ("cut_M2_0.5mm_46.5mm__E9_log00", "cut_M2_0.5mm_46.5mm__E9_log00"), ("f.fixed.mcap", "f.fixed"),
    ],
)  # fmt: skip
def test_stem(name: str, expected: str) -> None:
    assert files.stem(Path(name)) == expected


# --- info ---------------------------------------------------------------------------------------------------------


def test_info_of_one(capsys: pytest.CaptureFixture[str], flight: Path) -> None:
    code, out, err = run(capsys, "info", flight)
    assert (code, err) == (0, "")
    assert "position" in out
    assert "what it could identify" in out


def test_json_alone_is_all_of_standard_output(capsys: pytest.CaptureFixture[str], flight: Path) -> None:
    code, out, err = run(capsys, "info", flight, "--json")
    told = json.loads(out)["files"]
    assert (code, err) == (0, "")
    assert [t["file"] for t in told] == [str(flight)]
    assert told[0]["duration_s"] == pytest.approx(8.0, abs=0.02)
    signals = {s["name"]: s for s in told[0]["signals"]}
    assert signals["body_rate"]["unit"] == "rad/s"


def test_one_that_fails_does_not_stop_the_others(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    summary = folder.parent / "s.json"
    code, out, err = run(capsys, "info", folder, "--jobs", 1, "--json", summary)
    assert code == 3
    assert err.count("crazyem: ") == 1
    assert "broken.csv" in err
    assert "3 recordings, 1 could not be read, 7 other files skipped" in out
    told = json.loads(summary.read_text())
    assert [bool(f.get("error")) for f in told["files"]] == [False, False, True, False]
    assert told["files"][2]["exit_code"] == 3
    assert told["skipped_files"] == 7


def test_a_single_unreadable_file_is_one_sentence(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    for command in ("info", "doctor"):
        assert "broken.csv" in fails(capsys, command, folder / "broken.csv", code=3)
        assert "no such file" in fails(capsys, command, folder / "none.csv", code=2)


def test_json_does_not_replace_a_recording(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    before = (folder / "a.csv").read_bytes()
    said = fails(capsys, "info", "--json", folder / "a.csv", folder / "b.csv", code=2)
    assert "no JSON file" in said
    assert (folder / "a.csv").read_bytes() == before


def test_options_of_reading_reach_the_reader(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    assert "--motor" in fails(capsys, "info", flight, "--motor", "both", code=2)
    given = []
    for argv in (["info", "f", "--motor", "request", "--as-published", "--map", "m.toml"], ["replay", "f"]):
        from crazyem.cli import parser

        given.append(files.read_options(parser().parse_args(argv)))
    assert (given[0].mapping, given[0].motor, given[0].as_published) == ("m.toml", "request", True)
    assert (given[1].mapping, given[1].motor, given[1].as_published) == (None, None, False)


def test_info_in_parts_says_what_the_whole_says(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = save(made_flight(seconds=150.0, more=["rpm"]), tmp_path / "long.csv")
    told = []
    for more in ([], ["--parts"]):
        code, out, _ = run(capsys, "info", path, "--json", *more)
        assert code == 0
        told.append(json.loads(out)["files"][0])
    whole, parts = told
    assert parts["duration_s"] == pytest.approx(whole["duration_s"])
    assert parts["samples"] == whole["samples"]
    for a, b in zip(whole["signals"], parts["signals"], strict=True):
        for key in ("name", "samples", "unit", "missing_share", "marked_share"):
            assert a[key] == b[key]
        assert a["rate_hz"] == pytest.approx(b["rate_hz"])
        assert a["longest_gap_s"] == pytest.approx(b["longest_gap_s"])
    for key in ("speed_max_m_s", "altitude_max_m", "tilt_max_deg", "motor_command_max"):
        assert parts["envelope"][key] == pytest.approx(whole["envelope"][key], rel=1e-6), key


def test_inventories_of_parts_add_up() -> None:
    recording = made_flight(seconds=20.0)
    halves = [
        replace(recording, signals={n: cut(a, half) for n, a in recording.signals.items()}) for half in (False, True)
    ]
    whole, merged = inventory(recording), merge_inventories(inventory(h) for h in halves)
    assert merged.samples == whole.samples
    for a, b in zip(whole.signals, merged.signals, strict=True):
        assert (a.name, a.samples, a.start_s, a.end_s, a.rate_hz) == (b.name, b.samples, b.start_s, b.end_s, b.rate_hz)
        assert a.longest_gap_s == pytest.approx(b.longest_gap_s)


def test_findings_of_parts_become_one() -> None:
    early = Finding("gaps", Grade.HARMLESS, "One gap.", "position", ((1.0, 2.0),), {"longest_s": 1.0})
    late = Finding("gaps", Grade.DEGRADES, "A long gap.", "position", ((70.0, 75.0),), {"longest_s": 5.0})
    other = Finding("lag", Grade.UNUSABLE, "Lag.", "velocity")
    merged = merge_findings([(early,), (late, other)])
    assert [(f.check, f.grade) for f in merged] == [("lag", Grade.UNUSABLE), ("gaps", Grade.DEGRADES)]
    assert merged[1].intervals == ((1.0, 2.0), (70.0, 75.0))
    assert dict(merged[1].evidence) == {"longest_s": 5.0, "parts": 2.0}
