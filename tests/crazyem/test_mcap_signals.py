"""Any recording into our MCAP and back: bit for bit, in the order of processing; whole, in parts, by other readers."""

import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest
from any_recording import recordings, same
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from crazyem.errors import UsageError
from crazyem.recordings import Event, Finding, Fix, Grade, ReadOptions, Recording, SignalArray, open_recording
from crazyem.recordings.mcap import file as mcap_file
from crazyem.recordings.mcap.schemas import findings_from_json, findings_to_json
from crazyem.recordings.mcap.signals import write_recording
from crazyem.recordings.mcap.stream_codec import unique_name
from crazyem.signals.sample import SIGNALS

ARRAYS = ("time", "value", "host_time", "marked")


def bits(array):
    return np.ascontiguousarray(array).tobytes()


def assert_round_trip(recording, path):
    """Written and read as it stands there, stamps that cannot be as well: the same, every array bit for bit."""
    write_recording(recording, path, replace=True)
    back = mcap_file.read(path, ReadOptions())
    same(back, recording)
    for name, array in recording.signals.items():
        for key in ARRAYS:
            assert bits(getattr(back.signals[name], key)) == bits(getattr(array, key)), (name, key)


texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=12)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(recordings(texts.filter(lambda name: name and name not in SIGNALS), texts))
@example(Recording("empty", "none", {}))
def test_every_recording_comes_back_the_same(tmp_path, recording):
    assert_round_trip(recording, tmp_path / "r.mcap")


def flight(seconds=3.0, *, rates=(100.0, 10.0), epoch=1.7e9):
    rng = np.random.default_rng(4)
    signals = {}
    for k, (stream, rate) in enumerate(zip(("state", "power"), rates, strict=True)):
        n = int(seconds * rate)
        time = np.arange(n) / rate + 0.001 * k
        order = (np.round(time * 1e4)).astype(np.int64) * 10
        for i, name in enumerate(("position", "attitude") if k == 0 else ("voltage",)):
            value = rng.standard_normal((n, SIGNALS[name][0]))
            signals[name] = SignalArray(
                time, value, order + i + 5 * k, epoch + time, np.zeros(n, bool), name, *SIGNALS[name][1:], "firmware",
                stream, (name,),
            )  # fmt: skip
    return Recording("f", "test", signals, {"a": {"b": "c"}}, events=(Event(epoch + 1.5, "mark", {"x": 1}),))


def test_a_stream_is_one_channel_described_by_its_metadata(tmp_path):
    path = tmp_path / "f.mcap"
    write_recording(flight(), path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = {c.topic: c.metadata for c in summary.channels.values()}
    assert channels.keys() == {"/signals/state", "/signals/power", "/pose", "/tf", "/other_events"}
    position = next(s for s in json.loads(channels["/signals/state"]["signals"]) if s["name"] == "position")
    assert (position["unit"], position["frame"], position["clock"]) == ("m", "world", "firmware")
    assert position["source"] == ["position"]
    assert position["components"] == ["position_x", "position_y", "position_z"]
    assert all(index.uncompressed_size <= 256 * 1024 for index in summary.chunk_indexes)


@pytest.mark.parametrize(
    ("origin", "host", "first"),
    [(0.0, True, 1.7e9), (1.6e9, False, 1.6e9), (0.0, False, 0.0)],
    ids=["host clock", "stamps since 1970", "from zero"],
)
def test_log_times(tmp_path, origin, host, first):
    signals = dict(flight().signals)
    if not host:
        signals = {n: replace(a, host_time=np.full(a.time.size, math.nan)) for n, a in signals.items()}
    path = tmp_path / "f.mcap"
    write_recording(Recording("f", "test", signals, origin=origin), path)
    with path.open("rb") as stream:
        times = [m.log_time / 1e9 for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert times[0] == pytest.approx(first, abs=1e-6)
    assert times[-1] == pytest.approx(first + 2.99, abs=0.05)


def parts_and_whole(path, seconds):
    """The recording read whole, and in parts, whose joined signals and events are the same bit for bit."""
    whole = mcap_file.read(path, ReadOptions())
    parts = list(mcap_file.read_parts(path, ReadOptions(), seconds=seconds))
    assert {name for part in parts for name in part.signals} == set(whole.signals)
    for name, array in whole.signals.items():
        for key in (*ARRAYS, "order"):
            together = np.concatenate([getattr(p.signals[name], key) for p in parts if name in p.signals])
            assert bits(together) == bits(getattr(array, key)), (name, key)
    assert repr([e for part in parts for e in part.events]) == repr(list(whole.events))
    return parts, whole


@pytest.mark.parametrize("cut", [False, True])
def test_parts_add_up_to_the_whole(tmp_path, cut):
    path = tmp_path / "f.mcap"
    write_recording(flight(200.0, rates=(500.0, 10.0)), path)
    if cut:
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    parts, whole = parts_and_whole(path, 20.0)
    assert len(parts) > 4
    assert parts[-1].notices == whole.notices


def test_an_existing_file_is_left_alone(tmp_path):
    path = tmp_path / "f.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(UsageError, match="exists already"):
        write_recording(flight(), path)
    assert path.read_bytes() == b"mine"
    write_recording(flight(), path, replace=True)
    assert open_recording(path).metadata == {"a": {"b": "c"}}
    assert os.listdir(tmp_path) == ["f.mcap"]


def test_nothing_half_written_stays(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UsageError, match="No space left"):
        write_recording(flight(), tmp_path / "f.mcap")
    assert os.listdir(tmp_path) == []
    with pytest.raises(UsageError, match="cannot write"):
        write_recording(flight(), tmp_path / "no" / "f.mcap")


@given(st.lists(texts, max_size=20))
def test_field_names_are_identifiers_and_differ(wanted):
    taken: set[str] = set()
    made = [unique_name(text, taken) for text in wanted]
    assert all(name.isidentifier() and name.isascii() for name in made)
    assert len({name.replace("_", "").lower() for name in made}) == len(made)


def test_many_signals_in_one_stream(tmp_path):
    n = 50
    time, host = np.arange(n) * 0.01, np.full(n, math.nan)
    signals = {
        f"v{i}": SignalArray(time, np.full((n, 1), float(i)), np.arange(n) * 200 + i, host, np.arange(n) % (i + 2) == 0)
        for i in range(150)
    }
    assert_round_trip(Recording("w", "test", signals), tmp_path / "w.mcap")


@pytest.mark.parametrize("runs", [[[5, 1]], [[-1, 3]], [[0, 10**9]]], ids=["back", "before the first", "far too many"])
def test_rows_of_a_repair_that_cannot_be_are_refused(runs):
    good = json.loads(findings_to_json([Finding("gaps", Grade.HARMLESS, "A.", fix=Fix("mark", (), rows=np.arange(3)))]))
    good[0]["fix"]["rows"] = runs
    with pytest.raises(ValueError, match="rows"):
        findings_from_json(json.dumps(good))
