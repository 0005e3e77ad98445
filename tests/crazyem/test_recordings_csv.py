"""CSV flights: the real recordings, interpolated stretches, and files that are not what they claim to be."""

import csv
import gzip
import io
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import assert_same_signals, joined

from crazyem.errors import CrazyemError, DataError, FileFormatError
from crazyem.recordings import open_recording
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.csv import file as csv_file
from crazyem.recordings.csv.mapping import known_mappings
from crazyem.recordings.csv.signals import corners, interpolated_rows
from crazyem.signals.sample import ESTIMATOR_SIGNALS

NANOBENCH = [
    *("t", "px", "py", "pz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx_vicon"),
    *(f"imu_{sensor}_{axis}" for sensor in ("acc", "gyro") for axis in "xyz"),
    *(f"motor_motor_m{i}" for i in (1, 2, 3, 4)),
    "pwr_pm_vbat",
]
REQUIRED = ("position", "velocity", "attitude", "body_rate", "specific_force", "motor_command", "voltage")


def rows(count, seed=0):
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(count, len(NANOBENCH)))
    table[:, 0] = 1.7e9 + 0.01 * np.arange(count)
    table[:, -5:-1] = rng.integers(20_000, 60_000, (count, 4))
    return table


def text(table, header=NANOBENCH):
    return ",".join(header) + "\n" + "".join(",".join(f"{v:.9f}" for v in row) + "\n" for row in table)


def put(folder, content, name="flight.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_units_and_order(tmp_path):
    table = rows(20)
    recording = open_recording(put(tmp_path, gzip.compress(text(table).encode()), "flight.csv.gz"))
    recording.check(REQUIRED)
    assert recording.source == "csv:nanobench"
    column = {name: table[:, i] for i, name in enumerate(NANOBENCH)}
    signals = recording.signals
    assert signals["position"].value[:, 2] == pytest.approx(column["pz"], abs=1e-9)
    assert signals["specific_force"].value[:, 1] == pytest.approx(9.81 * column["imu_acc_y"], abs=1e-8)
    assert signals["body_rate"].value[:, 0] == pytest.approx(column["imu_gyro_x"], abs=1e-9)
    assert signals["motor_command"].value[:, 3] == pytest.approx(column["motor_motor_m4"] / 65535)
    assert signals["flying"].value[:, 0].tolist() == [1.0] * 20
    assert signals["position"].time[0] == 0.0
    assert signals["position"].host_time[3] == pytest.approx(1.7e9 + 0.03)
    samples = list(recording.samples())
    assert [s.time for s in samples] == sorted(s.time for s in samples)
    assert len(samples) == sum(recording.signals[n].time.size for n in recording.signals if n in ESTIMATOR_SIGNALS)
    assert recording.duration == pytest.approx(0.19)
    assert "The file has no columns for setpoint_position." in recording.notices


def test_interpolated_stretches_are_marked_and_not_held_against_the_file(tmp_path):
    table = rows(60)
    gap = slice(20, 26)  # 5 packets lost: rows 20..25 lie between two real ones
    imu = [NANOBENCH.index(c) for c in NANOBENCH if c.startswith("imu_")]
    for i in imu:
        table[gap, i] = np.interp(table[gap, 0], table[[19, 26], 0], table[[19, 26], i])
    recording = open_recording(put(tmp_path, text(table)))
    assert any("of the imu samples" in n for n in recording.notices)
    missing = np.flatnonzero(np.isnan(recording.signals["body_rate"].value).all(axis=1))
    assert missing.tolist() == list(range(19, 27))
    assert np.array_equal(recording.signals["specific_force"].marked, recording.signals["body_rate"].marked)
    assert not recording.signals["motor_command"].marked.any()
    recording.check(REQUIRED)


def test_nan_in_the_file_is_named(tmp_path):
    table = rows(30)
    table[7:9, NANOBENCH.index("imu_gyro_y")] = np.nan
    recording = open_recording(put(tmp_path, text(table)))
    with pytest.raises(DataError, match=r"body_rate is not a number in 2 of 30 samples, first at t = 0\.070 s"):
        recording.check(REQUIRED)
    assert math.isnan(recording.signals["body_rate"].value[7, 1])
    with pytest.raises(DataError, match="has no rotor_speed"):
        recording.check(["rotor_speed"])


def test_empty_fields_are_nan_and_a_cut_line_is_dropped(tmp_path):
    content = text(rows(10))
    lines = content.splitlines()
    lines[4] = lines[4].replace(lines[4].split(",")[1], "", 1)
    cut = "\n".join(lines)[:-30]
    recording = open_recording(put(tmp_path, cut))
    assert recording.signals["position"].time.size == 9
    assert math.isnan(recording.signals["position"].value[3, 0])
    assert any("cut short" in n for n in recording.notices)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a,b,c\n1,2,3\n", "of no known format"),
        (",".join(NANOBENCH) + "\n", "not a single sample"),
        (text(rows(3)).replace(",", ";", 40), "is not a recording|of no known format|fields"),
        (text(rows(3)).replace("px", "p", 1), "of no known format"),
        (text(rows(5)).replace(".", "x", 1), "is not a number"),
        ("host_t,block,fw_ms,name,value\n1,a,b,gyro.x,1\n", "not a firmware stamp|not a number"),
        ("host_t,block,fw_ms,name,value\n1,ref,0,ref.x,1\n", "not a single sample"),
        ("hello world\n", "is not a recording"),
        ("", "is empty"),
        (gzip.compress(text(rows(200)).encode())[:10_000], "gzip"),
    ],
)
def test_files_that_are_something_else(tmp_path, content, message):
    with pytest.raises(FileFormatError, match=message) as caught:
        open_recording(put(tmp_path, content))
    assert "flight.csv" in str(caught.value)


@given(content=st.text(alphabet="0123456789.,-enai\n \x00é", max_size=200), head=st.integers(0, 1))
def test_garbage_rows_never_raise_anything_else(tmp_path_factory, content, head):
    header = ("host_t,block,fw_ms,name,value", ",".join(NANOBENCH))[head]
    path = tmp_path_factory.getbasetemp() / "garbage.csv"
    path.write_text(header + "\n" + content, encoding="utf-8")
    try:
        list(open_recording(path).samples())
    except CrazyemError as error:
        message = str(error)
        assert "\n" not in message


@given(
    preset=st.sampled_from(["nanobench", "nanodrone_raw", "nanodrone_processed"]),
    values=st.lists(st.floats(), min_size=60, max_size=60),
    count=st.integers(1, 12),
    seconds=st.floats(0.0, 1e9),
)
def test_any_double_may_stand_in_a_file(tmp_path_factory, preset, values, count, seconds):
    mapping = next(m for m in known_mappings() if m.name == preset)
    names = list(dict.fromkeys([*mapping.recognise, *(c for s in mapping.signals.values() for c in s.columns)]))
    lines = [",".join(names)] + [
        ",".join(repr(values[(i * k + k) % 60]) for i in range(len(names))) for k in range(count)
    ]
    path = tmp_path_factory.getbasetemp() / "doubles.csv"
    path.write_text("\n".join(lines) + "\n")
    for options in (ReadOptions(), ReadOptions(as_published=True)):
        try:
            whole = csv_file.read(path, options)
        except CrazyemError:
            continue
        same(list(csv_file.read_parts(path, options, seconds)), whole)


# --- every way a table can be written --------------------------------------------------------------------------------

MINE = """
[time]
column = "t"
[signals.position]
columns = ["x", "y", "z"]
[signals.body_rate]
columns = ["p", "q", "r"]
packet = "imu"
[signals.voltage]
columns = ["v"]
corners = true
[signals.flying]
columns = ["x"]
above = 1.0
hold = 0.5
"""
NAMES = ["t", "x", "y", "z", "p", "q", "r", "v", "extra"]


def plain(content):
    """Columns of a sound CSV by the standard library: what the reader must agree with."""
    lines = list(csv.DictReader(io.StringIO(content)))
    return {name: np.array([float(line[name] or "nan") for line in lines]) for name in lines[0]}


def mine(folder, content):
    (folder / "mine.toml").write_text(MINE)
    return put(folder, content), ReadOptions(mapping=str(folder / "mine.toml"))


def table_text(count):
    table = np.random.default_rng(0).normal(size=(count, len(NAMES)))
    table[:, 0] = 1e3 + 0.01 * np.arange(count)
    return text(table, NAMES)


@given(
    rows=st.lists(st.lists(st.floats(allow_nan=False), min_size=8, max_size=8), min_size=1, max_size=30),
    seed=st.integers(0, 9),
    form=st.sampled_from(["plain", "crlf", "semicolon", "tab", "quoted", "bom", "gzip", "spaces"]),
)
def test_every_double_comes_back_exactly(tmp_path_factory, rows, seed, form):
    folder = tmp_path_factory.getbasetemp()
    delimiter = {"semicolon": ";", "tab": "\t"}.get(form, ",")
    stamps = np.cumsum(np.random.default_rng(seed).uniform(0.001, 0.02, len(rows))).tolist()
    fields = [[repr(t), *map(repr, row)] for t, row in zip(stamps, rows)]
    if form == "quoted":
        fields = [[f'"{f}"' for f in row] for row in fields]
    if form == "spaces":
        fields = [[f" {f} " for f in row] for row in fields]
    end = "\r\n" if form == "crlf" else "\n"
    content = end.join(delimiter.join(row) for row in [NAMES, *fields]) + end
    raw = ("\ufeff" if form == "bom" else "").encode() + content.encode()
    path, options = mine(folder, gzip.compress(raw) if form == "gzip" else raw)
    recording = open_recording(path, options)
    assert (recording.origin + recording.signals["position"].time).tolist() == stamps
    assert recording.signals["position"].value.tolist() == [row[:3] for row in rows]
    assert recording.signals["extra"].value[:, 0].tolist() == [row[7] for row in rows]


def test_stamps_that_do_not_survive_subtraction_keep_their_origin_at_zero(tmp_path):
    stamps = [5e4 / 3, 0.1, 0.3]  # a clock that was set
    content = "t,x,y,z\n" + "".join(f"{t!r},0,0,0\n" for t in stamps)
    recording = open_recording(*mine(tmp_path, content))
    assert recording.signals["position"].time.tolist() == stamps
    assert recording.origin == 0.0


def test_decimal_commas_words_duplicates_and_nameless_columns(tmp_path):
    content = "t;x;y;z;x;mode;;ok\n" + "".join(f"0,{i:02};1,5;2;3;{i};up;;true\n" for i in range(20))
    recording = open_recording(*mine(tmp_path, content))
    signals = recording.signals
    assert signals["position"].value[3].tolist() == [1.5, 2.0, 3.0]
    assert signals["position"].time[3] == 0.03
    assert signals["x#2"].value[7, 0] == 7.0
    assert signals["ok"].value[:, 0].tolist() == [1.0] * 20
    assert not {"mode", "column 7"} & signals.keys()
    assert any("x; the first one counts" in n for n in recording.notices)
    assert any("mode" in n for n in recording.notices)


def test_a_few_damaged_lines_cost_themselves_only(tmp_path):
    lines = table_text(1000).splitlines()
    expected = plain("\n".join(lines))
    damaged = {101: "1,2", 340: lines[340].replace(lines[340].split(",")[2], "oops", 1), 700: "," + lines[700][5:]}
    content = "\n".join(damaged.get(i, line) for i, line in enumerate(lines)) + "\n"
    recording = open_recording(*mine(tmp_path, content))
    kept = [i for i in range(1000) if i + 1 not in damaged]
    assert recording.signals["position"].value[:, 1].tolist() == expected["y"][kept].tolist()
    (found,) = [f for f in recording.findings if f.check == "integrity"]
    assert found.grade == "degrades"
    assert found.evidence == {"lines": 3.0}
    assert "line 102, 341, 701" in found.text
    assert "line 102 has 2 fields, the header has 9" in found.text


def test_a_word_in_a_column_nobody_needs_is_a_hole_in_it(tmp_path):
    lines = table_text(300).splitlines()
    lines[250] = lines[250].rpartition(",")[0] + ",broken"
    recording = open_recording(*mine(tmp_path, "\n".join(lines) + "\n"))
    assert np.flatnonzero(np.isnan(recording.signals["extra"].value[:, 0])).tolist() == [249]
    assert any("1 values in column extra are no numbers" in n for n in recording.notices)


def test_a_gzip_file_that_ends_early_gives_what_it_has(tmp_path):
    packed = gzip.compress(table_text(5000).encode())
    path, options = mine(tmp_path, packed[: len(packed) * 2 // 3])
    recording = open_recording(path, options)
    count = recording.signals["position"].time.size
    assert 2500 < count < 3500
    assert np.array_equal(recording.signals["position"].value[:, 0], plain(table_text(5000))["x"][:count])
    assert any("ends early" in n for n in recording.notices)
    corrupt = bytearray(packed)
    corrupt[len(packed) // 2] ^= 0xFF
    path.write_bytes(corrupt)
    with pytest.raises(FileFormatError, match=r"gzip|not a number|fields"):
        open_recording(path, options)


def test_a_gzip_bomb_is_refused_and_never_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("crazyem.recordings.csv.text._SMALL_TEXT", 4 << 20)
    header = ",".join(NAMES) + "\n"
    row = ",".join("0" * 9) + "\n"
    path, options = mine(tmp_path, gzip.compress((header + row * 800_000).encode()))
    assert path.stat().st_size < 50_000
    with pytest.raises(FileFormatError, match="unpacks to more than 200 times its size"):
        open_recording(path, options)
    path.write_bytes(gzip.compress((header + "1" * 4_000_000).encode()))
    with pytest.raises(FileFormatError, match="line of more than"):
        open_recording(path, options)


def test_rows_without_stamps_need_a_rate(tmp_path):
    (tmp_path / "rate.toml").write_text('[time]\nrate_hz = 50\n[signals.voltage]\ncolumns = ["v"]\n')
    path = put(tmp_path, "v,w\n" + "".join(f"{3.7 + 0.1 * i},0\n" for i in range(10)))
    recording = open_recording(path, ReadOptions(mapping=str(tmp_path / "rate.toml")))
    assert recording.signals["voltage"].time == pytest.approx(np.arange(10) / 50)
    assert any("no stamps" in n for n in recording.notices)


# --- parts -----------------------------------------------------------------------------------------------------------


def same(parts, whole):
    assert {p.origin for p in parts} == {whole.origin}
    assert_same_signals(joined(parts), whole.signals)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 3.0))
def test_parts_joined_are_the_whole(tmp_path_factory, seed, seconds):
    rng = np.random.default_rng(seed)
    count = 400
    table = rng.normal(size=(count, len(NAMES)))
    table[:, 0] = 5.0 + np.cumsum(rng.uniform(0.005, 0.02, count))
    for start in rng.integers(0, count - 20, 12):  # lost packets, on borders too
        gap = slice(start, start + int(rng.integers(3, 15)))
        for c in (4, 5, 6):
            ends = [gap.start, min(gap.stop, count - 1)]
            table[gap, c] = np.interp(table[gap, 0], table[ends, 0], table[ends, c])
    table[:, 7] = np.interp(table[:, 0], np.arange(0, 20, 0.1), 4 + rng.normal(0, 0.01, 200))
    path, options = mine(tmp_path_factory.getbasetemp(), text(table, NAMES))
    whole = csv_file.read(path, options)
    parts = list(csv_file.read_parts(path, options, seconds))
    assert len(parts) >= min(2, int((table[-1, 0] - table[0, 0]) / seconds))
    same(parts, whole)


# --- the real ones --------------------------------------------------------------------------------------------------


def test_real_firmware_long_form(shared_recordings):
    recording = open_recording(shared_recordings / "real_firmware" / "lee_34g_mass_pushed_midflight.csv.gz")
    recording.check([*REQUIRED, "wrench_command", "flying", "setpoint_position"])
    assert recording.source == "csv:crazyflie_long"
    assert recording.signals["position"].time[0] == 8.518
    assert recording.duration == pytest.approx(22.2, abs=0.05)
    assert recording.signals["setpoint_position"].value[:, 2] == pytest.approx(1.0, abs=0.2)
    flying = recording.signals["flying"].value[:, 0]
    assert 0.5 < flying.mean() < 1.0
    samples = list(recording.samples())
    hosts = [s.host_time for s in samples]
    assert hosts == sorted(hosts)  # order of arrival


# --- straight lines: lost packets are found, slow streams get their samples back ---


@given(st.integers(0, 2**32 - 1), st.integers(2, 8))
def test_exactly_the_straight_runs_are_found(seed, gap):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.009, 0.011, 50))
    values = rng.normal(size=(50, 3))
    inner = slice(10, 10 + gap)
    for c in range(3):
        values[inner, c] = np.interp(time[inner], time[[9, 10 + gap]], values[[9, 10 + gap], c])
    found = np.flatnonzero(interpolated_rows(time, np.round(values, 9)))
    assert found.tolist() == list(range(9, 11 + gap))


def test_constant_stretches_are_no_evidence():
    time = 0.01 * np.arange(30)
    assert not interpolated_rows(time, np.zeros((30, 4))).any()
    assert not interpolated_rows(time[:2], np.zeros((2, 4))).any()
    one_moves = np.zeros((30, 2))
    one_moves[:, 0] = np.linspace(0, 1, 30)
    assert interpolated_rows(time, one_moves).all()


# --- streams drawn by straight lines ---------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(4, 12))
def test_a_drawn_stream_gets_its_samples_back(seed, every):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.0099, 0.0101, 400))
    knots = np.arange(time[0] - 0.01 * every, time[-1] + 0.02 * every, 0.01 * every) + rng.uniform(0, 0.01)
    levels = 4.0 + np.cumsum(rng.choice([-2, -1, 1, 2], knots.size) * 5.3e-3 * rng.uniform(0.5, 1.0, knots.size))
    found = corners(time, np.round(np.interp(time, knots, levels), 9))
    inside = (knots > time[1]) & (knots < time[-2])
    slopes = np.diff(levels) / np.diff(knots)
    told = np.abs(np.diff(slopes, prepend=slopes[0], append=slopes[-1])) > 1e-3  # V/s; a straight line has no corner
    wanted = np.flatnonzero(inside & told[: knots.size])
    place = np.searchsorted(found.time, knots[wanted] - 1e-3)
    assert found.time[place] == pytest.approx(knots[wanted], abs=2e-5)
    assert found.value[place] == pytest.approx(levels[wanted], abs=1e-6)
    assert (np.diff(found.row) > 0).all()
    # and nothing else is taken for a sample. Two lines of rounded rows (5e-10) meet within 2e-9 over the bend. A corner
    # is put on a row if the next row is off its neighbours' line, by half of way times bend, no more than 4e-9 + 1e-9
    nearest = np.abs(found.time[:, None] - knots).argmin(axis=1)
    bend = np.abs(np.diff(slopes))[nearest - 1]
    assert (np.abs(found.time - knots[nearest]) * bend).max() < 2 * 5e-9
    drawn = np.interp(time, found.time, found.value)[found.row[0] + 1 : found.row[-1]]
    assert drawn == pytest.approx(np.interp(time, knots, levels)[found.row[0] + 1 : found.row[-1]], abs=1.05e-8)


def test_streams_that_nobody_drew_keep_their_rows():
    rng = np.random.default_rng(3)
    time, noise = 0.01 * np.arange(300), rng.normal(size=300)
    found = corners(time, noise)
    assert found.row.tolist() == list(range(300))
    assert found.value.tolist() == noise.tolist()
    still = corners(time, np.full(300, 3.7))
    assert (still.row.tolist(), still.value.tolist()) == ([0], [3.7])
    short = corners(time[:3], noise[:3])
    assert short.value.tolist() == noise[:3].tolist()
