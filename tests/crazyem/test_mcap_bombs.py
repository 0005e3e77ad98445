"""MCAP that claims too much: bombs are refused, other compressions are bounded alike."""

import struct
import zlib

import pytest
import zstandard
from mcap_sessions import MAGIC, chunk_record, chunks, record, small_fixture, top_level

from crazyem.errors import FileFormatError
from crazyem.recordings import open_recording
from crazyem.recordings.mcap import scan as mcap_scan
from crazyem.recordings.mcap.recover import recover

small = pytest.fixture(scope="module")(small_fixture)


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
