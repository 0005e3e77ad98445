"""Strangers' files with stamps that cannot be, and files that are no recordings: read or refused as they should be."""

from pathlib import Path

import numpy as np
import pytest

from crazyem.cli import main
from crazyem.errors import FileFormatError
from crazyem.recordings import Finding, Recording, open_recording
from crazyem.recordings.registry import open_parts

CASES = Path(__file__).parent / "cases"


def about_stamps(recording: Recording) -> Finding:
    """The one finding about stamps."""
    (finding,) = [f for f in recording.findings if f.check == "stamps"]
    return finding


def test_a_message_stamped_zero_was_never_published() -> None:
    recording = open_recording(CASES / "ulog_stamp_zero" / "a.ulg.gz")
    assert recording.duration == pytest.approx(30.0, abs=0.05)
    assert not [name for name in recording.signals if name.startswith("transponder_report")]
    assert "transponder_report has no stamps" in about_stamps(recording).text


def test_one_wild_stamp_costs_one_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = CASES / "ulog_wild_stamp" / "a.ulg.gz"
    recording = open_recording(path)
    assert recording.duration == pytest.approx(30.0, abs=0.05)
    assert recording.signals["body_rate"].time.size == 2999
    assert about_stamps(recording).evidence["records"] == 1
    fixed = tmp_path / "fixed.mcap"
    assert main(["doctor", str(path), "--fix", "-o", str(fixed)]) == 0
    assert "unusable" not in capsys.readouterr().out.lower()
    again = open_recording(fixed)
    np.testing.assert_array_equal(again.signals["body_rate"].time, recording.signals["body_rate"].time)
    assert not [f for f in again.findings if f.check == "stamps"]


def test_a_topic_of_another_clock_is_shifted_beside_the_others() -> None:
    recording = open_recording(CASES / "ulog_two_clocks" / "a.ulg.gz")
    assert recording.duration == pytest.approx(30.0, abs=0.05)
    assert about_stamps(recording).evidence["shift_s"] == pytest.approx(-1.7e9, rel=1e-6)
    position, attitude = recording.signals["position"], recording.signals["attitude"]
    assert abs(position.time[0] - attitude.time[0]) < 0.02
    assert position.period == pytest.approx(0.02)


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


def test_stamps_of_cfclient_beyond_24_bits_are_left_out() -> None:
    recording = open_recording(CASES / "cfclient_ns_stamps" / "State-20250301T10-00-05.csv")
    time = recording.signals["position"].time
    assert (time[0], time[-1], time.size) == (48.0, 49.99, 200)
    assert about_stamps(recording).evidence["records"] == 200
    assert str(about_stamps(recording).grade) == "degrades"


def test_a_boot_time_of_zero_is_placed_by_arrival() -> None:
    recording = open_recording(CASES / "tlog_zero_boot_ms" / "a.tlog")
    assert recording.duration == pytest.approx(19.95, abs=0.01)
    attitude = recording.signals["attitude"].time
    assert attitude.size == 400
    np.testing.assert_allclose(np.diff(attitude), 0.05, atol=0.01)
    assert about_stamps(recording).evidence["records"] == 10


def test_a_lower_case_column_of_stamps_is_read() -> None:
    recording = open_recording(CASES / "lower_case_cflib_csv" / "flight.csv")
    assert recording.signals["position"].time.size == 400
    assert recording.duration == pytest.approx(3.99)


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
