"""What each controller makes of each kind of setpoint (the table in docs: firmware_sim.md), on the whole flight."""

import numpy as np
import pytest
from flights import boot, hold, read

from firmware_sim.commander import setpoint as sp
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at

PID, MELLINGER, LEE = 1, 2, 5
QUIET = {"noise": {"thrust": 0.0, "torque": 0.0}}


def hovering(controller: int) -> Flight:
    """At 1 m over the place (0, 0), by places."""
    flight = boot(QUIET, stabilizer__controller=controller)
    hold(flight, (0.0, 0.0, 1.0), 4.0)
    return flight


def run(flight: Flight, seconds: float) -> np.ndarray:
    """Position and velocity every 10 ms."""
    rows = []
    for n in range(round(1000 * seconds)):
        flight.step()
        if n % 10 == 0:
            rows.append(flight.state[at.POS : at.VEL + 3].copy())
    return np.array(rows)


@pytest.mark.parametrize("controller", [PID, MELLINGER, LEE])
def test_velocities_only(controller: int) -> None:
    flight = hovering(controller)
    s = flight.setpoint
    s[:] = sp.null_setpoint()
    s[[sp.MODE_X, sp.MODE_Y, sp.MODE_Z, sp.MODE_YAW]] = sp.VELOCITY
    s[sp.VZ] = 0.1
    seen = run(flight, 8.0 if controller == PID else 1.5)  # a change of modes empties PID's integrals: kp / ki = 1.7 s
    if controller == PID:
        assert seen[-50:, 5].mean() == pytest.approx(0.1, abs=0.05)
    elif controller == MELLINGER:  # a hover at the height it was not told
        assert seen[-1, 2] < 0.5
        assert flight.state[at.PWM : at.PWM + 4].min() > 0
    else:
        assert flight.state[at.PWM : at.PWM + 4].tolist() == [0.0] * 4


@pytest.mark.parametrize("controller", [MELLINGER, LEE])
def test_acceleration_of_a_place_is_fed_forward_and_by_mellinger_not_when_levelling_out(controller: int) -> None:
    flight = hovering(controller)
    s = flight.setpoint
    s[sp.AX] = 1.0
    run(flight, 0.4)
    ahead = flight.state[at.VEL]
    assert ahead > 0.1
    s[[sp.MODE_X, sp.MODE_Y]] = sp.DISABLE  # what the supervisor does to a stale one
    s[[sp.MODE_ROLL, sp.MODE_PITCH]] = sp.ABSOLUTE
    s[sp.MODE_YAW] = sp.VELOCITY
    seen = run(flight, 2.0)
    if controller == MELLINGER:
        assert np.abs(np.diff(seen[-100:, 3])).max() < 1e-3  # level: the speed it had, no more
    else:
        assert seen[-1, 0] == pytest.approx(1.0 / 7.0, abs=0.01)  # m: place and feedforward held


def test_a_heading_held_by_pid_survives_a_change_of_modes() -> None:
    """From a heading by angle to one by rate: the wanted heading stays, it does not jump to the present one."""
    flight = hovering(PID)
    s = flight.setpoint
    s[sp.YAW] = 30.0
    run(flight, 0.1)  # on the way
    assert read(flight, "controller.yaw") == pytest.approx(30.0)
    s[sp.MODE_YAW] = sp.VELOCITY
    s[sp.MODE_X] = s[sp.MODE_Y] = sp.VELOCITY
    run(flight, 1.5)
    assert read(flight, "controller.yaw") == pytest.approx(30.0)
    assert read(flight, "stabilizer.yaw") == pytest.approx(30.0, abs=3.0)


@pytest.mark.parametrize("controller", [PID, MELLINGER])
def test_roll_pitch_and_yaw_of_legacy_controllers_are_whole_numbers(controller: int) -> None:
    """control_t carries them in 16 bits; what is logged is what the mixer gets."""
    flight = hovering(controller)
    group = "controller" if controller == PID else "ctrlMel"
    for axis in ("roll", "pitch", "yaw"):
        for _ in range(20):
            flight.step()
            assert read(flight, f"{group}.cmd_{axis}").is_integer()
