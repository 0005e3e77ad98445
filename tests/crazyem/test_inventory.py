"""What `info` says: signals and envelope against closed forms and plain numpy, verdicts against flights whose truth is
known and against what the estimator concludes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import Motion, array_of, changed, made_flight, without
from synthetic import COLUMNS, Truth, fly

from crazyem.doctor.excitation import rotation_fit, steps_of
from crazyem.doctor.identifiability import VERDICT_NAMES, Verdict, replay_objection
from crazyem.doctor.inventory import Inventory, envelope, inventory
from crazyem.recordings import Recording, open_recording
from crazyem.recordings.airborne import airtime
from crazyem.recordings.thrust import inputs_of
from crazyem.vehicle import GRAVITY, Vehicle, load_vehicle

TRUTH = Truth()
DRONE = Vehicle("made", mass=0.03, inertia=(1.7e-5, 1.7e-5, 3.0e-5), arm=(0.0325, 0.0325), motor_time_constant=0.05)


def recorded(truth: Truth, *, seed: int, duration: float = 16.0) -> Recording:
    """A closed-loop flight of the simulator of the estimator's tests, thrust and torque as commanded."""
    flight = fly(truth, seed=seed, duration=duration)
    signals = {"wrench_command": array_of("wrench_command", flight.time, flight.wrench, stream="c", place=0)}
    for place, (name, columns) in enumerate(COLUMNS.items(), start=1):
        signals[name] = array_of(name, flight.time, flight.y[:, columns], stream="s", place=place)
    return Recording("synthetic", "made", signals)


def verdicts(found: Inventory) -> dict[str, Verdict]:
    return {v.name: v for v in found.verdicts}


# signals --------------------------------------------------------------------------------------------------------


def test_a_row_says_what_a_plain_count_says() -> None:
    made = made_flight(seconds=10.0, jitter=0.05, loss=0.1, gaps={"imu": [(4.0, 4.5)]})
    gyro = made.signals["body_rate"]
    value, marked = gyro.value.copy(), gyro.marked.copy()
    value[10:30, 1] = np.nan  # 20 of the file's own, 7 of ours
    value[100:107], marked[100:107] = np.nan, True
    made = replace(made, signals={**made.signals, "body_rate": replace(gyro, value=value, marked=marked)})

    row = next(r for r in inventory(made).signals if r.name == "body_rate")

    gaps = sorted(b - a for a, b in zip(gyro.time, gyro.time[1:]))
    assert row.samples == len(gyro.time)
    assert row.longest_gap_s == gaps[-1] > 0.49
    assert row.period_s == pytest.approx(gaps[len(gaps) // 2], rel=1e-3)
    assert row.rate_hz == pytest.approx((len(gyro.time) - 1) / (gyro.time[-1] - gyro.time[0]), rel=1e-12)
    assert row.missing_share == 20 / row.samples
    assert row.marked_share == 7 / row.samples
    assert (row.unit, row.clock, row.stream) == ("rad/s", "firmware", "imu")


def test_the_clock_against_the_host() -> None:
    made = made_flight(seconds=10.0)
    signals = {n: replace(a, host_time=1.7e9 + a.time / (1.0 + 50e-6)) for n, a in made.signals.items()}
    (clock,) = inventory(replace(made, signals=signals)).clocks
    assert clock.against_host_ppm == pytest.approx(50.0, abs=0.2)


def test_everything_is_json_and_text() -> None:
    made = replace(made_flight(seconds=6.0), metadata={"firmware": {"version": "2025.02", "table": "x" * 5000}})
    found = inventory(made)
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [s["name"] for s in data["signals"]] == list(made.signals)
    assert data["envelope"]["speed_max_m_s"] > 0.0
    assert {v["name"] for v in data["identifiable"]} == set(VERDICT_NAMES)
    text = found.text(everything=True)
    assert "version 2025.02" in text
    assert "x" * 200 not in text  # whole tables are not for a terminal
    assert all(name in text for name in (*made.signals, *VERDICT_NAMES))
    short = found.text().splitlines()
    assert len(short) <= 20
    assert short[1].startswith("in the air")
    assert all(name in found.text() for name in VERDICT_NAMES)


@pytest.mark.parametrize("names", [(), ("position",), ("specific_force",), ("body_rate", "voltage"), ("attitude",)])
def test_nothing_is_needed(names: tuple[str, ...]) -> None:
    made = made_flight(seconds=6.0)
    few = replace(made, signals={n: made.signals[n] for n in names})
    velocity = made.signals["velocity"]
    none = np.zeros(0)
    empty = replace(velocity, time=none, value=np.zeros((0, 3)), order=none, host_time=none, marked=none.astype(bool))
    for recording in (few, replace(few, signals={**few.signals, "velocity": empty})):
        found = inventory(recording)
        json.dumps(found.to_dict(), allow_nan=False)
        assert found.text()
        assert all(v.verdict == "no" for v in found.verdicts)


# envelope -------------------------------------------------------------------------------------------------------


@settings(max_examples=5)
@given(
    seed=st.integers(0, 1000), size=st.floats(0.1, 0.4), frequency=st.floats(0.15, 0.3), height=st.floats(0.2, 0.6),
    rate=st.sampled_from([100.0, 250.0]),
)  # fmt: skip
def test_the_envelope_is_that_of_the_closed_form(
    seed: int, size: float, frequency: float, height: float, rate: float
) -> None:
    motion = Motion(seconds=20.0, seed=seed, size=size, frequency=frequency, height=height + size)
    made = made_flight(motion, noise=0.0, rates={"state": rate, "imu": rate, "motor": rate})
    air = airtime(made)
    found = envelope(made, air)

    fine = np.arange(0.0, 20.0, 1.0 / 1000.0)
    up = fine[motion.position(fine)[:, 2] > 0.03]
    (start, end) = air.flown[0][0], air.flown[-1][1]
    assert abs(start - up[0]) < 0.3  # rotors must carry it, and it must be 3 cm up
    assert abs(end - up[-1]) < 0.3
    inside = fine[(fine >= start) & (fine <= end)]
    speed = np.linalg.norm(motion.velocity(inside), axis=1)
    assert found.speed_max_m_s == pytest.approx(speed.max(), rel=0.01)
    assert found.speed_rms_m_s == pytest.approx(np.sqrt(np.mean(speed**2)), rel=0.02)
    up_axis = motion.attitude(inside).as_matrix()[:, 2, 2]
    assert found.tilt_max_deg == pytest.approx(np.degrees(np.arccos(up_axis.min())), rel=0.02)
    assert found.body_rate_max_rad_s == pytest.approx(np.abs(motion.body_rate(inside)).max(axis=0), rel=0.05, abs=0.01)
    assert found.altitude_max_m == pytest.approx(motion.position(inside)[:, 2].max(), rel=0.01)
    force = np.linalg.norm(motion.specific_force(inside), axis=1)
    assert found.specific_force_max_m_s2 == pytest.approx(force.max(), rel=0.02)
    assert found.voltage_start_V == pytest.approx(float(motion.voltage(np.array([start]))[0]), abs=1e-3)


def test_airborne_needs_no_particular_signal() -> None:
    made = made_flight(seconds=20.0, more=("rpm",))
    whole = airtime(made).flown[0]
    for left, by in (
        (without(made, "rotor_speed", "motor_command", "flying"), ("position",)),
        (without(made, "motor_command", "flying"), ("rotor_speed", "position")),
        (without(made, "position", "flying"), ("motor_command",)),
        (without(made, "position", "motor_command", "rotor_speed"), ("flying",)),
    ):
        air = airtime(left)
        assert air.judged_by == by
        assert air.flown[0] == pytest.approx(whole, abs=0.8)  # rotors turn before it is 3 cm up


def test_two_hops_are_two_stretches_and_a_short_dip_of_the_rotors_is_none() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    flying = ((t > 2) & (t < 8)) | ((t > 12) & (t < 18))
    duty = np.where(flying, 0.6, 0.0)
    duty[(t > 5.0) & (t < 5.2)] = 0.1
    z = np.where(flying, 0.5, 0.3)  # it rests on a table
    made = Recording(
        "hops", "made",
        {
            "position": array_of("position", t, np.column_stack([0 * t, 0 * t, z])),
            "motor_command": array_of("motor_command", t, np.tile(duty[:, None], 4), place=1),
        },
    )  # fmt: skip
    assert [(round(a), round(b)) for a, b in airtime(made).flown] == [(2, 8), (12, 18)]


def test_a_crash_ends_the_flight() -> None:
    made = made_flight(seconds=20.0)
    force = made.signals["specific_force"]
    value = force.value.copy()
    value[np.searchsorted(force.time, 17.5)] = [80.0, 60.0, 150.0]
    air = airtime(without(changed(made, "specific_force", value=value), "position", "flying"))
    assert 17.0 < air.flown[-1][1] < 17.5


def test_saturation_is_a_share_of_the_flight() -> None:
    made = made_flight(seconds=20.0)
    command = made.signals["motor_command"]
    value = np.minimum(command.value, 0.95)
    air = airtime(made)
    inside = np.flatnonzero(air.covers(command.time))
    value[inside[: inside.size // 4], 2] = 1.0
    found = envelope(changed(made, "motor_command", value=value), air)
    assert found.motor_saturated_share == pytest.approx(0.25, abs=0.002)


# verdicts -------------------------------------------------------------------------------------------------------


def test_excitation_makes_inertia_known_and_hover_does_not() -> None:
    excited = verdicts(inventory(recorded(TRUTH, seed=1), DRONE))
    hover = verdicts(inventory(recorded(replace(TRUTH, dither=0.0, heave=0.0), seed=1), DRONE))
    for name in ("mass", "Ixx", "Iyy", "Izz", "motor_time_constant"):
        assert excited[name].verdict == "yes", excited[name]
    for name, truth in zip(("Ixx", "Iyy", "Izz"), TRUTH.inertia):
        large, small = hover[name].relative_sd, excited[name].relative_sd
        assert large > 3.0 * small
        value = hover[name].value
        assert abs(math.log(value / truth)) < 3.0 * large
    assert hover["mass"].verdict == "yes"  # weight is enough
    assert excited["battery_law"].verdict == "no"


def test_the_expected_errors_are_the_real_ones() -> None:
    """Over 10 flights the errors of the fit are of the size that it says, and it says the size of the estimator's."""
    errors = []
    truth = np.log([*TRUTH.inertia, TRUTH.lag])
    for seed in range(10):
        made = recorded(TRUTH, seed=seed, duration=10.0)
        inputs, gyro = inputs_of(made, DRONE), made.signals["body_rate"]
        steps = steps_of(gyro.time, gyro.value, airtime(made))
        fit = rotation_fit(inputs, steps, DRONE)
        errors.append([(fit.value[i] - truth[i]) / fit.total(i) for i in range(4)])
        assert np.all(fit.sd[:4] < 0.1)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(rms < 1.8), rms  # 95 % of chi-square with 10 degrees of freedom is 1.35; the fit is a linearised one
    assert np.all(rms > 0.2), rms  # and not so wide that it says nothing


def test_a_longer_flight_knows_more_but_the_window_does_not() -> None:
    short = verdicts(inventory(recorded(TRUTH, seed=3, duration=10.0), DRONE))["mass"]
    long = verdicts(inventory(recorded(TRUTH, seed=3, duration=40.0), DRONE))["mass"]
    assert long.relative_sd < 0.8 * short.relative_sd
    assert long.window_relative_sd > 1.5 * long.relative_sd


def test_what_lacks_is_named() -> None:
    made = made_flight(seconds=10.0)
    found = verdicts(inventory(without(made, "motor_command")))
    assert all("no motor commands" in found[name].reason for name in ("mass", "Ixx", "battery_law"))
    found = verdicts(inventory(without(made, "body_rate", "attitude")))
    assert "neither body rate nor attitude" in found["Ixx"].reason
    assert "needs velocity and attitude" in found["drag"].reason
    found = verdicts(inventory(without(made, "voltage")))
    assert found["mass"].verdict == "weak"
    assert "voltage is not logged" in found["mass"].reason
    assert replay_objection(made, load_vehicle("cf2")) == ""
    assert replay_objection(without(made, "position", "voltage"), load_vehicle("cf2")) == (
        "it has no position and no voltage"
    )


def test_drag_and_mass_are_those_of_the_flight() -> None:
    """The made flight has thrust along body z, linear drag and no rotor lag."""
    motion = Motion(seconds=40.0, seed=2, drag=0.3, mass=0.036)
    vehicle = replace(load_vehicle("cf2"), motor_time_constant=0.0)
    found = verdicts(inventory(made_flight(motion), vehicle))
    mass, drag = found["mass"], found["drag"]
    assert mass.verdict == drag.verdict == "yes"
    assert drag.value == pytest.approx(0.3, rel=0.05)
    assert mass.value == pytest.approx(0.036, rel=0.02)
    assert mass.relative_sd < 0.01


# real flights: what `crazyem replay` concludes of them is in docs: real_recordings.md and test_replay_real.py --------


def test_the_shipped_flight_identifies_all() -> None:
    found = verdicts(inventory(open_recording(Path(__file__).parents[2] / "logs" / "payload_excite.mcap")))
    for name in ("mass", "Ixx", "Iyy", "Izz", "motor_time_constant", "input_delay", "torque_offsets"):
        assert found[name].verdict == "yes", found[name]
    # 36 g, J = (20, 21, 36)e-6, lag 60 ms; the scenario's file says so
    truth = {"mass": 0.036, "Ixx": 20e-6, "Iyy": 21e-6, "Izz": 36e-6, "motor_time_constant": 0.06}
    for name, value in truth.items():
        verdict = found[name]
        assert abs(verdict.value - value) < 3.0 * verdict.sd, verdict


@pytest.mark.parametrize(
    ("name", "vehicle", "mass"),
    [("lee_34g_mass_pushed_midflight", "cf2", 0.034), ("lee_brushless_39g", "cf21bl", 0.0393)],
)
def test_the_real_firmware_gives_mass_but_not_roll_and_pitch_inertia(
    shared_recordings: Path, name: str, vehicle: str, mass: float
) -> None:
    recording = open_recording(shared_recordings / "real_firmware" / f"{name}.csv.gz")
    found = verdicts(inventory(recording, load_vehicle(vehicle)))
    assert found["mass"].verdict == "yes"
    assert found["mass"].value == pytest.approx(mass, rel=0.005)
    for axis in ("Ixx", "Iyy"):
        assert found[axis].verdict != "yes"
        assert "mostly noise between their stamps" in found[axis].reason
    assert found["motor_time_constant"].verdict == "no"
    # what it says may be off does contain the truth
    for axis, value in {"Ixx": 1.657171e-5, "Iyy": 1.6655602e-5, "Izz": 2.9261652e-5}.items():
        verdict = found[axis]
        assert abs(math.log(verdict.value / value)) < 2.0 * verdict.relative_sd


def test_nanobench_gives_a_mass_ratio_and_no_inertia(shared_recordings: Path) -> None:
    recording = open_recording(shared_recordings / "nanobench" / "B3_figure8_medium_rep1.csv.gz")
    found = verdicts(inventory(recording, load_vehicle("cf2")))
    assert found["mass"].verdict == "yes"
    assert "ratio" in found["mass"].reason
    assert 1.55 < found["mass"].value / 0.027 < 1.75
    assert [found[axis].verdict for axis in ("Ixx", "Iyy", "Izz")] == ["no"] * 3


@pytest.mark.slow
def test_no_nanobench_flight_claims_an_inertia(shared_recordings: Path) -> None:
    for path in sorted((shared_recordings / "nanobench").glob("*.csv.gz")):
        found = verdicts(inventory(open_recording(path), load_vehicle("cf2")))
        assert all(found[axis].verdict != "yes" for axis in ("Ixx", "Iyy", "Izz")), path.name


def test_sysid_says_much_but_not_its_scale(shared_recordings: Path) -> None:
    """1 kHz, excited, no voltage, no pose: published are a time constant of 72 ms and equal moments about x and y."""
    recording = open_recording(shared_recordings / "sysid" / "log15")
    found = inventory(recording, load_vehicle("cf2-legacy"))
    assert found.envelope.judged_by[0] == "motor_command"
    assert found.envelope.tilt_max_deg is None
    by_name = verdicts(found)
    assert by_name["Ixx"].verdict == by_name["Iyy"].verdict == "weak"
    assert "voltage is not logged" in by_name["Ixx"].reason
    assert by_name["motor_time_constant"].value == pytest.approx(0.072, rel=0.15)
    assert "no position" in replay_objection(recording, load_vehicle("cf2-legacy"))


def test_crazypad_balances_its_weight(shared_recordings: Path) -> None:
    """No quaternion and no gyro: the mean vertical balance gives the mass by the legacy law, about 31 g."""
    recording = open_recording(shared_recordings / "crazypad" / "motor__normal_flight__E8_log00")
    found = inventory(recording, load_vehicle("cf2-legacy"))
    assert len(found.envelope.airborne_intervals_s) == 2  # out, land, back
    mass = verdicts(found)["mass"]
    assert mass.verdict == "yes"
    command, volts = recording.signals["motor_command"], recording.signals["voltage"]
    inside = airtime(recording).covers(command.time)
    curve = np.polynomial.Polynomial(load_vehicle("cf2-legacy").thrust_curve)
    plain = curve(command.value * volts.value).sum(axis=1)[inside].mean() / GRAVITY
    assert mass.value == pytest.approx(plain, rel=0.015)
