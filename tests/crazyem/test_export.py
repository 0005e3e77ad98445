"""Export to CSV and Parquet and back: no sample, stamp, mark or unit is lost; read a second time by plain slow code."""

import csv
import json
import math
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from any_recording import recordings, same, sequence, word
from hypothesis import given
from hypothesis import strategies as st
from made_flight import made_flight
from recording_files import assert_same_signals, joined

from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.recordings import Grade, ReadOptions, Recording, SignalArray, open_recording
from crazyem.recordings.csv.exported import read, read_parts
from crazyem.recordings.export import METADATA_SUFFIX, export, export_parts
from crazyem.recordings.registry import free_memory, is_large, open_parts

ODD = [
    "pm.vbatMV", "a,b", 'quote"d', "two\nlines", "tab\t", "Größe", "time", "host_time", "position_x", "x [m]", "",
    " ", "\x1b[31m", "a", "a#2", "a_marked", "a_0", "\ud800", "=1+1", "position_marked", "nan",
]  # fmt: skip


def samples_in(rows: Iterable[Sequence[Any]], entries: list[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
    """The samples in the rows of a table, cell by cell; a cell without a value is None."""
    for time, host, *cells in rows:
        for entry in entries:
            values = [cells.pop(0) for _ in entry["components"]]
            flag = cells.pop(0) if entry["marked"] else None if None in values else False
            absent = [value is None for value in (*values, flag)]
            assert all(absent) or not any(absent)
            if not any(absent):
                numbers = tuple(word(float(value)) for value in values)
                host_time = math.nan if host is None else float(host)
                yield entry["name"], word(float(time)), numbers, word(host_time), bool(int(flag))


def slow(path: Path) -> list[tuple[Any, ...]]:
    """The samples of an exported CSV in order, with the standard library and the description alone."""
    description = json.loads(Path(f"{path}{METADATA_SUFFIX}").read_text())
    with path.open(encoding="utf-8", newline="") as file:
        titles, *rows = csv.reader(file)
    assert titles == [column["titles"] for column in description["tableSchema"]["columns"]]
    cells = [[cell or None for cell in row] for row in rows]
    return list(samples_in(cells, description["notes"][0]["crazyem"]["signals"]))


UNITS = st.sampled_from(["", "mm", "%", "a]b", "m, [s]", 'name = "x"\n', "ü"])
any_recording = recordings(st.sampled_from(ODD), UNITS | st.text(max_size=5))


@given(any_recording)
def test_round_trip_through_csv_loses_nothing(recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.csv"
        export(recording, path)
        same(recording, read(path, ReadOptions()))
        assert slow(path) == sequence(recording)
        again = Path(folder) / "again.csv"
        export(read(path, ReadOptions()), again)
        assert again.read_bytes() == path.read_bytes()


def test_a_stamp_that_is_no_number_is_one_whatever_its_bits(tmp_path: Path) -> None:
    other = np.array([math.nan]).view(np.int64) ^ 1
    one, two = (
        SignalArray(time, np.zeros((1, 1)), np.array([order]), np.full(1, math.nan), np.zeros(1, bool), "", "", "",
                    "", "s", (name,))
        for name, time, order in (("a", np.array([math.nan]), 0), ("b", other.view(np.float64), 1))
    )  # fmt: skip
    recording = Recording("there", "made:up", {"a": one, "b": two}, {}, (), (), 0.0)
    export(recording, tmp_path / "out.csv")
    export(read(tmp_path / "out.csv", ReadOptions()), tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "out.csv").read_bytes()


@given(any_recording)
def test_parquet_holds_every_sample(recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.parquet"
        export(recording, path)
        table = pq.read_table(path)
    entries = json.loads(table.schema.metadata[b"crazyem"])["signals"]
    assert len(set(table.column_names)) == table.num_columns
    rows = zip(*(column.to_pylist() for column in table.columns), strict=True)
    assert list(samples_in(rows, entries)) == sequence(recording)


def test_pandas_finds_the_units_in_parquet(tmp_path: Path) -> None:
    recording = made_flight(seconds=3.0)
    export(recording, tmp_path / "f.parquet")
    table = pd.read_parquet(tmp_path / "f.parquet")
    assert table.attrs["units"]["body_rate_x"] == "rad/s"
    assert table.attrs["frames"]["body_rate_x"] == "body FLU"
    assert table.attrs["clocks"]["position_x"] == "firmware"
    assert table.attrs["recording"] == "made"
    rate = table["body_rate_z"].dropna()
    assert np.array_equal(rate.to_numpy(), recording.signals["body_rate"].value[:, 2])
    field = pq.read_schema(tmp_path / "f.parquet").field("specific_force_x")
    assert field.metadata[b"unit"] == b"m/s^2"


def test_csvw_description_names_every_column(tmp_path: Path) -> None:
    recording = made_flight(seconds=1.0)
    export(recording, tmp_path / "f.csv")
    told = json.loads((tmp_path / f"f.csv{METADATA_SUFFIX}").read_text())
    assert told["@context"] == "http://www.w3.org/ns/csvw"
    assert told["url"] == "f.csv"
    columns = {c["titles"]: c for c in told["tableSchema"]["columns"]}
    assert columns["specific_force_z [m/s^2]"]["schema:unitText"] == "m/s^2"
    assert columns["specific_force_z [m/s^2]"]["dc:description"] == "body FLU"
    assert len({c["name"] for c in columns.values()}) == len(columns)


def test_without_its_description_the_numbers_and_units_stay(tmp_path: Path) -> None:
    recording = made_flight(seconds=1.0, more=["mocap"])
    marked = np.zeros(recording.signals["voltage"].time.size, bool)
    marked[3] = True
    recording = replace(
        recording, signals={**recording.signals, "voltage": replace(recording.signals["voltage"], marked=marked)}
    )
    path = tmp_path / "f.csv"
    export(recording, path)
    Path(f"{path}{METADATA_SUFFIX}").unlink()
    found = open_recording(path)
    assert sequence(found) == sequence(recording)
    for name, array in found.signals.items():
        assert (array.quantity, array.unit, array.frame) == (
            recording.signals[name].quantity, recording.signals[name].unit, recording.signals[name].frame,
        )  # fmt: skip
    assert [f.grade for f in found.findings] == [Grade.DEGRADES]


def test_a_description_of_another_file_is_not_believed(tmp_path: Path) -> None:
    export(made_flight(seconds=1.0), tmp_path / "a.csv")
    export(made_flight(seconds=1.0, more=["rpm"]), tmp_path / "b.csv")
    beside = Path(f"{tmp_path / 'a.csv'}{METADATA_SUFFIX}")
    beside.write_bytes(Path(f"{tmp_path / 'b.csv'}{METADATA_SUFFIX}").read_bytes())
    assert any("other columns" in f.text for f in open_recording(tmp_path / "a.csv").findings)


@pytest.mark.slow
def test_parts_add_up_to_the_whole(tmp_path: Path) -> None:
    recording = made_flight(seconds=120.0, more=["rpm"])
    path, second = tmp_path / "f.csv", tmp_path / "g.csv"
    export(recording, path)
    whole = read(path, ReadOptions())
    parts = list(read_parts(path, ReadOptions(), seconds=20.0))
    assert len(parts) > 1
    assert_same_signals(joined(parts), whole.signals)
    export_parts(lambda: open_parts(path), second)
    assert second.read_bytes() == path.read_bytes()
    same(whole, open_recording(second))


def test_nothing_is_written_over_or_left_half(tmp_path: Path) -> None:
    recording = made_flight(seconds=1.0)
    path = tmp_path / "f.csv"
    path.write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        export(recording, path)
    assert path.read_text() == "mine"
    export(recording, path, force=True)
    assert path.read_text().startswith("time [s],")

    def broken() -> Iterator[Recording]:
        yield recording
        raise FileFormatError("cut.")

    with pytest.raises(FileFormatError):
        export_parts(broken, tmp_path / "g.parquet")
    with pytest.raises(UsageError, match=r"ends in \.csv or \.parquet"):
        export(recording, tmp_path / "f.xlsx")
    with pytest.raises(UsageError, match="cannot write"):
        export(recording, tmp_path / "none" / "f.csv")
    (tmp_path / "d.csv").mkdir()
    with pytest.raises(UsageError, match="directory"):
        export(recording, tmp_path / "d.csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.csv", "f.csv", f"f.csv{METADATA_SUFFIX}"]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "f.csv"
    export(made_flight(seconds=1.0), path)
    return path


def test_cut_anywhere_it_is_read_to_its_last_whole_line(exported: Path, tmp_path: Path) -> None:
    data, beside = exported.read_bytes(), Path(f"{exported}{METADATA_SUFFIX}").read_bytes()
    whole = sequence(open_recording(exported))
    path = tmp_path / "f.csv"
    Path(f"{path}{METADATA_SUFFIX}").write_bytes(beside)
    header = data.index(b"\n") + 1
    for end in range(header, len(data), 997):
        path.write_bytes(data[:end])
        if b"\n" not in data[header:end]:
            with pytest.raises(FileFormatError, match="not a single sample"):
                open_recording(path)
            continue
        found = open_recording(path)
        assert sequence(found) == whole[: len(sequence(found))]
        assert bool(found.findings) == (data[end - 1 : end] != b"\n")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time [s],host_time [s],voltage [V]\n0,,4\nsoon,,4\n", "soon"),
        ("time [s],host_time [s],voltage [V]\n0,,4\n1,,4,5\n", "Expected 3 columns, got 4"),
        ("time [s],host_time [s],voltage [V]\n0,,4\n,,4\n", "row 3 has no time"),
        ("time [s],host_time [s],voltage [V]\n", "not a single sample"),
        ("time [s],host_time [s]\n0,\n", "not the header"),
        ('time [s],host_time [s],"voltage\n0,,4\n', "line 1"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "f.csv"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=says) as caught:
        read(path, ReadOptions())
    assert str(path) in str(caught.value)


def complaint(path: Path) -> str:
    """The kind of error that reading ends with, which names the file; "" if it was read."""
    try:
        read(path, ReadOptions())
    except CrazyemError as error:
        if path.name not in str(error):
            raise
        return type(error).__name__
    return ""


@given(st.data())
def test_a_damaged_description_is_one_sentence(exported: Path, data: st.DataObject) -> None:
    """Any value of the description replaced by any other: read, or refused with the file's name."""
    told = json.loads(Path(f"{exported}{METADATA_SUFFIX}").read_text())
    junk = st.none() | st.integers() | st.floats() | st.text(max_size=3) | st.just([]) | st.just({}) | st.just([[1, 2]])
    node = told["notes"][0]
    key: Any = "crazyem"
    while isinstance(node[key], dict | list) and node[key] and data.draw(st.booleans()):
        node = node[key]
        key = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else list(range(len(node)))))
    node[key] = data.draw(junk)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "f.csv"
        path.write_bytes(exported.read_bytes())
        Path(f"{path}{METADATA_SUFFIX}").write_text(json.dumps(told))
        assert complaint(path) in ("", "FileFormatError")


def test_what_is_large_depends_on_the_memory_that_is_free(tmp_path: Path) -> None:
    path = tmp_path / "f.bin"
    path.write_bytes(b"x")
    assert not is_large(path)
    with path.open("r+b") as file:
        file.truncate(int(free_memory() * 0.3))  # a hole, takes no space
    assert is_large(path)
    assert is_large(path, jobs=4)
    assert not is_large(tmp_path)
