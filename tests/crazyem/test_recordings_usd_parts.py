"""uSD card logs in parts: joined they are the whole, however the file is cut, damaged or packed."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import assert_same_signals, joined
from test_recordings_usd import FIXED, header, log, logs, record, small_log

from crazyem.errors import CrazyemError, FileFormatError
from crazyem.recordings import ReadOptions, Recording
from crazyem.recordings.registry import open_parts
from crazyem.recordings.usd.file import read, read_parts


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    """Records lie across pieces, often."""
    monkeypatch.setattr("crazyem.recordings.usd.file._READ_BYTES", 37)


def words(findings):
    return sorted(repr(f.to_dict()) for f in findings)


def assert_joined(parts: list[Recording], whole: Recording) -> None:
    assert_same_signals(joined(parts), whole.signals)
    for part in parts:
        assert list(part.signals) == list(whole.signals)
        assert (part.path, part.source, part.metadata, part.origin) == (
            whole.path, whole.source, whole.metadata, whole.origin,
        )  # fmt: skip
    assert words(f for part in parts for f in part.findings) == words(whole.findings)
    assert [f.check for part in parts[:-1] for f in part.findings if f.check == "integrity"] == []
    assert [e for part in parts for e in part.events] == list(whole.events)


def outcome(function, path, *arguments):
    """What comes of reading: recordings, or the words of an error."""
    try:
        result = function(path, ReadOptions(), *arguments)
        return [result] if isinstance(result, Recording) else list(result)
    except CrazyemError as error:
        return f"{type(error).__name__}: {error}"


def parts_like_the_whole(content, path, seconds):
    """Read a file whole and in parts, compare them, and return the parts or the words of the error."""
    path.write_bytes(content)
    whole, parts = outcome(read, path), outcome(read_parts, path, seconds)
    if isinstance(whole, str):
        assert parts == whole
    else:
        assert_joined(parts, whole[0])
    return parts


@given(generated=logs(), seconds=st.sampled_from([0.0, 0.01, 0.1, 60.0]), cut=st.integers(0, 60))
def test_parts_of_any_log_joined_are_the_whole(tmp_path_factory, generated, seconds, cut):
    data = log(*generated)
    parts = parts_like_the_whole(data[: len(data) - cut], tmp_path_factory.mktemp("usd") / "log", seconds)
    if seconds == 0.0 and not cut:
        assert len(parts) == len(generated[2])


@given(st.data())
def test_damaged_bytes_are_the_same_in_parts(tmp_path_factory, data):
    content = bytearray(small_log(data.draw(st.sampled_from([1, 2])))[2])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + 1] = data.draw(st.binary(max_size=3))
    parts_like_the_whole(bytes(content), tmp_path_factory.mktemp("usd") / "log", 0.03)


def test_an_event_that_is_in_one_part_only_keeps_its_signals_in_all(tmp_path):
    events = [(FIXED, "fixedFrequency", [("stateEstimate.x", "f")]), (2, "other", [("a.b", "f"), ("flag", "B")])]
    rows = [(0, 10_000 * i, [i]) for i in range(100)]
    rows[70:70] = [(1, 695_000, [1.5, 7])]
    parts = parts_like_the_whole(log(2, events, rows), tmp_path / "log", 0.25)
    assert [part.signals["flag"].time.size for part in parts] == [0, 0, 1, 0]


@pytest.mark.parametrize("kind", ["request", "duty"])
def test_all_parts_agree_on_the_motors(tmp_path, kind, monkeypatch):
    """Also where the first parts hold no evidence, because no rotor turns."""
    rng = np.random.default_rng(5)
    events = [(FIXED, "fixedFrequency", [(f"motor.m{i}", "I") for i in (1, 2, 3, 4)])]
    rows = []
    for i in range(3000):
        if kind == "duty":
            values = rng.integers(20000, 40000, 4).tolist()
        else:
            t, r, p, y = (int(v) for v in rng.integers(30000, 31000, 4) - np.array([0, 30500, 30500, 30500]))
            values = [t - r + p + y, t - r - p - y, t + r - p + y, t + r + p - y]
        rows.append((0, 10_000 * i, values if i > 1000 else [0] * 4))
    path = tmp_path / "log"
    path.write_bytes(log(2, events, rows))
    monkeypatch.setattr("crazyem.recordings.usd.file._READ_BYTES", 5000)
    whole = read(path, ReadOptions())
    assert whole.metadata["motor"]["meaning"] == kind
    assert_joined(list(read_parts(path, ReadOptions(), seconds=5.0)), whole)
    # from a share of the rows: the same verdict, other numbers
    monkeypatch.setattr("crazyem.recordings.usd.file._SAMPLED_ROWS", 500)
    parts = list(read_parts(path, ReadOptions(), seconds=5.0))
    assert {part.metadata["motor"]["meaning"] for part in parts} == {kind}
    assert [set(part.signals) for part in parts] == [set(whole.signals)] * len(parts)
    assert 100 < parts[0].findings[0].evidence["mixer_rows"] <= 500


def test_stamps_of_version_1_go_on_from_part_to_part(tmp_path):
    events = [(FIXED, "fixedFrequency", [("a.b", "f")]), (2, "other", [("x", "B")])]
    stamps = [2**32 - 20, 2**32 - 10, 2**32 - 12, 0, 10, 5, 20, 2**31 + 25, 1]
    data = log(1, events, [(i % 2, stamp, [1]) for i, stamp in enumerate(stamps)])
    assert len(parts_like_the_whole(data, tmp_path / "log", 0.005)) > 3


def test_a_part_is_no_longer_than_told_nor_larger_than_it_may_be(tmp_path, monkeypatch):
    events = [(FIXED, "fixedFrequency", [("a.b", "f")])]
    parts = parts_like_the_whole(log(2, events, [(0, 10_000 * i, [i]) for i in range(1000)]), tmp_path / "log", 1.0)
    assert [part.duration for part in parts[:-1]] == pytest.approx([1.0] * 9, abs=0.011)  # a record more where 0.99..9
    monkeypatch.setattr("crazyem.recordings.usd.file.STRETCH_BYTES", 1400)
    standing = log(2, events, [(0, 7, [i]) for i in range(1000)])  # the clock does not run
    assert len(parts_like_the_whole(standing, tmp_path / "log", 1.0)) >= 10


def test_packed_it_is_read_in_parts_as_well(tmp_path, monkeypatch):
    data = small_log()[2]
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(data))
    assert_joined(list(open_parts(path, seconds=0.05)), read(path, ReadOptions()))
    path.write_bytes(gzip.compress(data)[:-9])
    with pytest.raises(FileFormatError, match="gzip"):
        list(read_parts(path, ReadOptions()))
    path.write_bytes(gzip.compress(data))
    monkeypatch.setattr("crazyem.recordings.contents.LARGEST_UNPACKED", 100)
    with pytest.raises(FileFormatError, match="unpacks to more"):
        list(read_parts(path, ReadOptions()))


def test_a_header_longer_than_a_piece_and_one_that_never_ends(tmp_path, monkeypatch):
    events = [(k, f"event{k}", [(f"g.v{i}", "B") for i in range(50)]) for k in range(20)]
    path = tmp_path / "log"
    parts_like_the_whole(header(2, events) + record(2, events[0], 5, [1] * 50) + bytes(4), path, 60.0)
    path.write_bytes(b"\xbc\x02\x00\x01\x00\xff\xff" + bytes([255]) * 100_000)
    monkeypatch.setattr("crazyem.recordings.usd.file._LONGEST_HEADER", 1000)
    with pytest.raises(FileFormatError, match="not text"):
        list(read_parts(path, ReadOptions()))


def test_real_logs_in_parts(shared_recordings, monkeypatch):
    monkeypatch.setattr("crazyem.recordings.usd.file._READ_BYTES", 10_007)
    for path in [*sorted((shared_recordings / "crazypad").iterdir())[:3], shared_recordings / "sysid" / "log10"]:
        parts = list(read_parts(path, ReadOptions(), seconds=4.0))
        assert len(parts) > 2
        assert_joined(parts, read(path, ReadOptions()))
