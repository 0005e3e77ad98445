"""One vehicle and one source of thrust for every command, the reasons where there is none, and what replay is told."""

from dataclasses import replace

import numpy as np
import pytest
from made_flight import array_of, changed, made_flight, without

from crazyem.api.replaying import check_flown, doctors_findings, required_signals
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.errors import DataError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.recordings import Recording
from crazyem.recordings.airborne import airtime
from crazyem.recordings.thrust import carried, inputs_of, signal_for, vehicle_for, weight_objection
from crazyem.vehicle import load_vehicle

CF2, BRUSHLESS = load_vehicle("cf2"), load_vehicle("cf21bl")


@pytest.fixture(scope="module")
def good() -> Recording:
    return made_flight(seconds=12.0, seed=3, more=("rpm",))


def test_the_vehicle_is_the_one_that_is_named_else_flown_else_measured(good: Recording) -> None:
    flown = replace(good, metadata={"vehicle": {"toml": load_vehicle("cf2-thrust-kit").to_toml()}})
    assert vehicle_for(flown, "cf2").name == "cf2"
    assert vehicle_for(flown).name == "cf2-thrust-kit"
    assert vehicle_for(good).name == "cf21bl"
    assert vehicle_for(without(good, "rotor_speed")).name == "cf2"
    assert vehicle_for(changed(good, "rotor_speed", value=0.0 * good.signals["rotor_speed"].value)).name == "cf2"


def test_an_unconnected_sensor_does_not_outvote_the_commands(good: Recording) -> None:
    dead = changed(good, "rotor_speed", value=0.0 * good.signals["rotor_speed"].value)
    assert signal_for(good, BRUSHLESS)[0] == "rotor_speed"
    assert signal_for(dead, BRUSHLESS)[0] == "motor_command"
    assert airtime(without(dead, "motor_command")).judged_by == ("flying", "position")
    assert "no sensor is connected" in signal_for(without(dead, "motor_command"), BRUSHLESS)[1]


def test_what_is_missing_is_named_with_the_preset_that_has_it(good: Recording) -> None:
    speeds = without(good, "motor_command")
    for refuse in (required_signals, flight_of):
        with pytest.raises(DataError, match=r"vehicle cf2 has no rotor_constant \(--vehicle cf21bl or cf21bl-busetto"):
            refuse(speeds, CF2)
    commands = without(good, "rotor_speed")
    busetto = load_vehicle("cf21bl-busetto")
    assert "cf21bl-busetto has no thrust_curve (--vehicle cf2 or" in signal_for(commands, busetto)[1]
    with pytest.raises(DataError, match="no voltage"):
        required_signals(without(commands, "voltage"), CF2)


def test_a_vehicle_that_its_rotors_never_carry_is_asked_for(good: Recording) -> None:
    air = airtime(good)
    commands = without(good, "rotor_speed")
    ratio = carried(commands, CF2, air)
    heavy = replace(CF2, mass=8.0 * CF2.mass)
    assert carried(commands, heavy, air) == pytest.approx(ratio / 8.0)
    text = weight_objection(commands, heavy, air)
    assert f"never carry its weight: they carry {ratio / 8.0:.2g} times" in text
    assert "is it this vehicle?" in text
    with pytest.raises(DataError, match="is it this vehicle"):
        check_flown(commands, heavy, air, samples=0)


def test_replay_and_diagnose_refuse_what_never_flew_for_the_same_reason(good: Recording) -> None:
    z = good.signals["position"].value * 0.0
    ground = without(changed(good, "position", value=z), "flying")
    reason = airtime(ground).reason
    assert "did not leave the ground" in reason
    with pytest.raises(DataError, match=reason):
        check_flown(ground, BRUSHLESS, airtime(ground))
    with pytest.raises(DataError, match=reason):
        flight_of(ground, BRUSHLESS)


def test_replay_is_told_what_bears_on_an_estimate(good: Recording) -> None:
    assert not doctors_findings(good)
    speed = good.signals["rotor_speed"].value * np.array([0.5, 1.0, 1.0, 1.0])
    (finding,) = doctors_findings(changed(good, "rotor_speed", value=speed))
    assert finding.check == "rotor_sensor"
    time = good.signals["position"].time
    unused = replace(array_of("euler", time, np.full((time.size, 3), np.nan)), stream="other")
    assert not doctors_findings(replace(good, signals={**good.signals, "euler": unused}))


def test_slow_commands_are_no_thrust(good: Recording) -> None:
    slow = without(good, "rotor_speed")
    slow = replace(
        slow, signals={**slow.signals, "motor_command": slow.signals["motor_command"].rows(slice(0, None, 25))}
    )
    why = inputs_of(slow, CF2)
    assert why == "motor_command at 4 Hz is too slow: steps of 0.25 s are gaps (at most 0.1 s)"
    with pytest.raises(DataError, match="too slow"):
        flight_of(slow, CF2)


def test_advice_asks_for_nothing_that_is_recorded() -> None:
    sag = CATALOGUE["battery_sag"]
    assert sag.advice({"motor_command"}).startswith("log pm.vbat, and ")
    assert sag.advice({"voltage"}) == "fly the same battery from full to empty"
    for effect in CATALOGUE.values():
        assert all(words in effect.separates for words in effect.spared.values())
