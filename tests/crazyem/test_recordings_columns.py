"""Rows of a table, some at a time: the same as by a plain loop over all samples in order."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.recordings import Recording, SignalArray
from crazyem.recordings.columns import rows_of

STAMPS = st.sampled_from([0.0, -0.0, 0.01, math.nan])
HOSTS = st.sampled_from([math.nan, 1.7e9])


def signal(time: list[float], host: list[float], order: list[int]) -> SignalArray:
    n = len(time)
    return SignalArray(
        np.array(time, float), np.zeros((n, 1)), np.array(order, np.int64), np.array(host, float), np.zeros(n, bool)
    )


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Few stamps and few orders, so that many samples share them; orders that go back."""
    signals = {}
    for name in "abcd"[: draw(st.integers(1, 4))]:
        n = draw(st.integers(0, 12))
        lists = [draw(st.lists(kind, min_size=n, max_size=n)) for kind in (STAMPS, HOSTS, st.integers(0, 9))]
        order = sorted(lists[2]) if draw(st.booleans()) else lists[2]
        signals[name] = signal(lists[0], lists[1], order)
    return Recording("there", "made", signals)


def plain(recording: Recording) -> list[tuple[str, str, list[tuple[str, int]]]]:
    """[(stamp, host time, [(signal, sample)])] with a loop."""
    names = list(recording.signals)
    samples = [
        (int(array.order[i]), place, i)
        for place, array in enumerate(recording.signals.values())
        for i in range(array.time.size)
    ]
    rows: list[tuple[str, str, list[tuple[str, int]]]] = []
    last = -1
    for _, place, i in sorted(samples):
        array = recording.signals[names[place]]
        stamps = (array.time[i].hex(), array.host_time[i].hex())
        if not rows or stamps != rows[-1][:2] or place <= last:
            rows.append((*stamps, []))
        rows[-1][2].append((names[place], i))
        last = place
    return rows


@given(recordings(), st.integers(1, 6))
def test_rows_some_at_a_time_are_those_of_a_plain_loop(recording: Recording, count: int) -> None:
    found: list[tuple[str, str, list[tuple[str, int]]]] = []
    for rows in rows_of(recording, recording.signals, samples=count):
        begin = len(found)
        found += [(t.hex(), h.hex(), []) for t, h in zip(rows.time, rows.host_time, strict=True)]
        for name in recording.signals:
            for row, sample in zip(rows.row[name].tolist(), rows.sample[name].tolist(), strict=True):
                found[begin + row][2].append((name, sample))
    assert found == plain(recording)


@pytest.mark.parametrize("order", [np.arange(1000), np.zeros(1000, int), np.arange(1000)[::-1]])
def test_what_is_taken_at_once_is_bounded(order: np.ndarray) -> None:
    one = signal(np.arange(1000.0).tolist(), [math.nan] * 1000, order.tolist())
    parts = list(rows_of(Recording("there", "made", {"a": one}), ["a", "not there"], samples=10))
    assert sum(rows.time.size for rows in parts) == 1000
    if len(set(order.tolist())) > 1:  # samples of one order stay together
        assert max(rows.time.size for rows in parts) <= 10
    assert list(rows_of(Recording("there", "made", {}), ["a"])) == []
