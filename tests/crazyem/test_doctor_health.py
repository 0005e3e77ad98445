"""The checks clocks, frozen, saturation, rotor_sensor and flight: a planted fault is found where it is."""

from dataclasses import replace

import numpy as np
import pytest
from doctor_checks import IMU, covers, only, rows_of, run, with_fields, with_values
from hypothesis import given
from hypothesis import strategies as st
from made_flight import array_of, changed, made_flight, without

from crazyem.doctor.fix import apply_fixes
from crazyem.recordings.airborne import _off_the_ground, airtime
from crazyem.recordings.finding import Grade
from crazyem.recordings.recording import Recording


@pytest.fixture(scope="module")
def good() -> Recording:
    return made_flight(seconds=20.0, seed=2, more=("rpm", "mocap"))


# -- clocks -----------------------------------------------------------------------------------------------------------


@given(span=st.sampled_from([2.0**24 / 1e3, 2.0**32 / 1e6, 2.0**32 / 1e3, 65.536]), at=st.floats(0.5, 19.5))
def test_an_overflow_is_found_and_unwrapped(good, span, at):
    time = good.signals["body_rate"].time
    wrapped = (time + span - at) % span
    finding = next(f for f in run("clocks", with_fields(good, *IMU, time=wrapped)) if "overflows" in f.text)
    assert finding.evidence["wrap_s"] == pytest.approx(span)
    for row, seconds in zip(rows_of(finding), finding.fix.factor, strict=True):
        wrapped[row:] += seconds
    assert np.diff(wrapped) == pytest.approx(np.diff(time), abs=1e-6)


def test_a_restart_is_no_overflow(good):
    time = good.signals["body_rate"].time.copy()
    time[2000:] -= 7.0
    finding = next(f for f in run("clocks", with_fields(good, *IMU, time=time)) if f.grade is Grade.UNUSABLE)
    assert finding.evidence["largest_s"] == pytest.approx(7.0, abs=0.01)
    assert (finding.evidence["first_row"], finding.fix) == (2000, None)


@given(rows=st.lists(st.integers(10, 3900), min_size=1, max_size=20, unique=True))
def test_records_out_of_order_can_be_sorted(good, rows):
    time = good.signals["body_rate"].time.copy()
    for row in rows:
        time[[row, row + 1]] = time[[row + 1, row]]
    finding = next(f for f in run("clocks", with_fields(good, *IMU, time=time)) if "out of order" in f.text)
    assert finding.evidence["records"] == (np.diff(time) < 0).sum()
    assert finding.fix.kind == "sort"


def test_copies_are_told_from_records_with_one_stamp(good):
    imu = {k: a for k, a in good.signals.items() if a.stream == "imu"}
    twice = np.sort(np.concatenate([np.arange(4000), [700, 1900]]))
    copied = {k: array_of(k, a.time[twice], a.value[twice], stream="imu") for k, a in imu.items()}
    finding = only("clocks", replace(good, signals={**good.signals, **copied}))
    assert (finding.evidence["records"], finding.evidence["copies"]) == (2, 2)
    assert rows_of(finding) == [701, 1902]
    time = good.signals["body_rate"].time.copy()
    time[1000] = time[999]
    finding = only("clocks", with_fields(good, *IMU, time=time))
    assert (finding.evidence["records"], finding.evidence["copies"]) == (1, 0)


@pytest.mark.parametrize("percent", [-1.5, -0.4, 0.4, 1.1])
def test_a_rate_beside_the_nominal_one(good, percent):
    finding = only("clocks", with_fields(good, *IMU, time=good.signals["body_rate"].time / (1.0 + percent / 100.0)))
    assert finding.grade is Grade.HARMLESS
    assert finding.evidence["deviation_percent"] == pytest.approx(percent, abs=0.02)
    assert finding.evidence["nominal_hz"] == 200.0


def test_a_rate_other_than_claimed(good):
    finding = only("clocks", replace(good, metadata={"claims": {"imu.rate_hz": "250"}}))
    assert finding.grade is Grade.DEGRADES
    assert finding.evidence["real_hz"] == pytest.approx(200.0, rel=1e-3)


@given(ppm=st.sampled_from([-20000.0, -3000.0, 2000.0, 15000.0]), seed=st.integers(0, 100))
def test_drift_against_the_host(good, ppm, seed):
    """Arrivals late by random delays only: 1 ms and an exponential tail of 3 ms."""
    time = good.signals["body_rate"].time
    host = 1.7e9 + time / (1.0 + ppm * 1e-6) + 1e-3 + np.random.default_rng(seed).exponential(3e-3, time.size)
    finding = next(f for f in run("clocks", with_fields(good, *IMU, host_time=host)) if "against the host" in f.text)
    assert finding.evidence["drift_ppm"] == pytest.approx(ppm, rel=0.05, abs=100.0)


def test_a_jump_of_the_clock_against_the_host(good):
    time = good.signals["body_rate"].time.copy()
    host = 1.7e9 + time + np.random.default_rng(0).exponential(3e-3, time.size)
    time[2500:] += 2.0
    finding = next(f for f in run("clocks", with_fields(good, *IMU, host_time=host, time=time)) if "jumps" in f.text)
    assert finding.evidence["largest_s"] == pytest.approx(2.0, abs=0.02)
    assert rows_of(finding) == [2500]
    assert finding.fix.factor[0] == pytest.approx(-2.0, abs=0.02)


# -- frozen -----------------------------------------------------------------------------------------------------------


@given(
    name=st.sampled_from(["body_rate", "specific_force", "position", "attitude", "velocity"]),
    start=st.floats(4.0, 12.0),
    lasting=st.floats(0.7, 3.0),
)
def test_a_stuck_signal_is_found_where_it_is(good, name, start, lasting):
    array = good.signals[name]
    first, last = np.searchsorted(array.time, [start, start + lasting])
    finding = only("frozen", with_values(good, name, slice(first, last), array.value[first]))
    assert finding.signal == name
    assert covers(finding, array.time[first], array.time[last - 1])
    assert rows_of(finding) == list(range(first + 1, last))


@pytest.mark.parametrize(("name", "axis"), [("body_rate", 2), ("specific_force", 0), ("rotor_speed", 1)])
def test_a_stuck_component(good, name, axis):
    array = good.signals[name]
    first, last = np.searchsorted(array.time, [6.0, 9.0])
    finding = only("frozen", with_values(good, name, np.s_[first:last, axis], array.value[first, axis]))
    assert array.components[axis] in finding.text
    assert covers(finding, 6.0, array.time[last - 1])


def test_a_log_that_stands_still_is_one_finding(good):
    planted = good
    for name in ("position", "velocity", "attitude"):
        planted = with_values(planted, name, slice(800, 1000), good.signals[name].value[800])
    finding = only("frozen", planted)
    assert set(finding.fix.signals) == {"position", "velocity", "attitude"}


def test_columns_not_in_use_are_one_note(good):
    time = good.signals["position"].time
    spare = {n: replace(array_of("voltage", time, np.zeros(2000)), quantity="") for n in ("pid.a", "pid.b")}
    finding = only("frozen", replace(good, signals={**good.signals, **spare}))
    assert (finding.grade, finding.evidence["columns"]) == (Grade.HARMLESS, 2)


# -- saturation -------------------------------------------------------------------------------------------------------


@given(rotor=st.integers(0, 3), start=st.floats(4.0, 14.0), lasting=st.floats(0.03, 2.0))
def test_a_rotor_at_its_limit(good, rotor, start, lasting):
    array = good.signals["motor_command"]
    first, last = np.searchsorted(array.time, [start, start + lasting])
    finding = only("saturation", with_values(good, "motor_command", np.s_[first:last, rotor], 1.0))
    assert covers(finding, array.time[first], array.time[last - 1])
    airborne = sum(b - a for a, b in airtime(good).airborne)
    assert finding.evidence[f"share_m{rotor + 1}"] == pytest.approx((last - first) / 100.0 / airborne, rel=0.02)
    assert finding.evidence["share"] == finding.evidence[f"share_m{rotor + 1}"]
    assert (finding.grade is Grade.DEGRADES) == (finding.evidence["share"] >= 0.005)


def test_a_cap_below_full_duty(good):
    value = good.signals["motor_command"].value
    value = np.minimum(value / (0.75 * value.max()), 1.0) * 0.93
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
def test_a_sensor_that_counts_a_fraction(good, rotor, at, length, fraction, duty):
    recording = good if duty else without(good, "motor_command")
    place = np.s_[at : at + length, rotor]
    wrong = good.signals["rotor_speed"].value[place] * fraction
    finding = only("rotor_sensor", with_values(recording, "rotor_speed", place, wrong))
    assert finding.evidence["rotor"] == rotor + 1
    assert finding.evidence["ratio"] == pytest.approx(fraction)
    assert rows_of(finding) == list(range(at, at + length))


@given(rotor=st.integers(0, 3), at=st.integers(500, 1400), length=st.integers(1, 100))
def test_a_sensor_that_drops_to_zero(good, rotor, at, length):
    finding = only("rotor_sensor", with_values(good, "rotor_speed", np.s_[at : at + length, rotor], 0.0))
    assert "zero" in finding.text
    assert rows_of(finding) == list(range(at, at + length))


def test_a_sensor_that_always_counts_half(good):
    value = good.signals["rotor_speed"].value * np.array([1.0, 1.0, 0.5, 1.0])
    finding = only("rotor_sensor", changed(good, "rotor_speed", value=value))
    assert (finding.fix.kind, finding.fix.factor) == ("scale", (1.0, 1.0, 2.0, 1.0))


@given(rotor=st.integers(0, 3), zeros=st.floats(0.07, 0.32), seed=st.integers(0, 50))
def test_a_sensor_that_counts_half_and_drops_to_zero_as_well(good, rotor, zeros, seed):
    """As on brushed drones: rotors differ, ratio 0.49, dropouts of a few samples; both are found and both repaired."""
    rng = np.random.default_rng(seed)
    array = good.signals["rotor_speed"]
    value = array.value * rng.normal(1.0, 0.02, 4) * rng.normal(1.0, 0.02, array.value.shape)
    true = value.copy()
    value[:, rotor] *= 0.49
    out = np.convolve(rng.random(array.time.size) < zeros / 3.0, np.ones(3), "same") > 0
    value[out, rotor] = 0.0
    half, dropped = run("rotor_sensor", changed(good, "rotor_speed", value=value))
    assert "half" in half.text
    assert half.evidence["ratio"] == pytest.approx(0.49, rel=0.1)
    flying = (array.time > 3.0) & (array.time < 17.0)
    assert dropped.evidence["share"] == pytest.approx(float(out[flying].mean()), abs=0.04)
    repaired, applied = apply_fixes(changed(good, "rotor_speed", value=value), [half, dropped])
    assert len(applied) == 2
    fixed = repaired.signals["rotor_speed"].value[flying & ~out]
    assert np.median(fixed[:, rotor] / true[flying & ~out, rotor]) == pytest.approx(0.98, abs=0.01)


def test_a_voltage_frozen_in_flight_degrades_what_needs_it(good):
    flat = with_values(good, "voltage", slice(None), 3.7)
    finding = only("frozen", flat)
    assert finding.grade is Grade.DEGRADES
    assert "15 %" in finding.text
    assert only("frozen", without(flat, "motor_command")).grade is Grade.HARMLESS
    assert not run("frozen", with_values(flat, "voltage", slice(1000), 3.8))


def test_missing_speeds_are_counted(good):
    marked = np.isin(np.arange(2000), range(800, 805))
    missing = with_values(good, "rotor_speed", np.s_[800:805, 1], np.nan)
    assert only("rotor_sensor", with_fields(missing, "rotor_speed", marked=marked)).evidence["samples"] == 5


# -- flight -----------------------------------------------------------------------------------------------------------


def test_never_left_the_ground(good):
    ground = with_values(good, "motor_command", slice(None), 0.05)
    ground = without(with_values(ground, "position", slice(None), [0.0, 0.0, 0.01]), "rotor_speed")
    assert only("flight", ground).grade is Grade.UNUSABLE
    assert not run("repeated", ground)  # what never flew may repeat


def test_rotors_that_turn_on_the_ground(good):
    finding = only("flight", with_values(good, "position", slice(None), [0.0, 0.0, 0.01]))
    assert finding.grade is Grade.UNUSABLE
    assert "did not leave" in finding.text


@given(at=st.floats(4.0, 15.0), lasting=st.floats(0.05, 1.0))
def test_upside_down(good, at, lasting):
    array = good.signals["attitude"]
    first, last = np.searchsorted(array.time, [at, at + lasting])
    finding = only("flight", with_values(good, "attitude", slice(first, last), [1.0, 0.0, 0.0, 0.0]))
    assert finding.evidence["tilt_deg"] == pytest.approx(180.0)
    assert covers(finding, array.time[first], array.time[last - 1])


@pytest.mark.parametrize("told_by", ["attitude", "specific_force"])
def test_a_crash_that_ends_on_the_side(told_by):
    good = made_flight(seconds=20.0)
    rows = good.signals[told_by].time > airtime(good).lifting[-1][1] + 0.1
    value = [np.sin(0.75), 0.0, 0.0, np.cos(0.75)] if told_by == "attitude" else [0.0, 9.8, 0.5]
    other = {"attitude": "specific_force", "specific_force": "attitude"}[told_by]
    finding = only("flight", without(with_values(good, told_by, rows, value), other))
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


def test_bounces_before_the_climb_and_after_the_landing_are_no_flight():
    """A touch is a force of the floor, several times the weight for a tenth of a second."""
    hop, down = [0.0, 0.04, 0.05, 0.0, 0.02], [0.02, 0.0, 0.05, 0.06, 0.04, 0.0, 0.0]
    flight = [0.04, 0.2, 1.0, 0.02, 0.6, 0.3, 0.05]  # with a touch in between, which is left as it is
    found = _off_the_ground(np.array([*hop, *flight, *down]))
    lifted = np.array(flight) > 0.03
    assert found.tolist() == [*[False] * len(hop), *lifted.tolist(), *[False] * len(down)]
    assert _off_the_ground(np.array([0.0, 0.04, 0.05, 0.0])).tolist() == [False, True, True, False]  # a hop alone
    assert _off_the_ground(np.array([0.04, 0.2, 0.3])).all()  # begins and ends in the air


def test_a_hard_landing_is_the_end_even_if_it_throws_the_drone_high():
    """Recorded: a landing at 0.9 m/s from 1 m (nanobench, a figure 8) and up again by 0.12 m, at 25 m/s^2."""
    flight, bounce = [0.04, 0.3, 1.0, 0.6, 0.1, 0.04], [0.01, 0.04, 0.08, 0.12, 0.12, 0.06, 0.02]
    found = _off_the_ground(np.array([0.0, *flight, *bounce]))
    assert found.tolist() == [False, *[True] * len(flight), *[False] * len(bounce)]
    low = np.array([0.0, 0.04, 0.12, 0.16, 0.01, 0.12, 0.0])  # of a low flight it is the flight itself
    assert _off_the_ground(low).tolist() == [False, True, True, True, False, True, False]
