"""Where the floor is under flights that do not show it: flights made elsewhere, whose rest is cut off."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from made_flight import made_flight

from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.diagnosis.flights.floor import with_common_floor
from crazyem.diagnosis.flights.recording_nuisances import nuisances_of_recordings

FLOORS = (0.05, 0.056, 0.06)


def flight(seed: int, ground: float, *, grounded: bool = True, above: float = 0.5) -> Flight:
    made = flight_of(fly(Hidden(), seed=seed, seconds=12.0), DRONE)
    y = made.y.copy()
    y[:, 2] += ground + above - y[:, 2].min()
    return replace(made, y=y, ground=ground if grounded else 0.0, grounded=grounded)


def test_a_recording_says_whether_it_shows_the_floor() -> None:
    whole = made_flight(seconds=12.0, seed=1)
    shown = flight_of(whole, DRONE)
    assert shown.grounded
    assert shown.ground == pytest.approx(whole.signals["position"].value[:50, 2].mean(), abs=1e-3)
    inside = {n: (a.time > 4.0) & (a.time < 9.0) for n, a in whole.signals.items()}
    cut = {
        n: replace(
            a, time=a.time[k], value=a.value[k], marked=a.marked[k], host_time=a.host_time[k], order=np.arange(k.sum())
        )
        for n, a in whole.signals.items() for k in (inside[n],)
    }  # fmt: skip
    assert not flight_of(replace(whole, signals=cut), DRONE).grounded


def test_a_flight_that_never_rests_stands_where_the_others_do() -> None:
    flights, unknown = [flight(k, g) for k, g in enumerate(FLOORS)], flight(3, 0.0, grounded=False)
    fitted, apart = with_common_floor(flights, [unknown])
    assert all(a is b for a, b in zip(fitted, flights, strict=True))
    assert apart[0].ground == pytest.approx(0.056)
    assert np.array_equal(apart[0].y, unknown.y)
    assert any("z = 0.056 m" in n for n in nuisances_of_recordings(fitted, apart)[-1].notices)
    (first, *_), _ = with_common_floor([unknown, *flights], [])
    assert first.ground == pytest.approx(0.056)


@pytest.mark.parametrize(
    "others", [(0.05,), (0.05, 0.3), (1.0, 1.01)], ids=["one alone", "floors that differ", "a floor above the flight"]
)
def test_where_the_others_do_not_tell_it_stays(others: tuple[float, ...]) -> None:
    unknown = flight(3, 0.0, grounded=False)
    _, apart = with_common_floor([flight(k, g) for k, g in enumerate(others)], [unknown])
    assert apart[0] is unknown


def test_without_positions_there_is_no_floor() -> None:
    blind = flight(3, 0.0, grounded=False)
    blind = replace(blind, y=np.where(np.arange(13) < 6, np.nan, blind.y))
    _, apart = with_common_floor([flight(k, g) for k, g in enumerate(FLOORS)], [blind])
    assert apart[0] is blind
