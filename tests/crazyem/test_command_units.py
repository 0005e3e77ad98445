"""Units of commands, and which thrust a recording has been flown with."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import array_of, changed, made_flight, without

from crazyem.api.replaying import check_flown, doctors_findings, required_signals
from crazyem.control.command_units import (
    LOOP,
    lag_of,
    lag_share,
    mass_thrust,
    motor_volts,
    rotor_reaction,
    thrust_per_unit,
    unit_torque,
)
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.errors import DataError
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.rotors import wrench_from_command
from crazyem.recordings import Recording
from crazyem.recordings.airborne import airtime
from crazyem.recordings.thrust import carried, inputs_of, signal_for, vehicle_for, weight_objection
from crazyem.vehicle import load_vehicle

CF2, BRUSHLESS = load_vehicle("cf2"), load_vehicle("cf21bl")
UNCOMPENSATED = replace(CF2, battery_compensated=False)


def wrench_of(vehicle, thrust, roll, pitch, yaw, volts):
    """F, M of mixer units: m1 = T - r/2 + p/2 + y, ...; each to duty by the compensation's own inverse, or as duty."""
    half = np.array([[-1, 1, 1], [-1, -1, -1], [1, -1, 1], [1, 1, -1]]) @ np.array([roll / 2, pitch / 2, yaw])
    units = thrust + half
    if vehicle.battery_compensated:
        roots = [np.roots([*vehicle.thrust_curve[::-1][:3], vehicle.thrust_curve[0] - u / 65535 * vehicle.thrust_max])
                 for u in units]  # fmt: skip
        duty = np.array([max(r.real for r in root if abs(r.imag) < 1e-9) for root in roots]) / volts
    else:
        duty = units / 65535
    return wrench_from_command(duty, volts, vehicle)


@pytest.mark.parametrize("vehicle", [CF2, BRUSHLESS, UNCOMPENSATED], ids=["cf2", "cf21bl", "uncompensated"])
@pytest.mark.parametrize("volts", [3.5, 4.1])
def test_unit_torque_is_the_derivative_of_the_torque_by_the_command(vehicle, volts) -> None:
    """Body y and z are the other way in the mixer's pitch and yaw."""
    thrust = vehicle.mass * 9.81 / 4
    hover = mass_thrust(vehicle, force=4 * thrust, volts=volts) * 4 * thrust
    torque = unit_torque(vehicle, thrust_per_unit(vehicle, thrust=thrust, volts=volts))
    for axis, sign in enumerate((1.0, -1.0, -1.0)):
        step = np.zeros(3)
        step[axis] = 1.0
        up, down = (wrench_of(vehicle, hover, *(s * step), volts)[1 + axis] for s in (1.0, -1.0))
        assert torque[axis] == pytest.approx(sign * (up - down) / 2, rel=1e-5)


def test_of_a_crazyflie_they_are_near_the_firmwares_own() -> None:
    """controller_indi.h: 0.0066146, 0.0052125, 0.001497 (other propellers, other years); act_dyn 0.03149 is 62.5 ms."""
    g1 = np.array(unit_torque(CF2, thrust_per_unit(CF2, thrust=0.07, volts=4.0))) / CF2.inertia
    assert g1 == pytest.approx((0.00719, 0.00715, 0.00175), rel=2e-3)
    assert lag_of(0.03149) == pytest.approx(0.0625, rel=1e-3)


@pytest.mark.parametrize(("vehicle", "expected"), [(CF2, 136531), (BRUSHLESS, 81919)])
def test_mass_thrust_of_the_platforms(vehicle, expected) -> None:
    assert mass_thrust(vehicle, force=0.3, volts=3.8) == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize("volts", [3.5, 4.1])
def test_mass_thrust_without_compensation_hovers_at_the_present_voltage(volts) -> None:
    force = 0.3
    unit = mass_thrust(UNCOMPENSATED, force=force, volts=volts)
    assert wrench_from_command(np.full(4, unit * force / 65535), volts, CF2)[0] == pytest.approx(force, rel=1e-9)


def test_g2_is_the_reaction_of_four_rotors_to_a_unit_in_one_period() -> None:
    """A step of the command, rotors at once: Izz dw/dt = -dH/dt, H = I (W1 - W2 + W3 - W4), per period."""
    thrust, k, inertia, per_unit = 0.07, 2e-8, 1.5e-8, 0.12 / 65535
    step = 10 * per_unit  # 10 units of yaw: rotors 1 and 3 up
    speeds = [np.sqrt((thrust + s * step) / k) for s in (1, -1, 1, -1)]
    before = math.sqrt(thrust / k)
    change = inertia * sum(abs(w - before) for w in speeds)
    g2 = rotor_reaction(per_unit, thrust=thrust, rotor_constant=k, rotor_inertia=inertia, izz=3e-5)
    assert g2 == pytest.approx(change / LOOP / 3e-5 / 10, rel=1e-3)


@given(st.floats(1e-3, 0.5))
def test_lag_and_share_are_inverse(lag: float) -> None:
    assert lag_of(lag_share(lag)) == pytest.approx(lag, rel=1e-9)


def test_no_lag_and_no_share_at_all() -> None:
    assert (lag_share(0.0), lag_of(1.0), lag_of(0.0)) == (1.0, 0.0, math.inf)


@given(st.floats(0.02, 0.14))
def test_motor_volts_undo_the_curve(thrust: float) -> None:
    v = motor_volts(CF2, thrust)
    assert sum(c * v**n for n, c in enumerate(CF2.thrust_curve)) == pytest.approx(thrust, rel=1e-9)


def test_what_cannot_be_known_is_refused() -> None:
    with pytest.raises(ValueError, match="no thrust_max"):
        thrust_per_unit(replace(CF2, thrust_max=math.inf), thrust=0.07, volts=4.0)
    with pytest.raises(ValueError, match="does not give"):
        motor_volts(CF2, 100.0)


# one vehicle and one source of thrust for every command, the reasons where there is none


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
