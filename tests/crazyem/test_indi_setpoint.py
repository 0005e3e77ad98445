"""Places for INDI: with them its outer loop asks for the reference's own acceleration and yaw rate."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.control.indi import PARAMETERS, IndiGains, place_ahead
from crazyem.control.trajectories import Reference

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
