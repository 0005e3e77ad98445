"""The checks on streams: each fault, planted into a good flight anywhere and in any size, is found where it is.

Good flights, made and real, are left alone. What is expected of real flights is counted here, with plain numpy.
"""

import csv
import gzip
import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import Motion, array_of, changed, made_flight, without

from crazyem.doctor.gaps import lost_records
from crazyem.doctor.streams import airtime, cadence, runs
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.options import ReadOptions
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.registry import open_recording
from crazyem.signals.sample import SIGNALS

CHECKS = ("numbers", "gaps", "interpolated", "repeated", "clocks", "frozen", "saturation", "rotor_sensor", "flight")
quick = settings(max_examples=15, deadline=None)


def run(check: str, recording: Recording) -> list[Finding]:
    return importlib.import_module(f"crazyem.doctor.{check}").check(recording)


def everything(recording: Recording) -> list[Finding]:
    return [finding for check in CHECKS for finding in run(check, recording)]


def only(check: str, recording: Recording) -> Finding:
    """The one finding of a check, which no other check repeats as unusable."""
    findings = run(check, recording)
    assert len(findings) == 1, [f.text for f in findings]
    return findings[0]


def covers(finding: Finding, start: float, end: float, slack: float = 0.02) -> bool:
    return any(a - slack <= start and end <= b + slack for a, b in finding.intervals)


@pytest.fixture(scope="module")
def good() -> Recording:
    return made_flight(seconds=20.0, seed=2, more=("rpm", "mocap"))


def with_values(recording: Recording, name: str, rows: slice, value: object) -> Recording:
    values = recording.signals[name].value.copy()
    values[rows] = value
    return changed(recording, name, value=values)


# -- good flights -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"seed": 3, "seconds": 30.0},
        {"motion": Motion(size=0.0)},
        {"motion": Motion(size=0.8, frequency=0.35, turn=1.0)},
        {"jitter": 0.1, "more": ("mocap", "onboard", "rpm", "accelerations", "angles")},
        {"jitter": 0.3},
        {"rates": {"imu": 1000.0, "state": 250.0}},
        {"noise": 0.0},
        {"noise": 5.0},
    ],
)
def test_silent_on_good_flights(options):
    assert [f.text for f in everything(made_flight(**options))] == []


@given(seed=st.integers(0, 10_000), size=st.floats(0.0, 0.7), rate=st.sampled_from([50.0, 100.0, 200.0, 500.0]))
@quick
def test_silent_on_any_good_flight(seed, size, rate):
    recording = made_flight(Motion(seconds=12.0, seed=seed, size=size), seed=seed, rates={"imu": rate}, more=("rpm",))
    assert [f.text for f in everything(recording)] == []


def test_silent_on_coarse_signals_of_a_hover():
    """Millimetres, milliradians and 12 bits repeat by chance; that is no fault."""
    recording = made_flight(Motion(size=0.02, seconds=20.0), noise=0.3, more=("rpm",))
    for name, step in (("position", 1e-3), ("velocity", 1e-2), ("attitude", 2e-3), ("motor_command", 1 / 255)):
        value = recording.signals[name].value
        recording = changed(recording, name, value=np.round(value / step) * step)
    findings = [f for f in everything(recording) if f.check != "numbers"]
    assert [f.text for f in findings] == []


HOSTILE = (0.0, 1.0, -1.0, 0.6, 65535.0, 1e300, -1e300, 5e-324, np.nan, np.inf, -np.inf)


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_nothing_makes_a_check_fail(data):
    """Empty, tiny, unsorted, constant, huge and missing: findings or none, never an error or a warning."""
    signals = {}
    names = st.sampled_from([*SIGNALS, "position@x", "motor.m1", "some.column"])
    for name in data.draw(st.lists(names, min_size=1, max_size=5, unique=True)):
        quantity = name.split("@")[0]
        components = SIGNALS[quantity][0] if quantity in SIGNALS else 1
        n = data.draw(st.sampled_from([0, 1, 2, 3, 9, 60, 120]))
        rng = np.random.default_rng(data.draw(st.integers(0, 99)))
        kind = data.draw(st.sampled_from(["noise", "constant", "hostile", "steps", "nan"]))
        value = {
            "noise": rng.normal(size=(n, components)),
            "constant": np.full((n, components), 0.5),
            "hostile": rng.choice(HOSTILE, (n, components)),
            "steps": np.repeat(rng.normal(size=(n, components)), 5, axis=0)[:n],
            "nan": np.full((n, components), np.nan),
        }[kind]
        steps = data.draw(st.sampled_from(["even", "same", "random", "wild"]))
        time = {
            "even": np.arange(n) * 0.01,
            "same": np.zeros(n),
            "random": rng.random(n) * 3.0,
            "wild": rng.choice([0.0, 1e-9, 1.0, -5.0, 1e9, np.nan, np.inf], n),
        }[steps]
        signals[name] = SignalArray(
            time,
            value,
            np.arange(n),
            time + data.draw(st.sampled_from([np.nan, 0.0, 1.7e9])),
            rng.random(n) < 0.5,
            quantity=quantity if quantity in SIGNALS else "",
            clock=data.draw(st.sampled_from(["firmware", "host"])),
            stream=data.draw(st.sampled_from(["", "a", "b"])),
        )
    for finding in everything(Recording("x", "made", signals)):
        assert finding.text
        assert all(np.isfinite(v) for v in finding.evidence.values()) or finding.check == "numbers"
        assert all(a <= b for a, b in finding.intervals)
        if finding.fix is not None and finding.fix.rows is not None:
            sizes = [signals[name].time.size for name in finding.fix.signals]
            assert finding.fix.rows.max() < min(sizes)


# -- numbers ----------------------------------------------------------------------------------------------------------


@given(at=st.integers(0, 1990), count=st.integers(1, 9), bad=st.sampled_from([np.nan, np.inf, -np.inf]))
@quick
def test_nan_is_found_unless_it_is_marked(good, at, count, bad):
    planted = with_values(good, "velocity", slice(at, at + count), bad)
    finding = only("numbers", planted)
    assert finding.signal == "velocity"
    assert finding.evidence["samples"] == count
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == list(range(at, at + count))
    marked = np.zeros(2000, bool)
    marked[at : at + count] = True
    array = replace(planted.signals["velocity"], marked=marked)
    assert run("numbers", replace(planted, signals={**planted.signals, "velocity": array})) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", 2e4),
        ("velocity", -200.0),
        ("attitude", 0.0),
        ("body_rate", 120.0),
        ("specific_force", 1e3),
        ("motor_command", 1.01),
        ("motor_command", -0.01),
        ("rotor_speed", 33035.6),
        ("voltage", 0.0),
    ],
)
def test_impossible_values_are_found_and_can_be_marked(good, name, value):
    finding = only("numbers", with_values(good, name, slice(700, 703), value))
    assert (finding.signal, finding.evidence["samples"], finding.grade) == (name, 3, Grade.DEGRADES)
    assert finding.fix is not None
    assert finding.fix.kind == "mark"
    time = good.signals[name].time
    assert covers(finding, time[700], time[702], 1e-9)


def test_millivolts_for_volts(good):
    finding = only("numbers", changed(good, "voltage", value=good.signals["voltage"].value * 1000.0))
    assert finding.grade is Grade.UNUSABLE
    assert finding.fix is not None
    assert (finding.fix.kind, finding.fix.factor) == ("scale", (0.001,))


def test_stamps_that_are_no_numbers(good):
    time = good.signals["voltage"].time.copy()
    time[5] = np.nan
    findings = everything(changed(good, "voltage", time=time))
    assert [f.grade for f in findings if f.check == "numbers"] == [Grade.UNUSABLE]


# -- gaps -------------------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10_000),
    loss=st.floats(0.0, 0.3),
    period=st.sampled_from([0.001, 0.00989, 0.0135, 0.02]),
    rounded=st.booleans(),
)
@quick
def test_lost_records_are_counted(seed, loss, period, rounded):
    """Against the truth: which of the regular stamps were taken out."""
    rng = np.random.default_rng(seed)
    kept = rng.random(3000) >= loss
    kept[[0, -1]] = True
    time = np.arange(3000) * period + rng.normal(0.0, 0.03 * period, 3000)
    if rounded and period > 0.005:
        time = np.round(time, 3)  # milliseconds
    truth = np.diff(np.flatnonzero(kept)) - 1
    rhythm = cadence(time[kept])
    assert rhythm.regular
    assert rhythm.period == pytest.approx(period, rel=2e-3)
    assert np.array_equal(lost_records(time[kept], rhythm.period), truth)


def test_a_late_record_is_no_lost_record():
    time = np.arange(1000) * 0.01
    late = time.copy()
    late[100::50] += 0.009  # 19 ms, then 1 ms
    assert lost_records(late, 0.01).sum() == 0
    assert lost_records(np.delete(late, [300, 520, 521]), 0.01).sum() == 3


@given(start=st.floats(2.0, 17.0), lasting=st.floats(0.03, 0.9), stream=st.sampled_from(["state", "imu", "motor"]))
@quick
def test_a_gap_is_found_where_it_is(start, lasting, stream):
    recording = made_flight(seconds=20.0, gaps={stream: [(start, start + lasting)]})
    finding = only("gaps", recording)
    rate = 200.0 if stream == "imu" else 100.0
    assert stream in finding.text
    assert finding.evidence["lost"] == pytest.approx(lasting * rate, abs=1.01)
    assert covers(finding, start + 1 / rate, start + lasting - 1 / rate, 1e-6)
    assert (finding.grade is Grade.DEGRADES) == (
        finding.evidence["longest_s"] > 0.1 or finding.evidence["share"] > 0.05
    )


def test_a_pause_of_everything_is_told_from_losses():
    silence = [(8.0, 11.0)]
    finding = only("gaps", made_flight(seconds=20.0, gaps={"state": silence, "imu": silence, "motor": silence}))
    assert finding.evidence["pauses"] == 1
    assert finding.evidence["silent_s"] == pytest.approx(3.0, abs=0.02)
    assert covers(finding, 8.005, 10.995)


def test_a_stream_that_ends_early_or_begins_late():
    finding = only("gaps", made_flight(seconds=20.0, gaps={"imu": [(12.0, 20.0)]}))
    assert "body_rate" in finding.text
    assert finding.evidence["silent_s"] == pytest.approx(8.0, abs=0.02)
    finding = only("gaps", made_flight(seconds=20.0, gaps={"motor": [(0.0, 3.0)]}))
    assert "first 3.0 s" in finding.text


def test_events_have_no_gaps():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.exponential(0.2, 80))
    events = array_of("acceleration", time, rng.normal(size=(80, 3)), stream="events")
    recording = made_flight(seconds=20.0)
    found = run("gaps", replace(recording, signals={**recording.signals, "acceleration": events}))
    assert [f for f in found if "events" in f.text and "missing" in f.text] == []


# -- interpolated -----------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 1000),
    count=st.integers(1, 40),
    length=st.integers(2, 30),
    name=st.sampled_from(["body_rate", "specific_force", "motor_command", "rotor_speed", "velocity"]),
)
@quick
def test_straight_lines_across_losses_are_found_exactly(good, seed, count, length, name):
    array = good.signals[name]
    rng = np.random.default_rng(seed)
    lost = np.zeros(array.time.size, bool)
    moving = np.flatnonzero((array.time > 2.0) & (array.time < 17.0))
    for at in rng.choice(moving, count, replace=False):
        lost[at : at + length] = True
    value = array.value.copy()
    for column in value.T:
        column[lost] = np.interp(array.time[lost], array.time[~lost], column[~lost])
    finding = only("interpolated", changed(good, name, value=np.round(value, 9)))
    found = np.zeros(lost.size, bool)
    assert finding.fix is not None
    found[finding.fix.rows] = True
    assert not (found & ~lost).any()  # no measured sample is thrown away
    assert (found & lost).sum() >= 0.97 * lost.sum()
    assert finding.signal == name


def test_a_voltage_drawn_from_ten_to_a_hundred_hertz(good):
    array = good.signals["voltage"]
    knots = np.arange(0.03, 20.0, 0.1)
    volts = np.interp(knots, array.time, array.value[:, 0]) + np.random.default_rng(1).normal(0, 0.01, knots.size)
    finding = only("interpolated", changed(good, "voltage", value=np.interp(array.time, knots, volts)[:, None]))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["rate_hz"] == pytest.approx(10.0, rel=0.05)


def test_lines_that_are_no_interpolation(good):
    """Setpoints are drawn; counts and constants are no evidence; smooth signals at a high rate only come close."""
    time = good.signals["position"].time
    ramp = np.column_stack([time, 0.3 * time, np.minimum(time, 1.0)])
    counts = np.round(np.column_stack([time, time, time, time]) * 100.0) / 65535.0
    smooth = np.column_stack([np.sin(3.0 * np.arange(20000) * 1e-3 + k) for k in range(3)])
    signals = {
        "setpoint_position": array_of("setpoint_position", time, ramp, stream="state"),
        "motor_command": array_of("motor_command", time, counts, stream="motor"),
        "position": array_of("position", np.arange(20000) * 1e-3, smooth),
    }
    assert run("interpolated", Recording("x", "made", signals)) == []


# -- repeated ---------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000), rate=st.floats(50.0, 96.0))
@quick
def test_a_nearest_neighbour_regrid_shows_its_real_rate(seed, rate):
    slow = made_flight(Motion(seconds=15.0, seed=seed), seed=seed, rates={"state": rate}, without=("imu",))
    grid = np.arange(0.0, 14.9, 0.01)
    signals = dict(slow.signals)
    for name in ("position", "velocity", "attitude"):
        array = slow.signals[name]
        nearest = np.clip(np.round(grid * rate).astype(int), 0, array.time.size - 1)
        signals[name] = array_of(name, grid, array.value[nearest], stream="state")
    finding = only("repeated", replace(slow, signals=signals))
    assert finding.evidence["rate_hz"] == pytest.approx(rate, rel=0.02)
    assert finding.fix is not None
    assert set(finding.fix.signals) == {"position", "velocity", "attitude"}
    value = signals["velocity"].value
    assert (value[finding.fix.rows] == value[finding.fix.rows - 1]).all()


@pytest.mark.parametrize("hold", [2, 5, 10])
def test_a_slow_sensor_in_a_fast_table_is_a_note(good, hold):
    value = np.repeat(good.signals["voltage"].value[::hold], hold, axis=0)[:2000]
    finding = only("repeated", changed(good, "voltage", value=value))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["rate_hz"] == pytest.approx(100.0 / hold, rel=0.03)


# -- clocks -----------------------------------------------------------------------------------------------------------


def stamped(recording: Recording, stream: str, time: np.ndarray) -> Recording:
    """The recording with other stamps for all signals of a stream."""
    signals = {k: replace(a, time=time) if a.stream == stream else a for k, a in recording.signals.items()}
    return replace(recording, signals=signals)


@given(span=st.sampled_from([2.0**24 / 1e3, 2.0**32 / 1e6, 2.0**32 / 1e3, 65.536]), at=st.floats(0.5, 19.5))
@quick
def test_an_overflow_is_found_and_unwrapped(good, span, at):
    time = good.signals["body_rate"].time
    wrapped = (time + span - at) % span
    finding = next(f for f in run("clocks", stamped(good, "imu", wrapped)) if "overflows" in f.text)
    assert finding.fix is not None
    assert finding.evidence["wrap_s"] == pytest.approx(span)
    repaired = wrapped.copy()
    for row, seconds in zip(finding.fix.rows, finding.fix.factor, strict=True):
        repaired[row:] += seconds
    assert np.diff(repaired) == pytest.approx(np.diff(time), abs=1e-6)


def test_a_restart_is_no_overflow(good):
    time = good.signals["body_rate"].time.copy()
    time[2000:] -= 7.0
    finding = next(f for f in run("clocks", stamped(good, "imu", time)) if f.grade is Grade.UNUSABLE)
    assert finding.evidence["largest_s"] == pytest.approx(7.0, abs=0.01)
    assert finding.evidence["first_row"] == 2000
    assert finding.fix is None


@given(rows=st.lists(st.integers(10, 3900), min_size=1, max_size=20, unique=True))
@quick
def test_records_out_of_order_can_be_sorted(good, rows):
    time = good.signals["body_rate"].time.copy()
    for row in rows:
        time[[row, row + 1]] = time[[row + 1, row]]
    finding = next(f for f in run("clocks", stamped(good, "imu", time)) if "out of order" in f.text)
    assert finding.evidence["records"] == (np.diff(time) < 0).sum()
    assert finding.fix is not None
    assert finding.fix.kind == "sort"


def test_copies_are_told_from_records_with_one_stamp(good):
    imu = {k: a for k, a in good.signals.items() if a.stream == "imu"}
    twice = np.sort(np.concatenate([np.arange(4000), [700, 1900]]))
    copied = {k: array_of(k, a.time[twice], a.value[twice], stream="imu") for k, a in imu.items()}
    finding = only("clocks", replace(good, signals={**good.signals, **copied}))
    assert (finding.evidence["records"], finding.evidence["copies"]) == (2, 2)
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == [701, 1902]
    time = good.signals["body_rate"].time.copy()
    time[1000] = time[999]
    finding = only("clocks", stamped(good, "imu", time))
    assert (finding.evidence["records"], finding.evidence["copies"]) == (1, 0)


@pytest.mark.parametrize("percent", [-1.5, -0.4, 0.4, 1.1])
def test_a_rate_beside_the_nominal_one(good, percent):
    time = good.signals["body_rate"].time / (1.0 + percent / 100.0)
    finding = only("clocks", stamped(good, "imu", time))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["deviation_percent"] == pytest.approx(percent, abs=0.02)
    assert finding.evidence["nominal_hz"] == 200.0


def test_a_rate_other_than_claimed(good):
    claimed = replace(good, metadata={"claims": {"imu.rate_hz": "250"}})
    finding = only("clocks", claimed)
    assert finding.grade is Grade.DEGRADES
    assert finding.evidence["real_hz"] == pytest.approx(200.0, rel=1e-3)


@given(ppm=st.sampled_from([-20000.0, -3000.0, 2000.0, 15000.0]), seed=st.integers(0, 100))
@quick
def test_drift_against_the_host(good, ppm, seed):
    """Arrivals late by random delays only: 1 ms and an exponential tail of 3 ms."""
    rng = np.random.default_rng(seed)
    array = good.signals["body_rate"]
    host = 1.7e9 + array.time / (1.0 + ppm * 1e-6) + 1e-3 + rng.exponential(3e-3, array.time.size)
    signals = {k: replace(a, host_time=host) if a.stream == "imu" else a for k, a in good.signals.items()}
    finding = next(f for f in run("clocks", replace(good, signals=signals)) if "against the host" in f.text)
    assert finding.evidence["drift_ppm"] == pytest.approx(ppm, rel=0.05, abs=100.0)


def test_a_jump_of_the_clock_against_the_host(good):
    array = good.signals["body_rate"]
    rng = np.random.default_rng(0)
    host = 1.7e9 + array.time + rng.exponential(3e-3, array.time.size)
    time = array.time.copy()
    time[2500:] += 2.0
    signals = {k: replace(a, host_time=host, time=time) if a.stream == "imu" else a for k, a in good.signals.items()}
    finding = next(f for f in run("clocks", replace(good, signals=signals)) if "jumps" in f.text)
    assert finding.evidence["largest_s"] == pytest.approx(2.0, abs=0.02)
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == [2500]
    assert finding.fix.factor[0] == pytest.approx(-2.0, abs=0.02)


# -- frozen -----------------------------------------------------------------------------------------------------------


@given(
    name=st.sampled_from(["body_rate", "specific_force", "position", "attitude", "velocity"]),
    start=st.floats(4.0, 12.0),
    lasting=st.floats(0.7, 3.0),
)
@quick
def test_a_stuck_signal_is_found_where_it_is(good, name, start, lasting):
    array = good.signals[name]
    first, last = np.searchsorted(array.time, [start, start + lasting])
    finding = only("frozen", with_values(good, name, slice(first, last), array.value[first]))
    assert finding.signal == name
    assert covers(finding, array.time[first], array.time[last - 1])
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == list(range(first + 1, last))


@pytest.mark.parametrize(("name", "axis"), [("body_rate", 2), ("specific_force", 0), ("rotor_speed", 1)])
def test_a_stuck_component(good, name, axis):
    array = good.signals[name]
    first, last = np.searchsorted(array.time, [6.0, 9.0])
    value = array.value.copy()
    value[first:last, axis] = value[first, axis]
    finding = only("frozen", changed(good, name, value=value))
    assert array.components[axis] in finding.text
    assert covers(finding, 6.0, array.time[last - 1])


def test_a_log_that_stands_still_is_one_finding(good):
    rows = slice(800, 1000)
    planted = good
    for name in ("position", "velocity", "attitude"):
        planted = with_values(planted, name, rows, good.signals[name].value[800])
    finding = only("frozen", planted)
    assert finding.fix is not None
    assert set(finding.fix.signals) == {"position", "velocity", "attitude"}


def test_columns_not_in_use_are_one_note(good):
    time = good.signals["position"].time
    spare = {n: replace(array_of("voltage", time, np.zeros(2000)), quantity="") for n in ("pid.a", "pid.b")}
    finding = only("frozen", replace(good, signals={**good.signals, **spare}))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["columns"] == 2


# -- saturation -------------------------------------------------------------------------------------------------------


@given(rotor=st.integers(0, 3), start=st.floats(4.0, 14.0), lasting=st.floats(0.03, 2.0))
@quick
def test_a_rotor_at_its_limit(good, rotor, start, lasting):
    array = good.signals["motor_command"]
    first, last = np.searchsorted(array.time, [start, start + lasting])
    value = array.value.copy()
    value[first:last, rotor] = 1.0
    finding = only("saturation", changed(good, "motor_command", value=value))
    assert covers(finding, array.time[first], array.time[last - 1])
    flight = airtime(good)
    assert flight is not None
    airborne = sum(b - a for a, b in flight.airborne)
    assert finding.evidence[f"share_m{rotor + 1}"] == pytest.approx((last - first) / 100.0 / airborne, rel=0.02)
    assert finding.evidence["share"] == finding.evidence[f"share_m{rotor + 1}"]
    assert (finding.grade is Grade.DEGRADES) == (finding.evidence["share"] >= 0.005)


def test_a_cap_below_full_duty(good):
    value = np.minimum(good.signals["motor_command"].value, 0.75 * good.signals["motor_command"].value.max())
    value = value / value.max() * 0.93
    finding = only("saturation", changed(good, "motor_command", value=value))
    assert finding.evidence["ceiling"] == pytest.approx(0.93)


def test_idle_in_the_air(good):
    array = good.signals["motor_command"]
    value = np.where(array.value > 0, np.maximum(array.value, 0.15), 0.0)
    value[900:920, 2] = 0.15
    finding = only("saturation", changed(good, "motor_command", value=value))
    assert "lower limit" in finding.text
    assert covers(finding, array.time[900], array.time[919])


# -- rotor sensor -----------------------------------------------------------------------------------------------------


@given(
    rotor=st.integers(0, 3),
    at=st.integers(500, 1400),
    length=st.integers(1, 200),
    fraction=st.sampled_from([1 / 2, 1 / 3, 1 / 4, 2.0]),
    duty=st.booleans(),
)
@quick
def test_a_sensor_that_counts_a_fraction(good, rotor, at, length, fraction, duty):
    recording = good if duty else without(good, "motor_command")
    value = good.signals["rotor_speed"].value.copy()
    value[at : at + length, rotor] *= fraction
    finding = only("rotor_sensor", changed(recording, "rotor_speed", value=value))
    assert finding.evidence["rotor"] == rotor + 1
    assert finding.evidence["ratio"] == pytest.approx(fraction)
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == list(range(at, at + length))


@given(rotor=st.integers(0, 3), at=st.integers(500, 1400), length=st.integers(1, 100))
@quick
def test_a_sensor_that_drops_to_zero(good, rotor, at, length):
    value = good.signals["rotor_speed"].value.copy()
    value[at : at + length, rotor] = 0.0
    finding = only("rotor_sensor", changed(good, "rotor_speed", value=value))
    assert "zero" in finding.text
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == list(range(at, at + length))


def test_a_sensor_that_always_counts_half(good):
    value = good.signals["rotor_speed"].value * np.array([1.0, 1.0, 0.5, 1.0])
    finding = only("rotor_sensor", changed(good, "rotor_speed", value=value))
    assert finding.fix is not None
    assert (finding.fix.kind, finding.fix.factor) == ("scale", (1.0, 1.0, 2.0, 1.0))


def test_missing_speeds_are_counted(good):
    array = good.signals["rotor_speed"]
    value = array.value.copy()
    value[800:805, 1] = np.nan
    missing = replace(array, value=value, marked=~np.isfinite(value).all(axis=1))
    finding = only("rotor_sensor", replace(good, signals={**good.signals, "rotor_speed": missing}))
    assert finding.evidence["samples"] == 5


# -- flight -----------------------------------------------------------------------------------------------------------


def test_never_left_the_ground(good):
    ground = with_values(good, "motor_command", slice(None), 0.05)
    ground = without(with_values(ground, "position", slice(None), [0.0, 0.0, 0.01]), "rotor_speed")
    assert only("flight", ground).grade is Grade.UNUSABLE


def test_rotors_that_turn_on_the_ground(good):
    finding = only("flight", with_values(good, "position", slice(None), [0.0, 0.0, 0.01]))
    assert finding.grade is Grade.UNUSABLE
    assert "did not leave" in finding.text


@given(at=st.floats(4.0, 15.0), lasting=st.floats(0.05, 1.0))
@quick
def test_upside_down(good, at, lasting):
    array = good.signals["attitude"]
    first, last = np.searchsorted(array.time, [at, at + lasting])
    finding = only("flight", with_values(good, "attitude", slice(first, last), [1.0, 0.0, 0.0, 0.0]))
    assert finding.evidence["tilt_deg"] == pytest.approx(180.0)
    assert covers(finding, array.time[first], array.time[last - 1])


@pytest.mark.parametrize("told_by", ["attitude", "specific_force"])
def test_a_crash_that_ends_on_the_side(told_by):
    good = made_flight(seconds=20.0)
    flight = airtime(good)
    assert flight is not None
    end = flight.lifting[-1][1]
    array = good.signals[told_by]
    value = array.value.copy()
    rows = array.time > end + 0.1
    value[rows] = [np.sin(0.75), 0.0, 0.0, np.cos(0.75)] if told_by == "attitude" else [0.0, 9.8, 0.5]
    other = {"attitude": "specific_force", "specific_force": "attitude"}[told_by]
    finding = only("flight", without(changed(good, told_by, value=value), other))
    assert "crashed" in finding.text
    assert finding.evidence["rest_tilt_deg"] == pytest.approx(86.0, abs=2.0)


@pytest.mark.parametrize("height", [0.5, 0.8])
def test_rotors_cut_at_height(good, height):
    """Free fall from there: the speed at the ground is that of the closed form."""
    time = good.signals["position"].time
    z = good.signals["position"].value[:, 2].copy()
    cut = float(time[np.flatnonzero((time > 15.0) & (z < height))[0]])
    value = good.signals["position"].value.copy()
    fall = np.maximum(height - 0.5 * 9.81 * np.maximum(time - cut, 0.0) ** 2, 0.0)
    value[time >= cut, 2] = fall[time >= cut]
    planted = changed(good, "position", value=value)
    for name in ("motor_command", "rotor_speed"):
        array = good.signals[name]
        planted = with_values(planted, name, slice(int(np.searchsorted(array.time, cut)), None), 0.0)
    found = {f.text.split(" at ")[0].split(" stop")[0]: f for f in run("flight", planted)}
    assert set(found) == {"The drone hits the ground", "The rotors"}
    speed = found["The drone hits the ground"].evidence["speed_m_s"]
    assert speed == pytest.approx(np.sqrt(2 * 9.81 * (height - 0.05)), rel=0.15)
    assert found["The rotors"].evidence["height_m"] == pytest.approx(height, abs=0.05)


# -- real flights -----------------------------------------------------------------------------------------------------


def column(path: Path, name: str) -> np.ndarray:
    """A column of a packed CSV, read without the project."""
    with gzip.open(path, "rt", newline="") as file:
        return np.array([float(row[name] or "nan") for row in csv.DictReader(file)])


def test_real_saturation_is_counted_right(shared_recordings):
    path = shared_recordings / "nanobench" / "B3_figure8_fast_rep2.csv.gz"
    finding = next(f for f in run("saturation", open_recording(path)) if "upper" in f.text)
    at_limit = int((column(path, "motor_motor_m4") >= 65535).sum())
    assert finding.evidence["share_m4"] == max(finding.evidence[f"share_m{i}"] for i in (1, 2, 3, 4))
    flight = airtime(open_recording(path))
    assert flight is not None
    seconds = sum(b - a for a, b in flight.airborne)
    # some of them were interpolated, and are missing
    assert 0.9 * at_limit <= finding.evidence["share_m4"] * seconds * 100.0 <= 1.3 * at_limit
    assert "low battery" in finding.text


def test_real_regrid(shared_recordings):
    """Rows of random_run1 that repeat the one before in all of 13 onboard columns, counted by hand."""
    path = shared_recordings / "nanodrone" / "raw" / "random_run1.csv.gz"
    names = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz", "qx", "qy", "qz", "qw")
    table = np.column_stack([column(path, name) for name in names])
    share = float((table[1:] == table[:-1]).all(axis=1).mean())
    finding = next(f for f in run("repeated", open_recording(path)) if "whole rows" in f.text)
    assert finding.evidence["share"] == pytest.approx(share, abs=0.02)
    assert finding.evidence["rate_hz"] == pytest.approx(74.0, abs=1.0)


def test_real_log_that_stood_still(shared_recordings):
    path = shared_recordings / "nanodrone" / "raw" / "square_run1.csv.gz"
    finding = only("frozen", open_recording(path))
    t = column(path, "t")
    table = np.column_stack([column(path, name) for name in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")])
    still = np.concatenate([[False], (np.diff(table, axis=0) == 0).all(axis=1)]) & (t < 6.5)
    first, last = max(runs(still).tolist(), key=lambda span: span[1] - span[0])
    assert finding.intervals[0] == pytest.approx((t[first - 1], t[last - 1]), abs=0.03)
    assert finding.evidence["longest_s"] == pytest.approx(2.0, abs=0.05)


def test_real_impossible_rotor_speeds(shared_recordings):
    path = shared_recordings / "nanodrone" / "raw" / "chirp_run1.csv.gz"
    speeds = np.column_stack([column(path, f"m{i}_erpm") for i in (1, 2, 3, 4)])
    rows = np.flatnonzero(((speeds > 1e6) & (speeds != 65535)).any(axis=1))
    finding = only("numbers", open_recording(path))
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == rows.tolist()


def test_real_crash_and_real_rough_landing(shared_recordings):
    """log10 ends on its back: the accelerometer at rest shows minus 1 g. log15 lands at 78 m/s^2 and stays upright."""
    options = ReadOptions(motor="duty")
    crash = open_recording(shared_recordings / "sysid" / "log10", options)
    assert crash.signals["specific_force"].value[-500:, 2].mean() == pytest.approx(-9.94, abs=0.05)
    finding = only("flight", crash)
    assert finding.evidence["rest_tilt_deg"] == pytest.approx(178.0, abs=1.0)
    assert run("flight", open_recording(shared_recordings / "sysid" / "log15", options)) == []


def test_real_fast_clock_and_dropped_records(shared_recordings):
    path = shared_recordings / "crazypad" / "motor__cut_propeller_M3_1mm_46mm__E8_log01"
    recording = open_recording(path)
    time = next(iter(recording.signals.values())).time
    steps = np.diff(time)
    gap = only("gaps", recording)
    assert gap.evidence["longest_s"] == pytest.approx(steps.max())
    assert gap.evidence["lost"] == round(float((steps[steps > 0.015] / np.median(steps) - 1).sum()))
    rate = only("clocks", recording)
    assert rate.evidence["deviation_percent"] == pytest.approx(100 * (0.01 / np.median(steps) - 1), abs=0.1)


def test_the_real_firmware_on_a_slow_computer(shared_recordings):
    """Its clock falls behind the host's by what the first and last packet say."""
    recording = open_recording(shared_recordings / "real_firmware" / "lee_brushless_39g.csv.gz")
    array = recording.signals["position"]
    behind = float((array.host_time[-1] - array.host_time[0]) - (array.time[-1] - array.time[0]))
    finding = next(f for f in run("clocks", recording) if "host" in f.text)
    assert finding.evidence["apart_s"] == pytest.approx(behind, rel=0.3)
    assert behind > 0.2


# What of each real flight is worse than harmless: reviewed one by one against the numbers (docs/doctor_streams.md).
REAL: dict[str, set[str]] = {
    "motor__add_weight_W1_near_M3_M4__E8_log00": {"saturation"},
    "motor__cut_M2_2.5mm_2.0mm_42.5mm_M1_2.0mm_2.0mm_43mm__E9_log00": {"saturation"},
    "motor__cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00": {"saturation"},
    "motor__cut_propeller_M3_3.5mm_3.5mm_40mm__E8_log00": {"saturation"},
    "B2_circle_fast_rep1.csv.gz": {"saturation"},
    "B2_circle_fast_rep3.csv.gz": {"saturation"},
    "B3_figure8_fast_rep2.csv.gz": {"saturation"},
    "B3_figure8_medium_rep1.csv.gz": {"saturation"},
    "B6_linear_ramp_rep2.csv.gz": {"saturation"},
    "B9_trefoil_fast_rep1.csv.gz": {"saturation", "gaps"},
    "raw/chirp_run1.csv.gz": {"saturation", "repeated", "numbers"},
    "raw/chirp_run2.csv.gz": {"saturation", "repeated"},
    "raw/chirp_run3.csv.gz": {"saturation"},
    "raw/chirp_run4.csv.gz": {"saturation", "repeated", "numbers", "flight"},
    "raw/random_run1.csv.gz": {"saturation", "repeated"},
    "raw/random_run2.csv.gz": {"saturation", "repeated"},
    "raw/random_run3.csv.gz": {"saturation", "repeated"},
    "raw/random_run4.csv.gz": {"saturation", "repeated"},
    "raw/square_run1.csv.gz": {"saturation", "repeated", "frozen"},
    "raw/square_run2.csv.gz": {"saturation", "repeated"},
    "raw/square_run3.csv.gz": {"saturation", "repeated"},
    "raw/square_run4.csv.gz": {"saturation", "repeated"},
    "processed/chirp_run2.csv.gz": {"repeated"},
    "processed/random_run1.csv.gz": {"repeated"},
    "processed/random_run3.csv.gz": {"repeated"},
    "processed/random_run4.csv.gz": {"repeated"},
    "processed/square_run2.csv.gz": {"repeated"},
    "processed/square_run4.csv.gz": {"repeated"},
    "log10": {"saturation", "flight"},
}


@pytest.mark.slow
def test_every_real_flight_as_reviewed(shared_recordings):
    files = sorted(p for p in shared_recordings.rglob("*") if p.is_file() and "truth" not in p.name)
    differences = {}
    for path in files:
        name = f"{path.parent.name}/{path.name}" if "nanodrone" in str(path) else path.name
        recording = open_recording(path, ReadOptions(motor="duty" if path.parent.name == "sysid" else None))
        found = {f.check for f in everything(recording) if f.grade is not Grade.HARMLESS}
        if found != REAL.get(name, set()):
            differences[name] = (sorted(found), sorted(REAL.get(name, set())))
    assert differences == {}
