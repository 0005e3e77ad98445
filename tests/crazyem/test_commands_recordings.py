"""Commands on recordings: which files, what is said, what is made of them."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_flight import Motion, changed, made_flight
from recording_files import fails, flight_fixture, folder_fixture, link_pair, run, save

from crazyem.cli import parser
from crazyem.commands import files
from crazyem.commands.merge import merge_findings
from crazyem.errors import UsageError
from crazyem.recordings import Finding, Grade, ReadOptions, open_recording
from crazyem.recordings.mcap.signals import write_recording

flight = pytest.fixture(scope="module")(flight_fixture)
folder = pytest.fixture(folder_fixture)


def json_of(capsys: pytest.CaptureFixture[str], *argv: object, code: int = 0) -> Any:
    """Run with --json, expect this exit code; return the JSON."""
    got, out, _ = run(capsys, *argv, "--json")
    assert got == code
    return json.loads(out)


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
    code, out, err = run(capsys, "info", flight, "--json")  # JSON alone is all of standard output
    (found,) = json.loads(out)["files"]
    assert (code, err) == (0, "")
    assert found["file"] == str(flight)
    assert found["duration_s"] == pytest.approx(8.0, abs=0.02)
    assert {s["name"]: s["unit"] for s in found["signals"]}["body_rate"] == "rad/s"


def test_one_that_fails_does_not_stop_the_others(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    summary = folder.parent / "s.json"
    code, out, err = run(capsys, "info", folder, "--jobs", 1, "--json", summary)
    assert code == 3
    assert err.count("crazyem: ") == 1
    assert "broken.csv" in err
    assert "3 recordings, 1 could not be read, 7 other files skipped" in out
    whole = json.loads(summary.read_text())
    assert [bool(f.get("error")) for f in whole["files"]] == [False, False, True, False]
    assert whole["files"][2]["exit_code"] == 3
    assert whole["skipped_files"] == 7


def test_a_single_unreadable_file_is_one_sentence(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    for command in ("info", "doctor"):
        assert "broken.csv" in fails(capsys, command, folder / "broken.csv", code=3)


def test_json_does_not_replace_a_recording(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    before = (folder / "a.csv").read_bytes()
    said = fails(capsys, "info", "--json", folder / "a.csv", folder / "b.csv", code=2)
    assert "no JSON file" in said
    assert (folder / "a.csv").read_bytes() == before


def test_options_of_reading_reach_the_reader() -> None:
    given = ["--motor", "request", "--as-published", "--map", "m.toml", "--from", "1", "--to", "2"]
    options = files.read_options(parser().parse_args(["replay", "f", *given]))
    assert options == ReadOptions("m.toml", "request", as_published=True, start=1.0, end=2.0)
    assert files.read_options(parser().parse_args(["replay", "f"])) == ReadOptions()


def test_info_in_parts_says_what_the_whole_says(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = save(made_flight(seconds=150.0, more=["rpm"]), tmp_path / "long.csv")
    whole, parts = (json_of(capsys, "info", path, *more)["files"][0] for more in ([], ["--parts"]))
    assert parts["duration_s"] == pytest.approx(whole["duration_s"])
    assert parts["samples"] == whole["samples"]
    for a, b in zip(whole["signals"], parts["signals"], strict=True):
        for key in ("name", "samples", "unit", "missing_share", "marked_share"):
            assert a[key] == b[key]
        assert a["rate_hz"] == pytest.approx(b["rate_hz"])
        assert a["longest_gap_s"] == pytest.approx(b["longest_gap_s"])
    for key in ("speed_max_m_s", "altitude_max_m", "tilt_max_deg", "motor_command_max"):
        assert parts["envelope"][key] == pytest.approx(whole["envelope"][key], rel=1e-6), key


def test_findings_of_parts_become_one() -> None:
    early = Finding("gaps", Grade.HARMLESS, "One gap.", "position", ((1.0, 2.0),), {"longest_s": 1.0})
    late = Finding("gaps", Grade.DEGRADES, "A long gap.", "position", ((70.0, 75.0),), {"longest_s": 5.0})
    other = Finding("lag", Grade.UNUSABLE, "Lag.", "velocity")
    merged = merge_findings([(early,), (late, other)])
    assert [(f.check, f.grade) for f in merged] == [("lag", Grade.UNUSABLE), ("gaps", Grade.DEGRADES)]
    assert merged[1].intervals == ((1.0, 2.0), (70.0, 75.0))
    assert dict(merged[1].evidence) == {"longest_s": 5.0, "parts": 2.0}


# commands that make files of recordings: doctor and its fixes, import, export, recover, layout


# --- doctor -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def in_degrees(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose gyro is in deg/s but says rad/s."""
    recording = made_flight(Motion(seconds=15.0, size=0.2))  # slow enough to be below what no gyro can show
    rate = recording.signals["body_rate"].value
    return save(changed(recording, "body_rate", value=np.degrees(rate)), tmp_path_factory.mktemp("ill") / "gyro.csv")


def test_doctor_names_grades_and_advises(capsys: pytest.CaptureFixture[str], in_degrees: Path) -> None:
    code, out, err = run(capsys, "doctor", in_degrees)
    assert (code, err) == (0, "")
    assert "UNUSABLE  rates body_rate" in out
    assert "evidence: " in out
    assert "advice: " in out
    (found,) = json_of(capsys, "doctor", in_degrees, "--strict", code=5)["files"]
    assert found["grade"] == "unusable"
    assert any(f["check"] == "rates" and f["fix"]["kind"] == "scale" for f in found["findings"] if f["fix"])


def test_fix_writes_a_new_file_that_is_cured(
    capsys: pytest.CaptureFixture[str], in_degrees: Path, tmp_path: Path
) -> None:
    before = in_degrees.read_bytes()
    target = tmp_path / "fixed.mcap"
    code, out, _ = run(capsys, "doctor", in_degrees, "--fix", "-o", target)
    assert code == 0
    assert "applied: rates" in out
    assert in_degrees.read_bytes() == before
    repaired = open_recording(target).signals["body_rate"].value
    assert repaired == pytest.approx(np.radians(open_recording(in_degrees).signals["body_rate"].value), rel=1e-2)
    assert not any(f["check"] == "rates" for f in json_of(capsys, "doctor", target)["files"][0]["findings"])
    assert "exists already" in fails(capsys, "doctor", in_degrees, "--fix", "-o", target, code=2)


def test_fix_goes_beside_the_recording_and_never_onto_it(
    capsys: pytest.CaptureFixture[str], in_degrees: Path, tmp_path: Path
) -> None:
    path = tmp_path / "gyro.csv"
    link_pair(in_degrees, path)
    assert run(capsys, "doctor", path, "--fix")[0] == 0
    assert (tmp_path / "gyro.fixed.mcap").exists()
    said = fails(capsys, "doctor", path, "--fix", "--force", "-o", path, code=2)
    assert "never written in place" in said


def test_what_is_sound_is_not_rewritten(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    target = tmp_path / "new.mcap"
    fixed = json_of(capsys, "doctor", flight, "--fix", "-o", target)["files"][0]["fixed"]
    assert fixed["applied"] == []
    assert fixed["output"] is None
    assert not target.exists()


def test_copies_among_several_are_told(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    link_pair(flight, tmp_path / "copy.csv")
    save(made_flight(seconds=8.0, seed=5), tmp_path / "other.csv")
    (pair,) = json_of(capsys, "doctor", flight, tmp_path, "--jobs", 1)["duplicates"]
    text = json.dumps(pair)
    assert "flight.csv" in text
    assert "copy.csv" in text
    assert "other.csv" not in text


# --- import, export -----------------------------------------------------------------------------------------------


def test_import_then_export_loses_nothing(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    mcap, table = tmp_path / "f.mcap", tmp_path / "again.csv"
    assert run(capsys, "import", flight, "-o", mcap)[0] == 0
    made = json_of(capsys, "export", mcap, "-o", table)["files"][0]
    assert made["output"] == [str(table), f"{table}-metadata.json"]
    a, b = open_recording(flight).signals, open_recording(table).signals
    for name, array in a.items():
        for field in ("time", "value", "host_time", "marked"):
            np.testing.assert_array_equal(getattr(array, field), getattr(b[name], field))
        for field in ("unit", "frame", "clock", "stream"):
            assert getattr(array, field) == getattr(b[name], field)
    assert run(capsys, "export", mcap, "-o", tmp_path / "f.parquet")[0] == 0
    assert pd.read_parquet(tmp_path / "f.parquet").attrs["units"]["voltage"] == "V"


def test_several_go_into_a_folder_that_keeps_theirs(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    (folder / "broken.csv").unlink()
    write_recording(made_flight(seconds=2.0), folder / "a.mcap")
    out = tmp_path / "new" / "tables"
    code, _, _ = run(capsys, "export", folder, "-o", out, "--format", "parquet", "--jobs", 1)
    assert code == 0
    made = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    assert made == ["a.csv.parquet", "a.mcap.parquet", "b.parquet", "day two/a.parquet"]
    said = fails(capsys, "import", folder / "a.csv", folder / "b.csv", "-o", folder / "README.txt", code=2)
    assert "not a folder" in said
    said = fails(capsys, "import", folder / "a.csv", folder / "day two" / "a.csv", "-o", tmp_path / "m", code=2)
    assert "one at a time" in said


def test_nothing_is_replaced_unless_asked_and_never_an_input(
    capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path
) -> None:
    path, target = tmp_path / "f.csv", tmp_path / "old.mcap"
    link_pair(flight, path)
    target.write_bytes(b"mine")
    (tmp_path / "link.csv").symlink_to(path)
    assert "exists already" in fails(capsys, "import", path, "-o", target, code=2)
    assert target.read_bytes() == b"mine"
    assert run(capsys, "import", path, "-o", target, "--force")[0] == 0
    assert open_recording(target).signals
    for same in (path, tmp_path / "link.csv", tmp_path / "." / "f.csv"):
        assert "never written in place" in fails(capsys, "export", path, "-o", same, "--force", code=2)
    assert path.read_bytes() == flight.read_bytes()


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["import", "{f}"], "-o"),
        (["import", "{f}", "-o", "/proc/x.mcap"], "/proc/x.mcap"),
        (["import", "{f}", "-o", "no/such/folder/x.mcap"], "cannot write"),
        (["export", "{f}", "-o", "x.xlsx"], "ends in .csv or .parquet"),
        (["export", "{f}", "-o", "x.csv", "--format", "parquet"], "--format"),
        (["info"], "FILE"),
        (["info", "{empty}"], "no recording in"),
        (["info", "{pipe}"], "neither a file nor a folder"),
        (["info", "{f}", "--motor", "both"], "--motor"),
        (["info", "none.csv"], "no such file"),
        (["doctor", "none.csv"], "no such file"),
        (["doctor", "{f}", "-o", "x.mcap"], "-o is where --fix writes"),
        (["info", "{f}", "--jobs", "0"], "--jobs"),
        (["info", "{f}", "--vehicle", "nimbus"], "unknown vehicle"),
        (["recover", "none.mcap", "-o", "x.mcap"], "none.mcap"),
        (["recover", "{f}", "-o", "{f}"], "never written in place"),
        (["layout", "-o", "no/such/folder/x.json"], "cannot write"),
        (["layout", "-o", "{f}"], "exists already"),
    ],
)
def test_wrong_usage_is_one_sentence(
    capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    argv: list[str], says: str,
) -> None:  # fmt: skip
    work, empty, pipe = tmp_path / "work", tmp_path / "empty", tmp_path / "pipe"
    work.mkdir()
    empty.mkdir()
    (empty / "notes.txt").write_text("nothing")
    os.mkfifo(pipe)
    monkeypatch.chdir(work)
    assert says in fails(capsys, *(a.format(f=flight, empty=empty, pipe=pipe) for a in argv), code=2)
    assert list(work.iterdir()) == []


# --- recover, layout ----------------------------------------------------------------------------------------------


def test_recover_a_cut_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    whole, broken, target = tmp_path / "w.mcap", tmp_path / "b.mcap", tmp_path / "r.mcap"
    write_recording(made_flight(seconds=60.0), whole)
    broken.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    assert json_of(capsys, "recover", broken, "-o", target)["files"][0]["messages"] > 0
    a, b = open_recording(whole).signals["body_rate"], open_recording(target).signals["body_rate"]
    assert 0 < b.time.size < a.time.size
    assert np.array_equal(a.value[: b.time.size], b.value)
    assert "exists already" in fails(capsys, "recover", broken, "-o", target, code=2)
    (tmp_path / "n.mcap").write_bytes(b"not an MCAP file")
    assert "n.mcap" in fails(capsys, "recover", tmp_path / "n.mcap", "-o", tmp_path / "m.mcap", code=3)
