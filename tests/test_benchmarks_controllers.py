"""The controller-parameter benchmark: one seed of its own flights, judged as its table judges them."""

import pytest

from benchmarks.controller_parameters import flights, table

SEED = 9002  # none of those of the table


def test_indi_with_half_its_effectiveness_is_right_within_two_seconds() -> None:
    result = flights(SEED)["low"]()
    assert not result["crashed"]
    assert not result["reverted"]
    assert result["error_2s"] < 0.05


def test_the_table_says_what_came_out() -> None:
    low = {
        "crashed": False, "reverted": False, "within_s": 1.5, "error_2s": 0.02, "overshoot": -0.1, "worst_error": 0.5,
    }  # fmt: skip
    text = table({1: {"low": low, "ideal": {**low, "overshoot": -0.12}}})
    assert "|INDI, g1 × 0.5: 5 % reached|1.50 (1.50 to 1.50) s|2 s 1/1|" in text
    assert "|INDI, g1 × 0.5: overshoot less ideal|2.00 (2.00 to 2.00) %|10 % 1/1|" in text


@pytest.mark.slow
@pytest.mark.nightly
def test_the_velocity_errs_less_with_the_drag_and_the_height_with_mass_thrust() -> None:
    found = {name: flight() for name, flight in flights(SEED).items() if "drag" in name or "massThrust" in name}
    assert found["drag"]["error_m_s"] < 2 / 3 * found["no drag"]["error_m_s"]
    assert abs(found["massThrust"]["height_m"]) < 0.02 < abs(found["no massThrust"]["height_m"])
    assert abs(found["massThrust"]["mass_error"]) < 0.01


@pytest.mark.slow
def test_without_a_guard_a_wrong_inertia_crashes_it_and_with_one_nothing_is_written() -> None:
    """Seed 9001: inertia estimated at 0.3 of the true one, so g1 3.4 times too large."""
    assert flights(9001)["wrong inertia unguarded"]()["crashed"]
    guarded = flights(9001)["wrong inertia guarded"]()
    assert not guarded["crashed"]
    assert guarded["worst_error"] < 0.05
