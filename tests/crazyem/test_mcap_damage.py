"""Damaged MCAP: every complete chunk is read, losses are located by byte, bombs are refused, files are continued."""

import contextlib
import os
import struct
import zlib
from io import BytesIO

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.recordings import ReadOptions, open_recording
from crazyem.recordings.mcap import file as mcap_file
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap.recover import recover
from crazyem.recordings.mcap.signals import write_recording
from crazyem.recordings.mcap.writer import RecordingWriter
from crazyem.signals.packet import Block, Packet, Variable

MAGIC = b"\x89MCAP0\r\n"
STATE = Block(0, tuple(Variable(f"stateEstimate.{n}", "float") for n in "xyz"), 10)
POWER = Block(1, (Variable("pm.vbat", "float"),), 10)


def packets(first, count):
    for k in range(first, first + count):
        yield Packet(0, 10 * k, 1.7e9 + 0.01 * k, (0.01 * k, 1.0, 0.5))
        yield Packet(1, 10 * k + 3, 1.7e9 + 0.01 * k + 0.003, (4.0 - 1e-4 * k,))


def record(path, first=0, count=60, *, every=15, append=False, blocks=(STATE, POWER), **metadata):
    """A recording with a chunk for every `every` pairs of packets."""
    with RecordingWriter(path, metadata, append=append) as writer:
        writer.blocks(blocks)
        for k, packet in enumerate(packets(first, count)):
            if packet.block < len(blocks):
                writer.packet(packet)
            if k % (2 * every) == 2 * every - 1:
                writer._put(writer._output.flush)
    assert writer.failure == ""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("damage") / "small.mcap"
    record(path)
    return path.read_bytes()


def top_level(data):
    """(offset, end, opcode) of every record, by the format's description: opcode, 64-bit length, content."""
    at, found = len(MAGIC), []
    while data[at : at + 8] != MAGIC:
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((at, at + 9 + length, opcode))
        at += 9 + length
    return found


def chunks(data):
    return [(start, end) for start, end, opcode in top_level(data) if opcode == 6]


def plain_scan(data):
    """The slow twin of the compiled scan."""
    at, messages, others = 0, [], []
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 5:
            channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", data, at + 9)
            messages.append((at + 31, length - 22, channel, log_time, publish_time, sequence))
        else:
            others.append((opcode, at + 9, length))
        at += 9 + length
    return messages, others


def stock_messages(path):
    """(topic, sequence, data) by the stock reader."""
    from mcap.reader import make_reader

    with open(path, "rb") as stream:
        reader = make_reader(stream)
        return [
            (channel.topic, message.sequence, bytes(message.data))
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]


def test_the_compiled_scan_is_the_plain_one(small):
    for start, end in chunks(small):
        data = mcap_scan.unpack(mcap_scan.parse_chunk(small[start + 9 : end]))
        scan = mcap_scan.scan(data)
        messages, others = plain_scan(data)
        assert scan.messages.tolist() == [list(m) for m in messages]
        assert scan.others.tolist() == [list(o) for o in others]


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_random_bytes_in_a_chunk(data):
    try:
        scan = mcap_scan.scan(data)
    except ValueError:
        return
    assert scan.messages.tolist() == [list(m) for m in plain_scan(data)[0]]


def test_a_length_of_an_exabyte_is_no_record():
    for length in (2**63 - 1, 2**63, 2**64 - 1, 2**40):
        with pytest.raises(ValueError, match="make no sense"):
            mcap_scan.scan(struct.pack("<BQ", 5, length) + bytes(40))


def test_truncation_at_any_byte_keeps_every_complete_chunk(small, tmp_path):
    path = tmp_path / "cut.mcap"
    ends = [end for _, end in chunks(small)]
    near = {end + d for end in ends for d in (-1, 0, 1)}
    seen = set()
    for size in sorted({*range(0, len(small), 7), *near, *range(len(small) - 40, len(small) + 1)}):
        complete = sum(end <= size for end in ends)
        path.write_bytes(small[:size])
        try:
            recording = open_recording(path)
        except FileFormatError:
            assert complete == 0
            continue
        assert recording.signals["position"].time.size == 15 * complete
        assert bool(recording.findings) == (size < len(small))
        seen.add(complete)
    assert seen == {1, 2, 3, 4}


@pytest.mark.parametrize("number", range(4))
def test_a_damaged_chunk_is_located_and_the_others_are_read(small, tmp_path, number):
    start, end = chunks(small)[number]
    broken = bytearray(small)
    broken[(start + end) // 2] ^= 0x40
    path = tmp_path / "broken.mcap"
    path.write_bytes(bytes(broken))
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 45  # the first as well: the summary repeats its announcements
    (finding,) = recording.findings
    assert finding.check == "integrity"
    assert finding.grade == "degrades"
    assert finding.evidence["offset_byte"] == start
    assert finding.evidence["lost_byte"] == end - start
    assert f"byte {start}" in finding.text
    if number < 3:
        assert finding.evidence["lost_messages"] == 30


def test_a_damaged_length_costs_one_chunk(small, tmp_path):
    """The walk finds the next chunk by itself."""
    for start, _ in chunks(small)[:3]:
        for place in (0, 1, 3, 7):
            broken = bytearray(small)
            broken[start + place] ^= 0x81
            path = tmp_path / "broken.mcap"
            path.write_bytes(bytes(broken))
            recording = open_recording(path)
            assert recording.signals["position"].time.size == 45
            assert recording.findings[0].evidence["offset_byte"] == start


def test_damage_between_chunks_loses_nothing(small, tmp_path):
    index = next(start for start, _, opcode in top_level(small) if opcode == 7)
    broken = bytearray(small)
    broken[index] = 0x55
    path = tmp_path / "broken.mcap"
    path.write_bytes(bytes(broken))
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 60
    assert recording.findings[0].evidence["offset_byte"] == index


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_anywhere_never_invents_a_sample(small, tmp_path, data):
    broken = bytearray(small)
    for _ in range(data.draw(st.integers(1, 6))):
        broken[data.draw(st.integers(8, len(broken) - 1))] = data.draw(st.integers(0, 255))
    path, target = tmp_path / "broken.mcap", tmp_path / "mended.mcap"
    path.write_bytes(bytes(broken))
    whole = {p.firmware_time_ms / 1000.0: p.values for p in packets(0, 60) if p.block == 0}
    try:
        recording = open_recording(path)
        position = recording.signals.get("position")
        if position is not None:
            for time, value in zip(position.time.tolist(), position.value.tolist(), strict=True):
                assert whole[time] == tuple(value)
        recover(path, target, replace=True)
        stock_messages(target)
    except CrazyemError:
        pass


# --- bombs ------------------------------------------------------------------------------------------------------------


def chunk_record(packed, size, crc=0, compression=b"zstd"):
    content = struct.pack("<QQQII", 0, 0, size, crc, len(compression)) + compression
    content += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(content)) + content


def with_chunk(small, record_bytes):
    """The file with one more chunk before its second."""
    at = chunks(small)[1][0]
    return small[:at] + record_bytes + small[at:]


@pytest.mark.parametrize(
    ("claimed", "content"),
    [(1000, 100_000_000), (100_000_000, 100_000_000), (2**62, 10), (10, 1000)],
    ids=["more than it says", "a huge one", "claims anything", "a little more"],
)
def test_a_chunk_that_is_a_bomb_is_left_out(small, tmp_path, claimed, content):
    bomb = chunk_record(zstandard.compress(bytes(content)), claimed)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(with_chunk(small, bomb))
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 60
    assert recording.findings[0].evidence["offset_byte"] == chunks(small)[1][0]


def test_a_file_of_many_large_chunks_is_refused(small, tmp_path):
    filler = struct.pack("<BQHH", 4, 4 + 20_000_000, 9, 0) + bytes(20_000_000)
    bomb = chunk_record(zstandard.compress(filler), len(filler), zlib.crc32(filler))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(with_chunk(small, bomb * 40))
    with pytest.raises(FileFormatError, match="unpacks to more than"):
        open_recording(path)
    with pytest.raises(FileFormatError, match="unpacks to more than"):
        recover(path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_a_summary_that_claims_many_messages_costs_nothing(small, tmp_path):
    start = next(s for s, _, opcode in top_level(small) if opcode == 11)
    broken = bytearray(small)
    broken[start + 9 + 48 : start + 9 + 56] = struct.pack("<Q", 2**50)
    path = tmp_path / "claims.mcap"
    path.write_bytes(bytes(broken))
    assert open_recording(path).signals["position"].time.size == 60


@pytest.mark.parametrize("compression", ["lz4", ""])
def test_other_compressions(tmp_path, compression):
    import lz4.frame

    record(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    made = b""
    for start, end, opcode in top_level(data):
        if opcode == 6:
            chunk = mcap_scan.parse_chunk(data[start + 9 : end])
            raw = mcap_scan.unpack(chunk)
            packed = lz4.frame.compress(raw) if compression else raw
            made += chunk_record(packed, len(raw), zlib.crc32(raw), compression.encode())
        elif opcode in (1, 12):
            made += data[start:end]
    path = tmp_path / "b.mcap"
    path.write_bytes(MAGIC + made)
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 60
    assert "not closed" in recording.notices[0]
    broken = bytearray(path.read_bytes())
    at = chunks(MAGIC + made + MAGIC)[1][0]
    broken[at] ^= 0xFF
    path.write_bytes(bytes(broken))
    assert open_recording(path, None).findings[0].evidence["offset_byte"] == at


# --- recover ----------------------------------------------------------------------------------------------------------


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
    from mcap.reader import make_reader
    from mcap.writer import Writer

    buffer = BytesIO()
    writer = Writer(buffer, chunk_size=200, use_chunking=chunked)
    writer.start(profile="ros2", library="test")
    schema = writer.register_schema("x.Y", "jsonschema", b"{}")
    channel = writer.register_channel("/x", "json", schema, {"k": "v"})
    for k in range(20):
        writer.add_message(channel, k, b'{"k": %d}' % k, k, sequence=7)
    writer.add_metadata("about", {"a": "b"})
    writer.add_attachment(1, 2, "photo", "image/png", b"pixels")
    for k in range(20, 40):
        writer.add_message(channel, k, b'{"k": %d}' % k, k, sequence=7)
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


# --- append -----------------------------------------------------------------------------------------------------------


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
    assert messages == streamed(path)
    record(path, first=300, count=5, append=True)
    assert open_recording(path).signals["position"].time.size == 95
    assert "session 3: crazyem" in open_recording(path).metadata


def streamed(path):
    """The same as `stock_messages`, without the index."""
    from mcap.stream_reader import StreamReader

    channels, found = {}, []
    with open(path, "rb") as stream:
        for entry in StreamReader(stream, validate_crcs=True).records:
            kind = type(entry).__name__
            if kind == "Channel":
                channels[entry.id] = entry.topic
            elif kind == "Message":
                found.append((channels[entry.channel_id], entry.sequence, bytes(entry.data)))
    return found


def test_nothing_is_lost_if_the_second_session_dies_at_any_moment(tmp_path):
    path, cut = tmp_path / "f.mcap", tmp_path / "cut.mcap"
    record(path)
    before = path.read_bytes()
    from crazyem.recordings.mcap.append import reopen

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


# --- hostile content behind sound checksums --------------------------------------------------------------------------


PIECES = st.sampled_from([b"\xff\xff\xff\xff", b"9999", b"null", b'"}][']) | st.binary(max_size=2)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_anything_inside_a_sound_chunk_gives_a_recording_or_one_clear_error(small, tmp_path, data):
    """Announcements, metadata and messages of any content, packed again with the right CRC."""
    made = MAGIC
    for start, end, opcode in top_level(small):
        content = small[start + 9 : end]
        if opcode == 6:
            raw = bytearray(mcap_scan.unpack(mcap_scan.parse_chunk(content)))
            for _ in range(data.draw(st.integers(0, 3))):
                at = data.draw(st.integers(0, len(raw) - 1))
                piece = data.draw(PIECES)
                raw[at : at + len(piece)] = piece
            made += chunk_record(zstandard.compress(bytes(raw)), len(raw), zlib.crc32(bytes(raw)))
        else:
            made += small[start:end]
    path = tmp_path / "hostile.mcap"
    path.write_bytes(made + MAGIC)
    for use in (
        lambda: list(open_recording(path).samples()),
        lambda: list(mcap_file.read_parts(path, ReadOptions(), seconds=0.2)),
        lambda: recover(path, tmp_path / "mended.mcap", replace=True),
    ):
        with contextlib.suppress(CrazyemError):
            use()
