"""Strangers' files on which the commands were wrong: what they must say of them, or why they refuse them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.cli import main
from crazyem.doctor import Finding, Grade, examine
from crazyem.errors import FileFormatError
from crazyem.recordings import ReadOptions, Recording, open_recording
from crazyem.recordings.airborne import airtime
from crazyem.recordings.finding import percent
from crazyem.recordings.registry import open_parts

CASES = Path(__file__).parent / "cases"
MAP = CASES / "map.toml"


def opened(case: str, name: str, mapping: Path | None = None) -> Recording:
    return open_recording(CASES / case / name, ReadOptions(str(mapping) if mapping else None))


def found(recording: Recording, check: str) -> list[Finding]:
    return [f for f in examine(recording) if f.check == check]


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(a) for a in arguments]) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command says that cannot do it."""
    assert main([str(a) for a in arguments]) != 0
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return captured.err


def test_a_drone_that_is_carried_off_its_table_does_not_fly() -> None:
    recording = opened("mocap_table_then_carried", "flight.csv.gz", MAP)
    ((begin, end),) = airtime(recording).flown
    assert (begin, end) == pytest.approx((8.3, 26.4), abs=0.15)
    assert not found(recording, "flight")  # one flight, seen whole


def test_a_leap_of_position_is_found_and_marked(tmp_path: Path) -> None:
    recording = opened("position_jump_cm", "flight.csv.gz", MAP)
    leap, coarse = found(recording, "numbers")
    assert leap.grade is Grade.DEGRADES
    assert leap.intervals[0] == pytest.approx((15.0, 15.04), abs=0.011)
    assert leap.evidence["speed_m_s"] == pytest.approx(80.0, rel=0.05)
    assert leap.fix is not None
    assert leap.fix.rows is not None
    assert leap.fix.rows.tolist() == list(range(1500, 1505))
    assert coarse.grade is Grade.HARMLESS
    assert coarse.evidence["resolution_m"] == pytest.approx(0.01)
    fixed = tmp_path / "fixed.mcap"
    path = CASES / "position_jump_cm" / "flight.csv.gz"
    assert main(["doctor", str(path), "--map", str(MAP), "--fix", "-o", str(fixed)]) == 0
    assert [f.grade for f in found(open_recording(fixed), "numbers")] == [Grade.HARMLESS]


@pytest.mark.parametrize(
    ("column", "signal", "unit"),
    [("u0", "motor_request", "us"), ("m1", "motor_request", "pwm"), ("m1", "motor_command", "pwm")],
)
def test_a_request_in_another_unit_is_no_saturation(tmp_path: Path, column: str, signal: str, unit: str) -> None:
    mapping, first = tmp_path / "map.toml", int(column[1])
    columns = [f"{column[0]}{i}" for i in range(first, first + 4)]
    mapping.write_text(f'{MAP.read_text()}[signals.{signal}]\ncolumns = {json.dumps(columns)}\nunit = "1"\n')
    recording = opened("request_in_wrong_unit", "flight.csv.gz", mapping)
    (finding,) = found(recording, "numbers")
    assert (finding.grade, finding.signal) == (Grade.UNUSABLE, signal)
    assert "outside 0..1 in 3000 of 3000" in finding.text
    assert f'unit = "{unit}"' in finding.advice
    assert not found(recording, "saturation")


def test_a_fixed_wing_is_no_quadrotor_to_any_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = CASES / "tlog_fixed_wing" / "a.tlog"
    (finding,) = [f for f in found(open_recording(path), "flight") if f.grade is Grade.UNUSABLE]
    assert "fixed wing" in finding.text
    lines = said(capsys, "info", path).splitlines()
    assert len(lines) <= 20
    assert "fixed wing" in lines[1]
    for command in (["replay", path, "--plot", tmp_path / "x.png"], ["diagnose", path]):
        assert "fixed wing aircraft, by its autopilot; the models here are of quadrotors" in refused(capsys, *command)


@pytest.mark.parametrize("counted", [True, False])
def test_a_rate_that_changes_is_no_loss(counted: bool) -> None:
    """By the sequence numbers, and by the intervals alone."""
    recording = opened("tlog_rate_change_no_loss", "a.tlog")
    if not counted:
        recording = replace(recording, metadata={})
    assert not found(recording, "gaps")


def test_a_topic_published_on_change_has_no_period() -> None:
    gaps = found(opened("ulog_on_change_topic", "a.ulg.gz"), "gaps")
    assert [f.grade for f in gaps] == [Grade.HARMLESS]
    assert "home_position" in gaps[0].text


def test_slow_rotor_speeds_say_the_same_to_every_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = CASES / "ulog_rotor_speed_4hz" / "a.ulg.gz"
    why = "rotor_speed at 4 Hz is too slow: steps of 0.25 s are gaps"
    told = json.loads(said(capsys, "info", path, "--vehicle", "cf21bl", "--json"))["files"][0]
    (mass,) = [v for v in told["identifiable"] if v["name"] == "mass"]
    assert mass["verdict"] == "no"
    assert why in mass["reason"]
    assert why in told["objections"]["replay"]
    assert why in refused(capsys, "replay", path, "--vehicle", "cf21bl", "--plot", tmp_path / "x.png")
    assert why in refused(capsys, "diagnose", path, "--vehicle", "cf21bl")


def test_info_of_an_autopilot_is_short(capsys: pytest.CaptureFixture[str]) -> None:
    for path in sorted([*CASES.glob("tlog_*/a.tlog"), *CASES.glob("ulog_*/a.ulg.gz")]):
        lines = said(capsys, "info", path).splitlines()
        assert len(lines) <= 20, path
        assert any(line.startswith("in the air") for line in lines[1:4])
        everything = said(capsys, "info", path, "--all")
        names = open_recording(path).signals
        assert all(name in everything for name in names)


@given(share=st.floats(0.0, 20.0))
def test_a_share_is_never_a_power_of_ten(share: float) -> None:
    text = percent(share)
    assert "e" not in text.replace("under", "")
    if "under" not in text:
        assert float(text.removesuffix(" %")) == pytest.approx(100.0 * share, rel=0.051, abs=0.5)


def test_erased_flash_after_the_last_record_is_not_read() -> None:
    path = CASES / "usd_ff_tail" / "log00"
    recording = open_recording(path)
    assert recording.duration == pytest.approx(5.99)
    assert {array.time.size for array in recording.signals.values()} == {600}
    (finding,) = [f for f in recording.findings if f.check == "integrity"]
    assert finding.evidence["offset_bytes"] == 22922
    assert "0xFF" in finding.text
    parts = list(open_parts(path, seconds=1.0))
    assert sum(len(part) for part in parts) == len(recording)
    assert [f.text for part in parts for f in part.findings] == [finding.text]


@pytest.mark.parametrize(
    ("name", "words"),
    [("lfs_pointer/flight.mcap", "git lfs pull"), ("dataflash_bin/log.BIN", "mavlogdump.py --format csv")],
)
def test_refusals_say_what_the_file_is_and_what_to_do(name: str, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        open_recording(CASES / name)


def test_a_folder_of_pointers_is_not_empty_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pointer = (CASES / "lfs_pointer" / "flight.mcap").read_bytes()
    for name in ("a.mcap", "b.ulg", "picture.png"):
        (tmp_path / name).write_bytes(pointer)
    assert main(["info", str(tmp_path), "--jobs", "1"]) == FileFormatError.exit_code
    said = capsys.readouterr().err
    assert said.count("git lfs pull") == 2
    assert "picture.png" not in said
