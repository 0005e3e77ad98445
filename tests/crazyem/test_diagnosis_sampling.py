"""Streams that are faster than their filters, and commands that were sent between the logged ones."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import nuisances
from crazyem.diagnosis.fitting.sampling import unlogged_share
from crazyem.diagnosis.flights.flight import thinned
from crazyem.diagnosis.settings import RECORDINGS


def values_of(time: NDArray) -> NDArray:
    return np.arange(time.size, dtype=float)[:, None]


@pytest.mark.parametrize(("period", "every"), [(0.002, 5), (0.004, 2), (0.005, 2), (0.008, 1), (0.01, 1), (0.02, 1)])
@pytest.mark.parametrize("begin", [0.0, 3.7, 1.7e6])
def test_of_a_fast_stream_every_so_many_samples_count(period: float, every: int, begin: float) -> None:
    """Evenly spaced, exactly; with stamps that jitter by a tenth of a period, within one sample."""
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, 600)
    for by, away in ((0.0, 0.0), (1.0, float(every > 1))):
        time = begin + period * (np.arange(600) + by * jitter)
        kept, value = thinned(time, values_of(time))
        assert kept.size == pytest.approx(600 / every, rel=0.02)
        assert np.abs(np.diff(value[1:-1, 0]) - every).max() <= away
        assert np.array_equal(kept, time[value[:, 0].astype(int)])  # values stay with their stamps


@given(st.integers(0, 2**31), st.sampled_from([0.002, 0.004, 0.005]))
def test_where_samples_are_lost_no_interval_stays_empty_that_holds_one(seed: int, period: float) -> None:
    there = np.random.default_rng(seed).random(500) > 0.05
    time = (period * np.arange(500))[there]
    kept, _ = thinned(time, values_of(time))
    alone = np.diff(time) > RECORDINGS.sample_period  # gaps of the stream itself
    assert np.diff(kept).max() <= 2 * RECORDINGS.sample_period + np.diff(time).max() * alone.any() + period
    assert set(kept) <= set(time)


class Commands(SimpleNamespace):
    """Stands for a flight whose commands are (n, 4) thrusts [N] every `period` s."""

    __hash__ = object.__hash__


def commanded(thrust: NDArray, period: float, *, measured: bool = False, levelled: bool = False) -> Any:
    time = period * np.arange(len(thrust))
    inputs = SimpleNamespace(time=time, thrust=thrust, measured=measured)
    signals = frozenset({"position", "attitude", "body_rate"})
    return Commands(
        name="flight", time=time, inputs=inputs, y=np.zeros((time.size, 13)), signals=signals, coarse=False,
        levelled=levelled, fused=False, differs=False,
    )  # fmt: skip


WHITE = 0.07 + 0.001 * np.random.default_rng(1).standard_normal((6000, 4))


@pytest.mark.parametrize(("period", "missed"), [(0.002, 0.0), (0.004, 0.5), (0.01, 0.8), (0.02, 0.9)])
def test_of_white_commands_all_but_the_logged_ones_are_missed(period: float, missed: float) -> None:
    """Half of white power is above half of the Nyquist frequency: twice that, squared, is one."""
    assert unlogged_share([commanded(WHITE, period)], DRONE) == pytest.approx(missed, rel=0.15)


def test_smooth_commands_and_measured_speeds_miss_nothing() -> None:
    time = 0.01 * np.arange(3000)
    swing = 0.07 + 0.005 * np.sin(2 * np.pi * 3.0 * time)[:, None] * np.array([1.0, 1.0, -1.0, -1.0])
    assert unlogged_share([commanded(swing, 0.01)], DRONE) < 1e-6
    assert unlogged_share([commanded(WHITE, 0.01, measured=True)], DRONE) == 0.0


def priors(flight: Any) -> dict[str, NDArray]:
    data: Any = SimpleNamespace(flights=[flight], constrained=frozenset())
    found = nuisances(data, Point(DRONE, {}, start_noise()), ())
    return {c.effect: np.array(precision) ** -0.5 for c, precision in found}


def test_what_was_not_logged_widens_the_priors_of_what_turns_the_drone() -> None:
    flight = commanded(WHITE, 0.01)
    share, sd = unlogged_share([flight], DRONE), priors(flight)
    assert sd["inertia"] / DRONE.inertia == pytest.approx(np.hypot([0.01, 0.01, 0.02], share))
    assert sd["rate_damping"] == pytest.approx(np.full(3, 3e-4 * share))
    assert sd["input_delay"] == pytest.approx(np.hypot(2e-3, 0.01 * share))
    whole = priors(commanded(WHITE, 0.002))
    assert whole["inertia"] / DRONE.inertia == pytest.approx([0.01, 0.01, 0.02])
    assert "rate_damping" not in whole


def test_commands_between_samples_are_free_where_the_log_is_slower_than_the_loop() -> None:
    assert priors(commanded(WHITE, 0.01))["sampled_commands"] == pytest.approx([0.4, 0.4])
    assert "sampled_commands" not in priors(commanded(WHITE, 0.002))
    assert "sampled_commands" not in priors(commanded(WHITE, 0.01, measured=True))


def test_a_battery_without_a_voltage_may_sag_and_run_down() -> None:
    assert not {"thrust_curve", "battery_sag"} & priors(commanded(WHITE, 0.01)).keys()
    sd = priors(commanded(WHITE, 0.01, levelled=True))
    assert sd["thrust_curve"] == pytest.approx(0.15)
    assert sd["battery_sag"] == pytest.approx(1.5e-3)
