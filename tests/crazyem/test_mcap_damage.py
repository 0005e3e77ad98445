"""Damaged and hostile MCAP files: what is sound is read, in bounded memory, and what is lost is said."""

import contextlib
import re
import struct
import zlib

import lz4.frame
import pytest
import zstandard
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap_sessions import MAGIC, chunk_record, chunks, packets, small_fixture, stock_messages, top_level

from crazyem.errors import CrazyemError, FileFormatError
from crazyem.recordings import ReadOptions, open_recording
from crazyem.recordings.mcap import file as mcap_file
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap.recover import recover

small = pytest.fixture(scope="module")(small_fixture)


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


def test_the_compiled_scan_is_the_plain_one(small):
    for start, end in chunks(small):
        data = mcap_scan.unpack(mcap_scan.parse_chunk(small[start + 9 : end]))
        scan = mcap_scan.scan(data)
        messages, others = plain_scan(data)
        assert scan.messages.tolist() == [list(m) for m in messages]
        assert scan.others.tolist() == [list(o) for o in others]


@given(st.binary(max_size=200))
@example(struct.pack("<BQ", 5, 2**63) + bytes(40))
@example(struct.pack("<BQ", 5, 2**64 - 1) + bytes(40))
@example(struct.pack("<BQ", 5, 2**40) + bytes(40))
def test_random_bytes_in_a_chunk(data):
    try:
        scan = mcap_scan.scan(data)
    except ValueError:
        return
    assert scan.messages.tolist() == [list(m) for m in plain_scan(data)[0]]


def test_truncation_at_any_byte_keeps_every_complete_chunk(small, tmp_path):
    path = tmp_path / "cut.mcap"
    ends = [end for _, end in chunks(small)]
    near = {end + d for end in ends for d in (-1, 0, 1)}
    whole, seen = [list(p.values) for p in packets(0, 60) if p.block == 0], set()
    for size in sorted({*range(0, len(small), 23), *near, *range(len(small) - 40, len(small))}):
        complete = sum(end <= size for end in ends)
        path.write_bytes(small[:size])
        try:
            recording = open_recording(path)
        except FileFormatError:
            assert complete == 0
            continue
        position = recording.signals["position"]
        assert position.value.tolist() == whole[: 15 * complete]
        assert re.search("ends in the middle|was not closed", recording.notices[0])
        seen.add(complete)
    assert seen == {1, 2, 3, 4}


def read_flipped(small, tmp_path, place, flip):
    """Number of samples, and findings, from the file with some bits of one byte flipped."""
    broken = bytearray(small)
    broken[place] ^= flip
    path = tmp_path / "broken.mcap"
    path.write_bytes(bytes(broken))
    recording = open_recording(path)
    return recording.signals["position"].time.size, recording.findings


@pytest.mark.parametrize("number", range(4))
def test_a_damaged_chunk_is_located_and_the_others_are_read(small, tmp_path, number):
    start, end = chunks(small)[number]
    samples, (finding,) = read_flipped(small, tmp_path, (start + end) // 2, 0x40)
    assert samples == 45  # the first as well: the summary repeats its announcements
    assert (finding.check, finding.grade) == ("integrity", "degrades")
    assert finding.evidence["offset_byte"] == start
    assert finding.evidence["lost_byte"] == end - start
    assert f"byte {start}" in finding.text
    if number < 3:
        assert finding.evidence["lost_messages"] == 30


@pytest.mark.parametrize("place", [0, 1, 3, 7])
@pytest.mark.parametrize("number", range(3))
def test_a_damaged_length_costs_one_chunk(small, tmp_path, number, place):
    """The walk finds the next chunk by itself."""
    start, _ = chunks(small)[number]
    samples, (finding, *_) = read_flipped(small, tmp_path, start + place, 0x81)
    assert samples == 45
    assert finding.evidence["offset_byte"] == start


def test_damage_between_chunks_loses_nothing(small, tmp_path):
    index = next(start for start, _, opcode in top_level(small) if opcode == 7)
    samples, (finding, *_) = read_flipped(small, tmp_path, index, 0x52)
    assert samples == 60
    assert finding.evidence["offset_byte"] == index


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
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


# --- hostile content behind sound checksums --------------------------------------------------------------------------


PIECES = st.sampled_from([b"\xff\xff\xff\xff", b"9999", b"null", b'"}][']) | st.binary(max_size=2)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
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
def test_other_compressions(small, tmp_path, compression):
    made = MAGIC
    for start, end, opcode in top_level(small):
        if opcode == 6:
            raw = mcap_scan.unpack(mcap_scan.parse_chunk(small[start + 9 : end]))
            packed = lz4.frame.compress(raw) if compression else raw
            made += chunk_record(packed, len(raw), zlib.crc32(raw), compression.encode())
        elif opcode in (1, 12):
            made += small[start:end]
    path = tmp_path / "b.mcap"
    path.write_bytes(made)
    recording = open_recording(path)
    assert recording.signals["position"].time.size == 60
    assert "not closed" in recording.notices[0]
    at = chunks(made + MAGIC)[1][0]
    path.write_bytes(made[:at] + b"\xf9" + made[at + 1 :])  # no record begins so
    assert open_recording(path).findings[0].evidence["offset_byte"] == at
