"""Streams that somebody resampled by straight lines: lost packets are found, slow streams get their samples back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.recordings.csv.signals import corners, interpolated_rows


@given(st.integers(0, 2**32 - 1), st.integers(2, 8))
def test_exactly_the_straight_runs_are_found(seed, gap):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.009, 0.011, 50))
    values = rng.normal(size=(50, 3))
    inner = slice(10, 10 + gap)
    for c in range(3):
        values[inner, c] = np.interp(time[inner], time[[9, 10 + gap]], values[[9, 10 + gap], c])
    found = np.flatnonzero(interpolated_rows(time, np.round(values, 9)))
    assert found.tolist() == list(range(9, 11 + gap))


def test_constant_stretches_are_no_evidence():
    time = 0.01 * np.arange(30)
    assert not interpolated_rows(time, np.zeros((30, 4))).any()
    assert not interpolated_rows(time[:2], np.zeros((2, 4))).any()
    one_moves = np.zeros((30, 2))
    one_moves[:, 0] = np.linspace(0, 1, 30)
    assert interpolated_rows(time, one_moves).all()


# --- streams drawn by straight lines ---------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(4, 12))
def test_a_drawn_stream_gets_its_samples_back(seed, every):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.0099, 0.0101, 400))
    knots = np.arange(time[0] - 0.01 * every, time[-1] + 0.02 * every, 0.01 * every) + rng.uniform(0, 0.01)
    levels = 4.0 + np.cumsum(rng.choice([-2, -1, 1, 2], knots.size) * 5.3e-3 * rng.uniform(0.5, 1.0, knots.size))
    found = corners(time, np.round(np.interp(time, knots, levels), 9))
    inside = (knots > time[1]) & (knots < time[-2])
    slopes = np.diff(levels) / np.diff(knots)
    told = np.abs(np.diff(slopes, prepend=slopes[0], append=slopes[-1])) > 1e-3  # V/s; a straight line has no corner
    wanted = np.flatnonzero(inside & told[: knots.size])
    place = np.searchsorted(found.time, knots[wanted] - 1e-3)
    assert found.time[place] == pytest.approx(knots[wanted], abs=2e-5)
    assert found.value[place] == pytest.approx(levels[wanted], abs=1e-6)
    assert (np.diff(found.row) > 0).all()
    # and nothing else is taken for a sample. Two lines of rounded rows (5e-10) meet within 2e-9 over the bend. A corner
    # is put on a row if the next row is off its neighbours' line, by half of way times bend, no more than 4e-9 + 1e-9
    nearest = np.abs(found.time[:, None] - knots).argmin(axis=1)
    bend = np.abs(np.diff(slopes))[nearest - 1]
    assert (np.abs(found.time - knots[nearest]) * bend).max() < 2 * 5e-9
    drawn = np.interp(time, found.time, found.value)[found.row[0] + 1 : found.row[-1]]
    assert drawn == pytest.approx(np.interp(time, knots, levels)[found.row[0] + 1 : found.row[-1]], abs=1.05e-8)


def test_streams_that_nobody_drew_keep_their_rows():
    rng = np.random.default_rng(3)
    time, noise = 0.01 * np.arange(300), rng.normal(size=300)
    found = corners(time, noise)
    assert found.row.tolist() == list(range(300))
    assert found.value.tolist() == noise.tolist()
    still = corners(time, np.full(300, 3.7))
    assert (still.row.tolist(), still.value.tolist()) == ([0], [3.7])
    short = corners(time[:3], noise[:3])
    assert short.value.tolist() == noise[:3].tolist()
