"""The expected response of a drone under INDI, against a numerical integration."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.wire_flight import LOG_PERIOD
from crazyem.control.indi import GAP, IndiResponse

STEP = 1e-3 * LOG_PERIOD


def setpoint(n):
    t = STEP * n
    return 0.3 * math.sin(9.0 * t), 0.2 * math.cos(4.0 * t), 1.0 + 0.1 * t


def slope(_, state, wanted):
    """Rates of p, v, a, a' in the two loops, with the gains at boot."""
    p, v, a, j = state.reshape(4, 3)
    commanded = 5.0 * (1.0 * (np.array(wanted) - p) - v)
    return np.concatenate([v, a, j, 24.0 * (5.0 * (commanded - a) - j)])


def test_the_response_is_the_solution_of_the_loops_equations() -> None:
    """A setpoint holds for a period of the log."""
    response = IndiResponse()
    position, velocity = (0.1, 0.0, 1.0), (0.0, 0.2, 0.0)
    state = np.array([*position, *velocity, *np.zeros(6)])
    for n in range(200):
        found = response.expected(STEP * n, setpoint(n), position if n == 0 else (9.0, 9.0, 9.0), velocity)
        assert found == pytest.approx(state[:3], abs=1e-6)

        state = solve_ivp(slope, (0.0, STEP), state, args=(setpoint(n),), rtol=1e-9, atol=1e-12).y[:, -1]


def test_an_invalid_setpoint_costs_one_sample() -> None:
    response = IndiResponse()
    response.expected(0.0, (math.nan, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    assert response.expected(STEP, (1.0, 0.0, 1.0), (0.2, 0.0, 1.0), (0.0, 0.0, 0.0)) == (0.2, 0.0, 1.0)
    assert math.isfinite(response.expected(2 * STEP, (1.0, 0.0, 1.0), (0.3, 0.0, 1.0), (0.0, 0.0, 0.0))[0])


def test_after_a_gap_or_a_step_back_in_time_the_response_starts_at_the_drone() -> None:
    response = IndiResponse()
    for time in (1.0, 1.0 + 1.01 * GAP, 0.5):
        assert response.expected(time, (5.0, 0.0, 1.0), (0.0, time, 1.0), (0.0, 0.0, 0.0)) == (0.0, time, 1.0)
    assert response.expected(0.9, (5.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))[0] > 0.1
