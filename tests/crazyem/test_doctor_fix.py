"""Repairs: a fault planted, found, repaired and gone; what does not help is taken back; nothing given is changed."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from doctor_checks import IMU, with_fields
from hypothesis import given
from hypothesis import strategies as st
from made_flight import Motion, changed, made_flight

from crazyem.doctor import examine, fix
from crazyem.doctor.fix import apply_fixes, repair, runs
from crazyem.recordings import Finding, Fix, Grade, Recording

MOTION = Motion(seconds=25.0, seed=3)
GOOD = made_flight(MOTION, seed=3)


def found(kind: str, signals: tuple[str, ...], *, check: str = "reader", **more: object) -> Finding:
    return Finding(check, Grade.DEGRADES, f"{kind} of {signals}", signals[0], fix=Fix(kind, signals, **more))  # type: ignore[arg-type]


def contents(recording: Recording) -> dict[str, tuple[bytes, ...]]:
    return {
        n: (a.time.tobytes(), a.value.tobytes(), a.order.tobytes(), a.host_time.tobytes(), a.marked.tobytes())
        for n, a in recording.signals.items()
    }


def repaired(bad: Recording, check: str) -> tuple[Recording, tuple[Finding, ...]]:
    """What `examine` finds is repaired, gone afterwards, noted, and the input is as it was."""
    before = contents(bad)
    findings = examine(bad)
    assert [f.check for f in findings if f.fix] == [check]
    result, applied = apply_fixes(bad, findings)
    assert [f.check for f in applied] == [check]
    assert contents(bad) == before
    assert "fixes" not in bad.metadata
    assert [f for f in examine(result) if f.fix is not None] == []
    (note,) = result.metadata["fixes"].values()
    assert json.loads(note)["check"] == check
    return result, applied


# planted, found, repaired -----------------------------------------------------------------------------------------


def test_a_sound_flight_is_left_alone() -> None:
    result, applied = apply_fixes(GOOD, examine(GOOD))
    assert result is GOOD
    assert applied == ()


def test_an_inverted_sign_comes_back_bit_for_bit() -> None:
    value = GOOD.signals["body_rate"].value
    result, _ = repaired(changed(GOOD, "body_rate", value=value * [1.0, -1.0, 1.0]), "rates")
    assert contents(result) == contents(GOOD)


def test_a_world_vector_comes_back_into_the_body() -> None:
    gyro = GOOD.signals["body_rate"]
    result, _ = repaired(changed(GOOD, "body_rate", value=MOTION.attitude(gyro.time).apply(gyro.value)), "rates")
    # the logged attitude has noise of 2 mrad and is read between its samples
    left = result.signals["body_rate"].value - gyro.value
    assert np.abs(left).max() < 0.01 * np.abs(gyro.value).max()


def test_a_wrapped_clock_is_unwrapped() -> None:
    span = 2**24 * 1e-3  # 24 bits of milliseconds
    signals = {n: replace(a, time=a.time - np.where(a.time >= 12.0, span, 0.0)) for n, a in GOOD.signals.items()}
    bad = replace(GOOD, signals=signals)
    result, applied = apply_fixes(bad, examine(bad))
    assert {f.fix.kind for f in applied if f.fix} == {"unwrap"}
    for name, array in result.signals.items():
        assert np.allclose(array.time, GOOD.signals[name].time, atol=2e-3), name
    assert [f for f in examine(result) if f.fix is not None] == []
    assert_in_order(result)


def test_a_late_stream_is_shifted_and_merged_anew() -> None:
    result, _ = repaired(with_fields(GOOD, *IMU, time=GOOD.signals["body_rate"].time + 0.04), "lag")
    for name in IMU:
        assert np.allclose(result.signals[name].time, GOOD.signals[name].time, atol=2e-3)
    assert {result.signals[n].stream for n in IMU} == {"imu"}  # they still share their stamps
    assert_in_order(result)


def assert_in_order(recording: Recording) -> None:
    """Samples are handed out in the order of their stamps, each once."""
    orders = np.concatenate([a.order for a in recording.signals.values()])
    times = np.concatenate([a.time for a in recording.signals.values()])
    assert np.unique(orders).size == orders.size
    assert np.all(np.diff(times[np.argsort(orders)]) >= 0.0)


# each kind, against plain arithmetic --------------------------------------------------------------------------------


def test_every_kind_does_what_it_says() -> None:
    gyro = GOOD.signals["body_rate"]
    rows = np.array([5, 6, 7, 100])

    scaled = repair(GOOD, found("scale", ("body_rate",), factor=(2.0, 3.0, -1.0))).signals["body_rate"]
    assert np.array_equal(scaled.value, gyro.value * [2.0, 3.0, -1.0])
    part = repair(GOOD, found("scale", ("body_rate",), factor=(2.0,), rows=rows)).signals["body_rate"]
    assert np.array_equal(np.flatnonzero((part.value != gyro.value).any(axis=1)), rows)

    late = repair(GOOD, found("shift", ("body_rate",), factor=(-0.5,)))
    assert np.array_equal(late.signals["body_rate"].time, gyro.time - 0.5)
    assert late.signals["body_rate"].stream != late.signals["specific_force"].stream  # no longer sampled together
    assert_in_order(late)

    jumps = repair(GOOD, found("unwrap", ("body_rate",), factor=(10.0, 2.0), rows=np.array([50, 60])))
    expected = gyro.time + np.where(np.arange(gyro.time.size) >= 50, 10.0, 0.0)
    expected += np.where(np.arange(gyro.time.size) >= 60, 2.0, 0.0)
    assert np.array_equal(jumps.signals["body_rate"].time, expected)

    gone = repair(GOOD, found("mark", ("body_rate",), rows=rows)).signals["body_rate"]
    assert np.array_equal(np.flatnonzero(gone.marked), rows)
    assert np.array_equal(np.flatnonzero(np.isnan(gone.value).any(axis=1)), rows)


def test_what_has_no_attitude_becomes_missing() -> None:
    attitude = GOOD.signals["attitude"]
    short = attitude.rows(np.flatnonzero(attitude.time < 10.0))
    bad = replace(GOOD, signals={**GOOD.signals, "attitude": short})
    gyro = repair(bad, found("world_to_body", ("body_rate",))).signals["body_rate"]
    lost = gyro.time > 10.1
    assert np.isnan(gyro.value[lost]).all()
    assert gyro.marked[lost].all()
    assert np.isfinite(gyro.value[gyro.time < 9.98]).all()


@given(
    power=st.integers(-8, 8), signs=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
    jump=st.integers(1, 4096), at=st.lists(st.integers(1, 4900), min_size=1, max_size=4, unique=True),
)  # fmt: skip
def test_a_fix_and_its_inverse_are_nothing(power: int, signs: tuple[float, ...], jump: int, at: list[int]) -> None:
    factor = tuple(s * 2.0**power for s in signs)
    there = repair(GOOD, found("scale", ("body_rate",), factor=factor))
    back = repair(there, found("scale", ("body_rate",), factor=tuple(1.0 / f for f in factor)))
    assert contents(back) == contents(GOOD)
    assert len(back.metadata["fixes"]) == 2

    rows = np.sort(np.array(at))
    exact = changed(GOOD, "body_rate", time=np.round(GOOD.signals["body_rate"].time * 1024.0) / 1024.0)
    steps = tuple(jump / 64.0 for _ in at)
    there = repair(exact, found("unwrap", ("body_rate",), factor=steps, rows=rows))
    back = repair(there, found("unwrap", ("body_rate",), factor=tuple(-s for s in steps), rows=rows))
    assert np.array_equal(back.signals["body_rate"].time, exact.signals["body_rate"].time)


@given(st.sets(st.integers(0, 60)))
def test_rows_are_noted_as_runs(rows: set[int]) -> None:
    noted = runs(np.array(sorted(rows), np.int64))
    assert {i for a, b in noted for i in range(a, b + 1)} == rows
    assert all(b + 1 < c for (_, b), (c, _) in pairwise(noted))


# what is believed --------------------------------------------------------------------------------------------------


@dataclass
class Stub:
    """A check whose findings are made by a function of the recording."""

    module: str
    run: Callable[[Recording], list[Finding]]


def test_a_repair_that_does_not_help_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = found("scale", ("body_rate",), check="stubborn", factor=(2.0,))
    monkeypatch.setattr(fix, "CHECKS", [Stub("stubborn", lambda recording: [wrong])])
    result, applied = apply_fixes(GOOD, [wrong])
    assert result is GOOD
    assert applied == ()


def test_what_another_repair_settles_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two checks see one cause: the second repair would do it twice."""
    bad = changed(GOOD, "body_rate", value=GOOD.signals["body_rate"].value * 4.0)
    large = float(np.abs(bad.signals["body_rate"].value).max())

    def make(check: str) -> Callable[[Recording], list[Finding]]:
        one = found("scale", ("body_rate",), check=check, factor=(0.25,))
        return lambda r: [one] if np.abs(r.signals["body_rate"].value).max() > 0.5 * large else []

    checks = [Stub(name, make(name)) for name in ("first", "second")]
    monkeypatch.setattr(fix, "CHECKS", checks)
    result, applied = apply_fixes(bad, [f for c in checks for f in c.run(bad)])
    assert [f.check for f in applied] == ["first"]
    assert contents(result) == contents(GOOD)


def test_rows_are_looked_up_again_after_other_repairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is applied is what the check says of the recording as it is now."""
    spike = changed(GOOD, "body_rate", value=GOOD.signals["body_rate"].value.copy())
    spike.signals["body_rate"].value[70] = 99.0

    def check(recording: Recording) -> list[Finding]:
        value = recording.signals["body_rate"].value
        rows = np.flatnonzero((value > 50.0).any(axis=1))
        return [found("mark", ("body_rate",), check="spikes", rows=rows)] if rows.size else []

    monkeypatch.setattr(fix, "CHECKS", [Stub("spikes", check)])
    stale = found("mark", ("body_rate",), check="spikes", rows=np.array([3]))
    result, applied = apply_fixes(spike, [stale])
    assert applied == (stale,)
    assert np.array_equal(np.flatnonzero(result.signals["body_rate"].marked), [70])


def test_a_finding_of_the_reader_is_applied_as_it_is_and_no_longer_said() -> None:
    said = found("scale", ("body_rate",), check="mapping", factor=(-1.0,))
    other = Finding("mapping", Grade.HARMLESS, "something else")
    result, applied = apply_fixes(replace(GOOD, findings=(said, other)), [said, other])
    assert applied == (said,)
    assert result.findings == (other,)
    assert np.array_equal(result.signals["body_rate"].value, -GOOD.signals["body_rate"].value)


@pytest.mark.parametrize(
    "bad",
    [
        Fix("melt", ("body_rate",)), Fix("scale", ("nothing",), (2.0,)), Fix("scale", ()),
        Fix("scale", ("body_rate",), (2.0, 2.0)), Fix("scale", ("body_rate",), (0.0,)),
        Fix("scale", ("body_rate",), (float("nan"),)),
        Fix("shift", ("body_rate",), ()),
        Fix("shift", ("body_rate",), (float("inf"),)),
        Fix("unwrap", ("body_rate",), (1.0,)),
        Fix("unwrap", ("body_rate",), (1.0,), np.array([1, 2])),
        Fix("mark", ("body_rate",)),
        Fix("mark", ("body_rate",), (), np.array([10**9])),
        Fix("mark", ("body_rate",), (), np.array([-1])),
        Fix("world_to_body", ("voltage",)),
    ],
)  # fmt: skip
def test_what_is_no_repair_is_passed_over(bad: Fix) -> None:
    result, applied = apply_fixes(GOOD, [Finding("reader", Grade.DEGRADES, "odd", fix=bad)])
    assert result is GOOD
    assert applied == ()


def test_several_faults_at_once() -> None:
    bad = changed(GOOD, "body_rate", value=GOOD.signals["body_rate"].value * 180.0 / np.pi)
    bad = changed(bad, "specific_force", value=GOOD.signals["specific_force"].value / 9.81)
    place = np.arange(GOOD.signals["position"].time.size)
    place[[700, 701]] = [701, 700]
    for name in ("position", "velocity", "attitude"):
        good = GOOD.signals[name]
        bad = changed(bad, name, time=good.time[place], value=good.value[place])
    result, applied = apply_fixes(bad, examine(bad))
    assert {f.check for f in applied} == {"clocks", "rates", "forces"}
    for name, array in GOOD.signals.items():
        assert np.array_equal(result.signals[name].time, array.time), name
        assert np.allclose(result.signals[name].value, array.value, rtol=1e-13), name
    assert_in_order(result)
    assert len(result.metadata["fixes"]) == 3
    assert [f for f in examine(result) if f.fix is not None] == []


def test_a_fast_turn_in_degrees_loses_no_sample() -> None:
    """In rad/s such a gyro looks impossible now and then; the unit is put right before anything is thrown away."""
    flight = made_flight(Motion(seconds=20.0, seed=3, size=0.7))
    faulty = changed(flight, "body_rate", value=np.degrees(flight.signals["body_rate"].value))
    assert any(f.check == "numbers" and f.fix is not None and f.fix.kind == "mark" for f in examine(faulty))
    repaired, applied = apply_fixes(faulty, examine(faulty))
    assert any(f.check == "rates" for f in applied)
    assert np.isfinite(repaired.signals["body_rate"].value).all()
