"""What the rotors were told: which signal serves, what it becomes; and vehicles with effects, folded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop import DRONE, fly
from made_flight import array_of, made_flight, without
from numpy.typing import NDArray

from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.flights.inputs import inputs_of
from crazyem.diagnosis.settings import RECORDINGS
from crazyem.errors import DataError, FileFormatError
from crazyem.physics import folding
from crazyem.physics.rotors import wrench
from crazyem.recordings import open_recording
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle, load_vehicle

Array = NDArray[np.float64]
TIMES = np.arange(0.0, 2.0, 0.01)
BOTH = replace(load_vehicle("cf2"), rotor_constant=3e-8)


def recording(**signals: Array) -> Recording:
    arrays = {
        name: array_of(name, TIMES[: len(value)], value, place=k) for k, (name, value) in enumerate(signals.items())
    }
    return Recording("made", "usd:2", arrays)


def constant(value: float, count: int = 4, rows: int = TIMES.size) -> Array:
    return np.full((rows, count), value)


def test_measured_speeds_come_first_where_the_vehicle_knows_them() -> None:
    both = recording(rotor_speed=constant(1500.0), motor_command=constant(0.6), voltage=constant(3.9, 1))
    found = inputs_of(both, BOTH).rotor
    assert found.measured
    assert np.allclose(found.thrust, 3e-8 * 1500.0**2)
    assert np.allclose(found.voltage, 3.9)
    found = inputs_of(both, load_vehicle("cf2")).rotor
    assert not found.measured
    volts = 0.6 * 3.9
    curve = load_vehicle("cf2").thrust_curve
    assert np.allclose(found.thrust, sum(c * volts**k for k, c in enumerate(curve)))


def test_the_voltage_is_the_newest_and_commands_before_the_first_are_left_out() -> None:
    given = recording(motor_command=constant(0.6))
    volts = array_of("voltage", [0.5, 1.0], [[4.0], [3.6]], place=5)
    found = inputs_of(replace(given, signals={**given.signals, "voltage": volts}), load_vehicle("cf2")).rotor
    assert found.time[0] == pytest.approx(0.5)
    assert (found.voltage[found.time < 0.999] == 4.0).all()
    assert (found.voltage[found.time > 1.001] == 3.6).all()


def test_without_a_voltage_a_nominal_one_is_used_and_said() -> None:
    found = inputs_of(recording(motor_command=constant(0.6)), load_vehicle("cf2"))
    other = inputs_of(
        recording(motor_command=constant(0.6), voltage=constant(RECORDINGS.nominal_voltage, 1)), BOTH
    ).rotor
    assert np.allclose(found.rotor.thrust, other.thrust)
    assert np.isnan(found.rotor.voltage).all()
    assert "3.85 V is assumed" in found.notices[0]


@pytest.mark.parametrize("name", ["cf2", "zhao"])
def test_a_wrench_becomes_four_thrusts_that_give_it_back(name: str) -> None:
    rng = np.random.default_rng(1)
    asked = np.column_stack([rng.uniform(0.2, 0.4, TIMES.size), rng.normal(0, 1e-3, (TIMES.size, 3))])
    found = inputs_of(recording(wrench_command=asked), load_vehicle(name))
    used = found.vehicle
    assert np.allclose(wrench(found.rotor.thrust, arm=used.arm, torque_per_thrust=used.torque_per_thrust), asked)
    assert found.signal == "wrench_command"


def test_nothing_that_becomes_thrust_is_an_error() -> None:
    with pytest.raises(DataError, match="there are no motor commands, rotor speeds or commanded thrust"):
        inputs_of(recording(position=constant(1.0, 3)), load_vehicle("cf2"))
    with pytest.raises(DataError, match="vehicle zhao has no thrust_curve"):
        inputs_of(recording(motor_command=constant(0.6)), load_vehicle("zhao"))


def test_stamps_increase_and_wild_samples_are_no_commands() -> None:
    value = constant(0.6)
    value[7], value[9] = 1e30, np.nan
    given = recording(motor_command=value, voltage=constant(3.9, 1))
    array = given.signals["motor_command"]
    time = array.time.copy()
    time[20] = time[19]
    time[30] = time[28]
    moved = replace(given, signals={**given.signals, "motor_command": replace(array, time=time)})
    found = inputs_of(moved, load_vehicle("cf2")).rotor
    assert (np.diff(found.time) > 0).all()
    assert found.time.size == TIMES.size - 4
    assert np.isfinite(found.thrust).all()


def test_time_is_counted_from_the_lift_off() -> None:
    flight = made_flight(seconds=12.0, noise=0.0)
    found = inputs_of(flight, load_vehicle("cf2"))
    assert 0.9 < found.took_off < 2.5  # on the ground for a second
    assert np.allclose(found.rotor.flown, np.maximum(found.rotor.time - found.took_off, 0))
    assert without(flight, "voltage").signals.keys() == flight.signals.keys() - {"voltage"}


def test_requests_of_old_firmware_become_the_volts_that_it_sent(shared_recordings: Path) -> None:
    """crazypad logs both the request and the duty: thrust from either is one, within 0.3 mN of 75."""
    flown = open_recording(shared_recordings / "crazypad" / "motor__normal_flight__E8_log00")
    vehicle = load_vehicle("cf2-legacy")
    sent = inputs_of(flown, vehicle).rotor
    asked = inputs_of(without(flown, "motor_command"), vehicle)
    assert asked.signal == "motor_request"
    assert np.abs(sent.thrust - asked.rotor.thrust).max() < 3e-4
    mixer = open_recording(shared_recordings / "crazypad" / "controller__normal_flight__E8_log00")
    found = inputs_of(mixer, vehicle).rotor
    total = [np.median(r.thrust.sum(1)[r.thrust.sum(1) > 0.2]) for r in (found, sent)]
    assert total[0] == pytest.approx(total[1], rel=0.03)  # two flights of one drone on one day


# -- vehicles with effects ---------------------------------------------------------------------------------------------


def with_effects(**effects: dict[str, float]) -> Vehicle:
    return replace(load_vehicle("cf2"), effects=effects)


def test_a_point_mass_folds_into_mass_and_inertia_by_steiner() -> None:
    plain = load_vehicle("cf2")
    found, left = folding.fold(with_effects(payload={"mass": 0.005, "x": 0.0, "y": 0.0, "z": -0.03}))
    reduced = plain.mass * 0.005 / (plain.mass + 0.005) * 0.03**2
    assert left == []
    assert found.effects == {}
    assert found.mass == pytest.approx(plain.mass + 0.005)
    assert found.inertia == pytest.approx((plain.inertia[0] + reduced, plain.inertia[1] + reduced, plain.inertia[2]))


def test_scales_and_lag_fold_into_the_rotors_and_the_rest_is_named() -> None:
    found, left = folding.fold(
        with_effects(
            thrust_scale={"scale": 0.9}, torque_scale={"scale": 1.1}, motor_lag={"time_constant": 0.08},
            linear_drag={"x": 0.01}, wind={"x": 1.0}, inertia={"xx": 2e-5},
        )
    )  # fmt: skip
    plain = load_vehicle("cf2")
    assert sorted(left) == ["linear_drag", "wind"]
    assert found.motor_time_constant == 0.08
    assert found.inertia == pytest.approx((2e-5, plain.inertia[1], plain.inertia[2]))
    ours = wrench([0.09, 0.08, 0.07, 0.1], arm=found.arm, torque_per_thrust=found.torque_per_thrust)
    theirs = wrench([0.09, 0.08, 0.07, 0.1], arm=plain.arm, torque_per_thrust=plain.torque_per_thrust)
    assert ours == pytest.approx(theirs * [1, 1.1, 1.1, 1.1])
    assert np.allclose(found.thrust_curve, 0.9 * np.array(plain.thrust_curve))
    assert "linear_drag" in folding.notice(left)


def test_a_vehicle_without_effects_is_left_as_it_is() -> None:
    for name in ("cf2", "zhao"):
        vehicle = load_vehicle(name)
        assert folding.fold(vehicle) == (vehicle, [])
    assert folding.notice([]) == ""


def test_without_rotors_there_is_no_thrust_to_scale() -> None:
    zhao = replace(load_vehicle("zhao"), effects={"thrust_scale": {"scale": 0.9}})
    assert folding.fold(zhao) == (replace(zhao, effects={}), ["thrust_scale"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[effects.magic]\nx = 1.0", "unknown effect 'magic'"),
        ("[effects.linear_drag]\nq = 1.0", "has no parameter 'q'"),
        ("[effects.linear_drag]\nx = -1.0", "parameter 'x' of effect 'linear_drag'"),
        ("[effects.inertia_products]\nxy = 0.001", "not a positive definite matrix"),
    ],
)
def test_a_wrong_effect_in_a_file_is_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "drone.toml"
    path.write_text(load_vehicle("cf2").to_toml() + text)
    with pytest.raises(FileFormatError, match=words) as caught:
        folding.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("fall", "there"), [(0.0, False), (0.05, True)])
def test_a_voltage_that_does_not_change_tells_nothing_of_a_battery(fall: float, there: bool) -> None:
    flown = fly(seconds=8.0)
    time = flown.signals["position"].time
    volts = 4.0 - fall * time / time[-1] + 3e-3 * np.random.default_rng(1).normal(size=time.size)
    made = replace(flown, signals={**flown.signals, "voltage": array_of("voltage", time, volts[:, None], place=70)})
    assert ("voltage" in flight_of(made, DRONE).signals) is there
