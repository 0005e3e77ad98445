"""When a drone is in the air by its height alone, by its flag, and beyond what is known of its rotors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import array_of, made_flight

from crazyem.recordings import Recording
from crazyem.recordings.airborne import airtime

TIME = np.arange(0.0, 40.0, 0.01)


def placed(z: np.ndarray, *, noise: float, seed: int = 0, wander: float = 0.05) -> Recording:
    """A recording of a position alone; sideways it wanders where `z` is off the support."""
    rng = np.random.default_rng(seed)
    away = np.abs(z - z[0]) > 1e-6
    x = np.where(away, wander * np.sin(TIME), 0.0)
    value = np.column_stack([x, 0.0 * x, z]) + noise * rng.standard_normal((TIME.size, 3))
    return Recording("made", "made", {"position": array_of("position", TIME, value)})


@given(
    table=st.floats(-2.0, 2.0), climb=st.floats(0.2, 2.0), noise=st.sampled_from([1e-4, 1e-3, 5e-3]),
    start=st.floats(4.0, 8.0), lasting=st.floats(6.0, 12.0), carried=st.floats(0.2, 1.0), seed=st.integers(0, 99),
)  # fmt: skip
def test_a_table_is_a_floor_and_carrying_is_no_flight(
    table: float, climb: float, noise: float, start: float, lasting: float, carried: float, seed: int
) -> None:
    up = np.clip((TIME - start) / 2.0, 0.0, 1.0) - np.clip((TIME - start - lasting + 2.0) / 2.0, 0.0, 1.0)
    hover = 0.01 * np.sin(2.0 * TIME) * (up > 0.2)
    down = np.clip((TIME - 30.0) / 2.0, 0.0, 1.0) * carried
    air = airtime(placed(table + climb * up + hover - down, noise=noise, seed=seed))
    ((begin, end),) = air.flown
    assert begin == pytest.approx(start + 0.06 / climb, abs=0.2)
    assert end == pytest.approx(start + lasting - 0.06 / climb, abs=0.2)
    assert air.ground == pytest.approx(table, abs=0.005)
    assert air.by_height_alone


def test_what_only_stands_or_is_put_lower_never_flew() -> None:
    still = airtime(placed(0.0 * TIME + 0.7, noise=2e-4))
    lower = airtime(placed(0.7 - 0.3 * np.clip((TIME - 20.0) / 2.0, 0.0, 1.0), noise=2e-4))
    for air in (still, lower):
        assert air.flown == ()
        assert "never rose" in air.reason


def test_a_flag_counts_from_its_first_to_its_last_sample() -> None:
    good = made_flight(seconds=20.0)
    whole = airtime(replace(good, signals={k: a for k, a in good.signals.items() if k != "flying"})).flown
    time = np.arange(0.0, 20.0)
    says = array_of("flying", time, ((time >= 6.0) & (time <= 12.0)).astype(float)[:, None])
    air = airtime(replace(good, signals={**good.signals, "flying": says}))
    assert air.flown == ((6.0, 12.0),)
    assert (whole[0][0] < 6.0, whole[-1][1] > 12.0) == (True, True)
    never = airtime(replace(good, signals={**good.signals, "flying": replace(says, value=0.0 * says.value)}))
    assert (never.flown, never.reason) == ((), "the flying flag never says so")


def test_the_height_tells_on_where_the_rotors_are_known_no_more() -> None:
    good = made_flight(seconds=20.0)
    whole = airtime(good).flown
    command = good.signals["motor_command"]
    cut = command.rows(slice(0, int(np.searchsorted(command.time, 9.0))))
    signals = {**good.signals, "motor_command": cut}
    signals.pop("flying")
    air = airtime(replace(good, signals=signals))
    assert air.flown[-1][1] == pytest.approx(whole[-1][1], abs=0.5)
    assert air.judged_by == ("motor_command", "position")


def test_nothing_that_tells_counts_as_all_of_it() -> None:
    good = made_flight(seconds=20.0)
    air = airtime(replace(good, signals={"attitude": good.signals["attitude"]}))
    assert not air.known
    assert air.seconds == pytest.approx(20.0, abs=0.05)
    assert airtime(Recording("empty", "made", {})).flown == ()
