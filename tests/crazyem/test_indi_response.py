"""INDI: the expected response of a drone against a numerical integration, and the places that it is sent."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from benchmarks.wire_flight import LOG_PERIOD
from crazyem.control.indi import GAP, PARAMETERS, IndiGains, IndiResponse, place_ahead
from crazyem.control.trajectories import Reference

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


# --- places ahead: with them the outer loop asks for the reference's own acceleration and yaw rate ---


vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
gains = st.floats(0.5, 10.0)


@given(vectors, vectors, vectors, st.floats(-1, 1), st.floats(-2, 2), gains, gains, gains)
def test_on_the_reference_the_loops_ask_for_its_acceleration(p, v, a, yaw, rate, k_p, k_v, k_r) -> None:
    g = IndiGains((k_p,) * 3, (k_v,) * 3, k_r)
    *place, heading = place_ahead(Reference(p, v, a, yaw=yaw, yaw_rate=rate), g)
    asked = [k_v * (k_p * (w - x) - s) for w, x, s in zip(place, p, v, strict=True)]
    assert asked == pytest.approx(a, abs=1e-9)
    assert k_r * (heading - yaw) == pytest.approx(rate, abs=1e-9)


def test_gains_are_the_drones_own_and_senseless_ones_those_at_boot() -> None:
    told = dict(zip(PARAMETERS, (2.0, 2.5, 3.0, 6.0, 0.0, -1.0, 4.0), strict=True))
    assert IndiGains.of(told) == IndiGains((2.0, 2.5, 3.0), (6.0, 5.0, 5.0), 4.0)
    assert IndiGains.of({}) == IndiGains()


def test_at_rest_the_place_is_the_reference() -> None:
    assert place_ahead(Reference((1.0, 2.0, 3.0), yaw=0.5), IndiGains()) == (1.0, 2.0, 3.0, 0.5)
