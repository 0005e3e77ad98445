"""uSD card logs: sample-exact against a slow decoder written from the format alone; cut, damaged and lying files."""

import math
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Grade
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.recordings.usd.file import read, recognises

FIXED = 0xFFFF


def name_bytes(text):
    return text.encode() + b"\0"


def header(version, events):
    """events: [(id, name, [(variable, letter), ...]), ...]"""
    out = b"\xbc" + struct.pack("<HH", version, len(events))
    for identifier, name, variables in events:
        out += struct.pack("<H", identifier) + name_bytes(name) + struct.pack("<H", len(variables))
        out += b"".join(name_bytes(f"{variable}({letter})") for variable, letter in variables)
    return out


def record(version, event, stamp, values):
    identifier, _, variables = event
    letters = "".join(letter for _, letter in variables)
    return struct.pack("<H" + {1: "I", 2: "Q"}[version] + letters, identifier, stamp, *values)


def log(version, events, rows):
    """rows: [(index of event, stamp, values), ...]"""
    body = header(version, events) + b"".join(record(version, events[k], stamp, v) for k, stamp, v in rows)
    return body + struct.pack("<I", zlib.crc32(body))


def slow_decode(data, *, whole=True):
    """The peer: a record at a time with struct; (event names, [(event index, stamp, values)], bytes left over)."""
    assert data[0] == 0xBC
    version, count = struct.unpack_from("<HH", data, 1)
    at = 5

    def text():
        nonlocal at
        end = data.index(b"\0", at)
        found, at = data[at:end].decode(), end + 1
        return found

    events = []
    for _ in range(count):
        (identifier,) = struct.unpack_from("<H", data, at)
        at += 2
        name = text()
        (variables,) = struct.unpack_from("<H", data, at)
        at += 2
        names = [text() for _ in range(variables)]
        events.append((identifier, name, [n[:-3] for n in names], "".join(n[-2] for n in names)))
    end = len(data) - (4 if whole else 0)
    rows = []
    while at + 2 <= end:
        (identifier,) = struct.unpack_from("<H", data, at)
        k = next((i for i, e in enumerate(events) if e[0] == identifier), None)
        if k is None:
            break
        form = "<" + {1: "I", 2: "Q"}[version] + events[k][3]
        if at + 2 + struct.calcsize(form) > end:
            break
        stamp, *values = struct.unpack_from(form, data, at + 2)
        rows.append((k, stamp, values))
        at += 2 + struct.calcsize(form)
    return version, events, rows, end - at


def tables_of(monkeypatch):
    """What the reader hands on, before it becomes signals."""
    seen = []

    def spy(tables, **options):
        seen.append(list(tables))
        return signals_from_tables(tables, **options)

    monkeypatch.setattr("crazyem.recordings.usd.file.signals_from_tables", spy)
    return seen


def assert_same(tables, decoded):
    version, events, rows, _ = decoded
    by_name = {table.name: table for table in tables}
    for k, (_, name, variables, _) in enumerate(events):
        mine = [(i, stamp, values) for i, (kind, stamp, values) in enumerate(rows) if kind == k]
        if not mine or not variables:
            assert name not in by_name
            continue
        table = by_name[name]
        assert table.order.tolist() == [i for i, _, _ in mine]
        rate = {1: 1e3, 2: 1e6}[version]
        assert [round(t * rate) for t in table.time] == [stamp for _, stamp, _ in mine]
        assert list(table.columns) == variables
        for j, variable in enumerate(variables):
            got, expected = table.columns[variable].tolist(), [values[j] for _, _, values in mine]
            assert len(got) == len(expected)
            assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(got, expected, strict=True))


@pytest.fixture
def put(tmp_path):
    def write(data, name="log00"):
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


def opened(path, **options):
    return read(path, ReadOptions(**options))


# --- real files ---


def test_real_files_are_exact(shared_recordings, monkeypatch):
    files = [*sorted((shared_recordings / "crazypad").iterdir())[::3], shared_recordings / "sysid" / "log10"]
    seen = tables_of(monkeypatch)
    for file in files:
        data = file.read_bytes()
        assert recognises(data[: 64 * 1024])
        recording = opened(file)
        decoded = slow_decode(data)
        assert decoded[3] == 0
        assert_same(seen.pop(), decoded)
        assert recording.metadata["usd"]["crc"] == "ok"
        assert not [f for f in recording.findings if f.check == "integrity"]


def test_a_real_file_as_signals(shared_recordings):
    file = shared_recordings / "crazypad" / "motor__normal_flight__E8_log00"
    recording = opened(file)
    _, events, rows, _ = slow_decode(file.read_bytes())
    column = {name: np.array([row[2][i] for row in rows], float) for i, name in enumerate(events[0][2])}
    signals = recording.signals
    assert recording.source == "usd:2"
    assert signals["position"].stream == "fixedFrequency"
    assert signals["position"].clock == "firmware"
    assert np.array_equal(signals["position"].value[:, 1], column["stateEstimate.y"])
    assert np.array_equal(signals["motor_command"].value[:, 2], column["pwm.m3_pwm"] / 65535.0)
    assert np.array_equal(signals["motor_request"].value[:, 3], column["motor.m4"] / 65535.0)
    assert np.array_equal(signals["voltage"].value[:, 0], (column["pm.vbatMV"] + 0.5) / 1000.0)
    assert np.array_equal(signals["acceleration"].value[:, 2], column["stateEstimate.az"] * 9.81)
    assert np.array_equal(signals["stateEstimate.roll"].value[:, 0], column["stateEstimate.roll"])
    assert signals["stateEstimate.roll"].unit == "deg"
    assert recording.metadata["usd"]["records.activeMarkerModeChanged"] == "0"


# --- generated files ---

SPECIAL = {"f": (math.nan, math.inf, -math.inf, -0.0, 1e-45, 3.4028234663852886e38), "e": (math.nan, math.inf, 6e-8)}


def values_of(letters, rng):
    """Any bit pattern, and the odd numbers more often."""
    form = "<" + letters
    values = list(struct.unpack(form, rng.bytes(struct.calcsize(form))))
    for i, letter in enumerate(letters):
        if letter in SPECIAL and rng.random() < 0.3:
            values[i] = SPECIAL[letter][rng.integers(len(SPECIAL[letter]))]
    return list(struct.unpack(form, struct.pack(form, *values)))


@st.composite
def logs(draw):
    version = draw(st.sampled_from([1, 2]))
    identifiers = draw(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=5, unique=True))
    events = []
    for number, identifier in enumerate(identifiers):
        letters = draw(st.lists(st.sampled_from("BbHhIife"), max_size=5))
        events.append((identifier, f"event{number}", [(f"g{number}.v{i}", letter) for i, letter in enumerate(letters)]))
    runs = draw(st.lists(st.tuples(st.integers(0, len(events) - 1), st.sampled_from([1, 2, 40])), min_size=1))
    kinds = [k for k, length in runs for _ in range(length)][:200]
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    stamps = (rng.integers(0, 2**31) + np.cumsum(rng.integers(0, 20_000, len(kinds)))).tolist()
    letters = ["".join(letter for _, letter in variables) for _, _, variables in events]
    return version, events, [(k, stamp, values_of(letters[k], rng)) for k, stamp in zip(kinds, stamps, strict=True)]


@given(generated=logs())
def test_any_log_is_exact(tmp_path_factory, generated):
    data = log(*generated)
    path = tmp_path_factory.mktemp("usd") / "log"
    path.write_bytes(data)
    with pytest.MonkeyPatch.context() as patch:
        seen = tables_of(patch)
        recording = opened(path)
    decoded = slow_decode(data)
    assert str(decoded[2]) == str(generated[2])  # the peer itself; as text, where a NaN equals itself
    assert_same(seen[0], decoded)
    assert recording.metadata["usd"]["crc"] == "ok"
    bare = [(k, stamp) for k, stamp, _ in generated[2] if not generated[1][k][2]]
    assert [e.data["name"] for e in recording.events] == [f"event{k}" for k, _ in bare]
    rate = {1: 1e3, 2: 1e6}[generated[0]]
    assert [round(e.time * rate) for e in recording.events] == [stamp for _, stamp in bare]


def small_log(version=2):
    events = [
        (FIXED, "fixedFrequency", [("acc.x", "f"), ("motor.m1", "I"), ("pm.vbatMV", "H")]),
        (3, "ping", []),
        (12, "mode", [("mode", "B"), ("level", "e")]),
    ]
    rows = [(0, 1000 + 10 * i, [0.5 * i, i, 4000 - i]) for i in range(20)]
    rows[3:3] = [(2, 1031, [7, math.nan]), (2, 1032, [8, math.inf])]
    rows[9:9] = [(1, 1075, [])]
    return events, rows, log(version, events, rows)


@pytest.mark.parametrize("version", [1, 2])
def test_truncated_at_every_byte(put, version, monkeypatch):
    events, _, data = small_log(version)
    all_rows = slow_decode(data)[2]
    first = len(header(version, events))
    seen = tables_of(monkeypatch)
    for length in range(len(data)):
        path = put(data[:length])
        decoded = slow_decode(data[:length], whole=False) if length >= first else None
        if decoded is None or not decoded[2]:
            with pytest.raises(FileFormatError, match="log00"):
                opened(path)
            continue
        assert str(decoded[2]) == str(all_rows[: len(decoded[2])])  # as text: a NaN equals itself there
        recording = opened(path)
        assert_same(seen.pop(), decoded)
        assert recording.metadata["usd"]["crc"] == "missing"
        (finding,) = [f for f in recording.findings if f.check == "integrity"]
        assert finding.grade is Grade.HARMLESS
        # up to three bytes of the CRC may be what is left
        assert finding.evidence["left_bytes"] == decoded[3]
        assert finding.evidence["last_s"] == decoded[2][-1][1] / {1: 1e3, 2: 1e6}[version]
        assert "cut off" in finding.text


def test_wrong_checksum_is_said_with_both_values(put):
    _, _, data = small_log()
    damaged = bytearray(data)
    damaged[-10] ^= 1
    recording = opened(put(bytes(damaged)))
    (finding,) = [f for f in recording.findings if f.check == "integrity"]
    assert recording.metadata["usd"]["crc"] == "wrong"
    assert finding.grade is Grade.DEGRADES
    assert f"{zlib.crc32(data[:-4]):08x}" in finding.text
    assert f"{zlib.crc32(bytes(damaged[:-4])):08x}" in finding.text
    assert len(recording) == len(opened(put(data)))


def test_damage_in_mid_file_keeps_what_came_before(put):
    events, rows, data = small_log()
    at = len(header(2, events)) + sum(len(record(2, events[k], s, v)) for k, s, v in rows[:7])
    damaged = bytearray(data)
    damaged[at : at + 2] = b"\x34\x12"
    recording = opened(put(bytes(damaged)))
    (finding,) = [f for f in recording.findings if f.check == "integrity"]
    assert finding.grade is Grade.DEGRADES
    assert f"byte {at}" in finding.text
    assert "4660" in finding.text
    assert recording.signals["acc.x"].time.size == sum(k == 0 for k, _, _ in rows[:7])


def test_bytes_after_the_last_record_of_a_sound_file(put):
    events, rows, _ = small_log()
    body = header(2, events) + b"".join(record(2, events[k], s, v) for k, s, v in rows) + b"\xff\xff\x01"
    recording = opened(put(body + struct.pack("<I", zlib.crc32(body))))
    (finding,) = [f for f in recording.findings if f.check == "integrity"]
    assert finding.evidence["left_bytes"] == 3
    assert recording.metadata["usd"]["crc"] == "ok"


def test_stamps_of_version_1_go_on_where_they_wrap(put, monkeypatch):
    events = [(FIXED, "fixedFrequency", [("a.b", "f")]), (2, "other", [("x", "B")])]
    stamps = [2**32 - 20, 2**32 - 10, 2**32 - 12, 0, 10, 5, 20]
    rows = [(i % 2, stamp, [1]) for i, stamp in enumerate(stamps)]
    recording = opened(put(log(1, events, rows)))
    times = {n: (recording.signals[n].time * 1000).round().astype(int).tolist() for n in ("a.b", "x")}
    assert times["a.b"] == [2**32 - 20, 2**32 - 12, 2**32 + 10, 2**32 + 20]
    assert times["x"] == [2**32 - 10, 2**32, 2**32 + 5]


def test_long_runs_of_one_kind(put, monkeypatch):
    events = [(FIXED, "fixedFrequency", [("a.b", "H")]), (2, "other", [("x", "B")])]
    lengths = [1, 15, 16, 17, 63, 64, 65, 80, 128, 129, 300]
    kinds = [k % 2 for k, n in enumerate(lengths) for _ in range(n)]
    rows = [(k, i, [i % 200]) for i, k in enumerate(kinds)]
    seen = tables_of(monkeypatch)
    data = log(2, events, rows)
    opened(put(data))
    assert_same(seen[0], slow_decode(data))


def test_names_that_stand_twice(put):
    events = [(FIXED, "same", [("a.b", "B"), ("a.b", "B")]), (2, "same", [("a.b", "B"), ("position", "B")])]
    recording = opened(put(log(2, events, [(0, 1, [1, 2]), (1, 2, [3, 4])])))
    assert {name: array.value.tolist() for name, array in recording.signals.items()} == {
        "a.b@same": [[1.0]],
        "a.b#1": [[2.0]],
        "a.b@same@2": [[3.0]],
        "position@same@2": [[4.0]],
    }


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xbc\x03\x00\x01\x00\x00\x00ab\x00\x00\x00", "version 3"),
        (b"\xbc\x02\x00\xff\xff", "65535 event types"),
        (b"\xbc\x02\x00\x00\x00", "0 event types"),
        (b"\xbc\x02\x00\x01\x00\xff\xff" + b"x" * 400, "not text"),
        (b"\xbc\x02\x00\x01\x00\xff\xff" + b"x" * 10, "in its header"),
        (b"\xbc\x02\x00\x01\x00\xff\xffname\x00\xff\xff", "65535 variables"),
        (b"\xbc\x02\x00\x01\x00\xff\xffname\x00\x01\x00a.b(q)\x00", "known type"),
        (b"\xbc\x02\x00\x01\x00\xff\xffname\x00\x01\x00B\x00", "known type"),
        (b"\xbc\x02\x00\x01\x00\xff\xffna\xffme\x00\x01\x00", "not text"),
        (header(2, [(1, "a", []), (1, "b", [])]), "twice"),
        (header(2, [(1, "a", [("x", "B")])]) + bytes(4), "not a single whole record"),
        (b"\xbd", "0xBC"),
        (b"", "ends after 0 bytes"),
    ],
)
def test_headers_that_lie(put, content, words):
    with pytest.raises(FileFormatError, match=words):
        opened(put(content))


def test_told_from_other_files():
    assert recognises(small_log()[2])
    for other in (b"", b"\xbc", b"\x89MCAP0\r\n" + bytes(9), b"ULog\x01\x12\x35\x01" + bytes(9), b"\xbc" + bytes(20)):
        assert not recognises(other)


def test_ctypes_and_columns_are_views(put, monkeypatch):
    """Ten minutes at 1 kHz are held once: the columns of a table share the memory of the file."""
    events = [(FIXED, "fixedFrequency", [("a.b", "e"), ("a.c", "i")])]
    seen = tables_of(monkeypatch)
    opened(put(log(2, events, [(0, i, [i, -i]) for i in range(50)])))
    (table,) = seen[0]
    assert isinstance(table, Table)
    assert table.ctypes == {"a.b": "FP16", "a.c": "int32_t"}
    assert not table.columns["a.b"].flags.owndata
    assert table.columns["a.b"].strides == (16,)
