"""The checks on streams: each fault, planted into a good flight anywhere and in any size, is found where it is.

Here: good and hostile flights before every check; numbers, gaps, interpolated, repeated. The rest:
test_doctor_health.py and test_doctor_kinematics.py.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from doctor_checks import covers, everything, only, rows_of, run, with_fields, with_values
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import MORE, Motion, array_of, changed, made_flight

from crazyem.doctor.gaps import lost_records
from crazyem.doctor.streams import cadence
from crazyem.recordings.finding import Grade
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.sample import SIGNALS


@pytest.fixture(scope="module")
def good() -> Recording:
    return made_flight(seconds=20.0, seed=2, more=("rpm", "mocap"))


# -- good flights -----------------------------------------------------------------------------------------------------


GOOD: dict[str, dict[str, Any]] = {
    "as made": {"seed": 3, "seconds": 30.0},
    "hover": {"motion": Motion(seconds=20.0, size=0.0, yaw=0.0)},
    "slow and noisy": {"motion": Motion(seconds=20.0, size=0.15, yaw=0.0), "noise": 3.0},
    "fast, turning": {"motion": Motion(size=0.8, frequency=0.35, turn=1.0)},
    "jitter": {"jitter": 0.3},
    "74 Hz and 1 kHz": {"motion": Motion(seconds=20.0, turn=1.0), "rates": {"state": 74.0, "imu": 1000.0}},
    "30 Hz": {"seconds": 25.0, "rates": {"state": 30.0, "imu": 100.0}, "noise": 2.0},
    "angles at 1 kHz": {"seconds": 12.0, "rates": {"angles": 1000.0}, "more": ["angles"]},
    "no noise": {"noise": 0.0},
    "no pose": {"seconds": 20.0, "without": ["state"]},
    "no IMU": {"seconds": 20.0, "without": ["imu"]},
}


@pytest.mark.parametrize("kind", GOOD)
def test_silent_on_good_flights(kind):
    assert [f.text for f in everything(made_flight(**GOOD[kind]))] == []


@given(
    seed=st.integers(0, 100_000), size=st.floats(0.0, 0.8), turn=st.floats(-1.0, 1.0), noise=st.floats(0.2, 4.0),
    rate=st.sampled_from([50.0, 100.0, 200.0, 500.0]),
)  # fmt: skip
@settings(max_examples=settings.default.max_examples // 3)
def test_silent_on_any_good_flight(seed, size, turn, noise, rate):
    motion = Motion(seconds=15.0, seed=seed, size=size, turn=turn)
    recording = made_flight(motion, seed=seed, noise=noise, rates={"imu": rate}, jitter=0.1, more=tuple(MORE))
    assert [f.text for f in everything(recording)] == []


def test_silent_on_coarse_signals_of_a_hover():
    """Millimetres, milliradians and 12 bits repeat by chance; that is no fault."""
    recording = made_flight(Motion(size=0.02, seconds=20.0), noise=0.3, more=("rpm",))
    for name, step in (("position", 1e-3), ("velocity", 1e-2), ("attitude", 2e-3), ("motor_command", 1 / 255)):
        recording = changed(recording, name, value=np.round(recording.signals[name].value / step) * step)
    assert [f.text for f in everything(recording) if f.check != "numbers"] == []


HOSTILE = (0.0, 1.0, -1.0, 0.6, 65535.0, 1e300, -1e300, 5e-324, np.nan, np.inf, -np.inf)
NAMES = [*SIGNALS, "position@x", "attitude@x", "euler@x", "motor.m1", "some.column"]
WILD = (0.0, 1e-9, 1.0, -5.0, 1e9, np.nan, np.inf)  # s


@given(data=st.data())
def test_nothing_makes_a_check_fail(data):
    """Empty, tiny, unsorted, constant, huge and missing: findings or none, never an error or a warning."""
    signals = {}
    few = st.lists(st.sampled_from(NAMES), min_size=1, max_size=5, unique=True)
    for name in data.draw(few | st.just(NAMES) | st.just(NAMES[::-1])):
        quantity = name.split("@")[0] if name.split("@")[0] in SIGNALS else ""
        components = SIGNALS[quantity][0] if quantity else 1
        n = data.draw(st.sampled_from([0, 1, 3, 9, 60, 120, 900]))
        rng = np.random.default_rng(data.draw(st.integers(0, 99)))
        noise = rng.normal(size=(n, components))
        values = [noise, 10.0 ** rng.integers(-300, 300) * noise, np.full_like(noise, 0.5), np.full_like(noise, np.nan)]
        values += [rng.choice(HOSTILE, noise.shape), np.repeat(noise, 5, axis=0)[:n]]
        values.append(np.where(rng.random(noise.shape) < 0.05, rng.choice(HOSTILE, noise.shape), noise))
        times = [np.arange(n) * 0.01, np.zeros(n), rng.random(n) * 3.0]
        times += [rng.choice(WILD, n), np.cumsum(rng.choice([0.0, 0.01, 0.01, 0.01, -0.01, 3.0], n))]
        time = data.draw(st.sampled_from(range(len(times))).map(times.__getitem__))
        signals[name] = SignalArray(
            time, data.draw(st.sampled_from(range(len(values))).map(values.__getitem__)), np.arange(n),
            time + data.draw(st.sampled_from([np.nan, 0.0, 1.7e9])), rng.random(n) < 0.5, quantity=quantity,
            clock=data.draw(st.sampled_from(["firmware", "host"])), stream=data.draw(st.sampled_from(["", "a", "b"])),
        )  # fmt: skip
    for finding in everything(Recording("x", "made", signals, {"claims": {"mass_kg": "0.03"}})):
        assert finding.text
        assert all(np.isfinite(v) for v in finding.evidence.values()) or finding.check == "numbers"
        assert all(a <= b for a, b in finding.intervals)
        if finding.fix is not None and finding.fix.rows is not None:
            sizes = [signals[name].time.size for name in finding.fix.signals]
            assert finding.fix.rows.max() < min(sizes)


# -- numbers ----------------------------------------------------------------------------------------------------------


@given(at=st.integers(0, 1990), count=st.integers(1, 9), bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_nan_is_found_unless_it_is_marked(good, at, count, bad):
    planted = with_values(good, "velocity", slice(at, at + count), bad)
    finding = only("numbers", planted)
    assert (finding.signal, finding.evidence["samples"]) == ("velocity", count)
    assert rows_of(finding) == list(range(at, at + count))
    marked = np.isin(np.arange(2000), rows_of(finding))
    assert run("numbers", with_fields(planted, "velocity", marked=marked)) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", 2e4), ("velocity", -200.0), ("attitude", 0.0), ("body_rate", 120.0), ("specific_force", 1e3),
        ("motor_command", 1.01), ("motor_command", -0.01), ("rotor_speed", 33035.6), ("voltage", 0.0),
    ],
)  # fmt: skip
def test_impossible_values_are_found_and_can_be_marked(good, name, value):
    finding = only("numbers", with_values(good, name, slice(700, 703), value))
    assert (finding.signal, finding.evidence["samples"], finding.grade) == (name, 3, Grade.DEGRADES)
    assert finding.fix.kind == "mark"
    time = good.signals[name].time
    assert covers(finding, time[700], time[702], 1e-9)


def test_millivolts_for_volts(good):
    finding = only("numbers", changed(good, "voltage", value=good.signals["voltage"].value * 1000.0))
    assert (finding.grade, finding.fix.kind, finding.fix.factor) == (Grade.UNUSABLE, "scale", (0.001,))


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
    finding = only("gaps", made_flight(seconds=20.0, gaps=dict.fromkeys(("state", "imu", "motor"), silence)))
    assert finding.evidence["pauses"] == 1
    assert finding.evidence["silent_s"] == pytest.approx(3.0, abs=0.02)
    assert covers(finding, 8.005, 10.995)


def test_a_stream_that_ends_early_or_begins_late():
    finding = only("gaps", made_flight(seconds=20.0, gaps={"imu": [(12.0, 20.0)]}))
    assert "body_rate" in finding.text
    assert finding.evidence["silent_s"] == pytest.approx(8.0, abs=0.02)
    finding = only("gaps", made_flight(seconds=20.0, gaps={"motor": [(0.0, 3.0)]}))
    assert "first 3.0 s" in finding.text


def test_gaps_are_no_other_fault():
    recording = made_flight(seconds=25.0, gaps={"imu": [(8.0, 11.0)], "state": [(15.0, 15.3)]})
    assert {f.check for f in everything(recording)} == {"gaps"}


def test_events_have_no_gaps():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.exponential(0.2, 80))
    events = array_of("acceleration", time, rng.normal(size=(80, 3)), stream="events")
    recording = made_flight(seconds=20.0)
    found = run("gaps", replace(recording, signals={**recording.signals, "acceleration": events}))
    assert not any("events" in f.text and "missing" in f.text for f in found)


# -- interpolated -----------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 1000),
    count=st.integers(1, 40),
    length=st.integers(2, 30),
    name=st.sampled_from(["body_rate", "specific_force", "motor_command", "rotor_speed", "velocity"]),
)
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
    found = rows_of(finding)
    assert lost[found].all()  # no measured sample is thrown away
    assert len(found) >= 0.97 * lost.sum()
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
    assert set(finding.fix.signals) == {"position", "velocity", "attitude"}
    value = signals["velocity"].value
    assert (value[finding.fix.rows] == value[finding.fix.rows - 1]).all()


@pytest.mark.parametrize("hold", [2, 5, 10])
def test_a_slow_sensor_in_a_fast_table_is_a_note(good, hold):
    value = np.repeat(good.signals["voltage"].value[::hold], hold, axis=0)[:2000]
    finding = only("repeated", changed(good, "voltage", value=value))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["rate_hz"] == pytest.approx(100.0 / hold, rel=0.03)
