"""--from and --to: a piece of a recording gives what a file gives that was cut beforehand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import made_flight
from recording_files import joined

from crazyem.cli import main
from crazyem.errors import UsageError
from crazyem.recordings import Event, Finding, Fix, Grade, ReadOptions, Recording, SignalArray, open_recording
from crazyem.recordings.export import METADATA_SUFFIX, export
from crazyem.recordings.registry import cut, cut_parts, open_parts


def array(time: np.ndarray, stream: str = "s") -> SignalArray:
    n = time.size
    return SignalArray(time, time[:, None] * 2.0, np.arange(n), 1.7e9 + time, np.zeros(n, bool), stream=stream)


def recording(**more: object) -> Recording:
    signals = {"a": array(np.arange(0.0, 10.0, 0.1)), "b": array(np.arange(0.05, 10.0, 0.5), "t")}
    return replace(Recording("there", "made:up", signals), **more)


@given(st.floats(0.0, 4.9), st.floats(5.0, 12.0))
def test_a_piece_holds_the_samples_between_its_ends_and_no_others(start: float, end: float) -> None:
    whole = recording()
    piece = cut(whole, start, end)
    for name, signal in whole.signals.items():
        inside = [t for t in signal.time.tolist() if start <= t <= end]
        assert piece.signals[name].time.tolist() == inside
        assert piece.signals[name].value[:, 0].tolist() == [2.0 * t for t in inside]
    assert cut(piece, start, end).signals["a"].time.size == piece.signals["a"].time.size


def test_findings_and_events_outside_are_left_out_and_rows_are_counted_anew() -> None:
    marks = Fix("mark", ("a",), rows=np.array([10, 50, 51]))
    findings = (
        Finding("gaps", Grade.HARMLESS, "early", intervals=((0.0, 1.0),)),
        Finding("gaps", Grade.HARMLESS, "inside", intervals=((4.0, 5.5),)),
        Finding("interpolated", Grade.DEGRADES, "rows", fix=marks),
        Finding("unit", Grade.DEGRADES, "two streams", fix=Fix("mark", ("a", "b"), rows=np.array([1]))),
    )
    events = (*(Event(1.7e9 + t, "setpoint", {}) for t in (1.0, 6.0)), Event(0.0, "log", {"message": "x"}))
    counted = {"statistics": {"received": "99", "lost": "3"}, "run": {"seed": "1"}}
    piece = cut(recording(findings=findings, events=events, metadata=counted), 4.95, None)
    assert [f.text for f in piece.findings] == ["inside", "rows", "two streams"]
    assert [f.fix.rows.tolist() for f in piece.findings if f.fix and f.fix.rows is not None] == [[0, 1]]
    assert [e.time for e in piece.events] == [1.7e9 + 6.0, 0.0]
    assert piece.metadata == {"run": {"seed": "1"}}


@pytest.mark.parametrize(("start", "end", "words"), [(20.0, None, "0.000 to 9.900"), (3.0, 3.0, "not before")])
def test_limits_without_anything_between_them_are_an_error(start: float, end: float | None, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        cut(recording(), start, end)
    with pytest.raises(UsageError):
        list(cut_parts(iter([recording()]), start, end))


def test_a_piece_is_the_file_that_was_cut_beforehand(tmp_path: Path) -> None:
    """A file whose rows before and after were deleted, and the piece, read whole, in parts, and imported."""
    whole, beforehand = tmp_path / "whole.csv", tmp_path / "cut.csv"
    export(made_flight(seconds=8.0), whole)
    header, *rows = whole.read_text().splitlines()
    kept = [row for row in rows if 3.0 <= float(row.split(",")[0]) <= 5.0]
    beforehand.write_text("\n".join([header, *kept]) + "\n")
    Path(f"{beforehand}{METADATA_SUFFIX}").write_bytes(Path(f"{whole}{METADATA_SUFFIX}").read_bytes())
    imported, options = tmp_path / "piece.mcap", ReadOptions(start=3.0, end=5.0)
    assert main(["import", str(whole), "-o", str(imported), "--from", "3", "--to", "5"]) == 0
    in_parts = joined(list(open_parts(whole, options, seconds=1.0)))
    pieces = [in_parts, open_recording(imported).signals, open_recording(whole, options).signals]
    for name, signal in open_recording(beforehand).signals.items():
        for piece in pieces:
            np.testing.assert_array_equal(piece[name].time, signal.time)
            np.testing.assert_array_equal(piece[name].value, signal.value)
