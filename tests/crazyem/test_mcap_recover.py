"""Damaged MCAP made whole: recovered into a new file, or continued by another session."""

import os
from io import BytesIO

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer
from mcap_sessions import MAGIC, STATE, chunks, packets, record, small_fixture, stock_messages, top_level

from crazyem.errors import FileFormatError, UsageError
from crazyem.recordings import open_recording
from crazyem.recordings.mcap.output import reopen
from crazyem.recordings.mcap.recover import recover
from crazyem.recordings.mcap.signals import write_recording
from crazyem.recordings.mcap.writer import RecordingWriter

small = pytest.fixture(scope="module")(small_fixture)


def test_recovering_a_sound_file_changes_nothing(small, tmp_path):
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(small)
    report = recover(source, target)
    assert report.lost_messages == 0
    assert report.problems == []
    assert report.closed
    assert stock_messages(target) == stock_messages(source)
    assert open_recording(target).metadata == open_recording(source).metadata


@pytest.mark.parametrize("number", range(4))
def test_recover_writes_all_but_the_damaged_chunk(small, tmp_path, number):
    start, end = chunks(small)[number]
    broken = bytearray(small)
    broken[end - 5] ^= 1
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(bytes(broken))
    report = recover(source, target)
    source.write_bytes(small)
    whole, found = stock_messages(source), stock_messages(target)
    lost = [m for m in whole if m not in found]
    assert [m for m in whole if m in found] == found
    assert len(lost) == 30
    assert [(p.offset, p.end) for p in report.problems] == [(start, end)]
    assert report.messages == len(found)
    if number < 3:
        assert report.lost_messages == 30
    assert report.to_dict()["problems"][0]["offset"] == start
    assert open_recording(target).notices == ()


def test_recover_after_a_cut(small, tmp_path):
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(small[: chunks(small)[3][1] - 1])
    report = recover(source, target)
    assert not report.closed
    assert len(stock_messages(target)) == report.messages == 90
    with pytest.raises(UsageError, match="exists already"):
        recover(source, target)
    with pytest.raises(UsageError, match="damaged file itself"):
        recover(source, source, replace=True)
    source.write_bytes(small[:40])
    with pytest.raises(FileFormatError, match="not one message"):
        recover(source, tmp_path / "c.mcap")
    with pytest.raises(UsageError, match="no such file"):
        recover(tmp_path / "nothing", tmp_path / "c.mcap")
    assert sorted(os.listdir(tmp_path)) == ["a.mcap", "b.mcap"]


@pytest.mark.parametrize("chunked", [True, False])
def test_recover_takes_files_of_others(tmp_path, chunked):
    buffer = BytesIO()
    writer = Writer(buffer, chunk_size=200, use_chunking=chunked)
    writer.start(profile="ros2", library="test")
    schema = writer.register_schema("x.Y", "jsonschema", b"{}")
    channel = writer.register_channel("/x", "json", schema, {"k": "v"})
    for k in range(40):
        writer.add_message(channel, k, b'{"k": %d}' % k, k, sequence=7)
        if k == 19:
            writer.add_metadata("about", {"a": "b"})
            writer.add_attachment(1, 2, "photo", "image/png", b"pixels")
    writer.finish()
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(buffer.getvalue()[:-300])
    report = recover(source, target)
    assert report.profile == "ros2"
    assert report.metadata == report.attachments == 1
    assert report.lost_messages is None
    with target.open("rb") as stream:
        reader = make_reader(stream)
        messages = [m.data for _, _, m in reader.iter_messages()]
        assert messages == [b'{"k": %d}' % k for k in range(len(messages))]
        assert len(messages) >= 30
        assert reader.get_header().profile == "ros2"
        assert [a.data for a in reader.iter_attachments()] == [b"pixels"]
        assert [m.metadata for m in reader.iter_metadata()] == [{"a": "b"}]
        assert reader.get_summary().statistics.message_count == len(messages)


@pytest.mark.parametrize("cut", [0, 1, 40, 400])
def test_a_second_session_follows_the_first(tmp_path, cut):
    path = tmp_path / "f.mcap"
    record(path, configuration={"n": "1"})
    first = open_recording(path)
    data = path.read_bytes()
    last_chunk = chunks(data)[-1][1]
    if cut:
        path.write_bytes(data[: last_chunk + cut - 1])
    record(path, first=200, count=30, append=True, configuration={"n": "2"})
    both = open_recording(path)
    assert both.notices == ()
    assert both.metadata["configuration"] == {"n": "1"}
    assert both.metadata["session 2: configuration"] == {"n": "2"}
    for name, array in first.signals.items():
        assert np.array_equal(both.signals[name].value[:60], array.value)
        assert both.signals[name].time.size == 90
        assert both.signals[name].stream == array.stream
    times = [s.time for s in both.samples() if s.signal == "position"]
    sent = [*packets(0, 60), *packets(200, 30)]
    assert times == [p.firmware_time_ms / 1000 for p in sent if not p.block]
    messages = stock_messages(path)
    assert [sequence for _, sequence, _ in messages] == list(range(1, len(messages) + 1))
    assert messages == stock_messages(path, NonSeekingReader)  # without the index
    record(path, first=300, count=5, append=True)
    assert open_recording(path).signals["position"].time.size == 95
    assert "session 3: crazyem" in open_recording(path).metadata


def test_nothing_is_lost_if_the_second_session_dies_at_any_moment(tmp_path):
    path, cut = tmp_path / "f.mcap", tmp_path / "cut.mcap"
    record(path)
    before = path.read_bytes()
    reopen(path).stream.close()
    assert path.read_bytes() == before  # opening alone changes nothing
    record(path, first=200, count=10, append=True)
    after = path.read_bytes()
    end = next(start for start, _, opcode in top_level(before) if opcode == 15)
    assert after[:end] == before[:end]
    for size in range(end, len(after), 11):
        cut.write_bytes(after[:size])
        assert open_recording(cut).signals["position"].time.size >= 60


def test_a_session_with_other_blocks(tmp_path):
    path = tmp_path / "f.mcap"
    record(path)
    record(path, first=200, count=10, append=True, blocks=(STATE,))
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 70
    assert recording.signals["voltage"].time.size == 60


def test_what_cannot_be_continued(small, tmp_path):
    path = tmp_path / "f.mcap"
    path.write_bytes(b"t,x\n1,2\n")
    with pytest.raises(FileFormatError, match="not a recording of crazyem"):
        RecordingWriter(path, append=True)
    broken = bytearray(small)
    start, end = chunks(small)[1]
    broken[end - 4] ^= 1
    path.write_bytes(bytes(broken))
    with pytest.raises(FileFormatError, match=f"damaged at byte {start}"):
        RecordingWriter(path, append=True)
    record(tmp_path / "g.mcap")
    write_recording(open_recording(tmp_path / "g.mcap"), tmp_path / "h.mcap")
    with pytest.raises(FileFormatError, match="imported"):
        RecordingWriter(tmp_path / "h.mcap", append=True)
    RecordingWriter(tmp_path / "new.mcap", append=True).close()
    assert (tmp_path / "new.mcap").read_bytes().startswith(MAGIC)
