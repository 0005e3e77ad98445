"""CSV flights: the real recordings, interpolated stretches, and files that are not what they claim to be."""

import gzip
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyem.errors import CrazyemError, DataError, FileFormatError
from crazyem.recordings import open_recording
from crazyem.recordings.interpolation import interpolated_rows
from crazyem.recordings.mapping import known_mappings, load_mapping
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
    path.write_text(content)
    return path


def test_units_and_order(tmp_path):
    table = rows(20)
    path = tmp_path / "flight.csv.gz"
    path.write_bytes(gzip.compress(text(table).encode()))
    recording = open_recording(path)
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
    ],
)
def test_files_that_are_something_else(tmp_path, content, message):
    with pytest.raises(FileFormatError, match=message) as caught:
        open_recording(put(tmp_path, content))
    assert "flight.csv" in str(caught.value)


def test_a_cut_gzip_file_is_one_sentence(tmp_path):
    packed = gzip.compress(text(rows(200)).encode())
    path = tmp_path / "flight.csv.gz"
    path.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(FileFormatError, match="gzip"):
        open_recording(path)


@settings(max_examples=200, deadline=None)
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


# --- mappings -------------------------------------------------------------------------------------------------------


def test_shipped_mappings_load():
    assert {m.name for m in known_mappings()} >= {"nanobench", "crazyflie_long"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('unit = "g"', 'unit = "stone"'), 'unknown unit "stone"'),
        (("[signals.position]", "[signals.positon]"), "no such signal"),
        (('columns = ["px", "py", "pz"]', 'columns = ["px"]'), "position has 3 components, not 1"),
        (('layout = "wide"', 'layout = "tall"'), "layout must be"),
        (('column = "t"', ""), "the key column is missing"),
        (("[time]", "[time"), "not valid TOML"),
        (('columns = ["px", "py", "pz"]', 'columns = "px"'), "columns must be a list"),
    ],
)
def test_a_broken_mapping_names_the_key(change, message):
    from importlib import resources

    source = (resources.files("crazyem.recordings") / "mappings" / "nanobench.toml").read_text(encoding="utf-8")
    assert change[0] in source
    with pytest.raises(FileFormatError, match=message) as caught:
        load_mapping(source.replace(*change, 1), "mine.toml")
    assert "mine.toml" in str(caught.value)


# --- the real ones --------------------------------------------------------------------------------------------------


def test_all_nanobench_flights(shared_recordings):
    flights = sorted((shared_recordings / "nanobench").glob("*.csv.gz"))
    assert len(flights) == 13
    for path in flights:
        recording = open_recording(path)
        recording.check(REQUIRED)
        q = recording.signals["attitude"].value
        assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=1e-3)
        force = np.linalg.norm(recording.signals["specific_force"].value, axis=1)
        assert np.nanmedian(force) == pytest.approx(9.81, abs=0.7)
        for packet in ("body_rate", "motor_command"):
            lost = recording.signals[packet].marked.mean()
            # one flight's onboard log died 10 s in: 23 s of it are a single straight line
            assert lost > 0.7 if "B9_trefoil_fast_rep1" in path.name else lost < 0.3


def test_nanobench_gyro_agrees_with_vicon_attitude(shared_recordings):
    from scipy.spatial.transform import Rotation

    recording = open_recording(shared_recordings / "nanobench" / "B3_figure8_fast_rep1.csv.gz")
    attitude, gyro = recording.signals["attitude"], recording.signals["body_rate"]
    turned = Rotation.from_quat(attitude.value)
    rate = (turned[:-10].inv() * turned[10:]).as_rotvec() / (attitude.time[10:] - attitude.time[:-10])[:, None]
    mean = np.array([gyro.value[i : i + 11].mean(axis=0) for i in range(len(rate))])
    good = np.isfinite(mean).all(axis=1)
    for axis in range(3):
        assert np.corrcoef(rate[good, axis], mean[good, axis])[0, 1] > (0.8 if axis < 2 else 0.5)


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
