"""Copies of a flight are found whatever was done to them; other flights along the same path are not."""

import json
import pickle
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import Motion, array_of, made_flight, without

from crazyem.doctor.duplicates import Duplicate, find_duplicates, fingerprint
from crazyem.recordings import Recording, open_recording

SECONDS = 25.0


@lru_cache(maxsize=8)
def flown(seed: int) -> Recording:
    """One path, flown again with other noise for each seed; the setpoints are the same every time."""
    motion = Motion(seconds=SECONDS, seed=7)
    made = made_flight(motion, seed=seed)
    t = made.signals["position"].time
    setpoint = array_of("setpoint_position", t, motion.position(t), place=20)
    return replace(made, path=f"flight{seed}", signals={**made.signals, "setpoint_position": setpoint})


def copy(
    recording: Recording,
    *,
    start: float = -np.inf,
    end: float = np.inf,
    shift: float = 0.0,
    scale: float = 1.0,
    digits: int | None = None,
    path: str = "copy",
) -> Recording:
    """The samples from start to end [s], their stamps later by shift [s], values scaled, then rounded to digits."""
    signals = {}
    for name, array in recording.signals.items():
        part = array.rows(np.flatnonzero((array.time >= start) & (array.time <= end)))
        value = part.value * scale
        value = value if digits is None else np.round(value, digits)
        signals[name] = replace(part, time=part.time + shift, value=value)
    return replace(recording, signals=signals, path=path)


def found_in(*recordings: Recording) -> list[Duplicate]:
    return find_duplicates([fingerprint(recording) for recording in recordings])


def test_a_copy_is_found_whole() -> None:
    (found,) = found_in(flown(1), copy(flown(1)))
    assert found.offset_s == 0.0
    assert found.share_first == found.share_second == 1.0
    finding = found.finding()
    assert finding.check == "duplicate"
    assert "is the same flight as" in finding.text
    json.dumps(finding.to_dict())
    json.dumps(found.to_dict())


@given(
    start=st.floats(0.0, 15.0), length=st.floats(6.0, 25.0), shift=st.floats(-1e4, 1e4),
    scale=st.sampled_from([1.0, -1.0, 180.0 / np.pi, 1.0 / 9.81, 1e3]), digits=st.sampled_from([None, 7, 5]),
)  # fmt: skip
def test_a_trimmed_shifted_scaled_rounded_copy_is_found(
    start: float, length: float, shift: float, scale: float, digits: int | None
) -> None:
    changed = copy(flown(1), start=start, end=start + length, shift=shift, scale=scale, digits=digits)
    (found,) = found_in(changed, flown(1))
    truth = min(start + length, SECONDS) - start
    assert {found.first, found.second} == {"flight1", "copy"}
    offset = found.offset_s if found.first == "flight1" else -found.offset_s
    assert offset == pytest.approx(shift, abs=0.006)
    assert found.overlap_s == pytest.approx(truth, abs=2.5)
    assert found.share_second > 0.7


def test_single_precision_and_other_names_are_found() -> None:
    other = {
        f"log.{n}": replace(a, value=a.value.astype(np.float32).astype(float), quantity="", unit="")
        for n, a in flown(1).signals.items()
    }
    assert len(found_in(flown(1), replace(flown(1), signals=other, path="other"))) == 1


def test_an_overlap_of_two_cuts_is_found() -> None:
    (found,) = found_in(copy(flown(1), end=16.0, path="a"), copy(flown(1), start=8.0, shift=100.0, path="b"))
    assert found.overlap_s == pytest.approx(8.0, abs=0.7)
    assert abs(found.offset_s) == pytest.approx(100.0, abs=0.006)
    assert "a part in common" in found.finding().text


def test_the_same_path_flown_again_is_another_flight() -> None:
    assert found_in(*(flown(seed) for seed in range(6))) == []


@given(a=st.integers(0, 10_000), b=st.integers(0, 10_000))
def test_other_noise_is_another_flight(a: int, b: int) -> None:
    """Bare noise: the hardest case, since every turning point is one of its."""
    if a == b:
        return
    t = np.arange(0.0, 20.0, 0.01)
    noise = {seed: np.random.default_rng(seed).normal(size=(t.size, 3)) for seed in (a, b)}
    made = [Recording(str(s), "x", {"body_rate": array_of("body_rate", t, value)}) for s, value in noise.items()]
    assert found_in(*made) == []


def test_of_many_copies_each_is_named_once() -> None:
    copies = [copy(flown(1), start=0.1 * i, path=f"copy{i:02d}") for i in range(40)]
    found = found_in(*copies, flown(2), flown(3))
    assert {d.second for d in found} == {f"copy{i:02d}" for i in range(1, 40)}
    assert {d.first for d in found} == {"copy00"}


def test_order_of_the_files_does_not_matter() -> None:
    flights = (flown(1), copy(flown(1), start=3.0), flown(2))
    assert found_in(*flights) == found_in(*flights[::-1])


@pytest.mark.parametrize("names", [(), ("voltage",), ("flying",)])
def test_what_has_no_noise_is_never_a_duplicate(names: tuple[str, ...]) -> None:
    quiet = replace(flown(1), signals={n: flown(1).signals[n] for n in names})
    still = array_of("position", np.arange(100.0), np.zeros((100, 3)))
    for recording in (quiet, Recording("still", "x", {"position": still}), Recording("none", "x", {})):
        found = found_in(recording, replace(recording, path="again"))
        assert len(found) <= ("voltage" in recording.signals)  # its noise is enough
    assert found_in() == []


def test_setpoints_do_not_count() -> None:
    measured = [n for n in flown(1).signals if not n.startswith("setpoint")]
    assert fingerprint(without(flown(1), *measured)).hashes.size == 0


def test_a_fingerprint_travels_between_processes() -> None:
    one = fingerprint(flown(1))
    assert len(pickle.dumps(one)) < 100_000
    assert find_duplicates([one, pickle.loads(pickle.dumps(one))])[0].matches == one.hashes.size


def test_real_flights_are_all_different_and_a_piece_of_one_is_found(shared_recordings: Path) -> None:
    folders = [shared_recordings / f for f in ("crazypad", "nanobench", "sysid")]
    paths = [p for folder in folders for p in sorted(folder.iterdir())]
    recordings = [open_recording(p) for p in paths]
    prints = [fingerprint(recording) for recording in recordings]
    assert find_duplicates(prints) == []
    for i in (0, 12, 26, 30, len(recordings) - 1):
        whole = recordings[i]
        low = min(float(a.time.min()) for a in whole.signals.values() if a.time.size)
        piece = copy(whole, start=low + 9.0, end=low + 16.0, shift=-3.25, digits=5, path="piece")
        (found,) = find_duplicates([*prints, fingerprint(piece)])
        assert (found.first, found.second) == (whole.path, "piece")
        assert found.offset_s == pytest.approx(-3.25, abs=0.006)
        assert found.overlap_s == pytest.approx(7.0, abs=1.0)
