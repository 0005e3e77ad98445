"""Stamps that cannot be: good recordings with bad stamps put in give the good ones back, with one finding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.stamps import (
    Fault,
    believed,
    clock_offset,
    finding,
    impossible,
    out_of_order,
    restarts,
    screened,
    screened_parts,
)

Column = NDArray[np.float64]
wild = st.sampled_from([4e18, 1.8e13, -7e6, np.nan, np.inf, 1.7e9])


@st.composite
def clocks(draw: st.DrawFn, least: int = 20) -> Column:
    """Stamps in order: a start, steps of a rate with jitter, perhaps a gap."""
    count = draw(st.integers(least, 120))
    period = draw(st.sampled_from([0.001, 0.01, 0.5, 2.0]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    steps = period * rng.uniform(0.5, 1.5, count)
    steps[draw(st.integers(6, count - 6))] += draw(st.sampled_from([0.0, 0.0, 30.0]))
    return draw(st.sampled_from([10.0, 5000.0])) + np.cumsum(steps)


def array(time: Column, *, stream: str = "s") -> SignalArray:
    n = time.size
    value = np.arange(n, dtype=float)[:, None]
    return SignalArray(time, value, np.arange(n), np.full(n, np.nan), np.zeros(n, bool), clock="c", stream=stream)


def with_bad(time: Column, bad: dict[int, float]) -> tuple[Column, NDArray[np.bool_]]:
    """Stamps with others put in before some rows, and where these are."""
    rows = sorted(bad)
    longer = np.insert(time, rows, [bad[row] for row in rows])
    flags = np.insert(np.zeros(time.size, bool), rows, True)
    return longer, flags


@given(clocks(), st.dictionaries(st.integers(0, 20), wild, max_size=3))
def test_wild_stamps_are_found_and_nothing_else(time: Column, bad: dict[int, float]) -> None:
    longer, flags = with_bad(time, bad)
    np.testing.assert_array_equal(impossible(longer), flags)


@given(clocks(), st.sets(st.integers(0, 20), max_size=8))
def test_the_stamp_that_says_there_is_none_is_found_anywhere(time: Column, rows: set[int]) -> None:
    longer, flags = with_bad(time, dict.fromkeys(rows, 0.0))
    np.testing.assert_array_equal(impossible(longer, absent=0.0), flags)


@given(clocks(), st.sets(st.integers(0, 118), max_size=5), st.floats(0.0, 0.9))
def test_records_that_come_late_by_less_than_a_second_are_not_wild(time: Column, rows: set[int], late: float) -> None:
    time = time.copy()
    for row in rows:
        if 0 < row < time.size:
            time[row] = max(time[row] - late, time[0])
    assert not out_of_order(time).any()


@given(clocks(), st.floats(5.0, 4000.0))
def test_a_clock_that_starts_again_is_no_wild_stamp_and_is_found(first: Column, back: float) -> None:
    again = first - (first[-1] - first[0]) - back
    time = np.concatenate([first, again])
    assert not impossible(time).any()
    (row,) = restarts(time)
    assert row == first.size


@given(clocks(), st.integers(2, 18))
def test_a_stamp_far_back_among_others_is_found(time: Column, row: int) -> None:
    longer, flags = with_bad(time, {row: float(time[0]) - 3000.0})
    np.testing.assert_array_equal(impossible(longer), flags)


@given(clocks(), st.dictionaries(st.integers(3, 17), wild, min_size=1, max_size=3))
def test_a_recording_without_the_wild_samples_is_the_good_one_with_one_finding(
    time: Column, bad: dict[int, float]
) -> None:
    good = Recording("f", "test", {"a": array(time), "b": array(time[::2], stream="t")})
    longer, flags = with_bad(time, bad)
    value = np.full((longer.size, 1), -1.0)
    value[~flags] = good.signals["a"].value
    odd = replace(array(longer), value=value)
    found = screened(replace(good, signals={**good.signals, "a": odd}))
    np.testing.assert_array_equal(found.signals["a"].time, time)
    np.testing.assert_array_equal(found.signals["a"].value, good.signals["a"].value)
    (told,) = found.findings
    assert told.evidence["records"] == len(bad)
    assert screened(good) is good


@given(clocks(least=40), st.dictionaries(st.integers(5, 35), wild, max_size=3), st.integers(5, 30))
def test_parts_are_screened_as_the_whole(time: Column, bad: dict[int, float], cut: int) -> None:
    longer, _ = with_bad(time, bad)
    whole = Recording("f", "test", {"a": array(longer)})
    pieces = [
        replace(whole, signals={"a": whole.signals["a"].rows(np.arange(a, b))})
        for a, b in ((0, cut), (cut, longer.size))
    ]
    parts, expected = list(screened_parts(iter(pieces))), screened(whole)
    joined = np.concatenate([p.signals["a"].time for p in parts])
    np.testing.assert_array_equal(joined, expected.signals["a"].time)
    assert [f.text for p in parts for f in p.findings] == [f.text for f in expected.findings]


@given(clocks(), st.sampled_from([1.7e9, -1.7e9, 4e5]))
def test_a_stream_of_another_clock_comes_back_to_where_it_was(time: Column, ahead: float) -> None:
    """Its records stand in the file between those of the others, sampled at the same instants."""
    places = np.arange(3 * time.size, dtype=float)
    names, sets = ["a", "b", "c"], [time, time, time + ahead]
    keep, shifts, faults = believed(names, sets, [places[0::3], places[1::3], places[2::3]])
    assert all(k.all() for k in keep)
    assert shifts[:2] == [0.0, 0.0]
    step = float(np.max(np.diff(time)))
    assert abs(shifts[2] + ahead) <= step + 1e-6
    (fault,) = faults
    assert (fault.stream, fault.what, fault.count) == ("c", "shifted", time.size)


def test_a_stream_that_runs_at_another_rate_is_not_shifted() -> None:
    time = np.arange(0.0, 30.0, 0.01)
    assert clock_offset(1e9 + 1000.0 * time, time, time, time) is None


def test_one_finding_for_all_and_none_without_faults() -> None:
    assert finding([]) == []
    faults = [Fault(f"s{i}", 2, 10, "left out", 4e18) for i in range(9)]
    (told,) = finding(faults, ["a", "a", "b"])
    assert told.evidence == {"records": 18.0, "streams": 9.0}
    assert "4 more streams" in told.text
    assert told.fix is not None
    assert told.fix.signals == ("a", "b")


def test_a_stream_without_any_stamps_says_so() -> None:
    (told,) = finding([Fault("home", 12, 12, "left out", 0.0)])
    assert "home has no stamps" in told.text
    assert str(told.grade) == "degrades"


def test_csv_rows_with_wild_stamps_are_left_out(tmp_path: Path) -> None:
    from crazyem.recordings import ReadOptions, open_recording

    (tmp_path / "map.toml").write_text('[time]\ncolumn = "t"\n[signals.position]\ncolumns = ["x", "y", "z"]\n')
    rows = [f"{0.01 * k!r},{k},0,0" for k in range(50)]
    options = ReadOptions(mapping=str(tmp_path / "map.toml"))
    good, odd = tmp_path / "good.csv", tmp_path / "odd.csv"
    good.write_text("\n".join(["T,x,y,z", *rows]) + "\n")  # and the column of time in another case
    odd.write_text("\n".join(["t,x,y,z", *rows[:20], "4e12,0,0,0", *rows[20:], "9e9,0,0,0"]) + "\n")
    expected, found = open_recording(good, options), open_recording(odd, options)
    np.testing.assert_allclose(found.signals["position"].time, expected.signals["position"].time, atol=1e-12)
    np.testing.assert_array_equal(found.signals["position"].value, expected.signals["position"].value)
    assert [f.evidence["records"] for f in found.findings if f.check == "stamps"] == [2]


def test_what_the_reader_found_and_what_the_rule_finds_are_one_finding() -> None:
    time = np.arange(0.0, 5.0, 0.01)
    time[[20, 300]] = 4e12
    first = finding([Fault("block", 2, 9, "left out", 4e7)], ["b"])
    (told,) = screened(Recording("f", "test", {"a": array(time)}, findings=tuple(first))).findings
    assert told.evidence == {"records": 4.0, "streams": 2.0}
    assert "2 of 9 records of block" in told.text
    assert "2 of 500 records of s" in told.text
    assert told.fix is not None
    assert told.fix.signals == ("b", "a")
