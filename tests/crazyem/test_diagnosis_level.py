"""A battery that nobody measured: its level from the first seconds in the air, and what is then not told."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_parts import start_point
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import Motion, changed, made_flight, without

from crazyem.diagnosis.fitting.candidates import candidates_for
from crazyem.diagnosis.fitting.nuisances import without_unobservable
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.diagnosis.prediction.predict import predict, recorded
from crazyem.diagnosis.settings import RECORDINGS
from crazyem.recordings.airborne import airtime
from crazyem.vehicle import GRAVITY, load_vehicle

MOTION = Motion(seconds=12.0, drag=0.0)
DRONE = replace(load_vehicle("cf2"), mass=MOTION.mass)


def unmeasured(motion=MOTION, **more):
    return without(made_flight(motion, noise=0.0, **more), "voltage")


def inputs(recording, vehicle=DRONE):
    return inputs_of(recording, vehicle, flight=airtime(recording))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_voltage_is_the_one_that_the_battery_had(seed):
    """Of a drone whose mass and thrust curve are right, whatever it flies; the voltage that was left out tells."""
    found = inputs(unmeasured(replace(MOTION, seed=seed)))
    middle = found.level.known - 1.5
    assert found.level.voltage == pytest.approx(float(MOTION.voltage(np.array([middle]))[0]), rel=0.003)
    assert f"{found.level.voltage:.2f} V is taken" in found.notices[0]
    assert "cannot be told" in found.notices[0]


@pytest.mark.parametrize("seed", [0, 1])
def test_heights_tell_it_where_no_velocity_is_recorded(seed):
    shown = without(unmeasured(replace(MOTION, seed=seed)), "velocity")
    height = shown.signals["position"]
    noise = 1e-3 * np.random.default_rng(seed).standard_normal(height.value.shape)
    for recording in (shown, changed(shown, "position", value=height.value + noise)):
        found = inputs(recording)
        middle = found.level.known - 1.5
        assert found.level.voltage == pytest.approx(float(MOTION.voltage(np.array([middle]))[0]), rel=0.005)


@settings(max_examples=10)
@given(st.floats(0.7, 1.4))
def test_commands_carry_the_vehicle_whatever_its_mass(factor):
    """Thrust over mass is what the flight shows: of a vehicle file that is wrong by any factor, too."""
    recording = unmeasured()
    found = inputs(recording, replace(DRONE, mass=factor * DRONE.mass))
    there = (found.rotor.time > found.level.known - 3.0) & (found.rotor.time < found.level.known)
    lifted = found.rotor.thrust[there].sum(1).mean() / (factor * DRONE.mass)
    up = MOTION.acceleration(found.rotor.time[there]) + np.array([0.0, 0.0, GRAVITY])
    assert lifted == pytest.approx(np.linalg.norm(up, axis=1).mean(), rel=0.01)


def test_where_a_flight_does_not_show_it_a_nominal_one_stays():
    flown = unmeasured()
    lying = replace(flown, signals={n: a for n, a in flown.signals.items() if n not in ("position", "flying")})
    for recording, vehicle in (
        (without(flown, "velocity", "position"), DRONE),
        (flown, replace(DRONE, mass=10 * DRONE.mass)),  # no battery carries that
        (changed(lying, "motor_command", value=0.0 * lying.signals["motor_command"].value), DRONE),
    ):
        found = inputs(recording, vehicle)
        assert found.level is None
        assert f"{RECORDINGS.nominal_voltage:g} V is assumed" in found.notices[0]
    assert inputs(made_flight(MOTION, noise=0.0)).level is None  # it was measured


def test_an_attitude_without_a_number_is_none():
    recording = unmeasured(replace(MOTION, size=0.1))
    nothing = changed(recording, "attitude", value=np.full_like(recording.signals["attitude"].value, np.nan))
    assert inputs(nothing).level.voltage == pytest.approx(inputs(recording).level.voltage, rel=0.01)


def test_a_prediction_knows_it_only_as_far_as_it_was_seen():
    shown = recorded(unmeasured(), DRONE)
    found = predict(shown, horizon=10, every=7)
    nominal, final = (
        predict(replace(shown, inputs=i, before=()), horizon=10, every=7) for i in (shown.before[0], shown.inputs)
    )
    first, last = found.start_time < shown.inputs.took_off, found.start_time > shown.inputs.level.known
    assert first.any()
    assert np.array_equal(found.prediction[first], nominal.prediction[first])
    assert np.array_equal(found.prediction[last], final.prediction[last])
    assert not np.array_equal(final.prediction[last], nominal.prediction[last])
    assert (np.diff(found.start_index) > 0).all()
    # after half a second in the air it is right to some per cent of the thrust
    known = [i.level for i in shown.before if i.level is not None and i.level.known > shown.inputs.took_off + 0.4]
    assert len(known) == 3
    for level in known:
        assert level.voltage == pytest.approx(float(MOTION.voltage(np.array([level.known]))[0]), rel=0.03)


@cache
def as_it_was():
    return predict(recorded(unmeasured(), DRONE), horizon=10)


@pytest.mark.parametrize("after", [0.1, 0.3, 0.8, 1.5, 2.5, 5.0])
def test_nothing_later_than_a_start_tells_of_the_battery(after):
    recording = unmeasured()
    at = inputs(recording).took_off + after
    broken = recording
    for name, end, by in (
        ("velocity", at, [0.0, 0.0, 1.0]),
        ("position", at, [0.0, 0.0, 0.5]),
        ("motor_command", at + 0.1, 0.1),
    ):
        array = recording.signals[name]
        value = array.value.copy()
        value[array.time > end] += by
        broken = changed(broken, name, value=value)
    one, other = as_it_was(), predict(recorded(broken, DRONE), horizon=10)
    start = np.flatnonzero(one.start_time <= at)[-1]
    assert np.array_equal(one.prediction[start], other.prediction[other.start_index == one.start_index[start]][0])


def test_how_heavy_or_strong_the_drone_is_is_left_open():
    flight = flight_of(unmeasured(), DRONE)
    assert flight.levelled
    assert not flight_of(made_flight(MOTION, noise=0.0), DRONE).levelled
    point = start_point()
    found, left_out = candidates_for(point, flight.signals, measured_speeds=False)
    data = SimpleNamespace(flights=[flight], coarse=False)
    kept, reasons = without_unobservable(data, point, found, left_out)
    gone = {"payload", "thrust_scale"}
    assert {c.effect for c in found} - {c.effect for c in kept} == gone
    assert all("no battery voltage" in reasons[n] for n in gone)
    assert "gain_per_second" in {n for c in kept if c.effect == "battery_sag" for n in c.free}
    data.flights += [replace(flight, levelled=False)]
    kept, _ = without_unobservable(data, point, found, left_out)
    assert gone <= {c.effect for c in kept}  # one that was measured can tell
