"""cfclient CSV: files written the way cfclient writes them come back exactly; sessions, wraps, cut and wrong files."""

import gzip
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.csv.cfclient import read, recognises, recognises_folder
from crazyem.recordings.finding import Grade

STATE = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
MOTOR = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
WRAP = 1 << 24


def as_cfclient(variables, rows):
    """What the LogWriter of cfclient writes: the stamp as an integer, str() of each value."""
    lines = [("Timestamp", *variables), *((stamp % WRAP, *values) for stamp, *values in rows)]
    return "".join(",".join(map(str, line)) + "\n" for line in lines)


def single(value):
    """A float as the link delivers it: a float32 in Python's double."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


def rows_of(variables, *, first=1000, period=10, count=20, seed=0):
    rng = np.random.default_rng(seed)
    whole = variables[0].startswith("motor")
    return [
        (first + period * i, *((int(rng.integers(0, 60000)) if whole else single(rng.normal())) for _ in variables))
        for i in range(count)
    ]


@pytest.fixture
def put(tmp_path):
    def write(name, text, folder="20250301T10-00-00"):
        path = tmp_path / folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def opened(path, **options):
    return read(path, ReadOptions(**options))


def about(recording, check):
    return [f for f in recording.findings if f.check == check]


# --- exactness ---


@given(
    st.lists(
        st.tuples(st.integers(0, 3000), st.floats(width=32), st.integers(0, 2**32 - 1), st.floats(allow_nan=True)),
        min_size=1, max_size=40,
    ),
    st.integers(0, WRAP - 1),
)  # fmt: skip
def test_every_value_comes_back(tmp_path_factory, steps, first):
    stamps = first + np.cumsum([s for s, *_ in steps]) - steps[0][0]
    rows = [(int(t), *values) for t, (_, *values) in zip(stamps, steps, strict=True)]
    path = tmp_path_factory.mktemp("cf") / "Block-20250301T10-00-00.csv"
    path.write_text(as_cfclient(("a.f", "a.u", "a.d"), rows))
    signals = opened(path).signals
    for i, name in enumerate(("a.f", "a.u", "a.d"), start=1):
        got = signals[name].value[:, 0].tolist()
        assert all(a == r[i] or (math.isnan(a) and math.isnan(r[i])) for a, r in zip(got, rows, strict=True))
        assert (signals[name].time * 1000).round().astype(int).tolist() == stamps.tolist()


def test_a_session_is_one_recording(put):
    state = rows_of(STATE, first=1003, count=30)
    motor = rows_of(MOTOR, first=1001, period=20, count=15, seed=1)
    folder = put("State est-20250301T10-00-05.csv", as_cfclient(STATE, state)).parent
    put("motor-all-20250301T10-00-05.csv", as_cfclient(MOTOR, motor))
    assert recognises_folder(folder)
    recording = opened(folder, motor="duty")
    signals = recording.signals
    assert recording.source == "csv:cfclient"
    assert set(signals) == {"position", "motor_command"}
    assert signals["position"].stream == "State est"
    assert signals["motor_command"].stream == "motor-all"
    assert signals["position"].clock == "firmware"
    assert signals["position"].value.tolist() == [list(v) for _, *v in state]
    assert signals["position"].time.tolist() == [t / 1000.0 for t, *_ in state]
    assert (signals["motor_command"].value * 65535).round().astype(int).tolist() == [v for _, *v in motor]
    times = [s.time for s in recording.samples()]
    assert times == sorted(times)
    assert len(times) == 45
    assert recording.metadata["cfclient"]["session"] == "20250301T10-00-00"


def test_one_file_says_what_lies_beside_it(put):
    path = put("state-20250301T10-00-05.csv", as_cfclient(STATE, rows_of(STATE)))
    assert not about(opened(path), "integrity")
    put("other-20250301T10-00-05.csv", as_cfclient(("pm.vbat",), rows_of(("pm.vbat",))))
    recording = opened(path)
    (finding,) = about(recording, "integrity")
    assert finding.grade is Grade.HARMLESS
    assert "1 more" in finding.text
    assert set(recording.signals) == {"position"}


def test_writing_switched_off_and_on_again_leaves_a_gap(put):
    first, again = rows_of(STATE, count=10), rows_of(STATE, first=61_000, count=10)
    folder = put("state-20250301T10-00-00.csv", as_cfclient(STATE, first)).parent
    put("state-20250301T10-01-00.csv", as_cfclient(STATE, again))
    signals = opened(folder).signals
    assert set(signals) == {"position"}
    assert signals["position"].time.size == 20
    assert np.diff(signals["position"].time).max() == pytest.approx(59.91)


def test_a_block_whose_variables_were_edited_is_two(put):
    folder = put("block-20250301T10-00-00.csv", as_cfclient(("a.b",), rows_of(("a.b",)))).parent
    put("block-20250301T10-01-00.csv", as_cfclient(("a.b", "a.c"), rows_of(("a.b", "a.c"), first=61_000)))
    assert {array.stream for array in opened(folder).signals.values()} == {"block", "block#2"}


# --- clocks ---


def test_stamps_wrap_inside_a_file_and_between_files(put):
    """One block starts before the 24 bits run over, the other after."""
    early = rows_of(STATE, first=WRAP - 60_000, count=7000)
    late = rows_of(("pm.vbat",), first=WRAP + 3000, count=50)
    folder = put("state-20250301T10-00-00.csv", as_cfclient(STATE, early)).parent
    put("battery-20250301T10-01-03.csv", as_cfclient(("pm.vbat",), late))
    assert recognises_folder(folder)
    signals = opened(folder).signals
    assert (signals["position"].time * 1000).round().astype(int).tolist() == [t for t, *_ in early]
    assert (signals["voltage"].time * 1000).round().astype(int).tolist() == [t for t, *_ in late]


STATE_FILE = as_cfclient(STATE, rows_of(STATE))


@pytest.mark.parametrize(
    ("files", "one_session"),
    [
        ({}, False),
        ({"state-20250301T10-00-00.csv": STATE_FILE, "notes.txt": "windy"}, True),
        ({"state-20250301T10-00-00.csv": STATE_FILE, "state-20250301T11-00-00.csv": STATE_FILE}, False),
        ({"flight1.csv": STATE_FILE, "flight2.csv": STATE_FILE}, False),
        ({"state-20250301T10-00-00.csv": STATE_FILE, "flight.mcap": b"\x89MCAP0\r\n"}, False),
        ({"state-20250301T10-00-00.csv": STATE_FILE, "paper.csv": "t,x,y\n1,2,3\n"}, False),
    ],
    ids=["nothing", "a session and notes", "two sessions", "files renamed", "a flight beside", "another table beside"],
)
def test_which_folders_are_one_recording(put, tmp_path, files, one_session):
    folder = tmp_path / "flights"
    folder.mkdir()
    for name, text in files.items():
        put(name, text, "flights")
    assert recognises_folder(folder) is one_session


def test_a_header_in_mid_file_is_said(put):
    text = as_cfclient(STATE, rows_of(STATE, first=50_000)) + as_cfclient(STATE, rows_of(STATE, first=2000))
    recording = opened(put("state.csv", text))
    (finding,) = about(recording, "integrity")
    assert finding.grade is Grade.DEGRADES
    assert "line 22" in finding.text
    assert recording.signals["position"].time.size == 40
    assert np.diff(recording.signals["position"].time).min() < -40
    assert np.array_equal(recording.signals["position"].order, np.sort(recording.signals["position"].order))


# --- ends and errors ---


def test_truncated_at_every_byte(put):
    rows = rows_of(STATE, count=6)
    data = as_cfclient(STATE, rows).encode()
    header = data.index(b"\n") + 1
    for length in range(len(data)):
        path = put("state.csv", data[:length])
        whole = data[:length].count(b"\n") - 1
        if whole < 1:
            with pytest.raises(FileFormatError, match=r"state\.csv"):
                opened(path)
            continue
        recording = opened(path)
        assert recording.signals["position"].value.tolist() == [list(v) for _, *v in rows[:whole]]
        cut = data[header:length].rpartition(b"\n")[2]
        assert bool(about(recording, "integrity")) == bool(cut)


def test_line_ends_blank_lines_byte_order_mark_and_gzip(put):
    rows = rows_of(STATE)
    expected = [list(v) for _, *v in rows]
    text = as_cfclient(STATE, rows)
    variants = {
        "dos.csv": text.replace("\n", "\r\n").encode(),
        "blank.csv": ("\n\r\n" + text.replace("\n", "\n\n")).encode(),
        "mark.csv": b"\xef\xbb\xbf" + text.encode(),
        "packed.csv.gz": gzip.compress(text.encode()),
    }
    for name, data in variants.items():
        plain = gzip.decompress(data) if name.endswith(".gz") else data
        assert recognises(plain)
        assert opened(put(name, data)).signals["position"].value.tolist() == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Timestamp,a.b\n", "not a single row"),
        ("Timestamp,a.b\n1,2\n2\n3,4\n", "line 3 has 1 fields"),
        ("Timestamp,a.b\n1,2\n2,x\n", "line 3 holds"),
        ("\n\nTimestamp,a.b\n1,2\n2,x\n", "line 5 holds"),
        ("Timestamp,a.b\n1,2\n2,\n", "line 3 holds"),
        ("Timestamp,a.b\nnan,3\n", "not a stamp"),
        ("Timestamp,a.b\n16777216,2\n50000000000,3\n", "not a stamp"),
        ("Timestamp\n1\n2\n", "stamps only"),
        ("timestamp\n1\n2\n", "stamps only"),
        ("Timestamp,a.b,a.b\n1,2,3\n", "twice"),
        ("Timestamp,a.b\n1,2\nTimestamp,a.c\n3,4\n", "line 3 is a header"),
        ("time,a.b\n1,2\n", "not a header"),
    ],
)
def test_errors_name_the_line(put, text, words):
    with pytest.raises(FileFormatError, match=words):
        opened(put("block.csv", text))


@pytest.mark.parametrize("stamp", ["nan", "-4", "1.5", "1e300", "16777216", "50000000000"])
def test_rows_whose_stamps_are_not_24_bits_of_ms_are_left_out_and_counted(put, stamp):
    recording = opened(put("block.csv", f"Timestamp,a.b\n1,2\n{stamp},3\n2,4\n"))
    assert recording.signals["a.b"].value.tolist() == [[2.0], [4.0]]
    (finding,) = [f for f in recording.findings if f.check == "stamps"]
    assert finding.evidence["records"] == 1
    assert "1 of 3 records of block" in finding.text


def test_a_lower_case_column_of_stamps_is_read_unless_a_mapping_says_otherwise(put):
    path = put("flight.csv", "timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z\n100,1,2,3\n110,4,5,6\n")
    assert opened(path).signals["position"].time.tolist() == [0.1, 0.11]
    mapping = put("map.toml", '[time]\ncolumn = "timestamp"\n[signals.voltage]\ncolumns = ["stateEstimate.x"]\n')
    assert opened(path, mapping=str(mapping)).signals["voltage"].time.tolist() == [0.0, 10.0]


def test_an_empty_block_of_a_session_is_mentioned(put):
    folder = put("state-20250301T10-00-00.csv", as_cfclient(STATE, rows_of(STATE))).parent
    put("empty-20250301T10-00-00.csv", as_cfclient(("a.b",), []))
    recording = opened(folder)
    (finding,) = about(recording, "integrity")
    assert "empty-" in finding.text
    assert set(recording.signals) == {"position"}


def test_told_from_other_csv():
    assert recognises(as_cfclient(STATE, []).encode())
    for header in ("t,px,py", "Timestamp,", "Timestamp,x", "Timestamp,a b.c", "times,a.b", ""):
        assert not recognises(header.encode() + b"\n1,2\n")
