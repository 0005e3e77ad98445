"""Formulas of what INDI and Mellinger believe: against the mixer and the rotors' law by finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from crazyem.physics.rotors import wrench_from_command
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
